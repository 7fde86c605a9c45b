"""Message definitions and type hashes, from the interface packages installed on this machine."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Final

from tdof_npid_ros.bag.definition import SEPARATOR, is_nested, parse_fields
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.interfaces import InterfaceError, installed_file

ROS2MSG: Final = "ros2msg"  # how definitions are written here


def _interface_file(type_name: str, suffix: str) -> Path:
    try:
        return installed_file(type_name, suffix)
    except InterfaceError as error:
        raise BagError(str(error)) from None


@cache
def definition(type_name: str) -> str:
    """Return the full definition of a type, all nested types included, as rosbag2 stores it (`ROS2MSG`).

    Args:
        type_name: for example "sensor_msgs/msg/JointState".

    Raises:
        BagError: the type, or one it contains, is not installed or cannot be read.
    """
    seen: set[str] = set()

    def expand(name: str) -> str:
        path = _interface_file(name, ".msg")
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise BagError(f"cannot read {path}: {error}; install its package again") from None
        fields = parse_fields(text, name.split("/", maxsplit=1)[0], str(path))
        parts = [text]
        for nested in sorted({field.type for field in fields if is_nested(field.type)}):
            if nested not in seen:
                seen.add(nested)
                parts.append(f"\n{SEPARATOR}\nMSG: {nested}\n{expand(nested)}")
        return "".join(parts)

    return expand(type_name)


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type, for example "RIHS01_a13e…".

    Raises:
        BagError: the type is not installed, or its description file is damaged.
    """
    path = _interface_file(type_name, ".json")
    try:
        hashes = json.loads(path.read_text(encoding="utf-8"))["type_hashes"]
        return next(str(entry["hash_string"]) for entry in hashes if entry["type_name"] == type_name)
    except (OSError, ValueError, KeyError, TypeError, StopIteration):
        raise BagError(f"cannot read the type hash of {type_name!r} from {path}: install its package again") from None
