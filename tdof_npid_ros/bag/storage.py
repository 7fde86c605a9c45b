"""What every kind of bag file offers to the reader."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from tdof_npid_ros.bag.scan import Table


@dataclass(frozen=True)
class TopicInfo:
    """A topic: `count` messages of a type, its `definition` (`ros2msg`), QoS profiles (YAML) and RIHS01 hash."""

    name: str
    type: str
    count: int
    definition: str
    encoding: str
    qos: str
    type_hash: str


class Piece(NamedTuple):
    """Messages that lie together in a file, with log times from `start_ns` to `end_ns`; `load` reads them."""

    start_ns: int
    end_ns: int
    load: Callable[[], Table]


class Storage(Protocol):
    """An open bag file.

    Attributes
    ----------
    topics
        By name.
    start_ns, end_ns
        Log times of the first and last message; 0 without messages.
    metadata
        Named key-value records, in file order.
    missing
        For each thing that a crash has cut off, one line; empty for a whole file.
    """

    name: str
    topics: dict[str, TopicInfo]
    start_ns: int
    end_ns: int
    metadata: list[tuple[str, dict[str, str]]]
    missing: list[str]

    @property
    def topic_of(self) -> Mapping[int, str]:
        """Return topic names by the channel numbers in tables."""

    def pieces(self) -> list[Piece]:
        """Return the file's messages, piece by piece. Loading raises BagError when a piece is damaged."""

    def close(self) -> None:
        """Close the file."""
