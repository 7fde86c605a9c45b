"""Files that are read: looked at before they are opened, and never read beyond a limit."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any, BinaryIO, Final

from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.yaml_text import YamlTextError, load_yaml

LARGEST_TEXT: Final = 4 << 20  # bytes of a file that is read whole: a hundred times any parameter file

_KINDS: Final = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class InputError(ValueError):
    """A file that cannot be read. The message is one line: which, why."""


def check_file(path: Path) -> os.stat_result:
    """Make sure that a path is an ordinary file, without opening it: a pipe would wait for a writer for ever, and to
    open a device may already do something. A link to a file serves.

    Returns:
        The file's status.

    Raises:
        InputError: it is none.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{one_line(path)} cannot be read: {error.strerror}") from error
    except ValueError as error:  # a zero byte in its name
        raise InputError(f"{one_line(path)} cannot be read: {error}") from error
    if not stat.S_ISREG(status.st_mode):
        kind = next((kind for test, kind in _KINDS if test(status.st_mode)), "something else")
        raise InputError(f"{one_line(path)} is {kind}: it must be a file")
    return status


def open_file(path: Path) -> BinaryIO:
    """Open an ordinary file for reading; see `check_file`.

    Raises:
        InputError: it is none, or cannot be opened.
    """
    check_file(path)
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK
    try:
        descriptor = os.open(path, flags)
    except OSError as error:
        raise InputError(f"{one_line(path)} cannot be read: {error.strerror}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):  # it has been replaced since we looked
        os.close(descriptor)
        raise InputError(f"{one_line(path)} is not a file any more")
    return os.fdopen(descriptor, "rb")


def read_file(path: Path, largest: int = LARGEST_TEXT) -> bytes:
    """The content of an ordinary file.

    Raises:
        InputError: it is none, cannot be read, or is larger than `largest` bytes.
    """
    with open_file(path) as file:
        try:
            # One byte more than allowed: what a file's status says of its size need not be true.
            content = file.read(min(os.fstat(file.fileno()).st_size, largest) + 1)
        except OSError as error:
            raise InputError(f"{one_line(path)} cannot be read: {error.strerror}") from error
    if len(content) > largest:
        raise InputError(f"{one_line(path)} is larger than {largest / 2**20:g} MiB: it cannot be what is wanted here")
    return content


def read_yaml(path: Path) -> Any:
    """The content of a YAML file, plain values only; see `load_yaml`.

    Raises:
        InputError: no ordinary file, too large, not UTF-8, or not YAML within the limits.
    """
    try:
        return load_yaml(read_file(path).decode("utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{one_line(path)} is not YAML: it is not UTF-8 at byte {error.start}") from error
    except YamlTextError as error:
        raise InputError(f"{one_line(path)} is not YAML: {error}") from error
