"""One MCAP file being written: messages gather in a chunk, chunks go whole to the operating system.

The records are the `mcap` package's, but for the two that each message takes part in: the message itself and the index
of its chunk. They are packed here, which is four times as fast as the package's `Writer`.
"""

from __future__ import annotations

import contextlib
import os
import sys
import zlib
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from tdof_npid_ros.bag import records

LIBRARY: Final = "tdof_npid_ros"

_ZSTD_LEVEL: Final = 1


class Compression(NamedTuple):
    """A way to compress chunks: its name in the file, and what makes the compressor."""

    name: str
    make: Callable[[], Callable[[bytes | bytearray], bytes]]


def _lz4(data: bytes | bytearray) -> bytes:
    return bytes(lz4.frame.compress(data, store_size=True))


COMPRESSIONS: Final = {
    "zstd": Compression("zstd", lambda: zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress),
    "lz4": Compression("lz4", lambda: _lz4),
    "none": Compression("", lambda: bytes),
}


class _Disk:
    """A file without a buffer, which never ends in a part of a write.

    Attributes:
        size: bytes in the file.
        crc: of all that is in it.
    """

    def __init__(self, path: Path) -> None:
        self.size = 0
        self.crc = 0
        self.descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)

    def write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self.descriptor, rest) :]
        except OSError:
            os.ftruncate(self.descriptor, self.size)
            os.lseek(self.descriptor, self.size, os.SEEK_SET)
            raise
        self.size += len(data)
        self.crc = zlib.crc32(data, self.crc)


