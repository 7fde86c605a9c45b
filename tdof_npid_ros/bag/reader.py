"""Read bags: messages in log-time order, or a topic's fields as NumPy columns."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np

from tdof_npid_ros.bag.cdr import decode_with
from tdof_npid_ros.bag.columns import ColumnBuilder, Columns, Skipped
from tdof_npid_ros.bag.definition import Definition
from tdof_npid_ros.bag.errors import BagError, choices, shown
from tdof_npid_ros.bag.folder import SQLITE, BagFolder
from tdof_npid_ros.bag.mcap_file import McapFile
from tdof_npid_ros.bag.scan import Table
from tdof_npid_ros.bag.sqlite_file import SqliteFile
from tdof_npid_ros.bag.storage import Piece, Storage, TopicInfo

Message = tuple[str, int, int, memoryview]  # topic, log time, publish time, CDR

LAST_NS: Final = 2**63 - 1

_MAX_OPEN_BYTES: Final = 1 << 30  # of pieces that overlap in time, read at once to put their messages in order
_ROWS_AT_ONCE: Final = 1 << 14  # of a piece, as Python objects
_MOST_LINES: Final = 20  # of an account
_FIRST_MESSAGES: Final = 1000  # among which one may lie far before the rest
_LONG_BEFORE_NS: Final = 60 * 10**9


class BagReader:
    """One or more bags, read as one. Use it as a context manager.

    Attributes:
        topics: `TopicInfo` by name, counts summed over all files.
        start_ns, end_ns: log times of the first and last message; both 0 when there is none.
        metadata: named records of key-value pairs (`BagWriter.write_metadata`), in order.
        custom_data: what `metadata.yaml` holds for users.
        truncated: whether a file ends before its end, as after a crash. What it holds is read all the same.
        missing: what the truncated files lack, a line for each thing.
        unreadable: for each topic whose messages cannot be decoded, the reason; the other topics do not suffer.
        skipped: for each topic read so far, how many of its messages cannot be decoded, and why; they were left out.
    """

    def __init__(self, *paths: str | Path) -> None:
        """Open bag folders, `.mcap` and `.db3` files.

        Raises:
            BagError: a path is no bag, or a file is damaged. That a recording was cut off is no error.
        """
        self.topics: dict[str, TopicInfo] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.custom_data: dict[str, str] = {}
        self.missing: list[str] = []
        self.skipped: dict[str, Skipped] = {}
        self._files: list[Storage] = []
        self._fields: dict[str, Definition] = {}
        try:
            for path in map(Path, paths):
                self._open(path)
        except BaseException:
            self.close()
            raise
        if not self._files:
            raise BagError("no bag to read: give at least one bag folder or file")
        filled = [file for file in self._files if any(topic.count for topic in file.topics.values())]
        self.start_ns = min((file.start_ns for file in filled), default=0)
        self.end_ns = max((file.end_ns for file in filled), default=0)

    @cached_property
    def begin_ns(self) -> int:
        """Log time with which the recording really begins, without first messages that lie far before all others.

        Such bear the time 0, for example, as they came before the first `/clock`.
        """
        begin = before = self.start_ns
        with suppress(BagError):  # of what is damaged one hears when it is read
            for _, log_time, _, _ in islice(self.messages(), _FIRST_MESSAGES):
                if log_time - before > max(_LONG_BEFORE_NS, self.end_ns - log_time):
                    begin = log_time
                before = log_time
        return begin

    @cached_property
    def unreadable(self) -> dict[str, str]:
        """Topics that cannot be decoded, and why."""
        reasons: dict[str, str] = {}
        for name in self.topics:
            try:
                self._definition(name)
            except BagError as error:
                reasons[name] = str(error)
        return reasons

    @property
    def left_out(self) -> list[str]:
        """A line for each topic that cannot be decoded, or has lost messages so, as far as it was read."""
        lines = [f"{self.topics[name].count} messages: {reason}" for name, reason in self.unreadable.items()]
        lines += [
            f"{skipped.count} messages of topic {shown(name)} cannot be decoded: {skipped.reason}"
            for name, skipped in self.skipped.items()
        ]
        more = len(lines) - _MOST_LINES
        return [*lines[:_MOST_LINES], f"and {more} more topics"] if more > 0 else lines

    @property
    def truncated(self) -> bool:
        """Whether something is missing."""
        return bool(self.missing)

    def close(self) -> None:
        """Close the files."""
        while self._files:
            self._files.pop().close()

    def __enter__(self) -> BagReader:
        """Return the reader."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def messages(
        self, topics: Collection[str] | None = None, *, start_ns: int = 0, stop_ns: int = LAST_NS
    ) -> Iterator[Message]:
        """Yield messages in log-time order, those of equal times in the order of the files.

        Args:
            topics: by default all, also those that cannot be decoded.
            start_ns, stop_ns: log times to begin with and to end before.

        Yields:
            Topic, log time and publish time in nanoseconds (the log time where the bag has no publish time), and the
            serialized message (a view, 4-byte head included).

        Raises:
            BagError: there is no such topic, or the bag is damaged.
        """
        wanted = frozenset(self.topics if topics is None else topics)
        for topic in wanted:
            self._topic(topic)
        waiting = deque(
            sorted(
                (
                    (piece, file)
                    for file in self._files
                    if wanted & file.topics.keys()
                    for piece in file.pieces()
                    if piece.end_ns >= start_ns and piece.start_ns < stop_ns
                ),
                key=lambda item: item[0].start_ns,
            )
        )
        return _merge(waiting, wanted, start_ns, stop_ns)

    def decoded(self, topic: str) -> Iterator[tuple[int, int, dict[str, Any]]]:
        """Yield a topic's messages as dicts, in log-time order; those that cannot be decoded go to `skipped`.

        Yields:
            Log time and publish time in nanoseconds, and the message; see `cdr.decode`.

        Raises:
            BagError: there is no such topic, it cannot be decoded at all, or the bag is damaged.
        """
        definition = self._definition(topic)
        skipped = 0
        for _, log_time, publish_time, data in self.messages([topic]):
            try:
                message = decode_with(definition, data)
            except BagError as error:
                skipped += 1
                first = self.skipped[topic].reason if skipped > 1 else str(error)
                self.skipped[topic] = Skipped(skipped, first)
                continue
            yield log_time, publish_time, message

    def columns(self, topic: str, fields: Sequence[str] | None = None) -> Columns:
        """Return a topic's messages as arrays by field path, in log-time order.

        Messages that cannot be decoded are left out; `skipped` tells how many, and why.

        Args:
            topic: its name.
            fields: flattened paths such as "position", "header.frame_id" or, through an array of messages,
                "points.positions"; see `fields`. By default all but those beneath arrays of messages. A stamp can be
                read whole ("header.stamp": int64, nanoseconds) or in parts ("header.stamp.sec", ".nanosec").
                "publication_sequence", only when asked for: the publisher's count of its messages (int64), 0 where
                the bag does not hold it.

        Returns:
            "log_time" and "publish_time" (int64, nanoseconds; the log time where the bag has no publish time), and
            for each field, with n messages:

            * a number: shape (n,), its own type;
            * an array of numbers, of the same length m in all messages: shape (n, m);
            * a string: shape (n,), NumPy `str`; an array of m strings: shape (n, m);
            * a field of each of m messages in an array: shape (n, m), or (n, m, k) if the field is an array;
            * anything else, that is arrays whose lengths vary, arrays of messages (as lists of dicts), and
              strings of very different lengths: shape (n,), objects.

        Raises:
            BagError: there is no such topic or field, the topic cannot be decoded at all, the bag is damaged, or the
                columns need more memory than is free.
        """
        builder = ColumnBuilder(self._definition(topic), fields, f"topic {shown(topic)}", self.topics[topic].count)
        limit = _free_memory_bytes()
        try:
            for file in self._files:
                if topic in file.topics:
                    self._add_columns(builder, file, topic, limit)
            if builder.skipped is not None:
                self.skipped[topic] = builder.skipped
            return builder.finish()
        except MemoryError:
            raise BagError(
                f"topic {shown(topic)}: its columns need more memory than there is: read fewer fields"
            ) from None

    def fields(self, topic: str) -> dict[str, str]:
        """Return what `columns` can read of a topic: types such as "float64[]" by flattened path.

        Raises:
            BagError: there is no such topic, or it cannot be decoded at all.
        """
        return {path: str(field) for path, field in self._definition(topic).paths.items()}

    def decode(self, topic: str, data: bytes | bytearray | memoryview) -> dict[str, Any]:
        """Return one message of a topic as a dict; see `cdr.decode`.

        Raises:
            BagError: there is no such topic, or the message or the definition is damaged.
        """
        return decode_with(self._definition(topic), data)

    def _open(self, path: Path) -> None:
        bag = BagFolder.of(path)
        self.custom_data.update(bag.custom_data)
        self.missing.extend(bag.missing)
        for name in bag.files:
            file: Storage = SqliteFile(name) if name.suffix == SQLITE else McapFile(name)
            self._files.append(file)
            self.metadata.extend(file.metadata)
            self.missing.extend(file.missing)
            for topic in file.topics.values():
                known = self.topics.get(topic.name)
                self.topics[topic.name] = known.joined(topic) if known else topic

    def _topic(self, topic: str) -> TopicInfo:
        if topic not in self.topics:
            raise BagError(f"no topic {shown(topic)!r} in the bag: choose from {choices(sorted(self.topics))}")
        return self.topics[topic]

    def _definition(self, topic: str) -> Definition:
        """Return what a topic's messages hold."""
        info = self._topic(topic)
        if topic not in self._fields:
            try:
                self._fields[topic] = info.fields()
            except BagError as error:
                raise BagError(f"topic {shown(topic)} cannot be decoded: {error}") from None
        return self._fields[topic]

    def _add_columns(self, builder: ColumnBuilder, file: Storage, topic: str, limit: int) -> None:
        before = builder.count
        channels = np.array([number for number, name in file.topic_of.items() if name == topic])
        for piece in file.pieces():
            table = piece.load()
            mine = table.channel == channels[0] if channels.size == 1 else np.isin(table.channel, channels)
            if mine.any():
                builder.add(table if mine.all() else table.only(mine))
            if builder.size > limit:
                raise BagError(
                    f"topic {shown(topic)}: its columns need more than the {limit >> 20} MiB of memory that are"
                    " free: read fewer fields"
                )
        if builder.count - before != file.topics[topic].count:
            raise BagError(
                f"{file.name}: {builder.count - before} messages of topic {shown(topic)} where the summary says"
                f" {file.topics[topic].count}: the file is damaged, run `tdof-npid recover`"
            )


