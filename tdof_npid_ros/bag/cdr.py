"""Decode single messages: CDR as ROS 2 sends it (XCDR1, either byte order), every length checked."""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from tdof_npid_ros.bag.definition import PRIMITIVES, STRING, Definition, Field, parse
from tdof_npid_ros.bag.errors import BagError

HEAD_BYTES: Final = 4
Order = Literal["<", ">"]

BYTE_ORDERS: Final[dict[int, Order]] = {0: ">", 1: "<"}  # by the second byte of the head
_MAX_TRAILING_BYTES: Final = 8  # padding that some senders add
_MAX_PARTS: Final = 1 << 20  # strings, sequences and nested messages in one message, for memory's sake

Data = bytes | bytearray | memoryview


class CdrCursor:
    """A place in a serialized message. Positions count from its first byte, the 4-byte head included.

    Attributes
    ----------
    order
        "<" or ">", the message's byte order, as NumPy writes it.
    lengths
        Positions and values of the length fields read so far: what makes the layout of the message.
    """

    def __init__(self, data: Data, where: str, position: int = HEAD_BYTES) -> None:
        """Begin after the head, or at a position known from another message of the same layout.

        Raises
        ------
        BagError
            The head is missing or announces another encoding.
        """
        self._data = memoryview(data).cast("B")
        self._where = where
        self.position = position
        self.lengths: list[tuple[int, int]] = []
        self._parts = 0
        if len(self._data) < HEAD_BYTES:
            raise BagError(f"{where}: a message of {len(self._data)} bytes has no CDR head: it is damaged")
        if self._data[0] != 0 or self._data[1] not in BYTE_ORDERS:
            raise BagError(
                f"{where}: CDR encoding {self._data[0]:02x}{self._data[1]:02x} is not supported: record plain CDR"
            )
        self.order: Order = BYTE_ORDERS[self._data[1]]

    @property
    def remaining(self) -> int:
        """Bytes from here to the message's end."""
        return len(self._data) - self.position

    def skip(self, size: int, alignment: int = 1) -> int:
        """Go beyond the next `size` bytes, aligned, and return where they begin."""
        start = self.position + (HEAD_BYTES - self.position) % alignment
        if size > len(self._data) - start:
            raise BagError(
                f"{self._where}: a field of {size} bytes at byte {start} of a message of {len(self._data)}:"
                " the message is damaged or of another type than the bag says"
            )
        self.position = start + size
        return start

    def length(self, least_bytes: int) -> int:
        """Return the next length field, of things that take at least so many bytes each."""
        start = self.skip(4, 4)
        value = int.from_bytes(self._data[start : start + 4], "little" if self.order == "<" else "big")
        if value * least_bytes > self.remaining:
            raise BagError(
                f"{self._where}: a length of {value} at byte {start} where {self.remaining} bytes remain:"
                " the message is damaged or of another type than the bag says"
            )
        self.lengths.append((start, value))
        self.count_parts(1)
        return value

    def count_parts(self, count: int) -> None:
        """Take note of strings, sequences and nested messages, of which one message may hold a million."""
        self._parts += count
        if self._parts > _MAX_PARTS:
            raise BagError(f"{self._where}: more than {_MAX_PARTS} strings and arrays in one message: leave it out")

    def string(self) -> tuple[int, int]:
        """Go beyond the next string and return where it begins and its bytes, the closing zero included."""
        size = self.length(1)
        start = self.skip(size)
        if size and self._data[start + size - 1] != 0:
            raise BagError(f"{self._where}: a string at byte {start} has no closing zero: the message is damaged")
        return start, size

    def text(self) -> str:
        """Return the next string."""
        start, size = self.string()
        try:
            return str(self._data[start : start + max(size - 1, 0)], "utf-8")
        except UnicodeDecodeError:
            raise BagError(f"{self._where}: a string at byte {start} is not UTF-8: the message is damaged") from None

    def numbers(self, primitive: str, count: int) -> NDArray[Any]:
        """Return the next `count` numbers in this machine's byte order."""
        dtype = np.dtype(PRIMITIVES[primitive])
        if not count:
            return np.empty(0, bool if primitive == "bool" else dtype)
        start = self.skip(count * dtype.itemsize, dtype.itemsize)
        values = np.frombuffer(self._data, dtype.newbyteorder(self.order), count, start)
        return values.astype(bool if primitive == "bool" else dtype)

    def end(self) -> None:
        """Check that the message ends here."""
        if self.remaining > _MAX_TRAILING_BYTES:
            raise BagError(
                f"{self._where}: {self.remaining} bytes follow the last field: the message is damaged or"
                " of another type than the bag says"
            )


def read_field(definition: Definition, field: Field, cursor: CdrCursor) -> Any:
    """Return the value of the field at the cursor."""
    if field.count is None:
        if field.type in PRIMITIVES:
            return cursor.numbers(field.type, 1)[0].item()
        return cursor.text() if field.type == STRING else _read_message(definition, field.type, cursor)
    least = definition.least[field.type]
    count = cursor.length(least) if field.count < 0 else field.count
    if count * least > cursor.remaining:
        cursor.skip(count * least)  # raises
    if field.type in PRIMITIVES:
        return cursor.numbers(field.type, count)
    if field.type == STRING:
        return [cursor.text() for _ in range(count)]
    return [_read_message(definition, field.type, cursor) for _ in range(count)]


def _read_message(definition: Definition, type_name: str, cursor: CdrCursor) -> dict[str, Any]:
    fields = definition.fields(type_name)
    cursor.count_parts(1)
    if not fields:
        cursor.skip(1)
    return {field.name: read_field(definition, field, cursor) for field in fields}


def decode(type_name: str, definition: str, data: Data) -> dict[str, Any]:
    """Decode one message.

    Parameters
    ----------
    type_name
        For example "trajectory_msgs/msg/JointTrajectory".
    definition
        Its full `ros2msg` text, as `TopicInfo.definition` holds it.
    data
        The serialized message with its 4-byte head.

    Returns
    -------
    Values by field name: numbers, bool and str; nested messages as dict; numeric arrays as one-dimensional
    NumPy arrays, other arrays as lists.

    Raises
    ------
    BagError
        The definition or the message is damaged, or they do not fit each other.
    """
    message, cursor = _read(type_name, definition, data)
    cursor.end()
    return message


def without_padding(type_name: str, definition: str, data: Data) -> bytes:
    """Return a message up to its last field: rclpy's `serialize_message` leaves spare bytes behind it.

    Raises
    ------
    BagError
        As `decode`.
    """
    _, cursor = _read(type_name, definition, data)
    return bytes(data[: cursor.position])


def _read(type_name: str, definition: str, data: Data) -> tuple[dict[str, Any], CdrCursor]:
    parsed = parse(type_name, definition)
    cursor = CdrCursor(data, f"message of type {type_name}")
    if parsed.least[parsed.root] > cursor.remaining:
        cursor.skip(parsed.least[parsed.root])  # raises
    return _read_message(parsed, parsed.root, cursor), cursor
