"""Decode single messages: CDR as ROS 2 sends it (XCDR1, either byte order), every length checked.

`walk` is the one way through a message; what comes of its fields (values, columns, nothing) is a `Builder`'s business.
"""

from __future__ import annotations

from typing import Any, Final, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tdof_npid_ros.bag.definition import PRIMITIVES, STRING, Definition, Field, parse
from tdof_npid_ros.bag.errors import BagError

HEAD_BYTES: Final = 4
Order = Literal["<", ">"]

BYTE_ORDERS: Final[dict[int, Order]] = {0: ">", 1: "<"}  # by the second byte of the head
_MAX_PARTS: Final = 1 << 20  # strings, sequences and nested messages in one message, for memory's sake
_OTHER: Final = "the message is damaged or of another type than the bag says"

Data = bytes | bytearray | memoryview
Span = tuple[int, int]  # first byte and bytes of a string, its closing zero included
Part = TypeVar("Part")


class CdrCursor:
    """A place in a serialized message. Positions count from its first byte, the 4-byte head included.

    Attributes:
        order: "<" or ">", the message's byte order, as NumPy writes it.
        lengths: positions and values of the length fields read so far: what makes the layout of the message.
        texts: where its strings lie.
    """

    def __init__(self, data: Data, where: str, position: int = HEAD_BYTES) -> None:
        """Begin after the head, or at a position known from another message of the same layout.

        Raises:
            BagError: the head is missing or announces another encoding.
        """
        self.data = memoryview(data).cast("B")
        self.where = where
        self.position = position
        self.lengths: list[tuple[int, int]] = []
        self.texts: list[Span] = []
        self._parts = 0
        if len(self.data) < HEAD_BYTES:
            raise BagError(f"{where}: a message of {len(self.data)} bytes has no CDR head: it is damaged")
        if self.data[0] != 0 or self.data[1] not in BYTE_ORDERS:
            raise BagError(
                f"{where}: CDR encoding {self.data[0]:02x}{self.data[1]:02x} is not supported: record plain CDR"
            )
        self.order: Order = BYTE_ORDERS[self.data[1]]

    @property
    def remaining(self) -> int:
        """Bytes from here to the message's end."""
        return len(self.data) - self.position

    def skip(self, size: int, alignment: int = 1) -> int:
        """Go beyond the next `size` bytes, aligned, and return where they begin."""
        start = self.position + (HEAD_BYTES - self.position) % alignment
        if size > len(self.data) - start:
            raise BagError(
                f"{self.where}: a field of {_number(size)} bytes at byte {start} of a message of {len(self.data)}:"
                f" {_OTHER}"
            )
        self.position = start + size
        return start

    def need(self, size: int) -> None:
        """Raise where fewer than `size` bytes remain."""
        if size > self.remaining:
            self.skip(size)

    def length(self, least_bytes: int) -> int:
        """Return the next length field, of things that take at least so many bytes each."""
        start = self.skip(4, 4)
        value = int.from_bytes(self.data[start : start + 4], "little" if self.order == "<" else "big")
        if value * least_bytes > self.remaining:
            raise BagError(
                f"{self.where}: a length of {value} at byte {start} where {self.remaining} bytes remain: {_OTHER}"
            )
        self.lengths.append((start, value))
        self.count_part()
        return value

    def count_part(self) -> None:
        """Take note of a string, sequence or nested message, of which one message may hold a million."""
        self._parts += 1
        if self._parts > _MAX_PARTS:
            raise BagError(f"{self.where}: more than {_MAX_PARTS} strings and arrays in one message: leave it out")

    def string(self) -> Span:
        """Go beyond the next string, which is checked, and return where it lies."""
        size = self.length(1)
        start = self.skip(size)
        content = bytes(self.data[start : start + size])
        if size and content[-1] != 0:
            raise BagError(f"{self.where}: a string at byte {start} has no closing zero: the message is damaged")
        if not content.isascii():
            try:
                content.decode()
            except UnicodeDecodeError:
                raise BagError(f"{self.where}: a string at byte {start} is not UTF-8: the message is damaged") from None
        self.texts.append((start, size))
        return start, size

    def text(self, span: Span) -> str:
        """Return a string that lies there."""
        start, size = span
        return str(self.data[start : start + max(size - 1, 0)], "utf-8")

    def numbers(self, primitive: str, start: int, count: int) -> NDArray[Any]:
        """Return the `count` numbers that lie there, in this machine's byte order."""
        dtype = np.dtype(PRIMITIVES[primitive])
        values = np.frombuffer(self.data, dtype.newbyteorder(self.order), count, start) if count else np.empty(0, dtype)
        return values.astype(bool if primitive == "bool" else dtype)


