"""Read a bag in rosbag2's SQLite storage (`.db3`)."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from tdof_npid_ros.bag.decompress import MAX_CHUNK_BYTES
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.scan import Table
from tdof_npid_ros.bag.storage import Piece, TopicInfo
from tdof_npid_ros.input_file import InputError, check_file

_PIECE_MESSAGES: Final = 8192
_PIECE_BYTES: Final = 8 << 20
_NEEDED: Final = {"topics", "messages"}
_READ: Final = {*_NEEDED, "message_definitions"}
_SIZES: Final = "SELECT timestamp, id, length(data) FROM messages ORDER BY timestamp, id"
_NEVER: Final = 2**63 - 1
_Place = tuple[int, int]  # of a message: its time and its number
_TABLES: Final = "SELECT name, sql FROM sqlite_master WHERE type = 'table'"


class SqliteFile:
    """An open `.db3` file: a `Storage`. Publish times are the log times, the only ones it holds."""

    def __init__(self, path: Path) -> None:
        """Open the file, and nothing but the file: it is taken as it is, and nothing is written beside it.

        Raises:
            BagError: it cannot be read, or is no bag.
        """
        self.path = path
        self.name = str(path)
        self.topics: dict[str, TopicInfo] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.missing: list[str] = []
        self._names: dict[int, str] = {}
        try:
            check_file(path)
        except InputError as error:
            raise BagError(f"cannot open a bag: {error}") from None
        self._look_for_unfinished_work()
        try:
            uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
            self._database = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
        except sqlite3.Error as error:
            raise BagError(f"cannot open {path}: {error}") from None
        try:
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
            self._query("PRAGMA trusted_schema = OFF")
            self._open()
        except BaseException:
            self._database.close()
            raise

    @property
    def topic_of(self) -> Mapping[int, str]:
        """Return topic names by channel number."""
        return self._names

    def pieces(self) -> list[Piece]:
        """Return the messages in pieces of some megabytes, in the order of their times."""
        return [Piece(start[0], end[0], partial(self._load, start, end)) for start, end in self._ranges]

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def _look_for_unfinished_work(self) -> None:
        for suffix in ("-wal", "-journal"):
            beside = self.path.with_name(self.path.name + suffix)
            if beside.exists() and beside.stat().st_size:
                self.missing.append(
                    f"{self.path}: {beside.name}, which a recorder has left beside it, is not read: put both together"
                    f" with `sqlite3 {self.path.name} 'PRAGMA journal_mode = delete'`"
                )

    def _query(self, query: str, arguments: Sequence[int] = ()) -> list[tuple[Any, ...]]:
        try:
            return self._database.execute(query, arguments).fetchall()
        except (sqlite3.Error, OverflowError, UnicodeDecodeError, MemoryError) as error:
            raise BagError(
                f"{self.path}: cannot be read ({error}): it is damaged or no bag, try sqlite3's `.recover`"
            ) from None

    def _open(self) -> None:
        tables = {name: str(sql) for name, sql in self._query(_TABLES)}
        if not tables.keys() >= _NEEDED:
            raise BagError(f"{self.path}: has no tables `topics` and `messages`: it is no bag")
        for name in tables.keys() & _READ:
            self._check_stored(name, tables[name])
        columns = {str(row[1]) for row in self._query("PRAGMA table_info(topics)")}
        definitions = self._definitions() if "message_definitions" in tables else {}
        counts = dict(self._query("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        wanted = [
            "id",
            "name",
            "type",
            "serialization_format",
            "offered_qos_profiles",
            "type_description_hash",
        ]
        chosen = ", ".join(name if name in columns else "''" for name in wanted)
        for number, name, type_name, serialization, qos, digest in self._query(f"SELECT {chosen} FROM topics"):
            if not isinstance(number, int) or not 0 <= number < 2**16:
                raise BagError(f"{self.path}: topic number {str(number)[:20]!r} is none: the file is damaged")
            encoding, text = definitions.get(type_name, ("", ""))
            values = (name, type_name, serialization, qos, digest, encoding, text)
            if not all(isinstance(value, str) for value in values) or name in self.topics:
                raise BagError(f"{self.path}: its table of topics is damaged, or names one twice")
            self._names[number] = name
            self.topics[name] = TopicInfo(
                name,
                type_name,
                counts.get(number, 0),
                text,
                encoding if serialization == "cdr" else serialization,
                qos,
                digest,
            )
        if counts.keys() - self._names.keys():
            raise BagError(f"{self.path}: holds messages of a topic that is not listed: the file is damaged")
        self._find_pieces()

    def _check_stored(self, table: str, sql: str) -> None:
        """Refuse content that is made up while it is read, and so may be larger than any file."""
        hidden = any(row[6] for row in self._query(f"PRAGMA table_xinfo({table})"))
        if hidden or "virtual" in sql.lower().split()[:2]:
            raise BagError(f"{self.path}: its table `{table}` is computed, not stored: no recorder writes this")

    def _definitions(self) -> dict[Any, tuple[Any, Any]]:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        return {name: (encoding, text) for name, encoding, text in self._query(query)}

    def _find_pieces(self) -> None:
        """Find ranges of time and number that hold so much that it can be in memory at once."""
        self._ranges: list[tuple[_Place, _Place]] = []
        first = last = (-1, 0)
        count = size = 0
        try:
            for time, number, length in self._database.execute(_SIZES):
                if not (isinstance(time, int) and isinstance(number, int) and 0 <= time < _NEVER):
                    raise BagError(f"{self.path}: a message's time is before 1970 or beyond 2262: the file is damaged")
                if (time, number) <= last:
                    raise BagError(f"{self.path}: two messages bear the number {number}: the file is damaged")
                if count == _PIECE_MESSAGES or (count and size + length > _PIECE_BYTES):
                    self._ranges.append((first, last))
                    count = size = 0
                last = (time, number)
                first = first if count else last
                count, size = count + 1, size + length
        except (sqlite3.Error, TypeError, OverflowError, UnicodeDecodeError) as error:
            raise BagError(f"{self.path}: its messages cannot be read ({error}): the file is damaged") from None
        if count:
            self._ranges.append((first, last))
        self.start_ns = self._ranges[0][0][0] if self._ranges else 0
        self.end_ns = self._ranges[-1][1][0] if self._ranges else 0

    def _load(self, first: _Place, last: _Place) -> Table:
        query = (
            "SELECT topic_id, timestamp, data FROM messages"
            " WHERE (timestamp, id) >= (?, ?) AND (timestamp, id) <= (?, ?) ORDER BY timestamp, id"
        )
        rows = self._query(query, (*first, *last))
        if not all(isinstance(data, bytes) and isinstance(time, int) for _, time, data in rows):
            raise BagError(f"{self.path}: a message at {first[0]} ns or later is no bytes: the file is damaged")
        length = np.array([len(data) for _, _, data in rows], np.int64)
        log_time = np.array([time for _, time, _ in rows], np.int64)
        return Table(
            np.frombuffer(b"".join(data for _, _, data in rows), np.uint8),
            np.array([number for number, _, _ in rows], np.uint16),
            np.zeros(len(rows), np.uint32),
            log_time,
            log_time,
            np.cumsum(length) - length,
            length,
        )
