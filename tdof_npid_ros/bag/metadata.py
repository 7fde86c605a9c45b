"""`metadata.yaml`, the table of contents that rosbag2 keeps beside a bag's files (version 9)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml

from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.qos import qos_dicts
from tdof_npid_ros.input_file import InputError, read_file
from tdof_npid_ros.yaml_text import YamlTextError, load_yaml

FILE_NAME: Final = "metadata.yaml"
VERSION: Final = 9

_NO_START: Final = 2**63 - 1  # what rosbag2 writes for a bag without messages


@dataclass(frozen=True)
class TopicEntry:
    """A topic in `metadata.yaml`; `qos` is the text of its QoS profiles."""

    name: str
    type: str
    qos: str
    type_hash: str
    count: int


@dataclass(frozen=True)
class FileEntry:
    """A file in `metadata.yaml`; times are log times in nanoseconds."""

    name: str
    start_ns: int
    end_ns: int
    count: int


@dataclass(frozen=True)
class BagMetadata:
    """All that `metadata.yaml` says."""

    topics: Sequence[TopicEntry]
    files: Sequence[FileEntry]
    custom_data: Mapping[str, str] = field(default_factory=dict)

    def as_yaml(self) -> str:
        """Return the text of the file."""
        filled = [file for file in self.files if file.count]
        start_ns = min((file.start_ns for file in filled), default=_NO_START)
        end_ns = max((file.end_ns for file in filled), default=_NO_START)
        information = {
            "version": VERSION,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": end_ns - start_ns},
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "message_count": sum(file.count for file in self.files),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": qos_dicts(topic.qos),
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.count,
                }
                for topic in self.topics
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.name for file in self.files],
            "files": [
                {
                    "path": file.name,
                    "starting_time": {"nanoseconds_since_epoch": file.start_ns if file.count else _NO_START},
                    "duration": {"nanoseconds": file.end_ns - file.start_ns if file.count else 0},
                    "message_count": file.count,
                }
                for file in self.files
            ],
            "custom_data": dict(self.custom_data) or None,
            "ros_distro": os.environ.get("ROS_DISTRO", "jazzy"),
        }
        return yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)


def write(folder: Path, metadata: BagMetadata) -> None:
    """Write `metadata.yaml`, whole or not at all.

    Raises:
        OSError: as the file system says.
    """
    partial = folder / f"{FILE_NAME}.tmp"
    with partial.open("w", encoding="utf-8") as file:
        file.write(metadata.as_yaml())
        file.flush()
        os.fsync(file.fileno())
    partial.replace(folder / FILE_NAME)


def read_information(folder: Path) -> dict[str, Any]:
    """Return what `metadata.yaml` says, empty when there is none or it was cut short by a crash.

    Raises:
        BagError: the file is no rosbag2 metadata or cannot be read.
    """
    path = folder / FILE_NAME
    try:
        path.lstat()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise BagError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        text = read_file(path).decode("utf-8")
    except InputError as error:
        raise BagError(str(error)) from None
    except UnicodeDecodeError:
        raise _no_metadata(path) from None
    try:
        content = load_yaml(text)
        information = content["rosbag2_bagfile_information"] if content else {}
    except (YamlTextError, TypeError, KeyError):
        raise _no_metadata(path) from None
    if not isinstance(information, dict):
        raise _no_metadata(path)
    return information


def _no_metadata(path: Path) -> BagError:
    return BagError(f"{path}: no valid rosbag2 metadata: delete it, the bag opens without")
