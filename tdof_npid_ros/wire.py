"""The loop's signals as they are on the wire: sensor_msgs/msg/JointState in CDR, read and written without rclpy's
message.

To build that message, and to take it apart, costs rclpy more than a step of the loop costs plant and controller
together.
What turns at every step goes this way; everything else publishes ordinary messages.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
SECOND: Final = 1_000_000_000  # ns
_STAMP: Final = 4  # where header.stamp is; places are aligned as counted from here
_LABELS: Final = 12  # where header.frame_id is, and name after it
NO_VALUES = np.empty(0)


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
    """Reads the messages of one topic, whose frame and names are mostly as in the message before."""

    def __init__(self) -> None:
        self._head = self._labels = b"?"  # no message before this one
        self._order = _OWN
        self._end = sys.maxsize  # of the labels
        self._frame_id = ""
        self._name: tuple[str, ...] = ()

    def read(self, data: bytes) -> Sample:
        """The sample in a serialized message.

        Raises:
            ValueError: it is not a JointState in plain CDR, or its stamp has a second of more than 1e9 ns.
        """
        try:
            if not (data.startswith(self._head) and data.startswith(self._labels, _LABELS)):
                self._read_labels(data)
            seconds, nanoseconds = self._order.stamp.unpack_from(data, _STAMP)
            if nanoseconds >= SECOND:
                raise ValueError
            position, at = self._values(data, self._end)
            velocity, at = self._values(data, at)
            effort, at = self._values(data, at)
        except (struct.error, ValueError, KeyError):
            raise ValueError(f"its {len(data)} bytes are not a valid JointState in plain CDR") from None
        return Sample(seconds * SECOND + nanoseconds, self._frame_id, self._name, position, velocity, effort)

    def _values(self, data: bytes, at: int) -> tuple[np.ndarray, int]:
        (count,) = self._order.length.unpack_from(data, at)
        if not count:
            return NO_VALUES, at + 4
        at += 4 + -at % 8
        return np.frombuffer(data, self._order.float, count, at).astype(np.float64), at + 8 * count

    def _read_labels(self, data: bytes) -> None:
        head = data[:2]
        length = _ORDERS[head].length
        frame_id, at = _string(data, _LABELS, length)
        (count,) = length.unpack_from(data, at)
        at += 4
        name = []
        for _ in range(count):
            word, at = _string(data, at, length)
            name.append(word)
        self._head, self._order, self._labels, self._end = head, _ORDERS[head], data[_LABELS:at], at
        self._frame_id, self._name = frame_id, tuple(name)


def _string(data: bytes, at: int, length: struct.Struct) -> tuple[str, int]:
    """The string whose length is at `at`, and where the next length is."""
    (size,) = length.unpack_from(data, at)
    at += 4
    if size > len(data) - at:
        raise ValueError("the string does not end within the message")
    return data[at : at + max(size - 1, 0)].decode(errors="replace"), at + size + -size % 4


class SignalWriter:
    """Writes messages that have frame and names in common."""

    def __init__(self) -> None:
        self.label("", ())

    def label(self, frame_id: str, name: Sequence[str]) -> None:
        """What header.frame_id and name are from now on."""
        self._labels = b"".join([_string_bytes(frame_id), _OWN.length.pack(len(name)), *map(_string_bytes, name)])

    def write(
        self,
        stamp_ns: int,
        position: np.ndarray = NO_VALUES,
        velocity: np.ndarray = NO_VALUES,
        effort: np.ndarray = NO_VALUES,
    ) -> bytes:
        """The serialized message with these values: float64 of any shape, written in C order, or empty."""
        parts = [_OWN_HEAD, b"\0\0", _OWN.stamp.pack(*divmod(stamp_ns, SECOND)), self._labels]
        at = _LABELS + len(self._labels)
        for values in (position, velocity, effort):
            count = values.size
            parts.append(_OWN.length.pack(count))
            if count:
                parts += (bytes(-at % 8), values.tobytes())
                at += -at % 8 + 8 * count
            at += 4
        return b"".join(parts)


def _string_bytes(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _OWN.length.pack(len(data)) + data + bytes(-len(data) % 4)
