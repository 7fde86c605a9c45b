"""What every kind of bag file offers to the reader."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, Protocol

from tdof_npid_ros.bag import schema
from tdof_npid_ros.bag.definition import Definition, parse
from tdof_npid_ros.bag.errors import BagError, shown
from tdof_npid_ros.bag.qos import QosProfile, qos_profiles
from tdof_npid_ros.bag.scan import Table
from tdof_npid_ros.bag.schema import ROS2MSG

CDR_DEFINITIONS: Final = frozenset((ROS2MSG, "ros2idl", ""))  # how definitions of messages in CDR are written


@dataclass(frozen=True)
class TopicInfo:
    """A topic as a bag holds it.

    Attributes:
        name: in full.
        type: for example "sensor_msgs/msg/JointState"; empty where the bag does not tell.
        count: messages.
        definition: of the type, as text.
        encoding: how the definition is written if the messages are in CDR, else how the messages are.
        qos: profiles that its publishers offered (YAML); empty where the bag does not tell.
        type_hash: RIHS01; likewise.
        problem: why its messages cannot be told apart, for example that they are of two types; mostly empty.
    """

    name: str
    type: str
    count: int
    definition: str
    encoding: str
    qos: str
    type_hash: str
    problem: str = ""

    @property
    def profiles(self) -> list[QosProfile]:
        """The QoS profiles, whichever distribution wrote them."""
        return qos_profiles(self.qos)

    def joined(self, other: TopicInfo) -> TopicInfo:
        """This topic with what another file, or another channel, holds of it."""
        if not other.count:
            return self
        if not self.count:
            return replace(other, problem=self.problem or other.problem)
        problem = self.problem or other.problem
        if not problem and self.type != other.type:
            problem = f"it is of two types, {shown(self.type)} and {shown(other.type)}"
        if not problem and self.encoding != other.encoding and not {self.encoding, other.encoding} <= CDR_DEFINITIONS:
            problem = f"it is in two encodings, {shown(self.encoding)} and {shown(other.encoding)}"
        if not problem and _differ(self, other):
            problem = f"it has two definitions of its type {shown(self.type)}"
        best = self if self.definition or not other.definition else other
        return replace(best, count=self.count + other.count, qos=self.qos or other.qos, problem=problem)

    def fields(self) -> Definition:
        """What its messages hold; by the installed type where the bag has no definition of it.

        Raises:
            BagError: its messages cannot be decoded, with the reason.
        """
        if self.problem:
            raise BagError(self.problem)
        if self.encoding not in CDR_DEFINITIONS:
            is_ros1 = self.encoding == "ros1"
            advice = ": convert the ROS 1 bag with `rosbags-convert` (pip install rosbags)" if is_ros1 else ""
            raise BagError(f"its messages are in {shown(self.encoding) or 'no known encoding'}, not in CDR{advice}")
        if self.encoding == ROS2MSG and self.definition.strip():
            return parse(self.type, self.definition)
        try:
            installed = parse(self.type, schema.definition(self.type))
        except BagError as error:
            if self.encoding == ROS2MSG:
                return parse(self.type, self.definition)  # a message without fields
            raise BagError(f"the bag holds no definition of its type in ros2msg, and {error}") from None
        if self.type_hash and schema.type_hash(self.type) != self.type_hash:
            raise BagError(f"the bag holds no definition of its type {shown(self.type)}, and another one is installed")
        return installed


def _differ(one: TopicInfo, other: TopicInfo) -> bool:
    if one.definition == other.definition or not one.definition or not other.definition:
        return False
    try:
        return one.fields().types != other.fields().types
    except BagError:
        return True


class Piece(NamedTuple):
    """Messages that lie together in a file, with log times from `start_ns` to `end_ns`; `load` reads them."""

    start_ns: int
    end_ns: int
    load: Callable[[], Table]


class Storage(Protocol):
    """An open bag file.

    Attributes:
        name: its path.
        topics: by name.
        start_ns, end_ns: log times of the first and last message; 0 without messages.
        metadata: named key-value records, in file order.
        missing: for each thing that a crash has cut off, one line; empty for a whole file.
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
