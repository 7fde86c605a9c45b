"""Read an MCAP file, whole or cut off by a crash. No length, count or time in it is believed unchecked.

The records' heads are walked once from the front, which finds the chunks without trusting the index, and
finds where a file ends that was never finished. Counts come from the summary when there is one, else from the
chunks themselves.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from tdof_npid_ros.bag import records, scan
from tdof_npid_ros.bag.decompress import check_size, decompress
from tdof_npid_ros.bag.definition import MAX_TEXT_BYTES
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.records import Cursor
from tdof_npid_ros.bag.storage import Piece, TopicInfo

_HEAD_BYTES: Final = 4096  # read at each record: more than any chunk's head
_RUN_BYTES: Final = 1 << 20  # messages outside of chunks are read in pieces of this size
_CRC_FILE_BYTES: Final = 256 << 20  # the checksum over all data is verified in files up to this size
_MAX_DEFINITIONS_BYTES: Final = 64 << 20
_LEAST_MESSAGE_BYTES: Final = records.PREFIX_BYTES + records.MESSAGE_FIELDS_BYTES
_MAX_METADATA_BYTES: Final = 16 << 20
_MAX_DEFINITIONS: Final = 2 * 2**16  # in one chunk: every schema and every channel that there can be

_DATA_OPCODES: Final = frozenset(range(records.SCHEMA, records.DATA_END + 1))

_DAMAGED: Final = "the file is damaged, run `tdof-npid recover`"
_STOPS: Final = {
    scan.CUT_SHORT: "is longer than what holds it",
    scan.WRONG_LENGTH: "is a message too short for its own fields",
    scan.WRONG_TIME: "bears a time beyond the year 2262",
    scan.TOO_MANY: "is the first of more definitions than any bag needs",
}


class _Span(NamedTuple):
    """Where messages lie: a chunk, or whole message records (`head` is None)."""

    offset: int
    size: int
    head: records.ChunkHead | None
    start_ns: int
    end_ns: int


class McapFile:
    """An open MCAP file: a `Storage`.

    With `salvage`, damaged pieces are left out and named in `missing`, instead of raising BagError.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        """Open the file and find its pieces.

        Raises
        ------
        BagError
            It cannot be read, is no MCAP file or is damaged. A file that only ends too early is no error.
        """
        self.path = path
        self.name = str(path)
        self.topics: dict[str, TopicInfo] = {}
        self.start_ns = 0
        self.end_ns = 0
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.missing: list[str] = []
        self.dropped_bytes = 0
        self._salvage = salvage
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}
        self._text_bytes = 0
        self._spans: list[_Span] = []
        self._metadata_bytes = 0
        self._data_crc = 0
        self._data_whole = False
        self._finished = False
        self._statistics: records.Statistics | None = None
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise BagError(f"cannot open {path}: {error.strerror}") from None
        try:
            self.size = os.fstat(self._descriptor).st_size
            self._open()
        except BaseException:
            os.close(self._descriptor)
            raise

    @property
    def topic_of(self) -> Mapping[int, str]:
        """Return topic names by channel number."""
        return {channel.id: channel.topic for channel in self._channels.values()}

    def pieces(self) -> list[Piece]:
        """Return the chunks and runs of messages, in file order."""
        return [Piece(span.start_ns, span.end_ns, partial(self.load, span)) for span in self._spans]

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def load(self, span: _Span) -> scan.Table:
        """Return the messages of a piece.

        Raises
        ------
        BagError
            The piece is damaged.
        """
        where = self._where("chunk" if span.head else "messages", span.offset)
        data = self._read(span.offset, span.size)
        if len(data) < span.size:
            raise BagError(f"{where}: the file has become shorter since it was opened: open it again")
        content = decompress(span.head, data, where) if span.head else np.frombuffer(data, np.uint8)
        walk = scan.walk(content, _MAX_DEFINITIONS)
        if walk.stop != scan.AT_END:
            raise BagError(f"{where}: the record at byte {walk.position} {_STOPS[walk.stop]}: {_DAMAGED}")
        for position in walk.others.tolist():
            self._take_definition(content, position, where)
        table = walk.table
        unknown = set(np.unique(table.channel).tolist()) - self._channels.keys()
        if unknown:
            raise BagError(f"{where}: messages of channel {min(unknown)}, which is not announced: {_DAMAGED}")
        if table.log_time.size and not (
            span.start_ns <= int(table.log_time.min()) and int(table.log_time.max()) <= span.end_ns
        ):
            raise BagError(f"{where}: messages of other times than it announces: {_DAMAGED}")
        return table

    def _where(self, what: str, offset: int) -> str:
        return f"{self.path}: {what} at byte {offset}"

    def _read(self, offset: int, size: int) -> bytes:
        try:
            parts = []
            while size:
                part = os.pread(self._descriptor, size, offset)
                if not part:
                    break
                parts.append(part)
                offset += len(part)
                size -= len(part)
            return parts[0] if len(parts) == 1 else b"".join(parts)
        except OSError as error:
            raise BagError(f"cannot read {self.path} at byte {offset}: {error.strerror}") from None

    def _open(self) -> None:
        magic = self._read(0, len(records.MAGIC))
        if not records.MAGIC.startswith(magic):
            raise BagError(f"{self.path}: does not begin as an MCAP file: it is something else or damaged")
        self._finished = (
            self.size >= 2 * len(records.MAGIC) + records.FOOTER_BYTES
            and self._read(self.size - len(magic), len(magic)) == records.MAGIC
        )
        end = self._walk()
        if self._finished:
            self._read_summary(end)
            self._check_data_crc(end)
        elif end < self.size and not self._data_whole:
            self._lose(end, self.size - end, "a record without its end")
        if not self._finished:
            self.missing.append(f"{self.path}: the index and summary: the recording was never finished")
        if self._statistics is None or self._salvage:
            self._count()
        else:
            self._take_statistics(self._statistics)

    def _lose(self, offset: int, size: int, what: str) -> None:
        self.missing.append(f"{self.path}: {size} bytes from byte {offset} on: {what}")
        self.dropped_bytes += size

    def _walk(self) -> int:
        """Find the pieces; return where the data section ends, or the last whole record of an unfinished file."""
        position = len(records.MAGIC)
        while True:
            head = self._read(position, _HEAD_BYTES)
            if len(head) < records.PREFIX_BYTES:
                break
            opcode, length = records.prefix.unpack_from(head)
            if opcode == records.MESSAGE:
                step = self._walk_messages(position)
                if not step:
                    break
                position += step
                continue
            step = records.PREFIX_BYTES + length
            if step > self.size - position:
                break
            if opcode == records.DATA_END and length >= 4:
                self._data_crc = int.from_bytes(head[9:13], "little")
                self._data_whole = True
                return position
            if not self._understood(opcode, position):
                if self._salvage or not (self._finished or self._anything_after(position)):
                    break
                raise BagError(f"{self._where('record', position)}: of unknown kind {opcode}: {_DAMAGED}")
            try:
                if opcode == records.CHUNK:
                    self._note_chunk(position, length, head)
                elif opcode in (records.SCHEMA, records.CHANNEL, records.METADATA):
                    self._note_record(opcode, position, length)
            except BagError as error:
                if not self._salvage:
                    raise
                self._lose(position, step, str(error))
            position += step
        if self._finished and not self._salvage:
            raise BagError(f"{self._where('record', position)}: is longer than the file: {_DAMAGED}")
        self._finished = False
        return position

    def _understood(self, opcode: int, position: int) -> bool:
        if opcode == records.HEADER:
            return position == len(records.MAGIC)
        return opcode in _DATA_OPCODES or opcode >= records.FIRST_PRIVATE

    def _anything_after(self, position: int) -> bool:
        """Tell whether the file holds more than the zeros that a power cut leaves behind."""
        while position < self.size:
            data = self._read(position, _RUN_BYTES)
            if data.count(0) < len(data):
                return True
            position += max(len(data), 1)
        return False

    def _walk_messages(self, position: int) -> int:
        """Note the messages outside of chunks from here on; return their bytes."""
        data = np.frombuffer(self._read(position, _RUN_BYTES), np.uint8)
        size, stop = scan.run_length(data)
        if not size and stop == scan.CUT_SHORT and data.size >= records.PREFIX_BYTES:
            _, length = records.prefix.unpack_from(data.data)
            size = records.PREFIX_BYTES + length
            if size > self.size - position:
                return 0
            where = self._where("message", position)
            check_size(size, where)
            data = np.frombuffer(self._read(position, size), np.uint8)
            size, stop = scan.run_length(data)
        walk = scan.walk(data[:size], 0)
        if stop == scan.WRONG_LENGTH or walk.stop == scan.WRONG_TIME:
            at = position + (walk.position if walk.stop else size)
            if not self._salvage:
                raise BagError(f"{self._where('record', at)}: {_STOPS[walk.stop or stop]}: {_DAMAGED}")
            size = walk.position
            walk = scan.walk(data[:size], 0)
        if size:
            times = walk.table.log_time
            self._spans.append(_Span(position, size, None, int(times.min()), int(times.max())))
        return size

    def _note_chunk(self, position: int, length: int, head: bytes) -> None:
        where = self._where("chunk", position)
        content = memoryview(head)[records.PREFIX_BYTES : records.PREFIX_BYTES + length]
        chunk = records.read_chunk_head(Cursor(content, where))
        if chunk.data_offset + chunk.data_size != length:
            raise BagError(f"{where}: its lengths contradict each other: {_DAMAGED}")
        check_size(chunk.uncompressed_size, where)
        offset = position + records.PREFIX_BYTES + chunk.data_offset
        self._spans.append(_Span(offset, chunk.data_size, chunk, chunk.start_ns, chunk.end_ns))

    def _note_record(self, opcode: int, position: int, length: int) -> None:
        where = self._where("record", position)
        if opcode == records.METADATA:
            self._metadata_bytes += length
            if self._metadata_bytes > _MAX_METADATA_BYTES:
                raise BagError(f"{where}: more than {_MAX_METADATA_BYTES >> 20} MiB of metadata: {_DAMAGED}")
            cursor = Cursor(self._read(position + records.PREFIX_BYTES, length), where)
            self.metadata.append((cursor.text(), cursor.text_map()))
            return
        check_size(length, where)
        data = self._read(position, records.PREFIX_BYTES + length)
        self._take_definition(np.frombuffer(data, np.uint8), 0, where)

    def _take_definition(self, data: scan.Bytes, position: int, where: str) -> None:
        """Take note of the schema or channel at a position."""
        opcode, length = records.prefix.unpack_from(data.data, position)
        start = position + records.PREFIX_BYTES
        cursor = Cursor(data[start : start + length].data, where)
        if opcode == records.SCHEMA:
            schema = records.read_schema(cursor)
            if self._schemas.setdefault(schema.id, schema) != schema:
                raise BagError(f"{where}: schema {schema.id} is announced twice, differently: {_DAMAGED}")
            self._text_bytes += length
        elif opcode == records.CHANNEL:
            channel = records.read_channel(cursor)
            if self._channels.setdefault(channel.id, channel) != channel:
                raise BagError(f"{where}: channel {channel.id} is announced twice, differently: {_DAMAGED}")
            self._text_bytes += length
        elif opcode < records.FIRST_PRIVATE:
            raise BagError(f"{where}: a record of kind {opcode} in it, where none may be: {_DAMAGED}")
        if self._text_bytes > _MAX_DEFINITIONS_BYTES or length > MAX_TEXT_BYTES + 65536:
            raise BagError(f"{where}: more definitions than any bag needs: {_DAMAGED}")

    def _read_summary(self, data_end: int) -> None:
        """Take the statistics, schemas and channels from the summary."""
        footer_at = self.size - len(records.MAGIC) - records.FOOTER_BYTES
        footer = self._read(footer_at, records.FOOTER_BYTES)
        opcode, length = records.prefix.unpack_from(footer)
        start, _, crc = records.footer_fields.unpack_from(footer, records.PREFIX_BYTES)
        where = self._where("summary", start)
        if opcode != records.FOOTER or length != records.footer_fields.size:
            raise BagError(f"{self._where('footer', footer_at)}: is not one: {_DAMAGED}")
        if not start:
            return
        if not data_end < start <= footer_at:
            raise BagError(f"{where}: lies outside of its place in the file: {_DAMAGED}")
        check_size(footer_at - start, where)
        summary = self._read(start, footer_at - start)
        if crc and zlib.crc32(footer[:-4], zlib.crc32(summary)) != crc:
            raise BagError(f"{where}: its checksum is wrong: {_DAMAGED}")
        walk = scan.walk(np.frombuffer(summary, np.uint8), len(summary))
        if walk.stop != scan.AT_END or walk.table.offset.size:
            raise BagError(f"{where}: its records do not end where it ends: {_DAMAGED}")
        for position in walk.others.tolist():
            opcode, length = records.prefix.unpack_from(summary, position)
            content = memoryview(summary)[position + records.PREFIX_BYTES :][:length]
            if opcode == records.STATISTICS:
                self._statistics = records.read_statistics(Cursor(content, where))
            elif opcode in (records.SCHEMA, records.CHANNEL):
                self._take_definition(np.frombuffer(summary, np.uint8), position, where)

    def _check_data_crc(self, end: int) -> None:
        if not self._data_crc or self.size > _CRC_FILE_BYTES or self._salvage:
            return
        crc = 0
        for position in range(0, end, _RUN_BYTES):
            crc = zlib.crc32(self._read(position, min(_RUN_BYTES, end - position)), crc)
        if crc != self._data_crc:
            raise BagError(f"{self.path}: the checksum over its data is wrong: {_DAMAGED}")

    def _take_statistics(self, statistics: records.Statistics) -> None:
        counts = statistics.channel_counts
        chunks = sum(span.head is not None for span in self._spans)
        if (
            sum(counts.values()) != statistics.message_count
            or chunks != statistics.chunk_count
            or counts.keys() - self._channels.keys()
            or {channel.schema_id for channel in self._channels.values()} - {0, *self._schemas}
        ):
            self._count()  # the summary leaves something out, as it may: it is in the chunks
            if self._message_count() != statistics.message_count:
                raise BagError(
                    f"{self.path}: holds {self._message_count()} messages where its summary says"
                    f" {statistics.message_count}: {_DAMAGED}"
                )
            return
        held = sum(span.head.uncompressed_size if span.head else span.size for span in self._spans)
        if statistics.message_count * _LEAST_MESSAGE_BYTES > held:
            raise BagError(f"{self.path}: its summary tells of more messages than fit into it: {_DAMAGED}")
        self._set_topics(counts)
        if statistics.message_count:
            self._set_times([(statistics.start_ns, statistics.end_ns)])

    def _message_count(self) -> int:
        return sum(topic.count for topic in self.topics.values())

    def _count(self) -> None:
        """Read all pieces to see what is in them."""
        counts: dict[int, int] = {}
        times: list[tuple[int, int]] = []
        kept: list[_Span] = []
        for number, span in enumerate(self._spans):
            try:
                table = self.load(span)
            except BagError as error:
                torn = not self._finished and number == len(self._spans) - 1
                if not self._salvage and not torn:
                    raise
                self._lose(span.offset, span.size, str(error))
                continue
            kept.append(span)
            for channel, count in zip(*np.unique(table.channel, return_counts=True), strict=True):
                counts[int(channel)] = counts.get(int(channel), 0) + int(count)
            if table.log_time.size:
                times.append((int(table.log_time.min()), int(table.log_time.max())))
        self._spans = kept
        self._set_topics(counts)
        self._set_times(times)

    def _set_times(self, times: list[tuple[int, int]]) -> None:
        self.start_ns = min((start for start, _ in times), default=0)
        self.end_ns = max((end for _, end in times), default=0)

    def _set_topics(self, counts: Mapping[int, int]) -> None:
        for channel in self._channels.values():
            schema = self._schemas.get(channel.schema_id)
            encoding = channel.message_encoding or "no known encoding"
            info = TopicInfo(
                channel.topic,
                schema.name if schema else "",
                counts.get(channel.id, 0),
                str(schema.data, "utf-8", "replace") if schema else "",
                (schema.encoding if schema else "") if channel.message_encoding == "cdr" else encoding,
                channel.metadata.get("offered_qos_profiles", ""),
                channel.metadata.get("topic_type_hash", ""),
                "" if schema or not channel.schema_id else f"its schema {channel.schema_id} is nowhere in the file",
            )
            known = self.topics.get(channel.topic)
            self.topics[channel.topic] = known.joined(info) if known else info
