"""The loop's signals as they are on the wire: sensor_msgs/msg/JointState in CDR, read and written without rclpy's
message; and the labels that they bear in `header.frame_id`.

To build that message, and to take it apart, costs rclpy more than a step of the loop costs plant and controller
together.
What turns at every step goes this way; everything else publishes ordinary messages.
"""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
SECOND: Final = 1_000_000_000  # ns
_STAMP: Final = 4  # where header.stamp is; places are aligned as counted from here
_LABELS: Final = 12  # where header.frame_id is, and name after it
NO_VALUES = np.empty(0)


NO_PLAN: Final = "-"  # in a label, in place of a plan's digest
_DIGEST: Final = re.compile("[0-9a-f]{12}")
_LABEL: Final = re.compile(r"(?:([0-9a-f]{12})|-)/([0-9a-z]+)\.([0-9]{1,18})")
_OLD_LABEL: Final = re.compile(r"([0-9a-f]{12})/([0-9]{1,18})")  # <plan>/<number>, in recordings of before 2027
_REMEMBERED: Final = 256  # labels that need not be parsed again; at any time a loop has two


class EpisodeLabel(NamedTuple):
    """Which episode an output of our plant belongs to: `<plan, or ->/<activation>.<number>` in `header.frame_id`.

    A label that is new says that the plant has begun from its initial state.

    Attributes:
        plan: digest of the plan that the plant follows in lockstep; empty where setpoint and disturbance are live.
        activation: of the plant, another one each time; empty in labels of the old form, `<plan>/<number>`.
        number: counts the episodes and resets of the activation, from 1.
    """

    plan: str
    activation: str
    number: int

    @staticmethod
    def parse(text: str) -> EpisodeLabel | None:
        """The label that a text is; None if it is anything else, a robot's frame for one."""
        return _parsed_label(text)

    @staticmethod
    def named_in(frame_id: str) -> EpisodeLabel | None:
        """The episode that an output's or an answer's `header.frame_id` names."""
        return _parsed_label(frame_id) or _parsed_answer(frame_id).episode

    def __str__(self) -> str:
        if not self.activation:
            return f"{self.plan}/{self.number}"
        return f"{self.plan or NO_PLAN}/{self.activation}.{self.number}"

    def follows(self, other: EpisodeLabel) -> bool:
        """Whether this is a later episode of the same activation."""
        return self.activation == other.activation and self.number > other.number


class AnswerLabel(NamedTuple):
    """What an answer was computed with and for: `<parameters>`, or `<parameters> <episode>`, in `header.frame_id`.

    Attributes:
        parameters: their digest.
        episode: of the output that is answered; None for a robot's.
    """

    parameters: str
    episode: EpisodeLabel | None = None

    @property
    def is_ours(self) -> bool:
        """Whether it begins with what a digest of parameters is; a robot's frames do not."""
        return _DIGEST.fullmatch(self.parameters) is not None

    @staticmethod
    def parse(text: str) -> AnswerLabel:
        """The label that an answer's `header.frame_id` is."""
        return _parsed_answer(text)

    def __str__(self) -> str:
        return self.parameters if self.episode is None else f"{self.parameters} {self.episode}"


@lru_cache(_REMEMBERED)
def _parsed_label(text: str) -> EpisodeLabel | None:
    if found := _LABEL.fullmatch(text):
        plan, activation, number = found.groups()
        return EpisodeLabel(plan or "", activation, int(number))
    if found := _OLD_LABEL.fullmatch(text):
        return EpisodeLabel(found[1], "", int(found[2]))
    return None


@lru_cache(_REMEMBERED)
def _parsed_answer(text: str) -> AnswerLabel:
    parameters, _, episode = text.partition(" ")
    return AnswerLabel(parameters, _parsed_label(episode))


class _Order(NamedTuple):
    """How numbers are written in a byte order."""

    stamp: struct.Struct
    length: struct.Struct
    float: np.dtype

    @classmethod
    def of(cls, sign: str) -> _Order:
        return cls(struct.Struct(f"{sign}iI"), struct.Struct(f"{sign}I"), np.dtype(f"{sign}f8"))


_ORDERS: Final = {b"\0\0": _Order.of(">"), b"\0\1": _Order.of("<")}  # plain CDR, by its first two bytes
_OWN_HEAD: Final = b"\0\1" if sys.byteorder == "little" else b"\0\0"
_OWN_START: Final = _OWN_HEAD + b"\0\0"
_OWN: Final = _ORDERS[_OWN_HEAD]