class Builder(Protocol[Part]):
    """Makes something of each field of a message; paths are flattened, such as "header.stamp"."""

    def numbers(self, path: str, field: Field, start: int, count: int) -> Part:
        """Of a number, or an array of `count`, that begins at this byte."""

    def texts(self, path: str, field: Field, spans: list[Span]) -> Part:
        """Of a string, or an array of strings."""

    def messages(self, path: str, field: Field, start: int, parts: list[Part]) -> Part:
        """Of a message, or an array, whose field began at this byte, from what was made of each."""

    def message(self, type_name: str, parts: list[tuple[Field, Part]]) -> Part:
        """Of a message's fields together."""


def walk(
    definition: Definition, cursor: CdrCursor, builder: Builder[Part], type_name: str | None = None, prefix: str = ""
) -> Part:
    """Go through the message at the cursor.

    Raises:
        BagError: it is damaged or of another type.
    """
    name = type_name or definition.root
    fields = definition.fields(name)
    cursor.count_part()
    cursor.need(definition.least[name])
    if not fields:
        cursor.skip(1)
    return builder.message(
        name, [(field, walk_field(definition, field, cursor, builder, prefix + field.name)) for field in fields]
    )


def walk_field(definition: Definition, field: Field, cursor: CdrCursor, builder: Builder[Part], path: str = "") -> Part:
    """Go through the field at the cursor; see `walk`."""
    begin = cursor.position
    least = definition.least[field.type]
    count = 1 if field.count is None else cursor.length(least) if field.count < 0 else field.count
    cursor.need(count * least)
    if field.type in PRIMITIVES:
        return builder.numbers(path, field, cursor.skip(count * least, least if count else 1), count)
    if field.type == STRING:
        return builder.texts(path, field, [cursor.string() for _ in range(count)])
    inner = path + "."
    parts = [walk(definition, cursor, builder, field.type, inner) for _ in range(count)]
    return builder.messages(path, field, begin, parts)


class ValueBuilder:
    """Makes the values: numbers, bool and str; messages as dicts, numeric arrays as NumPy's, other arrays as lists."""

    def __init__(self, cursor: CdrCursor) -> None:
        """For the message at this cursor."""
        self._cursor = cursor

    def numbers(self, path: str, field: Field, start: int, count: int) -> Any:
        """Numbers."""
        values = self._cursor.numbers(field.type, start, count)
        return values[0].item() if field.count is None else values

    def texts(self, path: str, field: Field, spans: list[Span]) -> Any:
        """Strings."""
        values = [self._cursor.text(span) for span in spans]
        return values[0] if field.count is None else values

    def messages(self, path: str, field: Field, start: int, parts: list[Any]) -> Any:
        """Messages."""
        return parts[0] if field.count is None else parts

    def message(self, type_name: str, parts: list[tuple[Field, Any]]) -> Any:
        """One message."""
        return {field.name: value for field, value in parts}


class _NoBuilder:
    """Makes nothing: for those who only want to know whether a message is sound, and where it ends."""

    def numbers(self, path: str, field: Field, start: int, count: int) -> None:
        """Nothing."""

    def texts(self, path: str, field: Field, spans: list[Span]) -> None:
        """Nothing."""

    def messages(self, path: str, field: Field, start: int, parts: list[None]) -> None:
        """Nothing."""

    def message(self, type_name: str, parts: list[tuple[Field, None]]) -> None:
        """Nothing."""


def decode(type_name: str, definition: str, data: Data) -> dict[str, Any]:
    """Decode one message. Spare bytes after its last field are legal, as rclpy's `serialize_message` leaves them.

    Args:
        type_name: for example "trajectory_msgs/msg/JointTrajectory".
        definition: its full `ros2msg` text, as `TopicInfo.definition` holds it.
        data: the serialized message with its 4-byte head.

    Returns:
        Values by field name: numbers, bool and str; nested messages as dict; numeric arrays as one-dimensional
        NumPy arrays, other arrays as lists.

    Raises:
        BagError: the definition or the message is damaged, or they do not fit each other.
    """
    return decode_with(parse(type_name, definition), data)


def decode_with(definition: Definition, data: Data) -> dict[str, Any]:
    """Decode one message; see `decode`."""
    cursor = CdrCursor(data, f"message of type {definition.root}")
    message: dict[str, Any] = walk(definition, cursor, ValueBuilder(cursor))
    return message


def without_padding(type_name: str, definition: str, data: Data) -> bytes:
    """Return a message up to its last field, without spare bytes behind it.

    Raises:
        BagError: as `decode`.
    """
    cursor = CdrCursor(data, f"message of type {type_name}")
    walk(parse(type_name, definition), cursor, _NoBuilder())
    return bytes(data[: cursor.position])


def _number(value: int) -> str:
    return str(value) if value < 10**30 else "more than 1e30"
