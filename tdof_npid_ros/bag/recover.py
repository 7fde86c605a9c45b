"""Rewrite a bag that a crash has cut off, or that is damaged, into a whole one, and account for what is missing."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tdof_npid_ros.bag.columns import ColumnBuilder, Skipped
from tdof_npid_ros.bag.errors import BagError, shown
from tdof_npid_ros.bag.folder import SQLITE, BagFolder
from tdof_npid_ros.bag.salvage import SalvagedFile
from tdof_npid_ros.bag.scan import Table
from tdof_npid_ros.bag.storage import CDR_DEFINITIONS, TopicInfo
from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.one_line import as_text, one_line

RECORD: Final = "recovered"  # the metadata record that says so in the new bag


@dataclass(frozen=True)
class RecoveryReport:
    """What `recover` found.

    Attributes:
        source, destination: the bags.
        messages: recovered messages by topic.
        lost: messages that gaps in the sequence numbers show to be missing, by topic; topics without such numbers
            are left out.
        missing_messages: messages that the source's own statistics or indexes show to be missing, by topic.
        undecodable: recovered messages that cannot be decoded, by topic, with the first one's reason. They are in the
            new bag as they were in the old.
        dropped_bytes: bytes of the source that could not be read.
        first_ns, last_ns: log times of the first and last recovered message; 0 when there is none.
        missing: for each thing that the source lacks, one line with its place; empty when the source was whole.
        mended: for each thing that is damaged in the source but was read all the same, one line.
    """

    source: Path
    destination: Path
    messages: dict[str, int]
    lost: dict[str, int]
    missing_messages: dict[str, int]
    undecodable: dict[str, Skipped]
    dropped_bytes: int
    first_ns: int
    last_ns: int
    missing: tuple[str, ...]
    mended: tuple[str, ...]

    @property
    def whole(self) -> bool:
        """Whether nothing was missing."""
        return not self.missing and not any(self.lost.values()) and not self.missing_messages

    def lines(self) -> list[str]:
        """Return the account as lines of text."""
        total = sum(self.messages.values())
        found = [f"{self.destination}: {total} messages recovered, up to {self.last_ns / 1e9:.9f} s"]
        for topic in sorted(self.messages.keys() | self.missing_messages.keys()):
            found.append(f"  {shown(topic)}: {self.messages.get(topic, 0)}{self._gaps(topic)}")
        lost = f" {self.dropped_bytes} bytes" if self.dropped_bytes else ""
        found.append(f"missing:{lost}" if self.missing else "nothing is missing")
        found.extend(f"  {one_line(line)}" for line in self.missing)
        if self.mended:
            found.append("damaged, but read:")
            found.extend(f"  {one_line(line)}" for line in self.mended)
        return found

    def _gaps(self, topic: str) -> str:
        """What is known of a topic's missing and undecodable messages."""
        told = ""
        if topic in self.missing_messages:
            told += f", {self.missing_messages[topic]} missing by the file's own count"
        if topic in self.lost:
            told += f", {self.lost[topic]} lost by their sequence numbers"
        if topic in self.undecodable:
            skipped = self.undecodable[topic]
            told += f", {skipped.count} of them cannot be decoded ({one_line(skipped.reason)})"
        return told


