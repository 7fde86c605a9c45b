"""Outputs of a long run: refused at its start if they could not be written at its end."""

from __future__ import annotations

import atexit
import fcntl
import hashlib
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

ROOM = 65536  # bytes: more than a result or a checkpoint of any population takes


class OutputError(ValueError):
    """A file or folder that must not or cannot be written. The message is one line: which, why."""


def check_outputs(outputs: Sequence[Path], inputs: Sequence[Path] = ()) -> None:
    """Make sure that files can be written, and that each is another one than the inputs and the other outputs.

    Raises:
        OutputError: they cannot, or one is not.
    """
    taken = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in taken:
            raise OutputError(f"{path}: inputs and outputs must be different files")
        taken.add(path.resolve())
    for path in outputs:
        check_writable(path)


def new_folder(path: Path) -> Path:
    """The path of a folder that is not there yet.

    Raises:
        OutputError: it is.
    """
    if path.exists():
        raise OutputError(f"{path} exists already and is not overwritten: choose another folder")
    return path


_held: dict[Path, IO[str]] = {}  # locks of this process


def hold(path: Path) -> None:
    """Make sure that no other process on this machine writes this file or folder before this process has ended.

    The lock is a file among the temporary ones, for the file itself may be replaced again and again.

    Raises:
        OutputError: another process holds it.
    """
    name = hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:16]
    lock = Path(tempfile.gettempdir()) / f"tdof-npid-{os.getuid()}-{name}.lock"
    if lock in _held:
        return
    try:
        file = lock.open("a", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path} cannot be locked: {lock}: {error.strerror}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise OutputError(f"{path} is being written by another run: wait for its end, or give another path") from None
    _held[lock] = file
    atexit.register(lock.unlink, missing_ok=True)


def check_writable(path: Path) -> None:
    """Make sure that a file can be written, and that the disk has room for it; it stays as it is.

    Raises:
        OutputError: it cannot.
    """
    try:
        if path.exists():
            with path.open("r+b"):
                pass
        with tempfile.TemporaryFile(dir=path.parent) as probe:
            probe.write(b"\0" * ROOM)
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        why = error.strerror or "it is a pipe or the like: give a file"
        raise OutputError(f"{path} cannot be written: {why}") from error
