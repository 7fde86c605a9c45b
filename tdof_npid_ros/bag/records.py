"""MCAP records as bytes: packing and bounded unpacking (https://mcap.dev/spec). All integers little-endian."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Final, NamedTuple

from tdof_npid_ros.bag.errors import BagError

MAGIC: Final = b"\x89MCAP0\r\n"
PREFIX_BYTES: Final = 9  # opcode and length before each record's content
FOOTER_BYTES: Final = PREFIX_BYTES + 20

HEADER: Final = 0x01
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
MESSAGE_INDEX: Final = 0x07
CHUNK_INDEX: Final = 0x08
STATISTICS: Final = 0x0B
METADATA: Final = 0x0C
METADATA_INDEX: Final = 0x0D
SUMMARY_OFFSET: Final = 0x0E
DATA_END: Final = 0x0F
FIRST_PRIVATE: Final = 0x80  # opcodes from here on are other programs' own, to be skipped

prefix: Final = struct.Struct("<BQ")
message_head: Final = struct.Struct("<BQHIQQ")
MESSAGE_FIELDS_BYTES: Final = 22  # channel, sequence, log time and publish time
chunk_times: Final = struct.Struct("<QQQI")  # start, end, uncompressed size, uncompressed CRC
chunk_index_times: Final = struct.Struct("<QQQQ")  # start, end, chunk offset, chunk length
footer_fields: Final = struct.Struct("<QQI")
statistics_fields: Final = struct.Struct("<QHIIIIQQ")
id_and_count: Final = struct.Struct("<HQ")


class Schema(NamedTuple):
    """A message type: `data` is its definition, in the language `encoding`."""

    id: int
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """A topic as one file knows it."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


class ChunkHead(NamedTuple):
    """A chunk without its data, which begins `data_offset` bytes into the record's content."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    data_offset: int
    data_size: int


class Statistics(NamedTuple):
    """What a whole file holds."""

    message_count: int
    chunk_count: int
    start_ns: int
    end_ns: int
    channel_counts: dict[int, int]


def record(opcode: int, content: bytes) -> bytes:
    """Return the record `opcode` with this content."""
    return prefix.pack(opcode, len(content)) + content


def text(value: str) -> bytes:
    """Return a string with its length before it."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _text_map(values: Mapping[str, str]) -> bytes:
    data = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


def _count_map(counts: Mapping[int, int]) -> bytes:
    data = b"".join(id_and_count.pack(key, value) for key, value in counts.items())
    return struct.pack("<I", len(data)) + data


def header_record(profile: str, library: str) -> bytes:
    """Return the record that opens a file."""
    return record(HEADER, text(profile) + text(library))


def schema_record(schema: Schema) -> bytes:
    """Return a schema as a record."""
    head = struct.pack("<H", schema.id) + text(schema.name) + text(schema.encoding)
    return record(SCHEMA, head + struct.pack("<I", len(schema.data)) + schema.data)


def channel_record(channel: Channel) -> bytes:
    """Return a channel as a record."""
    head = struct.pack("<HH", channel.id, channel.schema_id) + text(channel.topic)
    return record(CHANNEL, head + text(channel.message_encoding) + _text_map(channel.metadata))


def metadata_record(name: str, values: Mapping[str, str]) -> bytes:
    """Return named key-value pairs as a record."""
    return record(METADATA, text(name) + _text_map(values))


def chunk_head(start_ns: int, end_ns: int, uncompressed_size: int, crc: int, compression: str, data_size: int) -> bytes:
    """Return what stands before a chunk's data, the record's prefix included."""
    head = chunk_times.pack(start_ns, end_ns, uncompressed_size, crc) + text(compression)
    head += struct.pack("<Q", data_size)
    return prefix.pack(CHUNK, len(head) + data_size) + head


def message_index_record(channel_id: int, entries: bytes) -> bytes:
    """Return the index of one channel in one chunk; `entries` are pairs of uint64: log time, offset."""
    return record(MESSAGE_INDEX, struct.pack("<HI", channel_id, len(entries)) + entries)