class Sample(NamedTuple):
    """One message of a signal.

    Attributes:
        stamp_ns: header.stamp.
        frame_id: header.frame_id.
        name: (names,).
        position, velocity, effort: each (lanes,), or empty; the sample's own memory.
    """

    stamp_ns: int
    frame_id: str
    name: tuple[str, ...]
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


class SignalReader:
    """Reads the messages of one topic, whose frame, names and numbers of values are mostly as in the message before."""

    def __init__(self) -> None:
        self._order = _OWN
        self._fixed: tuple[tuple[bytes, int], ...] = ((b"?", 0),)  # what does not change, and where; none so far
        self._values: tuple[tuple[int, int], ...] = ()  # of position, velocity, effort: how many, and where
        self._frame_id = ""
        self._name: tuple[str, ...] = ()

    def read(self, data: bytes) -> Sample:
        """The sample in a serialized message.

        Raises:
            ValueError: it is not a JointState in plain CDR, or its stamp has a second of more than 1e9 ns.
        """
        try:
            for part, at in self._fixed:
                if not data.startswith(part, at):
                    self._lay_out(data)
                    break
            order = self._order
            seconds, nanoseconds = order.stamp.unpack_from(data, _STAMP)
            if nanoseconds >= SECOND:
                raise ValueError
            position, velocity, effort = [
                np.frombuffer(data, order.float, count, at).astype(np.float64) if count else NO_VALUES
                for count, at in self._values
            ]
        except (struct.error, ValueError, KeyError):
            raise ValueError(f"its {len(data)} bytes are not a valid JointState in plain CDR") from None
        return Sample(seconds * SECOND + nanoseconds, self._frame_id, self._name, position, velocity, effort)

    def _lay_out(self, data: bytes) -> None:
        """Find where everything is in this message, and in those like it."""
        order = _ORDERS[data[:2]]
        length = order.length
        frame_id, at = _string(data, _LABELS, length)
        (count,) = length.unpack_from(data, at)
        at += 4
        name = []
        for _ in range(count):
            word, at = _string(data, at, length)
            name.append(word)
        fixed, values, end = [(data[:2], 0)], [], _LABELS
        for _ in range(3):
            (count,) = length.unpack_from(data, at)
            at += 4
            if count:
                at += -(at - _STAMP) % 8
            fixed.append((data[end:at], end))
            values.append((count, at))
            at = end = at + 8 * count
        self._order, self._fixed, self._values = order, tuple(fixed), tuple(values)
        self._frame_id, self._name = frame_id, tuple(name)


def _string(data: bytes, at: int, length: struct.Struct) -> tuple[str, int]:
    """The string whose length is at `at`, and where the next length is."""
    (size,) = length.unpack_from(data, at)
    at += 4
    if size > len(data) - at:
        raise ValueError("the string does not end within the message")
    return data[at : at + max(size - 1, 0)].decode(errors="replace"), at + size + -size % 4


class SignalWriter:
    """Writes messages that have frame and names in common, and mostly the numbers of values."""

    def __init__(self) -> None:
        self.label("", ())

    def label(self, frame_id: str, name: Sequence[str]) -> None:
        """What header.frame_id and name are from now on."""
        self._labels = b"".join([_string_bytes(frame_id), _OWN.length.pack(len(name)), *map(_string_bytes, name)])
        self._lay_out((0, 0, 0))

    def write(
        self,
        stamp_ns: int,
        position: np.ndarray = NO_VALUES,
        velocity: np.ndarray = NO_VALUES,
        effort: np.ndarray = NO_VALUES,
    ) -> bytes:
        """The serialized message with these values: float64 of any shape, written in C order, or empty."""
        counts = position.size, velocity.size, effort.size
        if counts != self._counts:
            self._lay_out(counts)
        before_position, before_velocity, before_effort = self._fixed
        return b"".join(
            (
                _OWN_START,
                _OWN.stamp.pack(*divmod(stamp_ns, SECOND)),
                before_position,
                position.tobytes(),
                before_velocity,
                velocity.tobytes(),
                before_effort,
                effort.tobytes(),
            )
        )

    def _lay_out(self, counts: tuple[int, int, int]) -> None:
        """What stands before position, velocity and effort, of which there are so many values."""
        fixed, at, before = [], _LABELS, self._labels
        for count in counts:
            before += _OWN.length.pack(count)
            if count:
                before += bytes(-(at + len(before) - _STAMP) % 8)
            fixed.append(before)
            at += len(before) + 8 * count
            before = b""
        self._counts, self._fixed = counts, tuple(fixed)


def _string_bytes(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _OWN.length.pack(len(data)) + data + bytes(-len(data) % 4)
