"""MCAP records as bytes (https://mcap.dev/spec): the `mcap` package's, read from content that may be anything.

Ours are the head of a chunk, read without the chunk, and what each message takes part in: its record and its index.
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Final, NamedTuple, TypeVar

import mcap.records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from tdof_npid_ros.bag.errors import BagError

MAGIC: Final[bytes] = MCAP0_MAGIC
PREFIX_BYTES: Final = 9  # opcode and length before each record's content
MESSAGE_FIELDS_BYTES: Final = 22  # channel, sequence, log time and publish time
FOOTER_BYTES: Final = PREFIX_BYTES + 20
FIRST_PRIVATE: Final = 0x80  # opcodes from here on are other programs' own, to be skipped
DATA_OPCODES: Final = frozenset(Opcode) - {Opcode.HEADER, Opcode.FOOTER}
DAMAGED: Final = "the file is damaged, run `tdof-npid recover`"

_chunk_times: Final = struct.Struct("<QQQI")  # start, end, uncompressed size, uncompressed CRC

Record = TypeVar(
    "Record",
    mcap.records.Attachment,
    mcap.records.AttachmentIndex,
    mcap.records.Channel,
    mcap.records.ChunkIndex,
    mcap.records.Footer,
    mcap.records.MessageIndex,
    mcap.records.Metadata,
    mcap.records.MetadataIndex,
    mcap.records.Schema,
    mcap.records.Statistics,
)


_prefix: Final = struct.Struct("<BQ")
MESSAGE: Final = int(Opcode.MESSAGE)  # a plain number, for the sake of speed
message_head: Final = struct.Struct("<BQHIQQ")  # all of a message record but its data


class ChunkHead(NamedTuple):
    """A chunk without its data, which begins `data_offset` bytes into the record's content."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    data_offset: int
    data_size: int


class _Content(BytesIO):
    """A record's content, beyond whose end nobody reads."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EndOfFile
        return data


def read_prefix(data: bytes | memoryview, position: int = 0) -> tuple[int, int]:
    """Return opcode and length of the record that begins there; all of the prefix is there."""
    opcode, length = _prefix.unpack_from(data, position)
    return opcode, length


def read(kind: type[Record], content: bytes | memoryview, where: str) -> Record:
    """Return the record with this content; what follows its last field is left alone, as the specification wants.

    Raises:
        BagError: it ends too early, or holds a string that is not UTF-8.
    """
    try:
        record: Record = kind.read(ReadDataStream(_Content(content)))
    except (EndOfFile, struct.error):
        raise BagError(f"{where}: a field is longer than the record that holds it: {DAMAGED}") from None
    except UnicodeDecodeError:
        raise BagError(f"{where}: a string is not UTF-8: {DAMAGED}") from None
    return record


def read_chunk_head(content: bytes | memoryview, where: str) -> ChunkHead:
    """Return the head of the chunk in a record's content, of which only the beginning need be at hand.

    Raises:
        BagError: it ends too early, or the name of the compression is not UTF-8.
    """
    stream = ReadDataStream(_Content(content))
    try:
        start_ns, end_ns, uncompressed_size, crc = _chunk_times.unpack(stream.read(_chunk_times.size))
        compression = stream.read_prefixed_string()
        data_size = stream.read8()
    except (EndOfFile, struct.error):
        raise BagError(f"{where}: a field is longer than the record that holds it: {DAMAGED}") from None
    except UnicodeDecodeError:
        raise BagError(f"{where}: a string is not UTF-8: {DAMAGED}") from None
    return ChunkHead(start_ns, end_ns, uncompressed_size, crc, compression, stream.count, data_size)


def message_index(channel_id: int, entries: bytes) -> bytes:
    """Return the index of one channel in one chunk; `entries` are pairs of uint64: log time, offset."""
    content = struct.pack("<HI", channel_id, len(entries)) + entries
    return _prefix.pack(Opcode.MESSAGE_INDEX, len(content)) + content


def as_bytes(*found: mcap.records.McapRecord) -> bytes:
    """Return records one after the other, as they are in a file."""
    builder = RecordBuilder()
    for record in found:
        record.write(builder)
    data: bytes = builder.end()
    return data