def statistics_record(statistics: Statistics, schema_count: int, channel_count: int, metadata_count: int) -> bytes:
    """Return a file's statistics as a record."""
    fields = statistics_fields.pack(
        statistics.message_count,
        schema_count,
        channel_count,
        0,  # attachments
        metadata_count,
        statistics.chunk_count,
        statistics.start_ns,
        statistics.end_ns,
    )
    return record(STATISTICS, fields + _count_map(statistics.channel_counts))


def chunk_index_record(
    head: ChunkHead, offset: int, length: int, index_offsets: Mapping[int, int], index_length: int
) -> bytes:
    """Return the summary's entry for the chunk at `offset`, `length` bytes long with its prefix."""
    content = chunk_index_times.pack(head.start_ns, head.end_ns, offset, length)
    content += _count_map(index_offsets) + struct.pack("<Q", index_length) + text(head.compression)
    return record(CHUNK_INDEX, content + struct.pack("<QQ", head.data_size, head.uncompressed_size))


class Cursor:
    """Reads fields from a record's content and refuses to read beyond its end.

    Raises
    ------
    BagError
        From every method, when the content ends too early or a string is not UTF-8.
    """

    def __init__(self, data: bytes | memoryview, where: str) -> None:
        """Begin at the start of `data`; `where` names it in errors."""
        self._data = memoryview(data)
        self._where = where
        self.position = 0

    @property
    def remaining(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self.position

    def take(self, size: int) -> memoryview:
        """Return the next `size` bytes."""
        if size > self.remaining:
            raise BagError(
                f"{self._where}: a length of {size} bytes where only {self.remaining} remain: the file is"
                " damaged, run `tdof-npid recover`"
            )
        start = self.position
        self.position += size
        return self._data[start : self.position]

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        """Return the next fields."""
        return layout.unpack(self.take(layout.size))

    def u16(self) -> int:
        """Return the next uint16."""
        return int.from_bytes(self.take(2), "little")

    def u32(self) -> int:
        """Return the next uint32."""
        return int.from_bytes(self.take(4), "little")

    def u64(self) -> int:
        """Return the next uint64."""
        return int.from_bytes(self.take(8), "little")

    def text(self) -> str:
        """Return the next string."""
        data = self.take(self.u32())
        try:
            return str(data, "utf-8")
        except UnicodeDecodeError:
            raise BagError(
                f"{self._where}: a string is not UTF-8: the file is damaged, run `tdof-npid recover`"
            ) from None

    def sub(self, size: int) -> Cursor:
        """Return a cursor over the next `size` bytes."""
        return Cursor(self.take(size), self._where)

    def text_map(self) -> dict[str, str]:
        """Return the next map of strings."""
        inner = self.sub(self.u32())
        values: dict[str, str] = {}
        while inner.remaining:
            key = inner.text()
            values[key] = inner.text()
        return values

    def count_map(self) -> dict[int, int]:
        """Return the next map from uint16 to uint64."""
        inner = self.sub(self.u32())
        values: dict[int, int] = {}
        while inner.remaining:
            key, value = inner.unpack(id_and_count)
            values[key] = value
        return values


def read_schema(cursor: Cursor) -> Schema:
    """Return the schema in a record's content."""
    return Schema(cursor.u16(), cursor.text(), cursor.text(), bytes(cursor.take(cursor.u32())))


def read_channel(cursor: Cursor) -> Channel:
    """Return the channel in a record's content."""
    return Channel(cursor.u16(), cursor.u16(), cursor.text(), cursor.text(), cursor.text_map())


def read_chunk_head(cursor: Cursor) -> ChunkHead:
    """Return the head of the chunk in a record's content, of which only the beginning need be at hand."""
    start_ns, end_ns, uncompressed_size, crc = cursor.unpack(chunk_times)
    compression = cursor.text()
    data_size = cursor.u64()
    return ChunkHead(start_ns, end_ns, uncompressed_size, crc, compression, cursor.position, data_size)


def read_statistics(cursor: Cursor) -> Statistics:
    """Return the statistics in a record's content."""
    count, _, _, _, _, chunks, start_ns, end_ns = cursor.unpack(statistics_fields)
    return Statistics(count, chunks, start_ns, end_ns, cursor.count_map())
