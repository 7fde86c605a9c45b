"""Rewrite a bag that a crash has cut off, or that is damaged, into a whole one, and account for what is missing."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tdof_npid_ros.bag import metadata
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.mcap_file import McapFile
from tdof_npid_ros.bag.reader import bag_files
from tdof_npid_ros.bag.scan import Table
from tdof_npid_ros.bag.storage import TopicInfo
from tdof_npid_ros.bag.writer import BagWriter

RECOVERABLE: Final = "ros2msg"  # the language of the definitions of topics that are recovered
RECORD: Final = "recovered"  # the metadata record that says so in the new bag


@dataclass(frozen=True)
class RecoveryReport:
    """What `recover` found.

    Attributes
    ----------
    source, destination
        The bags.
    messages
        Recovered messages by topic.
    lost
        Messages that gaps in the sequence numbers show to be missing, by topic; topics without such numbers
        are left out.
    dropped_bytes
        Bytes of the source that could not be read.
    first_ns, last_ns
        Log times of the first and last recovered message; 0 when there is none.
    missing
        For each thing that the source lacks, one line with its place; empty when the source was whole.
    """

    source: Path
    destination: Path
    messages: dict[str, int]
    lost: dict[str, int]
    dropped_bytes: int
    first_ns: int
    last_ns: int
    missing: tuple[str, ...]

    @property
    def whole(self) -> bool:
        """Whether nothing was missing."""
        return not self.missing and not any(self.lost.values())

    def lines(self) -> list[str]:
        """Return the account as lines of text."""
        total = sum(self.messages.values())
        found = [f"{self.destination}: {total} messages recovered, up to {self.last_ns / 1e9:.9f} s"]
        for topic, count in sorted(self.messages.items()):
            lost = self.lost.get(topic)
            gap = "" if lost is None else f", {lost} lost by their sequence numbers"
            found.append(f"  {topic}: {count}{gap}")
        found.append(f"missing: {self.dropped_bytes} bytes" if self.missing else "nothing is missing")
        found.extend(f"  {line}" for line in self.missing)
        return found


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
        self._topic_ids: dict[str, int] = {}
        self._gaps: dict[str, _SequenceGaps] = {}
        self.messages: dict[str, int] = {}
        self.missing: list[str] = []
        self.times: list[tuple[int, int]] = []

    def copy(self, file: McapFile) -> None:
        """Take over all that can be read of a file."""
        self.missing += file.missing
        for topic in file.topics.values():
            self._announce(topic, file)
        for piece in file.pieces():
            self._copy_table(piece.load(), file)
        for name, values in file.metadata:
            self._writer.write_metadata(name, values)

    def lost(self) -> dict[str, int]:
        """Return the gaps by topic."""
        return {topic: gaps.lost for topic, gaps in self._gaps.items() if gaps.lost is not None}

    def _announce(self, topic: TopicInfo, file: McapFile) -> None:
        if topic.encoding != RECOVERABLE or topic.problem:
            what = f"{topic.count} messages of topic {topic.name}, in {topic.encoding or 'an unknown format'}"
            self.missing.append(f"{file.path}: {what}, not CDR with a definition in ros2msg")
        elif topic.name not in self._topic_ids:
            self._topic_ids[topic.name] = self._writer.add_topic(
                topic.name, topic.type, qos=topic.qos, definition=topic.definition, type_hash=topic.type_hash
            )
            self.messages[topic.name] = 0

    def _copy_table(self, table: Table, file: McapFile) -> None:
        names = {channel: name for channel, name in file.topic_of.items() if name in self._topic_ids}
        ids = {channel: self._topic_ids[name] for channel, name in names.items()}
        table = table.only(np.isin(table.channel, list(ids)))
        if not table.log_time.size:
            return
        self.times.append((int(table.log_time.min()), int(table.log_time.max())))
        data = table.data.data
        for channel, sequence, log_time, publish_time, offset, length in zip(
            *(column.tolist() for column in table[1:]), strict=True
        ):
            self._writer.write(ids[channel], data[offset : offset + length], log_time, publish_time, sequence)
        for channel, name in names.items():
            numbers = table.sequence[table.channel == channel].astype(np.int64)
            if numbers.size:
                self.messages[name] += numbers.size
                self._gaps.setdefault(name, _SequenceGaps()).add(numbers)


def recover(source: str | Path, destination: str | Path) -> RecoveryReport:
    """Write all that can be read of a bag to a new one, with index, summary and `metadata.yaml`.

    Parameters
    ----------
    source
        A bag folder or an MCAP file, finished or not. It is not changed.
    destination
        The new bag's folder, which must not exist.

    Returns
    -------
    The account of what is missing. The new bag holds it too, in the metadata record "recovered".

    Raises
    ------
    BagError
        Nothing can be read of the source, or the destination exists or cannot be written.
    """
    source, destination = Path(source), Path(destination)
    if destination.exists():
        raise BagError(f"{destination} exists already and is not overwritten: choose another name")
    paths = bag_files(source)
    if any(path.suffix == ".db3" for path in paths):
        raise BagError(f"{source}: only MCAP bags can be recovered: use sqlite3's `.recover`")
    with ExitStack() as stack:
        files = [McapFile(path, salvage=True) for path in paths]
        for file in files:
            stack.callback(file.close)
        writer = stack.enter_context(BagWriter(destination, custom_data=_custom_data(source)))
        recovery = _Recovery(writer)
        for file in files:
            recovery.copy(file)
        report = RecoveryReport(
            source,
            destination,
            recovery.messages,
            recovery.lost(),
            sum(file.dropped_bytes for file in files),
            min((start for start, _ in recovery.times), default=0),
            max((end for _, end in recovery.times), default=0),
            tuple(recovery.missing),
        )
        writer.write_metadata(RECORD, {"source": str(source), "report": "\n".join(report.lines())})
    return report


def _custom_data(source: Path) -> dict[str, str]:
    """Return the users' part of `metadata.yaml`, as far as it is there."""
    try:
        custom = metadata.read_information(source).get("custom_data") if source.is_dir() else None
    except BagError:
        return {}
    return {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}
