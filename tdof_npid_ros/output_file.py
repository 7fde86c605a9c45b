"""Outputs of a long run: refused at its start if they could not be written at its end."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

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
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error