def _free_memory_bytes() -> int:
    """Return how much columns may take: half of what the system has left, as joining them may need the other half."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024 // 2
    except (OSError, ValueError):
        pass
    return 2**63


def _rows(table: Table, file: Storage, wanted: frozenset[str], start_ns: int, stop_ns: int) -> Iterator[Message]:
    """Yield the wanted messages of a table in log-time order."""
    times = table.log_time
    names = file.topic_of
    mine = (times >= start_ns) & (times < stop_ns)
    foreign = [number for number, name in names.items() if name not in wanted]
    if foreign:
        mine &= ~np.isin(table.channel, foreign)
    if not mine.all():
        table = table.only(mine)
    if (table.log_time[1:] < table.log_time[:-1]).any():
        table = table.only(np.argsort(table.log_time, kind="stable"))
    data = table.data.data.toreadonly()
    for first in range(0, table.length.size, _ROWS_AT_ONCE):
        block = table.only(slice(first, first + _ROWS_AT_ONCE))
        for channel, log_time, publish_time, offset, length in zip(
            block.channel.tolist(),
            block.log_time.tolist(),
            np.where(block.publish_time == 0, block.log_time, block.publish_time).tolist(),
            block.offset.tolist(),
            block.length.tolist(),
            strict=True,
        ):
            yield names[channel], log_time, publish_time, data[offset : offset + length]


def _merge(
    waiting: deque[tuple[Piece, Storage]], wanted: frozenset[str], start_ns: int, stop_ns: int
) -> Iterator[Message]:
    """Yield the messages of pieces, which come sorted by their start, in log-time order.

    A piece is loaded when its turn comes, and forgotten when it is read.
    """
    running: list[tuple[int, int, Message, Iterator[Message], int]] = []
    number = 0
    open_bytes = 0
    while running or waiting:
        if waiting and (not running or waiting[0][0].start_ns <= running[0][0]):
            piece, file = waiting.popleft()
            table = piece.load()
            rows = _rows(table, file, wanted, start_ns, stop_ns)
            if not running and (not waiting or waiting[0][0].start_ns > piece.end_ns):
                yield from rows  # no other piece lies in its time
                continue
            open_bytes += table.data.nbytes
            if open_bytes > _MAX_OPEN_BYTES:
                raise BagError(
                    f"{file.name}: more than {_MAX_OPEN_BYTES >> 20} MiB of chunks lie in one time: put"
                    " the bag in order with `tdof-npid recover`"
                )
            first = next(rows, None)
            if first is not None:
                heapq.heappush(running, (first[1], number, first, rows, table.data.nbytes))
                number += 1
            else:
                open_bytes -= table.data.nbytes
            continue
        _, order, message, rows, size = running[0]
        yield message
        following = next(rows, None)
        if following is None:
            heapq.heappop(running)
            open_bytes -= size
        else:
            heapq.heapreplace(running, (following[1], order, following, rows, size))
