"""Read an MCAP file, whole or cut off by a crash. No length, count or time in it is believed unchecked.

The records' heads are walked once from the front, which finds the chunks without trusting the index, and
finds where a file ends that was never finished. Counts come from the summary when there is one, else from the
chunks themselves. `salvage.SalvagedFile` reads what is damaged, too.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Footer, Metadata, Schema, Statistics

from tdof_npid_ros.bag import records, scan
from tdof_npid_ros.bag.decompress import check_size, decompress
from tdof_npid_ros.bag.definition import MAX_TEXT_BYTES
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.records import DAMAGED
from tdof_npid_ros.bag.storage import Piece, TopicInfo
from tdof_npid_ros.input_file import InputError, open_file

HEAD_BYTES: Final = 4096  # read at each record: more than any chunk's head
RUN_BYTES: Final = 1 << 20  # messages outside of chunks are read in pieces of this size
CDR: Final = "cdr"

_CRC_FILE_BYTES: Final = 256 << 20  # the checksum over all data is verified in files up to this size
_MAX_DEFINITIONS_BYTES: Final = 64 << 20
_LEAST_MESSAGE_BYTES: Final = records.PREFIX_BYTES + records.MESSAGE_FIELDS_BYTES
_MAX_METADATA_BYTES: Final = 16 << 20
MAX_DEFINITIONS: Final = 2 * 2**16  # in one chunk: every schema and every channel that there can be

STOPS: Final = {
    scan.CUT_SHORT: "is longer than what holds it",
    scan.WRONG_LENGTH: "is a message too short for its own fields",
    scan.WRONG_TIME: "bears a time beyond the year 2262",
    scan.TOO_MANY: "is the first of more definitions than any bag needs",
}
_OTHERS: Final = {  # how files of other formats begin, and what to do with them
    b"#ROSBAG V": "is a ROS 1 bag: convert it with `rosbags-convert --src FILE.bag --dst NEW` (pip install rosbags)",
    b"\x28\xb5\x2f\xfd": "is compressed as a whole: unpack it with `zstd -d FILE`",
    b"\x04\x22\x4d\x18": "is compressed as a whole: unpack it with `lz4 -d FILE`",
    b"\x1f\x8b": "is compressed as a whole: unpack it with `gunzip FILE`",
    b"SQLite format 3\0": "is an SQLite file: name it .db3 if it is a bag",
    b"version https://git-lfs": "is only the place holder of a file in Git LFS: get it with `git lfs pull`",
}


class Span(NamedTuple):
    """Where messages lie: a chunk's data, or whole message records (`head` is None)."""

    offset: int
    size: int
    head: records.ChunkHead | None
    start_ns: int
    end_ns: int


class UnfollowableError(BagError):
    """A record of which it cannot be told where it ends."""


class TornError(UnfollowableError):
    """A record that goes on beyond the end of the file."""


