"""Messages as NumPy columns. Those of one layout are decoded together, without a Python loop over them.

A layout is where each field lies in a message: it follows from the lengths of its sequences and strings. One
message of a layout is walked in Python; all others are compared with it at their length fields, and sliced.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tdof_npid_ros.bag import scan
from tdof_npid_ros.bag.cdr import HEAD_BYTES, CdrCursor, Order, Span, ValueBuilder, walk, walk_field
from tdof_npid_ros.bag.definition import PRIMITIVES, STRING, TIMES, Definition, Field
from tdof_npid_ros.bag.errors import BagError, choices, shown

Column = NDArray[Any]
Columns = dict[str, Column]

LOG_TIME: Final = "log_time"
PUBLISH_TIME: Final = "publish_time"
SEQUENCE: Final = "publication_sequence"

_LAYOUT_TRIES: Final = 16  # layouts looked for by comparing; a piece with more is sorted message by message
_ROW_SHIFT: Final = 4  # `scan.gather` puts so many bytes before a message
_SPARE_BYTES: Final = 1 << 20
_PADDING_FACTOR: Final = 4

_Rows = scan.Bytes
_Extract = Callable[[_Rows], Column]


class Layout(NamedTuple):
    """Where the fields lie, for all messages with these bytes of length fields."""

    order: Order
    length_words: NDArray[np.int64]  # which 32-bit words of a row are length fields
    lengths: NDArray[np.uint32]
    texts: list[Span]
    extractors: tuple[tuple[str, _Extract], ...]

    def key(self) -> tuple[str, bytes, bytes]:
        """Return what distinguishes it from other layouts."""
        return self.order, self.length_words.tobytes(), self.lengths.tobytes()

    def matches(self, rows: _Rows) -> NDArray[np.bool_]:
        """Tell which rows, shape (messages, width), have this layout."""
        same: NDArray[np.bool_] = (rows[:, _ROW_SHIFT] == 0) & (rows[:, _ROW_SHIFT + 1] == (self.order == "<"))
        if self.length_words.size:
            words = rows.view(f"{self.order}u4")[:, self.length_words]
            same &= (words == self.lengths).all(axis=1)
        return same

    def valid(self, rows: _Rows) -> NDArray[np.bool_]:
        """Tell in which rows of this layout all strings are right; the first row was looked at already."""
        right = np.ones(len(rows), np.bool_)
        if len(rows) == 1:
            return right
        for start, size in self.texts:
            if size:
                content = rows[:, start + _ROW_SHIFT : start + _ROW_SHIFT + size]
                right &= content[:, -1] == 0
                if (content >= 0x80).any():
                    for row in np.flatnonzero((content >= 0x80).any(axis=1)):
                        right[row] &= _is_utf8(content[row].tobytes())
        return right


def _is_utf8(content: bytes) -> bool:
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return True


def _number_extractor(primitive: str, count: int | None, start: int, order: Order) -> _Extract:
    dtype = np.dtype(PRIMITIVES[primitive])
    first = (start + _ROW_SHIFT) // dtype.itemsize
    foreign = dtype.newbyteorder(order)
    native = np.dtype(bool) if primitive == "bool" else dtype
    if count is None:
        return lambda rows: rows.view(foreign)[:, first].astype(native)
    return lambda rows: rows.view(foreign)[:, first : first + count].astype(native)


def _decode_texts(raw: NDArray[np.uint8]) -> Column:
    """Return rows of valid UTF-8, shape (messages, bytes), as strings."""
    messages, size = raw.shape
    if size == 0:
        return np.full(messages, "", "U1")
    if not raw[:, -1].all():  # NumPy's strings would lose zeros at their end
        return _as_objects([bytes(row).decode() for row in raw])
    if (raw < 0x80).all():
        return raw.astype(np.uint32).view(f"U{size}")[:, 0]
    joined = np.ascontiguousarray(raw).view(f"V{size}")[:, 0].tolist()
    decoded = {text: text.decode() for text in set(joined)}
    return np.array([decoded[text] for text in joined])


def _as_objects(texts: list[str]) -> Column:
    column = np.empty(len(texts), object)
    column[:] = texts
    return column


def _text_extractor(span: Span) -> _Extract:
    start, size = span
    first = start + _ROW_SHIFT
    last = first + max(size - 1, 0)
    return lambda rows: _decode_texts(rows[:, first:last])


def _stacked(members: Sequence[_Extract], none: np.dtype[Any]) -> _Extract:
    """Put what there is of each element of an array side by side; `none` is the type where there are no elements."""

    def extract(rows: _Rows) -> Column:
        if not members:
            return np.empty((len(rows), 0), none)
        columns = [member(rows) for member in members]
        if len({column.shape for column in columns}) == 1 and columns[0].dtype != object:
            return np.stack(columns, axis=1)
        whole = np.empty(len(rows), object)
        for row in range(len(rows)):
            whole[row] = [column[row] for column in columns]
        return whole

    return extract


def _object_extractor(definition: Definition, field: Field, start: int, size: int) -> _Extract:
    def extract(rows: _Rows) -> Column:
        column = np.empty(len(rows), object)
        for index, row in enumerate(rows):
            cursor = CdrCursor(row[_ROW_SHIFT : _ROW_SHIFT + size].data, field.name, start)
            column[index] = walk_field(definition, field, cursor, ValueBuilder(cursor))
        return column

    return extract


def _stamp_extractor(seconds: _Extract, nanoseconds: _Extract) -> _Extract:
    return lambda rows: seconds(rows).astype(np.int64) * 1_000_000_000 + nanoseconds(rows)


_Extractors = dict[str, _Extract]  # by path


class _LayoutBuilder:
    """Notes where the fields of one message lie; those that are not wanted are left out."""

    def __init__(self, definition: Definition, wanted: Mapping[str, Sequence[str]], cursor: CdrCursor) -> None:
        self._definition = definition
        self._wanted = wanted
        self._cursor = cursor

    def numbers(self, path: str, field: Field, start: int, count: int) -> _Extractors:
        """Of numbers."""
        if path not in self._wanted:
            return {}
        array = None if field.count is None else count
        return {path: _number_extractor(field.type, array, start, self._cursor.order)}

    def texts(self, path: str, field: Field, spans: list[Span]) -> _Extractors:
        """Of strings."""
        if path not in self._wanted:
            return {}
        members = [_text_extractor(span) for span in spans]
        return {path: members[0] if field.count is None else _stacked(members, np.dtype("U1"))}

    def messages(self, path: str, field: Field, start: int, parts: list[_Extractors]) -> _Extractors:
        """Of a message within, or of each in an array."""
        if path not in self._wanted:
            return parts[0] if field.count is None else {}
        if field.count is None:
            return {**parts[0], path: _stamp_extractor(parts[0][f"{path}.sec"], parts[0][f"{path}.nanosec"])}
        found = {path: _object_extractor(self._definition, field, start, len(self._cursor.data))}
        for inner in self._wanted[path]:
            none = _element_dtype(self._definition.paths[inner])
            found[inner] = _stacked([part[inner] for part in parts], none)
        return found

    def message(self, type_name: str, parts: list[tuple[Field, _Extractors]]) -> _Extractors:
        """Of one message's fields together."""
        found: _Extractors = {}
        for _, part in parts:
            if part:
                found.update(part)
        return found


