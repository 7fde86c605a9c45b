"""One MCAP file being written: messages gather in a chunk, chunks go whole to the operating system."""

from __future__ import annotations

import contextlib
import os
import sys
import zlib
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Final

import lz4.frame
import numpy as np
import zstandard

from tdof_npid_ros.bag import records

LIBRARY: Final = "tdof_npid_ros"

_ZSTD_LEVEL: Final = 1


def _zstd() -> Callable[[bytes | bytearray], bytes]:
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress


def _lz4() -> Callable[[bytes | bytearray], bytes]:
    return lambda data: bytes(lz4.frame.compress(data, store_size=True))


def _none() -> Callable[[bytes | bytearray], bytes]:
    return bytes


# By the writer's option: the name in the file, and what makes the compressor.
COMPRESSIONS: Final[dict[str, tuple[str, Callable[[], Callable[[bytes | bytearray], bytes]]]]] = {
    "zstd": ("zstd", _zstd),
    "lz4": ("lz4", _lz4),
    "none": ("", _none),
}


class FileWriter:
    """An MCAP file of profile `ros2`. Whatever has been flushed stays readable, also without `finish`.

    Methods raise OSError as the file system does; the file then ends where the last whole record ended.
    """

    def __init__(self, path: Path, compression: str) -> None:
        """Create the file.

        Raises
        ------
        FileExistsError
            There is such a file already.
        """
        self.path = path
        self.size = 0  # bytes in the file
        self.counts: dict[int, int] = {}  # messages by channel, flushed or not
        self.start_ns = 2**63 - 1
        self.end_ns = 0
        self.chunk = bytearray()  # records not in the file yet
        self._compression, make = COMPRESSIONS[compression]
        self._compress = make()
        self._entries: dict[int, array[int]] = {}  # log time, offset, log time, … of the chunk, by channel
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunk_index: list[bytes] = []
        self._metadata_index: list[bytes] = []
        self._data_crc = 0
        self._closed = False
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            self._append(records.MAGIC + records.header_record("ros2", LIBRARY))
        except OSError:
            os.close(self._descriptor)
            raise

    @property
    def message_count(self) -> int:
        """Messages in the file and in the chunk being gathered."""
        return sum(self.counts.values())

    def add_schema(self, schema: records.Schema) -> None:
        """Write a schema, before the first channel that uses it."""
        self._append(records.schema_record(schema))
        self._schemas.append(schema)

    def add_channel(self, channel: records.Channel) -> None:
        """Write a channel, before its first message."""
        self._append(records.channel_record(channel))
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

        Raises
        ------
        KeyError
            There is no such channel.
        struct.error
            A time or the sequence number is out of range.
        """
        entries = self._entries[channel_id]
        size = len(data)
        head = records.message_head.pack(
            records.MESSAGE,
            records.MESSAGE_FIELDS_BYTES + size,
            channel_id,
            sequence,
            log_time_ns,
            publish_time_ns,
        )
        entries.append(log_time_ns)
        entries.append(len(self.chunk))
        self.chunk += head
        self.chunk += data
        self.counts[channel_id] += 1

    def write_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write named key-value pairs, after all messages so far."""
        self.flush()
        content = records.metadata_record(name, values)
        index = self.size.to_bytes(8, "little") + len(content).to_bytes(8, "little") + records.text(name)
        self._append(content)
        self._metadata_index.append(records.record(records.METADATA_INDEX, index))

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
        crc = zlib.crc32(self.chunk)
        head = records.chunk_head(start_ns, end_ns, len(self.chunk), crc, self._compression, len(data))
        chunk_length = len(head) + len(data)
        parts = [head, data]
        index_offsets: dict[int, int] = {}
        position = self.size + chunk_length
        for channel_id, entries in channels:
            if sys.byteorder == "big":
                entries.byteswap()
            part = records.message_index_record(channel_id, entries.tobytes())
            parts.append(part)
            index_offsets[channel_id] = position
            position += len(part)
        described = records.ChunkHead(start_ns, end_ns, len(self.chunk), crc, self._compression, 0, len(data))
        index_length = position - self.size - chunk_length
        entry = records.chunk_index_record(described, self.size, chunk_length, index_offsets, index_length)

        self._append(b"".join(parts))
        self._chunk_index.append(entry)
        self.start_ns = min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)
        self.chunk.clear()
        for _, entries in channels:
            del entries[:]

    def sync(self) -> None:
        """Wait until what has been flushed is on the disk, where it survives a power cut."""
        os.fdatasync(self._descriptor)

    def check_in_place(self) -> None:
        """Raise FileNotFoundError when the file is no longer where it was created."""
        there = self.path.stat()
        here = os.fstat(self._descriptor)
        if (there.st_dev, there.st_ino) != (here.st_dev, here.st_ino):
            raise FileNotFoundError(2, "another file is in its place", str(self.path))

    def finish(self) -> None:
        """Flush, write the summary and close."""
        self.flush()
        data_end = records.record(records.DATA_END, self._data_crc.to_bytes(4, "little"))
        self._append(data_end + self._summary(self.size + len(data_end)))
        os.fsync(self._descriptor)
        os.close(self._descriptor)
        self._closed = True

    def finish_if_possible(self) -> None:
        """After an error: save what can still be saved, and close."""
        if self._closed:
            return
        with contextlib.suppress(OSError):
            self.finish()
        if not self._closed:
            os.close(self._descriptor)
            self._closed = True

    def _summary(self, start: int) -> bytes:
        statistics = records.Statistics(
            self.message_count,
            len(self._chunk_index),
            self.start_ns if self.message_count else 0,
            self.end_ns,
            self.counts,
        )
        groups = [
            (records.SCHEMA, [records.schema_record(schema) for schema in self._schemas]),
            (records.CHANNEL, [records.channel_record(channel) for channel in self._channels]),
            (
                records.STATISTICS,
                [
                    records.statistics_record(
                        statistics, len(self._schemas), len(self._channels), len(self._metadata_index)
                    )
                ],
            ),
            (records.CHUNK_INDEX, self._chunk_index),
            (records.METADATA_INDEX, self._metadata_index),
        ]
        summary = b""
        offsets = b""
        for opcode, members in groups:
            group = b"".join(members)
            if group:
                position = (start + len(summary)).to_bytes(8, "little")
                content = bytes([opcode]) + position + len(group).to_bytes(8, "little")
                offsets += records.record(records.SUMMARY_OFFSET, content)
            summary += group
        offsets_start = start + len(summary)
        summary += offsets
        footer_head = records.prefix.pack(records.FOOTER, records.footer_fields.size)
        footer_head += start.to_bytes(8, "little") + offsets_start.to_bytes(8, "little")
        crc = zlib.crc32(footer_head, zlib.crc32(summary))
        return summary + footer_head + crc.to_bytes(4, "little") + records.MAGIC

    def _append(self, data: bytes) -> None:
        """Write all of `data`, or nothing."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self.size)
            os.lseek(self._descriptor, self.size, os.SEEK_SET)
            raise
        self.size += len(data)
        self._data_crc = zlib.crc32(data, self._data_crc)