class McapFile:
    """An open MCAP file: a `Storage`.

    Attributes:
        path: of the file.
        channels: what each channel number stands for.
        attachments: where they lie: first byte and length of the content.
    """

    def __init__(self, path: Path) -> None:
        """Open the file and find its pieces.

        Raises:
            BagError: it cannot be read, is no MCAP file or is damaged. A file that only ends too early is no error.
        """
        self.path = path
        self.name = str(path)
        self.topics: dict[str, TopicInfo] = {}
        self.channels: dict[int, TopicInfo] = {}
        self.start_ns = 0
        self.end_ns = 0
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.missing: list[str] = []
        self.attachments: list[tuple[int, int]] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._text_bytes = 0
        self._spans: list[Span] = []
        self._metadata_bytes = 0
        self._data_crc = 0
        self._data_end = 0  # where the record that ends the data ends
        self._finished = False  # the file ends as a finished one does
        self._statistics: Statistics | None = None
        try:
            self._file = open_file(path)
        except InputError as error:
            raise BagError(f"cannot open a bag: {error}") from None
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self._open()
        except BaseException:
            self._file.close()
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
        self._file.close()

    def load(self, span: Span) -> scan.Table:
        """Return the messages of a piece.

        Raises:
            BagError: the piece is damaged.
        """
        where = self._where_is(span)
        table = self._records_of(span)
        unknown = set(scan.distinct(table.channel).tolist()) - self._channels.keys()
        if unknown:
            raise BagError(f"{where}: messages of channel {min(unknown)}, which is not announced: {DAMAGED}")
        if table.log_time.size and not (
            span.start_ns <= int(table.log_time.min()) and int(table.log_time.max()) <= span.end_ns
        ):
            raise BagError(f"{where}: messages of other times than it announces: {DAMAGED}")
        return table

    def attachment(self, offset: int, length: int) -> Attachment:
        """Return an attachment.

        Raises:
            BagError: it is damaged.
        """
        where = self._where("attachment", offset)
        check_size(length, where)
        return records.read(Attachment, self._read(offset, length), where)

    def _content_of(self, span: Span) -> scan.Bytes:
        """Return a piece's records as bytes."""
        where = self._where_is(span)
        data = self._read(span.offset, span.size)
        if len(data) < span.size:
            raise BagError(f"{where}: the file has become shorter since it was opened: open it again")
        return decompress(span.head, data, where) if span.head else np.frombuffer(data, np.uint8)

    def _records_of(self, span: Span) -> scan.Table:
        """Return a piece's messages, and take note of the definitions among them."""
        content, where = self._content_of(span), self._where_is(span)
        walk = scan.walk(content, MAX_DEFINITIONS)
        if walk.stop != scan.AT_END:
            raise BagError(f"{where}: the record at byte {walk.position} {STOPS[walk.stop]}: {DAMAGED}")
        for position in walk.others.tolist():
            self._take_definition(content, position, where)
        return walk.table

    def _where_is(self, span: Span) -> str:
        return self._where("chunk" if span.head else "messages", span.offset)

    def _where(self, what: str, offset: int) -> str:
        return f"{self.path}: {what} at byte {offset}"

    def _read(self, offset: int, size: int) -> bytes:
        try:
            parts = []
            while size:
                part = os.pread(self._file.fileno(), size, offset)
                if not part:
                    break
                parts.append(part)
                offset += len(part)
                size -= len(part)
            return parts[0] if len(parts) == 1 else b"".join(parts)
        except (OSError, OverflowError) as error:
            raise BagError(f"cannot read {self.path} at byte {offset}: {error}") from None

    def _open(self) -> None:
        self._check_beginning()
        self._finished = (
            self.size >= 2 * len(records.MAGIC) + records.FOOTER_BYTES
            and self._read(self.size - len(records.MAGIC), len(records.MAGIC)) == records.MAGIC
        )
        start = self._read_summary() if self._finished else 0
        end = self._walk()
        if self._finished:
            if self._data_end != (start or self.size - len(records.MAGIC) - records.FOOTER_BYTES):
                raise BagError(f"{self._where('record', end)}: ends elsewhere than the data: {DAMAGED}")
            self._check_data_crc(end)
        else:
            self._note_unfinished(end)
        if self._statistics is None:
            self._count()
        else:
            self._take_statistics(self._statistics)

    def _check_beginning(self) -> None:
        begin = self._read(0, 32)
        if records.MAGIC.startswith(begin[: len(records.MAGIC)]):
            return
        for magic, advice in _OTHERS.items():
            if begin.startswith(magic):
                raise BagError(f"{self.path}: {advice}")
        raise BagError(f"{self.path}: does not begin as an MCAP file: it is something else or damaged")

    def _note_unfinished(self, end: int) -> None:
        if end < self.size and not self._data_end:
            self.missing.append(f"{self.path}: {self.size - end} bytes from byte {end} on: a record without its end")
        self.missing.append(f"{self.path}: the index and summary: the recording was never finished")

    def _walk(self) -> int:
        """Find the pieces; return where the data section ends, or the last whole record of an unfinished file."""
        position = len(records.MAGIC)
        while True:
            try:
                step = self._step(position)
            except UnfollowableError as error:
                torn = isinstance(error, TornError) or self._only_zeros(position)
                if self._finished or not torn:
                    raise
                return position
            if not step:
                return position
            position += step

    def _step(self, position: int) -> int:
        """Take note of the record at a position, or of all messages from there on; return the bytes to the next.

        Returns 0 where the data ends.

        Raises:
            UnfollowableError: it cannot be told where the record ends.
            BagError: the record is damaged.
        """
        head = self._read(position, HEAD_BYTES)
        where = self._where("record", position)
        if len(head) < records.PREFIX_BYTES:
            raise TornError(f"{where}: is longer than the file: {DAMAGED}")
        opcode, length = records.read_prefix(head)
        if opcode == Opcode.MESSAGE:
            return self._note_messages(position)
        step = records.PREFIX_BYTES + length
        if not self._understood(opcode, position):
            raise UnfollowableError(f"{where}: of unknown kind {opcode}: {DAMAGED}")
        if step > self.size - position:
            raise TornError(f"{where}: is longer than the file: {DAMAGED}")
        if opcode == Opcode.DATA_END and length >= 4:
            self._data_crc = int.from_bytes(head[records.PREFIX_BYTES :][:4], "little")
            self._data_end = position + step
            return 0
        self._note(opcode, position, length, head)
        return step

    def _note(self, opcode: int, position: int, length: int, head: bytes) -> None:
        """Take note of a record that is no message."""
        if opcode == Opcode.CHUNK:
            self._note_chunk(position, length, head)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            check_size(length, self._where("record", position))
            data = self._read(position, records.PREFIX_BYTES + length)
            self._take_definition(np.frombuffer(data, np.uint8), 0, self._where("record", position))
        elif opcode == Opcode.METADATA:
            self._note_metadata(position, length)
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.append((position + records.PREFIX_BYTES, length))

    def _understood(self, opcode: int, position: int) -> bool:
        if opcode == Opcode.HEADER:
            return position == len(records.MAGIC)
        return opcode in records.DATA_OPCODES or opcode >= records.FIRST_PRIVATE

    def _only_zeros(self, position: int) -> bool:
        """Tell whether nothing follows but the zeros that a power cut leaves behind."""
        while position < self.size:
            data = self._read(position, RUN_BYTES)
            if data.count(0) < len(data):
                return False
            position += max(len(data), 1)
        return True

    def _note_messages(self, position: int) -> int:
        """Note the messages outside of chunks from here on; return their bytes."""
        data = np.frombuffer(self._read(position, RUN_BYTES), np.uint8)
        size, stop = scan.run_length(data)
        if not size and stop == scan.CUT_SHORT:
            _, length = records.read_prefix(data.data)
            size = records.PREFIX_BYTES + length
            if size > self.size - position:
                raise TornError(f"{self._where('record', position)}: is longer than the file: {DAMAGED}")
            check_size(size, self._where("message", position))
            data = np.frombuffer(self._read(position, size), np.uint8)
            size, stop = scan.run_length(data)
        walk = scan.walk(data[:size], 0)
        if walk.stop == scan.WRONG_TIME:
            size = walk.position
            walk = scan.walk(data[:size], 0)
            stop = scan.WRONG_TIME
        if not size:
            raise UnfollowableError(f"{self._where('record', position)}: {STOPS[stop]}: {DAMAGED}")
        times = walk.table.log_time
        self._spans.append(Span(position, size, None, int(times.min()), int(times.max())))
        return size

    def _note_chunk(self, position: int, length: int, head: bytes) -> None:
        where = self._where("chunk", position)
        chunk = records.read_chunk_head(memoryview(head)[records.PREFIX_BYTES :][:length], where)
        if chunk.data_offset + chunk.data_size != length:
            raise UnfollowableError(f"{where}: its lengths contradict each other: {DAMAGED}")
        check_size(chunk.uncompressed_size, where)
        check_size(chunk.data_size, where)
        offset = position + records.PREFIX_BYTES + chunk.data_offset
        self._spans.append(Span(offset, chunk.data_size, chunk, chunk.start_ns, chunk.end_ns))

    def _note_metadata(self, position: int, length: int) -> None:
        where = self._where("record", position)
        if self._metadata_bytes + length > _MAX_METADATA_BYTES:
            raise BagError(f"{where}: more than {_MAX_METADATA_BYTES >> 20} MiB of metadata: {DAMAGED}")
        self._metadata_bytes += length
        record = records.read(Metadata, self._read(position + records.PREFIX_BYTES, length), where)
        self.metadata.append((record.name, record.metadata))

    def _take_definition(self, data: scan.Bytes, position: int, where: str) -> None:
        """Take note of the schema or channel at a position."""
        opcode, length = records.read_prefix(data.data, position)
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            if opcode < records.FIRST_PRIVATE:
                raise BagError(f"{where}: a record of kind {opcode} in it, where none may be: {DAMAGED}")
            return
        content = data[position + records.PREFIX_BYTES :][:length].data
        if opcode == Opcode.SCHEMA:
            schema = records.read(Schema, content, where)
            if schema.id not in self._schemas:
                self._check_budget(length, where)
            if self._schemas.setdefault(schema.id, schema) != schema:
                raise BagError(f"{where}: schema {schema.id} is announced twice, differently: {DAMAGED}")
        else:
            channel = records.read(Channel, content, where)
            if channel.id not in self._channels:
                self._check_budget(length, where)
            if self._channels.setdefault(channel.id, channel) != channel:
                raise BagError(f"{where}: channel {channel.id} is announced twice, differently: {DAMAGED}")

    def _check_budget(self, length: int, where: str) -> None:
        """Take note of so many bytes of definitions, of which a file may hold only so many."""
        if self._text_bytes + length > _MAX_DEFINITIONS_BYTES or length > MAX_TEXT_BYTES + 65536:
            raise BagError(f"{where}: more definitions than any bag needs: {DAMAGED}")
        self._text_bytes += length

    def _read_summary(self) -> int:
        """Take the statistics, schemas and channels from the summary; return where it begins, 0 where there is none."""
        footer_at = self.size - len(records.MAGIC) - records.FOOTER_BYTES
        content = self._read(footer_at, records.FOOTER_BYTES)
        if records.read_prefix(content) != (Opcode.FOOTER, records.FOOTER_BYTES - records.PREFIX_BYTES):
            raise BagError(f"{self._where('footer', footer_at)}: is not one: {DAMAGED}")
        footer = records.read(Footer, content[records.PREFIX_BYTES :], self._where("footer", footer_at))
        start = footer.summary_start
        if not start:
            return 0
        where = self._where("summary", start)
        if not len(records.MAGIC) <= start <= footer_at:
            raise BagError(f"{where}: lies outside of its place in the file: {DAMAGED}")
        check_size(footer_at - start, where)
        summary = self._read(start, footer_at - start)
        if footer.summary_crc and zlib.crc32(content[:-4], zlib.crc32(summary)) != footer.summary_crc:
            raise BagError(f"{where}: its checksum is wrong: {DAMAGED}")
        walk = scan.walk(np.frombuffer(summary, np.uint8), len(summary))
        if walk.stop != scan.AT_END or walk.table.offset.size:
            raise BagError(f"{where}: its records do not end where it ends: {DAMAGED}")
        for position in walk.others.tolist():
            self._take_summary_record(np.frombuffer(summary, np.uint8), position, where)
        return int(start)

    def _take_summary_record(self, summary: scan.Bytes, position: int, where: str) -> None:
        opcode, length = records.read_prefix(summary.data, position)
        if opcode == Opcode.STATISTICS:
            content = summary[position + records.PREFIX_BYTES :][:length].data
            self._statistics = records.read(Statistics, content, where)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._take_definition(summary, position, where)

    def _check_data_crc(self, end: int) -> None:
        if not self._data_crc or self.size > _CRC_FILE_BYTES:
            return
        crc = 0
        for position in range(0, end, RUN_BYTES):
            crc = zlib.crc32(self._read(position, min(RUN_BYTES, end - position)), crc)
        if crc != self._data_crc:
            raise BagError(f"{self.path}: the checksum over its data is wrong: {DAMAGED}")

    def _take_statistics(self, statistics: Statistics) -> None:
        counts = statistics.channel_message_counts
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
                    f" {statistics.message_count}: {DAMAGED}"
                )
            return
        held = sum(span.head.uncompressed_size if span.head else span.size for span in self._spans)
        if statistics.message_count * _LEAST_MESSAGE_BYTES > held:
            raise BagError(f"{self.path}: its summary tells of more messages than fit into it: {DAMAGED}")
        self._set_topics(counts)
        if statistics.message_count:
            self._set_times([(statistics.message_start_time, statistics.message_end_time)])

    def _message_count(self) -> int:
        return sum(topic.count for topic in self.topics.values())

    def _count(self) -> None:
        """Read all pieces to see what is in them."""
        counts: dict[int, int] = {}
        times: list[tuple[int, int]] = []
        kept: list[Span] = []
        for number, span in enumerate(self._spans):
            try:
                table = self.load(span)
            except BagError as error:
                if not self._leave_out(span, number == len(self._spans) - 1, str(error)):
                    raise
                continue
            kept.append(span)
            for channel, count in zip(*np.unique(table.channel, return_counts=True), strict=True):
                counts[int(channel)] = counts.get(int(channel), 0) + int(count)
            if table.log_time.size:
                times.append((int(table.log_time.min()), int(table.log_time.max())))
        self._spans = kept
        self._set_topics(counts)
        self._set_times(times)

    def _leave_out(self, span: Span, is_last: bool, why: str) -> bool:
        """Do without a piece that is damaged, if a crash may have torn it; tell whether that is so."""
        if self._finished or not is_last:
            return False
        self.missing.append(f"{self.path}: {span.size} bytes from byte {span.offset} on: {why}")
        return True

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
                (schema.encoding if schema else "") if channel.message_encoding == CDR else encoding,
                channel.metadata.get("offered_qos_profiles", ""),
                channel.metadata.get("topic_type_hash", ""),
                "" if schema or not channel.schema_id else f"its schema {channel.schema_id} is nowhere in the file",
            )
            self.channels[channel.id] = info
            known = self.topics.get(channel.topic)
            self.topics[channel.topic] = known.joined(info) if known else info
