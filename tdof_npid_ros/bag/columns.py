"""Messages as NumPy columns. Those of one layout are decoded together, without a Python loop over them.

A layout is where each field lies in a message: it follows from the lengths of its sequences and strings. One
message of a layout is walked in Python; all others are compared with it at their length fields, and sliced.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tdof_npid_ros.bag import scan
from tdof_npid_ros.bag.cdr import HEAD_BYTES, CdrCursor, Order, read_field
from tdof_npid_ros.bag.definition import PRIMITIVES, STRING, TIMES, Definition, Field
from tdof_npid_ros.bag.errors import BagError

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


def _number_extractor(primitive: str, count: int | None, start: int, order: Order) -> _Extract:
    dtype = np.dtype(PRIMITIVES[primitive])
    first = (start + _ROW_SHIFT) // dtype.itemsize
    foreign = dtype.newbyteorder(order)
    native = np.dtype(bool) if primitive == "bool" else dtype
    if count is None:
        return lambda rows: rows.view(foreign)[:, first].astype(native)
    return lambda rows: rows.view(foreign)[:, first : first + count].astype(native)


def _decode_texts(raw: NDArray[np.uint8], where: str) -> Column:
    """Return rows of bytes, shape (messages, bytes), as strings."""
    messages, size = raw.shape
    if size == 0:
        return np.full(messages, "", "U1")
    if (raw < 0x80).all():
        return raw.astype(np.uint32).view(f"U{size}")[:, 0]
    joined = np.ascontiguousarray(raw).view(f"V{size}")[:, 0].tolist()
    decoded: dict[bytes, str] = {}
    try:
        for text in joined:
            if text not in decoded:
                decoded[text] = text.decode()
    except UnicodeDecodeError:
        raise BagError(f"{where}: a string is not UTF-8: the bag is damaged, run `tdof-npid recover`") from None
    return np.array([decoded[text] for text in joined])


def _text_extractor(start: int, size: int, where: str) -> _Extract:
    first = start + _ROW_SHIFT
    last = first + max(size - 1, 0)

    def extract(rows: _Rows) -> Column:
        if size and rows[:, last].any():
            raise BagError(f"{where}: a string has no closing zero: the bag is damaged, run `tdof-npid recover`")
        return _decode_texts(rows[:, first:last], where)

    return extract


def _texts_extractor(spans: Sequence[tuple[int, int]], where: str) -> _Extract:
    members = [_text_extractor(start, size, where) for start, size in spans]

    def extract(rows: _Rows) -> Column:
        if not members:
            return np.empty((len(rows), 0), "U1")
        return np.stack([member(rows) for member in members], axis=1)

    return extract


def _object_extractor(definition: Definition, field: Field, start: int, size: int, where: str) -> _Extract:
    def extract(rows: _Rows) -> Column:
        column = np.empty(len(rows), object)
        for index, row in enumerate(rows):
            message = row[_ROW_SHIFT : _ROW_SHIFT + size]
            column[index] = read_field(definition, field, CdrCursor(message.data, where, start))
        return column

    return extract


def _stamp_extractor(seconds: _Extract, nanoseconds: _Extract) -> _Extract:
    return lambda rows: seconds(rows).astype(np.int64) * 1_000_000_000 + nanoseconds(rows)


class _LayoutWalker:
    """Walks one message and notes where its fields lie."""

    def __init__(self, definition: Definition, wanted: frozenset[str], message: memoryview, where: str) -> None:
        self._definition = definition
        self._wanted = wanted
        self._size = len(message)
        self._where = where
        self._cursor = CdrCursor(message, where)

    def layout(self) -> Layout:
        """Return the message's layout."""
        extractors = tuple(
            (path, extract) for path, extract in self._message(self._definition.root, "") if path in self._wanted
        )
        positions = np.array([position for position, _ in self._cursor.lengths], np.int64)
        lengths = np.array([value for _, value in self._cursor.lengths], np.uint32)
        return Layout(self._cursor.order, (positions + _ROW_SHIFT) // 4, lengths, extractors)

    def end(self) -> None:
        """Check that the message ends where its last field does."""
        self._cursor.end()

    def _message(self, type_name: str, prefix: str) -> Iterator[tuple[str, _Extract]]:
        fields = self._definition.fields(type_name)
        if not fields:
            self._cursor.skip(1)
        for field in fields:
            path = prefix + field.name
            if field.type in self._definition.types and field.count is None:
                inner = list(self._message(field.type, path + "."))
                if field.type in TIMES:
                    yield path, _stamp_extractor(inner[0][1], inner[1][1])
                yield from inner
            else:
                yield path, self._leaf(field, f"{self._where}, field {path}")

    def _leaf(self, field: Field, where: str) -> _Extract:
        cursor = self._cursor
        if field.type in PRIMITIVES:
            size = int(PRIMITIVES[field.type][1])
            count = cursor.length(size) if field.count == -1 else field.count
            total = 1 if count is None else count
            start = cursor.skip(total * size, size if total else 1)
            return _number_extractor(field.type, count, start, cursor.order)
        if field.type == STRING and field.count is None:
            return _text_extractor(*cursor.string(), where)
        if field.type == STRING:
            count = cursor.length(4) if field.count == -1 else field.count or 0
            return _texts_extractor([cursor.string() for _ in range(count)], where)
        start = cursor.position
        read_field(self._definition, field, cursor)
        return _object_extractor(self._definition, field, start, self._size, where)


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

    def finish(self, count: int) -> Column:
        """Return the column."""
        whole, self._whole = self._whole, None
        if whole is not None:
            if self._filled == count:
                return whole[:count]
            self._parts.insert(0, (np.arange(self._filled), whole[: self._filled]))
        return _join(self._parts, count)


class ColumnBuilder:
    """Gathers a topic's messages, piece after piece, into columns."""

    def __init__(self, definition: Definition, fields: Sequence[str] | None, where: str, expected: int = 0) -> None:
        """Prepare to decode `fields` (flattened paths), by default all, of `expected` messages.

        Raises
        ------
        BagError
            There is no such field.
        """
        times = (LOG_TIME, PUBLISH_TIME, SEQUENCE)
        known = [path for path in definition.paths() if path not in times]
        unknown = [name for name in fields or () if name not in known and name not in times]
        if unknown:
            raise BagError(f"{where}: no field {unknown[0]!r}: choose from {', '.join([*times, *known])}")
        self._paths = [path for path in known if fields is None or path in fields]
        self._definition = definition
        self._wanted = frozenset(self._paths)
        self._where = where
        self._columns = {path: _Gathered(expected) for path in self._paths}
        self._times: list[tuple[scan.Ints, scan.Ints]] = []
        self._sequence: list[scan.Ints] | None = [] if SEQUENCE in (fields or ()) else None
        self.count = 0
        self.size = 0  # bytes in the columns so far

    def add(self, table: scan.Table) -> None:
        """Decode the messages of a table.

        Raises
        ------
        BagError
            A message is damaged or of another type.
        """
        rows = np.arange(self.count, self.count + table.length.size)
        self.count += table.length.size
        self._times.append((table.log_time, table.publish_time))
        self.size += 16 * table.length.size
        if self._sequence is not None:
            self._sequence.append(table.sequence.astype(np.int64))
        if not self._paths:
            return
        for size in np.unique(table.length):
            which = table.length == size
            if size < HEAD_BYTES:
                raise BagError(f"{self._where}: a message of {size} bytes has no CDR head: the bag is damaged")
            self._add_rows(rows[which], scan.gather(table.data, table.offset[which], int(size)), int(size))

    def finish(self) -> Columns:
        """Return the columns in log-time order: `log_time`, `publish_time`, and the fields."""
        columns: Columns = {}
        empty = np.empty(0, np.int64)
        log_time = np.concatenate([empty, *(times[0] for times in self._times)])
        publish_time = np.concatenate([empty, *(times[1] for times in self._times)])
        self._times.clear()
        order = None
        if (log_time[1:] < log_time[:-1]).any():
            order = np.argsort(log_time, kind="stable")
            log_time, publish_time = log_time[order], publish_time[order]
        columns[LOG_TIME] = log_time
        columns[PUBLISH_TIME] = publish_time
        if self._sequence is not None:
            sequence = np.concatenate([empty, *self._sequence])
            columns[SEQUENCE] = sequence if order is None else sequence[order]
        if not self.count:
            return columns | self._empty()
        for path in self._paths:
            column = self._columns.pop(path).finish(self.count)
            columns[path] = column if order is None else column[order]
        return columns

    def _add_rows(self, rows: scan.Ints, block: _Rows, size: int) -> None:
        for _ in range(_LAYOUT_TRIES):
            if not rows.size:
                return
            layout = self._layout(block[0], size)
            same = layout.matches(block)
            if same.all():
                self._extract(layout, rows, block)
                return
            self._extract(layout, rows[same], block[same])
            rows, block = rows[~same], block[~same]
        groups: dict[tuple[str, bytes, bytes], tuple[Layout, list[int]]] = {}
        for index in range(rows.size):
            layout = self._layout(block[index], size)
            groups.setdefault(layout.key(), (layout, []))[1].append(index)
        for layout, members in groups.values():
            self._extract(layout, rows[members], block[members])

    def _layout(self, row: NDArray[np.uint8], size: int) -> Layout:
        message = row[_ROW_SHIFT : _ROW_SHIFT + size].data
        walker = _LayoutWalker(self._definition, self._wanted, message, self._where)
        layout = walker.layout()
        walker.end()
        return layout

    def _extract(self, layout: Layout, rows: scan.Ints, block: _Rows) -> None:
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
        walker = _LayoutWalker(self._definition, self._wanted, message.data, self._where)
        return {path: extract(row)[:0] for path, extract in walker.layout().extractors}


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