class _SequenceGaps:
    """Counts the gaps of one topic's sequence numbers, as long as they only grow, as one publisher's do."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._lost = 0
        self._grows = True

    def add(self, sequence: np.ndarray[tuple[int], np.dtype[np.int64]]) -> None:
        """Take the numbers of the next messages, in file order."""
        if self._last is not None:
            sequence = np.concatenate([[self._last], sequence])
        steps = np.diff(sequence)
        self._grows = self._grows and bool((steps > 0).all())
        self._lost += int(steps.sum()) - steps.size
        self._last = int(sequence[-1])

    @property
    def lost(self) -> int | None:
        """Messages missing, or None when the numbers do not tell."""
        return self._lost if self._grows else None


class _Recovery:
    """The bag being written, and what is known of it."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._topic_ids: dict[tuple[str, str, str], int] = {}  # by name, type and definition
        self._gaps: dict[str, _SequenceGaps] = {}
        self._checks: dict[int, ColumnBuilder] = {}  # by topic id, where there is a definition to go by
        self.messages: dict[str, int] = {}
        self.missing_messages: Counter[str] = Counter()
        self.undecodable: dict[str, Skipped] = {}
        self.missing: list[str] = []
        self.mended: list[str] = []
        self.times: list[tuple[int, int]] = []

    def copy(self, file: SalvagedFile) -> None:
        """Take over all that can be read of a file."""
        self.mended += file.mended
        self.missing_messages += file.lost
        ids = {
            number: self._announce(channel)
            for number, channel in file.channels.items()
            if not self._is_left_out(channel, file)
        }
        for piece in file.pieces():
            self._copy_table(piece.load(), ids, file)
        for name, values in file.metadata:
            self._writer.write_metadata(name, values)
        for place in file.attachments:
            try:
                self._writer.write_attachment(file.attachment(*place))
            except BagError as error:
                self.missing.append(str(error))
        self.missing += file.missing

    def lost(self) -> dict[str, int]:
        """Return the gaps by topic."""
        return {topic: gaps.lost for topic, gaps in self._gaps.items() if gaps.lost is not None}

    def _is_left_out(self, channel: TopicInfo, file: SalvagedFile) -> bool:
        """Whether ROS could not read a channel's messages, and with them the whole bag."""
        left_out = channel.encoding not in CDR_DEFINITIONS or not channel.type
        if left_out:
            how = "of no type" if channel.encoding in CDR_DEFINITIONS else f"in {shown(channel.encoding)}"
            what = f"{channel.count} messages of topic {shown(channel.name)}, {how}"
            self.missing.append(f"{file.path}: {what}: ROS 2 does not read them, they are left out")
        return left_out

    def _announce(self, channel: TopicInfo) -> int:
        key = channel.name, channel.type, channel.definition
        if key not in self._topic_ids:
            number = self._writer.add_topic(
                channel.name,
                channel.type,
                qos=channel.qos,
                definition=channel.definition,
                type_hash=channel.type_hash,
                encoding=channel.encoding,
            )
            self._topic_ids[key] = number
            self.messages.setdefault(channel.name, 0)
            with suppress(BagError):
                self._checks[number] = ColumnBuilder(channel.fields(), [], f"topic {shown(channel.name)}")
        return self._topic_ids[key]

    def _copy_table(self, table: Table, ids: dict[int, int], file: SalvagedFile) -> None:
        table = table.only(np.isin(table.channel, list(ids)))
        if not table.log_time.size:
            return
        self.times.append((int(table.log_time.min()), int(table.log_time.max())))
        data = table.data.data
        for channel, sequence, log_time, publish_time, offset, length in zip(
            *(column.tolist() for column in table[1:]), strict=True
        ):
            self._writer.write(ids[channel], data[offset : offset + length], log_time, publish_time, sequence)
        for channel, number in ids.items():
            mine = table.channel == channel
            if mine.any():
                self._take_note(file.channels[channel].name, number, table.only(mine))

    def _take_note(self, topic: str, number: int, table: Table) -> None:
        self.messages[topic] += table.length.size
        self._gaps.setdefault(topic, _SequenceGaps()).add(table.sequence.astype(np.int64))
        check = self._checks.get(number)
        if check is not None:
            check.add(table)
            if check.skipped is not None:
                self.undecodable[topic] = check.skipped


def recover(source: str | Path, destination: str | Path) -> RecoveryReport:
    """Write all that can be read of a bag to a new one, with index, summary and `metadata.yaml`.

    Args:
        source: a bag folder or an MCAP file, finished or not. It is not changed.
        destination: the new bag's folder, which must not exist.

    Returns:
        The account of what is missing. The new bag holds it too, in the metadata record "recovered".

    Raises:
        BagError: nothing can be read of the source, or the destination exists or cannot be written.
    """
    source, destination = Path(source), Path(destination)
    if destination.exists() or destination.is_symlink():
        raise BagError(f"{destination} exists already and is not overwritten: choose another name")
    bag = BagFolder.of(source, salvage=True)
    if any(path.suffix == SQLITE for path in bag.files):
        raise BagError(f"{source}: only MCAP bags can be recovered: use sqlite3's `.recover`")
    with ExitStack() as stack:
        files = []
        missing = list(bag.missing)
        for path in bag.files:
            try:
                files.append(stack.enter_context(closing(SalvagedFile(path))))
            except BagError as error:
                if len(bag.files) == 1:
                    raise
                missing.append(str(error))
        if not files:
            raise BagError(f"{source}: none of its files can be read: {missing[-1]}")
        writer = stack.enter_context(BagWriter(destination, custom_data=bag.custom_data))
        recovery = _Recovery(writer)
        for file in files:
            recovery.copy(file)
        report = RecoveryReport(
            source,
            destination,
            recovery.messages,
            recovery.lost(),
            dict(recovery.missing_messages),
            recovery.undecodable,
            sum(file.dropped_bytes for file in files),
            min((start for start, _ in recovery.times), default=0),
            max((end for _, end in recovery.times), default=0),
            (*missing, *recovery.missing),
            tuple(recovery.mended),
        )
        writer.write_metadata(RECORD, {"source": as_text(source), "report": as_text("\n".join(report.lines()))})
    return report
