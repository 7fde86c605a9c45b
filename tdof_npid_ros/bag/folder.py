"""Which files make a bag: a file stands for itself, a folder for what its `metadata.yaml` lists."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from tdof_npid_ros.bag import metadata
from tdof_npid_ros.bag.errors import BagError, choices, shown

SQLITE: Final = ".db3"
_MOST_LINES: Final = 50  # about files that are not read
_SUFFIXES: Final = (".mcap", SQLITE)
_OTHERS: Final = (".bag", ".zstd", ".zst", ".lz4", ".gz")  # of which opening them says what to do


@dataclass(frozen=True)
class BagFolder:
    """A bag as it lies on the disk.

    Attributes:
        files: in the order they were written.
        missing: for each file that is listed and not there, or not to be read, one line.
        custom_data: what `metadata.yaml` holds for users.
    """

    files: tuple[Path, ...]
    missing: tuple[str, ...] = ()
    custom_data: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path, *, salvage: bool = False) -> BagFolder:
        """Find a bag's files: those that `metadata.yaml` lists, or all of them where it lists none.

        With `salvage`, all of them as well where `metadata.yaml` is damaged.

        Raises:
            BagError: there is no bag at this path, or it is compressed as a whole.
        """
        if not path.is_dir():
            return cls((path,))
        missing: tuple[str, ...] = ()
        try:
            information = metadata.read_information(path)
        except BagError as error:
            if not salvage:
                raise
            information, missing = {}, (str(error),)
        _check_compression(path, information)
        listed = information.get("relative_file_paths")
        custom = information.get("custom_data")
        custom_data = {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}
        if not isinstance(listed, list) or not listed:
            return cls(_all_files(path), missing, custom_data)
        files, absent = _listed_files(path, [str(name) for name in listed])
        return cls(files, (*missing, *absent), custom_data)


def _check_compression(path: Path, information: Mapping[str, Any]) -> None:
    mode = str(information.get("compression_mode") or "NONE").upper()
    if mode == "FILE":
        how = "unpack its files with `zstd -d` and open them one by one, or delete metadata.yaml then"
    else:
        how = "unpack it with `ros2 bag convert`"
    if mode != "NONE":
        raise BagError(f"{path}: is compressed by rosbag2 (compression mode {shown(mode)}): {how}")


def _all_files(path: Path) -> tuple[Path, ...]:
    try:
        there = [file for file in path.iterdir() if file.is_file()]
    except OSError as error:
        raise BagError(f"cannot open {path}: {error.strerror}: give a bag folder or a file") from None
    for suffixes in (_SUFFIXES, _OTHERS):
        files = sorted((file for file in there if file.suffix in suffixes), key=_by_number)
        if files:
            return tuple(files)
    raise BagError(f"{path}: no .mcap or .db3 file in it: give a bag folder or a file")


def _by_number(file: Path) -> list[tuple[int, str]]:
    """So that 10 comes after 9."""
    return [(int(part[:18]), "") if part.isdecimal() else (0, part) for part in re.split(r"([0-9]+)", file.name)]


def _listed_files(path: Path, names: list[str]) -> tuple[tuple[Path, ...], list[str]]:
    """Return the listed files that are there, and a line for each that is not."""
    files: dict[Path, None] = {}
    absent = []
    where = f"{path}: {metadata.FILE_NAME} lists"
    for name in dict.fromkeys(names):
        relative = PurePosixPath(name)
        if relative.is_absolute() or ".." in relative.parts or "\0" in name:
            absent.append(f"{where} {shown(name)}, which lies outside of the bag: it is not read")
            continue
        file = path / relative
        if relative.parts[:1] == (path.resolve().name,) and not file.exists():
            file = path.joinpath(*relative.parts[1:])  # as rosbag2 wrote it until Foxy
        if file.exists():
            files[file] = None
        else:
            absent.append(f"{where} {shown(name)}, which is not there")
    if not files:
        there = sorted(file.name for file in path.iterdir() if file.suffix in _SUFFIXES)
        raise BagError(
            f"{where} {choices(names)}, and none of them is there to be read: it holds {choices(there)};"
            f" delete {metadata.FILE_NAME} to open what is there"
        )
    more = len(absent) - _MOST_LINES
    return tuple(files), [*absent[:_MOST_LINES], f"{where} {more} more that are not read"] if more > 0 else absent