class FileWriter:
    """An MCAP file of profile `ros2`. Whatever has been flushed stays readable, also without `finish`.

    Methods raise OSError as the file system does; the file then ends where the last whole record ended.

    Attributes:
        path: of the file.
        counts: messages by channel, flushed or not.
        start_ns, end_ns: of the log times in the file.
        chunk: message records that are not in the file yet.
    """

    def __init__(self, path: Path, compression: str) -> None:
        """Create the file.

        Raises:
            FileExistsError: there is such a file already.
        """
        self.path = path
        self.counts: dict[int, int] = {}
        self.start_ns = 2**63 - 1
        self.end_ns = 0
        self.chunk = bytearray()
        self._compression, make = COMPRESSIONS[compression]
        self._compress = make()
        self._entries: dict[int, array[int]] = {}  # log time, offset, log time, … of the chunk, by channel
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunk_indexes: list[McapRecord] = []
        self._attachment_indexes: list[McapRecord] = []
        self._metadata_indexes: list[McapRecord] = []
        self._closed = False
        self._disk = _Disk(path)
        try:
            self._disk.write(records.MAGIC + records.as_bytes(Header(profile="ros2", library=LIBRARY)))
        except OSError:
            os.close(self._disk.descriptor)
            raise

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._disk.size

    @property
    def message_count(self) -> int:
        """Messages in the file and in the chunk being gathered."""
        return sum(self.counts.values())

    def add_schema(self, schema: Schema) -> None:
        """Write a schema, before the first channel that uses it."""
        self._disk.write(records.as_bytes(schema))
        self._schemas.append(schema)

    def add_channel(self, channel: Channel) -> None:
        """Write a channel, before its first message."""
        self._disk.write(records.as_bytes(channel))
        self._channels.append(channel)
        self._entries[channel.id] = array("Q")
        self.counts[channel.id] = 0

    def write(
        self,
        channel_id: int,
        data: bytes | bytearray | memoryview,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
    ) -> None:
        """Add a message to the chunk; it is safe once `flush` returns.

        Raises:
            KeyError: there is no such channel.
            struct.error: a time or the sequence number is out of range.
        """
        entries = self._entries[channel_id]
        length = records.MESSAGE_FIELDS_BYTES + len(data)
        head = records.message_head.pack(records.MESSAGE, length, channel_id, sequence, log_time_ns, publish_time_ns)
        entries.append(log_time_ns)
        entries.append(len(self.chunk))
        self.chunk += head
        self.chunk += data
        self.counts[channel_id] += 1

    def write_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write named key-value pairs, after all messages so far."""
        self.flush()
        place, content = self._disk.size, records.as_bytes(Metadata(name=name, metadata=values))
        self._disk.write(content)
        self._metadata_indexes.append(MetadataIndex(offset=place, length=len(content), name=name))

    def write_attachment(self, attachment: Attachment) -> None:
        """Write an attachment, after all messages so far."""
        self.flush()
        place, content = self._disk.size, records.as_bytes(attachment)
        self._disk.write(content)
        index = AttachmentIndex(
            offset=place,
            length=len(content),
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )
        self._attachment_indexes.append(index)

    def flush(self) -> None:
        """Hand the gathered chunk to the operating system; from then on it survives this process."""
        if not self.chunk:
            return
        channels = [(channel_id, entries) for channel_id, entries in self._entries.items() if entries]
        times = [np.frombuffer(entries, dtype=np.uint64)[::2] for _, entries in channels]
        start_ns = min(int(column.min()) for column in times)
        end_ns = max(int(column.max()) for column in times)
        del times  # an array cannot be emptied while NumPy looks at it
        data = self._compress(self.chunk)
        chunk = Chunk(
            message_start_time=start_ns,
            message_end_time=end_ns,
            uncompressed_size=len(self.chunk),
            uncompressed_crc=zlib.crc32(self.chunk),
            compression=self._compression,
            data=data,
        )
        parts = [records.as_bytes(chunk)]
        length = len(parts[0])
        places: dict[int, int] = {}
        end = self._disk.size + length
        for channel_id, entries in channels:
            if sys.byteorder == "big":
                entries.byteswap()
            parts.append(records.message_index(channel_id, entries.tobytes()))
            places[channel_id] = end
            end += len(parts[-1])
        index = ChunkIndex(
            message_start_time=start_ns,
            message_end_time=end_ns,
            chunk_start_offset=self._disk.size,
            chunk_length=length,
            message_index_offsets=places,
            message_index_length=end - self._disk.size - length,
            compression=self._compression,
            compressed_size=len(data),
            uncompressed_size=len(self.chunk),
        )
        self._disk.write(b"".join(parts))
        self._chunk_indexes.append(index)
        self.start_ns = min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)
        self.chunk.clear()
        for _, entries in channels:
            del entries[:]

    def sync(self) -> None:
        """Wait until what has been flushed is on the disk, where it survives a power cut."""
        os.fdatasync(self._disk.descriptor)

    def check_in_place(self) -> None:
        """Raise FileNotFoundError when the file is no longer where it was created."""
        there = self.path.stat()
        here = os.fstat(self._disk.descriptor)
        if (there.st_dev, there.st_ino) != (here.st_dev, here.st_ino):
            raise FileNotFoundError(2, "another file is in its place", str(self.path))

    def finish(self) -> None:
        """Flush, write the summary and close."""
        self.flush()
        data_end = records.as_bytes(DataEnd(data_section_crc=self._disk.crc))
        self._disk.write(data_end + self._summary(self._disk.size + len(data_end)))
        os.fsync(self._disk.descriptor)
        os.close(self._disk.descriptor)
        self._closed = True

    def finish_if_possible(self) -> None:
        """After an error: save what can still be saved, and close."""
        if self._closed:
            return
        with contextlib.suppress(OSError):
            self.finish()
        if not self._closed:
            os.close(self._disk.descriptor)
            self._closed = True

    def _statistics(self) -> Statistics:
        return Statistics(
            message_count=self.message_count,
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=len(self._attachment_indexes),
            metadata_count=len(self._metadata_indexes),
            chunk_count=len(self._chunk_indexes),
            message_start_time=self.start_ns if self.message_count else 0,
            message_end_time=self.end_ns,
            channel_message_counts=self.counts,
        )

    def _summary(self, start: int) -> bytes:
        groups = {
            Opcode.SCHEMA: self._schemas,
            Opcode.CHANNEL: self._channels,
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: self._chunk_indexes,
            Opcode.ATTACHMENT_INDEX: self._attachment_indexes,
            Opcode.METADATA_INDEX: self._metadata_indexes,
        }
        summary = b""
        offsets = b""
        for opcode, members in groups.items():
            group = records.as_bytes(*members)
            if group:
                offset = SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(group))
                offsets += records.as_bytes(offset)
            summary += group
        offsets_start = start + len(summary)
        summary += offsets
        footer = records.as_bytes(Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=0))
        crc = zlib.crc32(footer[:-4], zlib.crc32(summary))
        return summary + footer[:-4] + crc.to_bytes(4, "little") + records.MAGIC