def _element_dtype(field: Field) -> np.dtype[Any]:
    """Of a value of this field, where a column has none to go by."""
    if field.type in PRIMITIVES:
        return np.dtype(bool if field.type == "bool" else PRIMITIVES[field.type])
    return np.dtype("U1" if field.type == STRING else np.int64 if field.type in TIMES else object)


def _paths_to_visit(definition: Definition, asked: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The paths that must be visited for those asked for; with each array of messages, those beneath it."""
    visited: dict[str, tuple[str, ...]] = {}
    for path in asked:
        visited[path] = ()
        if definition.paths[path].type in TIMES:
            visited |= {f"{path}.sec": (), f"{path}.nanosec": ()}
    for path in list(visited):
        parts = path.split(".")
        for length in range(1, len(parts)):
            above = ".".join(parts[:length])
            field = definition.paths.get(above)
            if field is not None and field.count is not None:
                visited[above] = (*visited.get(above, ()), path)
    return visited


class _Gathered:
    """One column being gathered: in its final place as long as all is alike and in order, else in parts."""

    def __init__(self, expected: int) -> None:
        self._expected = expected
        self._whole: Column | None = None
        self._filled = 0
        self._parts: list[tuple[scan.Ints, Column]] = []

    def add(self, rows: scan.Ints, column: Column) -> None:
        """Take the values of some messages; `rows` says which."""
        end = self._filled + rows.size
        in_order = rows[0] == self._filled and rows[-1] == end - 1 and end <= self._expected
        if self._whole is None and in_order:
            self._whole = np.empty((self._expected, *column.shape[1:]), column.dtype)
        whole = self._whole
        if (
            in_order
            and not self._parts
            and whole is not None
            and whole.shape[1:] == column.shape[1:]
            and whole.dtype == column.dtype
        ):
            whole[self._filled : end] = column
            self._filled = end
        else:
            self._parts.append((rows, column))

    def finish(self, count: int, skipped: scan.Ints) -> Column:
        """Return the column of `count` values; the rows `skipped` have none."""
        whole, self._whole = self._whole, None
        if whole is not None:
            if self._filled == count:
                return whole[:count]
            self._parts.insert(0, (np.arange(self._filled), whole[: self._filled]))
        if skipped.size:
            self._parts = [(rows - np.searchsorted(skipped, rows), column) for rows, column in self._parts]
        return _join(self._parts, count)


@dataclass(frozen=True)
class Skipped:
    """Messages of one topic that cannot be decoded; `reason` is the first one's."""

    count: int
    reason: str


class ColumnBuilder:
    """Gathers a topic's messages, piece after piece, into columns. Those that cannot be decoded are left out.

    Attributes:
        count: messages so far.
        skipped: how many of them cannot be decoded, and why; None as long as all can.
        size: bytes in the columns so far.
    """

    def __init__(self, definition: Definition, fields: Sequence[str] | None, where: str, expected: int = 0) -> None:
        """Prepare to decode `fields` (flattened paths), by default all, of `expected` messages.

        Raises:
            BagError: there is no such field.
        """
        times = (LOG_TIME, PUBLISH_TIME, SEQUENCE)
        if fields is None:
            self._paths = [path for path in definition.columns if path not in times]
        else:
            unknown = [name for name in fields if name not in definition.paths and name not in times]
            if unknown:
                known = choices([*times, *definition.paths])
                raise BagError(f"{where}: no field {shown(unknown[0])!r}: choose from {known}")
            self._paths = [path for path in definition.paths if path in fields and path not in times]
        self._definition = definition
        self._visited = _paths_to_visit(definition, self._paths)
        self._where = where
        self._columns = {path: _Gathered(expected) for path in self._paths}
        self._times: list[tuple[scan.Ints, scan.Ints]] = []
        self._sequence: list[scan.Ints] | None = [] if SEQUENCE in (fields or ()) else None
        self._skipped_rows: list[scan.Ints] = []
        self._reason = ""
        self.count = 0
        self.size = 0

    @property
    def skipped(self) -> Skipped | None:
        """What cannot be decoded."""
        count = sum(rows.size for rows in self._skipped_rows)
        return Skipped(count, self._reason) if count else None

    def add(self, table: scan.Table) -> None:
        """Decode the messages of a table."""
        rows = np.arange(self.count, self.count + table.length.size)
        self.count += table.length.size
        self._times.append((table.log_time, table.publish_time))
        self.size += 16 * table.length.size
        if self._sequence is not None:
            self._sequence.append(table.sequence.astype(np.int64))
        for size in scan.distinct(table.length):
            which = table.length == size
            least = HEAD_BYTES + self._definition.least[self._definition.root]
            if size < least:
                self._skip(rows[which], f"a message of {size} bytes, where its type takes at least {least}")
            else:
                self._add_rows(rows[which], scan.gather(table.data, table.offset[which], int(size)), int(size))

    def finish(self) -> Columns:
        """Return the columns in log-time order: `log_time`, `publish_time`, and the fields.

        A publish time of 0 is none: the log time stands in its place.
        """
        columns: Columns = {}
        skipped = np.sort(np.concatenate([np.empty(0, np.int64), *self._skipped_rows]))
        log_time = _without(skipped, [times[0] for times in self._times])
        publish_time = _without(skipped, [times[1] for times in self._times])
        self._times.clear()
        if not publish_time.all():
            publish_time = np.where(publish_time == 0, log_time, publish_time)
        order = None
        if (log_time[1:] < log_time[:-1]).any():
            order = np.argsort(log_time, kind="stable")
            log_time, publish_time = log_time[order], publish_time[order]
        columns[LOG_TIME] = log_time
        columns[PUBLISH_TIME] = publish_time
        if self._sequence is not None:
            sequence = _without(skipped, self._sequence)
            columns[SEQUENCE] = sequence if order is None else sequence[order]
        if not log_time.size:
            return columns | self._empty()
        for path in self._paths:
            column = self._columns.pop(path).finish(log_time.size, skipped)
            columns[path] = column if order is None else column[order]
        return columns

    def _skip(self, rows: scan.Ints, reason: str = "") -> None:
        self._reason = self._reason or reason
        self._skipped_rows.append(rows)

    def _add_rows(self, rows: scan.Ints, block: _Rows, size: int) -> None:
        for _ in range(_LAYOUT_TRIES):
            if not rows.size:
                return
            layout = self._layout(block[0], size)
            if layout is None:
                other = (block != block[0]).any(axis=1)
                self._skip(rows[~other])
                rows, block = rows[other], block[other]
                continue
            same = layout.matches(block)
            if same.all():
                self._extract(layout, rows, block)
                return
            self._extract(layout, rows[same], block[same])
            rows, block = rows[~same], block[~same]
        groups: dict[tuple[str, bytes, bytes], tuple[Layout, list[int]]] = {}
        for index in range(rows.size):
            layout = self._layout(block[index], size)
            if layout is None:
                self._skip(rows[index : index + 1])
            else:
                groups.setdefault(layout.key(), (layout, []))[1].append(index)
        for layout, members in groups.values():
            self._extract(layout, rows[members], block[members])

    def _layout(self, row: NDArray[np.uint8], size: int) -> Layout | None:
        """Return the layout of a message, None when it cannot be decoded."""
        try:
            return self._layout_of(row[_ROW_SHIFT : _ROW_SHIFT + size].data)
        except BagError as error:
            self._reason = self._reason or str(error)
            return None

    def _layout_of(self, message: memoryview) -> Layout:
        cursor = CdrCursor(message, "a message")
        found = walk(self._definition, cursor, _LayoutBuilder(self._definition, self._visited, cursor))
        positions = np.array([position for position, _ in cursor.lengths], np.int64)
        lengths = np.array([value for _, value in cursor.lengths], np.uint32)
        extractors = tuple((path, found[path]) for path in self._paths)
        return Layout(cursor.order, (positions + _ROW_SHIFT) // 4, lengths, cursor.texts, extractors)

    def _extract(self, layout: Layout, rows: scan.Ints, block: _Rows) -> None:
        valid = layout.valid(block)
        if not valid.all():
            self._skip(rows[~valid], "a string has no closing zero or is not UTF-8")
            rows, block = rows[valid], block[valid]
        for path, extract in layout.extractors:
            column = extract(block)
            self.size += column.nbytes
            self._columns[path].add(rows, column)

    def _empty(self) -> Columns:
        """Return the columns of no messages, with the types that they would have."""
        size = HEAD_BYTES + 8 * (self._definition.least[self._definition.root] + 1)
        if size > _SPARE_BYTES:
            return {path: np.empty(0, object) for path in self._paths}
        message = np.zeros(size, np.uint8)
        message[1] = 1  # little-endian
        row = scan.gather(message, np.zeros(1, np.int64), size)
        return {path: extract(row)[:0] for path, extract in self._layout_of(message.data).extractors}


def _without(skipped: scan.Ints, parts: Sequence[scan.Ints]) -> scan.Ints:
    """Join the parts and leave some rows out."""
    whole = np.concatenate([np.empty(0, np.int64), *parts])
    return np.delete(whole, skipped) if skipped.size else whole


def _join(parts: Sequence[tuple[scan.Ints, Column]], count: int) -> Column:
    """Put the parts of one column together; rows say where each value belongs."""
    columns = [column for _, column in parts]
    shapes = {column.shape[1:] for column in columns}
    if len(shapes) == 1 and columns[0].dtype != object and not _pads_too_much(columns, count):
        if all(rows[0] == start and rows[-1] - start == rows.size - 1 for start, rows in _starts(parts)):
            return columns[0] if len(columns) == 1 else np.concatenate(columns)
        joined = np.empty((count, *shapes.pop()), np.result_type(*columns))
        for rows, column in parts:
            joined[rows] = column
        return joined
    objects = np.empty(count, object)
    for rows, column in parts:
        for row, value in zip(rows.tolist(), column, strict=True):
            objects[row] = str(value) if isinstance(value, np.str_) else value
    return objects


def _starts(parts: Sequence[tuple[scan.Ints, Column]]) -> Iterator[tuple[int, scan.Ints]]:
    start = 0
    for rows, _ in parts:
        if rows.size:
            yield start, rows
        start += rows.size


def _pads_too_much(columns: Sequence[Column], count: int) -> bool:
    """Tell whether one long string among short ones would blow up the column."""
    if columns[0].dtype.kind != "U":
        return False
    width = max(column.dtype.itemsize for column in columns)
    cells = max(int(np.prod(column.shape[1:])) for column in columns)
    have = sum(column.nbytes for column in columns)
    return width * cells * count > _PADDING_FACTOR * have + _SPARE_BYTES
