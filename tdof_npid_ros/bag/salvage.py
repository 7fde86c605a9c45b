"""An MCAP file of which all is read that can be: by the walk from the front, and by every index that it holds.

* The walk from the front goes on after damage: at the next place that an index names, or where records fit again.
* The chunk index in the summary tells where chunks lie whose own heads are damaged.
* The message indexes beside the chunks tell where messages lie behind damage within a chunk.
* Message indexes and statistics tell how many messages are missing.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, MessageIndex, Metadata, MetadataIndex, Schema, Statistics

from tdof_npid_ros.bag import records, scan
from tdof_npid_ros.bag.decompress import COMPRESSIONS, check_size
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.mcap_file import (
    HEAD_BYTES,
    MAX_DEFINITIONS,
    RUN_BYTES,
    STOPS,
    McapFile,
    Span,
    TornError,
    UnfollowableError,
)
from tdof_npid_ros.bag.records import DAMAGED

_CHAIN: Final = 3  # records in a row that must fit before one that was found is believed
_MOST_CANDIDATES: Final = 1 << 20  # places looked at for a record that fits
_MOST_INDEX_BYTES: Final = 16 << 20  # of one message index
_MAX_PADDING: Final = 16  # bytes that some writers put after a record's last field
_MOST_LINES: Final = 500  # of the account of one file
_DATA_END_BYTES: Final = 4
_CHECKED: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.MESSAGE_INDEX, Opcode.DATA_END)


class SalvagedFile(McapFile):
    """An MCAP file, whole or not. What is damaged is left out.

    Attributes:
        mended: what is damaged and was read all the same, a line for each thing.
        dropped_bytes: that could not be read.
        lost: messages known to be missing, by topic.
        lost_by: how that is known; empty where nothing tells.
    """

    def __init__(self, path: Path) -> None:
        """Open the file and find its pieces.

        Raises:
            BagError: it cannot be read, or is no MCAP file.
        """
        self.mended: list[str] = []
        self.dropped_bytes = 0
        self.lost: Counter[str] = Counter()
        self.lost_by = ""
        self._chunk_indexes: dict[int, ChunkIndex] = {}
        self._known: list[int] = []  # where records begin, by the indexes
        self._chunk_ends: dict[int, int] = {}  # of the chunks at these places
        self._message_indexes: dict[int, list[tuple[int, int, int]]] = {}  # channel, place, messages, by span offset
        self._lost_spans: list[Span] = []
        self._limit = 0  # where the data ends, as far as is known
        super().__init__(path)

    def load(self, span: Span) -> scan.Table:
        """Return the messages of a piece, as many as can be read.

        Raises:
            BagError: nothing of it can be read.
        """
        table = self._records_of(span)
        known = np.isin(table.channel, list(self._channels))
        if not known.all():
            self._miss(f"{self._where_is(span)}: {int((~known).sum())} messages of channels that are not announced")
            table = table.only(known)
        return table

    def _open(self) -> None:
        self._check_beginning()
        self._limit = self.size
        end_magic = self._read(max(self.size - len(records.MAGIC), 0), len(records.MAGIC)) == records.MAGIC
        self._finished = end_magic and self.size >= 2 * len(records.MAGIC) + records.FOOTER_BYTES
        if self._finished:
            self._limit = self.size - len(records.MAGIC) - records.FOOTER_BYTES
            try:
                self._limit = self._read_summary() or self._limit
            except BagError as error:
                self._miss(f"{self.path}: the index and summary: {self._plain(str(error))}")
        end = self._walk()
        if not self._finished:
            if end < self.size and not self._data_end:
                self._lose(end, self.size - end, "a record without its end")
            self._miss(f"{self.path}: the index and summary: the recording was never finished")
        self._spans.sort(key=lambda span: span.offset)
        self._count()
        self._account()

    def _check_beginning(self) -> None:
        try:
            super()._check_beginning()
        except BagError:
            if not self._fits(len(records.MAGIC), 1):
                raise
            self.mended.append(f"{self.path}: its first {len(records.MAGIC)} bytes, which say that it is an MCAP file")

    # The walk from the front, and how it goes on after damage

    def _walk(self) -> int:
        self._known.sort()
        position = len(records.MAGIC)
        while position < self._limit:
            try:
                step = self._step(position)
            except UnfollowableError as error:
                following = self._go_on(position, error)
                if following is None:
                    if not isinstance(error, TornError) or self._finished:
                        self._lose(position, self._limit - position, str(error))
                        position = self.size
                    break
                position = following
                continue
            except BagError as error:
                _, length = records.read_prefix(self._read(position, records.PREFIX_BYTES))
                step = records.PREFIX_BYTES + length
                self._lose(position, step, str(error))
            if not step:
                break
            position += step
        for offset in sorted(self._chunk_indexes):
            if offset not in self._chunk_ends and self._take_by_index(offset):
                self.mended.append(f"{self._where('chunk', offset)}: was not passed, found by the chunk index")
        return position

    def _step(self, position: int) -> int:
        content = self._read(position, HEAD_BYTES)
        if content[:1] == bytes([Opcode.CHUNK]):
            try:
                return super()._step(position)
            except BagError as error:
                raise UnfollowableError(str(error)) from None
        if len(content) >= records.PREFIX_BYTES:
            opcode, length = records.read_prefix(content)
            fits = records.PREFIX_BYTES + length <= self._limit - position
            if fits and opcode in _CHECKED and not self._is_like(opcode, length, content, position):
                raise UnfollowableError(
                    f"{self._where('record', position)}: its content does not fit its kind: {DAMAGED}"
                )
        return super()._step(position)

    def _go_on(self, position: int, error: BagError) -> int | None:
        """Return where to go on behind a record whose end is not known, None when nothing fits any more."""
        if self._take_by_index(position):
            self.mended.append(f"{self.path}: {self._plain(str(error))}; read by the chunk index")
            return self._chunk_ends[position]
        if self._take_by_own_sizes(position):
            self.mended.append(f"{self.path}: {self._plain(str(error))}; read by the size of its data")
            return self._chunk_ends[position]
        after = bisect_right(self._known, position)
        known = self._known[after] if after < len(self._known) else self._limit
        found = next(self._fitting(position + 1, known), None)
        following, how = (known, "an index") if found is None else (found, "what fits")
        if following >= self._limit:
            return None
        self._lose(position, following - position, str(error), f"; the next record was found by {how}")
        return following

    def _note_chunk(self, position: int, length: int, head: bytes) -> None:
        super()._note_chunk(position, length, head)
        self._chunk_ends[position] = position + records.PREFIX_BYTES + length

    def _take_by_index(self, position: int) -> bool:
        """Take the chunk at a position as the chunk index describes it."""
        index = self._chunk_indexes.get(position)
        if index is None or index.compressed_size > index.chunk_length or position + index.chunk_length > self.size:
            return False
        try:
            check_size(index.compressed_size, "")
            check_size(index.uncompressed_size, "")
        except BagError:
            return False
        head = records.ChunkHead(
            index.message_start_time, index.message_end_time, index.uncompressed_size, 0, index.compression, 0,
            index.compressed_size,
        )  # fmt: skip
        self._take_chunk(position, position + index.chunk_length, head)
        return True

    def _take_by_own_sizes(self, position: int) -> bool:
        """Take the chunk at a position if one of the two sizes that it tells leads to the next record."""
        content = self._read(position, HEAD_BYTES)
        if len(content) < records.PREFIX_BYTES or content[0] != Opcode.CHUNK:
            return False
        _, length = records.read_prefix(content)
        try:
            head = records.read_chunk_head(memoryview(content)[records.PREFIX_BYTES :], "")
            check_size(head.uncompressed_size, "")
        except BagError:
            return False
        for size in (head.data_size, length - head.data_offset):
            end = position + records.PREFIX_BYTES + head.data_offset + size
            if size >= 0 and end < self._limit and self._fits(end):
                self._take_chunk(position, end, head._replace(data_size=size))
                return True
        return False

    def _take_chunk(self, position: int, end: int, head: records.ChunkHead) -> None:
        self._spans.append(Span(end - head.data_size, head.data_size, head, head.start_ns, head.end_ns))
        self._chunk_ends[position] = end

    def _fitting(self, begin: int, end: int) -> Iterator[int]:
        """Yield the places in a part of the file where records fit."""
        looked_at = 0
        for first in range(begin, end, RUN_BYTES):
            data = np.frombuffer(self._read(first, RUN_BYTES + records.PREFIX_BYTES - 1), np.uint8)
            if data.size < records.PREFIX_BYTES:
                return
            count = data.size - records.PREFIX_BYTES + 1
            likely = np.isin(data[:count], [int(opcode) for opcode in records.DATA_OPCODES])
            for byte in range(5, 9):  # the length's upper half, 0 in any record below 4 GiB
                likely &= data[byte : byte + count] == 0
            for place in (np.flatnonzero(likely) + first).tolist():
                looked_at += 1
                if place >= end or looked_at > _MOST_CANDIDATES:
                    return
                if self._fits(place):
                    yield place

    def _fits(self, position: int, chain: int = _CHAIN) -> bool:
        """Tell whether a record lies there, by its content and by the records that follow it."""
        for _ in range(chain):
            content = self._read(position, HEAD_BYTES)
            if position == self._limit:
                return True
            if len(content) < records.PREFIX_BYTES:
                return False
            opcode, length = records.read_prefix(content)
            step = records.PREFIX_BYTES + length
            if step > self._limit - position or not self._is_like(opcode, length, content, position):
                return False
            if opcode == Opcode.DATA_END:
                return True
            position += step
        return True

    def _is_like(self, opcode: int, length: int, content: bytes, position: int) -> bool:
        """Tell whether the content that begins so can be a record of this kind."""
        if opcode == Opcode.MESSAGE:
            channel = int.from_bytes(content[records.PREFIX_BYTES :][:2], "little")
            return length >= records.MESSAGE_FIELDS_BYTES and channel in self._channels
        if opcode == Opcode.DATA_END:
            return length == 4
        if opcode == Opcode.HEADER:
            return position == len(records.MAGIC)
        if opcode == Opcode.CHUNK:
            return self._is_like_chunk(length, content)
        if opcode == Opcode.MESSAGE_INDEX:
            entries = int.from_bytes(content[records.PREFIX_BYTES + 2 :][:4], "little")
            return entries % 16 == 0 and 0 <= length - 6 - entries <= _MAX_PADDING
        kinds = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata}
        kind = kinds.get(Opcode(opcode)) if opcode in records.DATA_OPCODES else None
        if kind is None or length > _MOST_INDEX_BYTES:
            return bool(opcode == Opcode.ATTACHMENT)
        try:
            record = records.read(kind, self._read(position + records.PREFIX_BYTES, length), "")
        except BagError:
            return False
        return 0 <= records.PREFIX_BYTES + length - len(records.as_bytes(record)) <= _MAX_PADDING

    def _is_like_chunk(self, length: int, content: bytes) -> bool:
        try:
            head = records.read_chunk_head(memoryview(content)[records.PREFIX_BYTES :], "")
            check_size(head.uncompressed_size, "")
        except BagError:
            return False
        whole = head.data_offset + head.data_size == length
        return whole and head.start_ns <= head.end_ns and head.compression in COMPRESSIONS

    # What the indexes tell

    def _take_summary_record(self, summary: scan.Bytes, position: int, where: str) -> None:
        super()._take_summary_record(summary, position, where)
        opcode, length = records.read_prefix(summary.data, position)
        content = summary[position + records.PREFIX_BYTES :][:length].data
        if opcode == Opcode.CHUNK_INDEX:
            index = records.read(ChunkIndex, content, where)
            self._chunk_indexes[index.chunk_start_offset] = index
            self._known += (index.chunk_start_offset, *index.message_index_offsets.values())
        elif opcode == Opcode.METADATA_INDEX:
            self._known.append(records.read(MetadataIndex, content, where).offset)
        elif opcode == Opcode.ATTACHMENT_INDEX:
            self._known.append(records.read(AttachmentIndex, content, where).offset)

    def _note(self, opcode: int, position: int, length: int, head: bytes) -> None:
        super()._note(opcode, position, length, head)
        if opcode == Opcode.MESSAGE_INDEX and self._spans and self._spans[-1].head:
            content = head[records.PREFIX_BYTES :]
            channel, size = int.from_bytes(content[:2], "little"), int.from_bytes(content[2:6], "little")
            if size + 6 <= length:
                found = self._message_indexes.setdefault(self._spans[-1].offset, [])
                found.append((channel, position + records.PREFIX_BYTES, size // 16))

    def _index_entries(self, span: Span) -> Iterator[tuple[int, int, int]]:
        """Yield channel, log time and place within a chunk of each message that its message indexes name."""
        for channel, place, count in self._message_indexes.get(span.offset, []):
            size = 6 + 16 * count
            if size <= _MOST_INDEX_BYTES:
                index = records.read(MessageIndex, self._read(place, size), self._where("message index", place))
                yield from ((channel, time, offset) for time, offset in index.records)

    # Damage within a piece

    def _records_of(self, span: Span) -> scan.Table:
        content, where = self._content_of(span), self._where_is(span)
        walk = scan.walk(content, MAX_DEFINITIONS)
        if walk.stop == scan.TOO_MANY:
            raise BagError(f"{where}: the record at byte 0 {STOPS[walk.stop]}: {DAMAGED}")
        table = walk.table
        if walk.stop != scan.AT_END:
            before = scan.walk(content[: walk.position], MAX_DEFINITIONS)
            table = self._with_indexed(before.table, content, walk.position, span)
            others = before.others
            self._say_damage(span, walk, table)
        else:
            others = walk.others
        for position in others.tolist():
            try:
                self._take_definition(content, position, where)
            except BagError as error:
                self._miss(f"{self.path}: {self._plain(str(error))}")
        return table

    def _with_indexed(self, table: scan.Table, content: scan.Bytes, damage: int, span: Span) -> scan.Table:
        """Return a table with the messages behind the damage that the chunk's indexes lead to."""
        tables = [table]
        for channel, time, offset in sorted(self._index_entries(span), key=lambda entry: entry[2]):
            if not damage <= offset <= content.size - records.PREFIX_BYTES - records.MESSAGE_FIELDS_BYTES:
                continue
            _, length = records.read_prefix(content.data, offset)
            end = offset + records.PREFIX_BYTES + length
            if content[offset] != Opcode.MESSAGE or end > content.size:
                continue
            one = scan.walk(content[offset:end], 0)
            if one.stop == scan.AT_END and (int(one.table.channel[0]), int(one.table.log_time[0])) == (channel, time):
                tables.append(one.table._replace(offset=one.table.offset + offset))
        columns = [np.concatenate(parts) for parts in zip(*(found[1:] for found in tables), strict=True)]
        return scan.Table(content, *columns)

    def _say_damage(self, span: Span, walk: scan.Walk, table: scan.Table) -> None:
        line = f"{self._where_is(span)}: the record at byte {walk.position} of it {STOPS[walk.stop]}"
        named = self._message_indexes.get(span.offset)
        if named is None:
            self._miss(f"{line}; what follows is lost, it has no message index")
        else:
            lost = sum(count for *_, count in named) - table.length.size
            self._miss(f"{line}; {max(lost, 0)} messages are lost, by its message indexes")

    # The account

    def _leave_out(self, span: Span, is_last: bool, why: str) -> bool:
        named = self._message_indexes.get(span.offset)
        told = f"; it held {sum(count for *_, count in named)} messages, by its message indexes" if named else ""
        self._lost_spans.append(span)
        self._lose(span.offset, span.size, why, told)
        return True

    def _account(self) -> None:
        """Find out how many messages are missing: by the statistics, else by the message indexes."""
        if self._finished and self._data_end and not self.missing and not self.mended:
            try:
                self._check_data_crc(self._data_end - records.PREFIX_BYTES - _DATA_END_BYTES)
            except BagError as error:
                self.mended.append(f"{self.path}: {self._plain(str(error))}; nothing shows what is damaged")
        if self._statistics is not None:
            self.lost_by = "the file's statistics"
            self.lost = self._lost_by_statistics(self._statistics)
        elif any(span.offset in self._message_indexes for span in self._lost_spans):
            self.lost_by = "the message indexes of the lost chunks"
            for span in self._lost_spans:
                for channel, _, count in self._message_indexes.get(span.offset, []):
                    if channel in self._channels:
                        self.lost[self._channels[channel].topic] += count

    def _lost_by_statistics(self, statistics: Statistics) -> Counter[str]:
        lost: Counter[str] = Counter()
        for channel, expected in statistics.channel_message_counts.items():
            info = self.channels.get(channel)
            if info is None:
                self._miss(f"{self.path}: {expected} messages of channel {channel}, which is not announced any more")
            elif expected > info.count:
                lost[info.name] += expected - info.count
        return lost

    def _lose(self, offset: int, size: int, why: str, told: str = "") -> None:
        self._miss(f"{self.path}: {size} bytes from byte {offset} on: {self._plain(why)}{told}")
        self.dropped_bytes += size

    def _miss(self, line: str) -> None:
        if len(self.missing) == _MOST_LINES:
            self.missing.append(f"{self.path}: there is more damage than is listed here")
        if len(self.missing) < _MOST_LINES and line not in self.missing:
            self.missing.append(line)

    def _plain(self, why: str) -> str:
        """What an error says, without the file's name and without the advice to do what is being done."""
        return why.removeprefix(f"{self.path}: ").removesuffix(f": {DAMAGED}")
