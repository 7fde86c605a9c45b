"""Compiled walks over MCAP records in memory. Nothing here trusts a length that it reads."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from tdof_npid_ros.compiled import compiled, entry_point

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
_Number = TypeVar("_Number", bound=np.integer)

_MESSAGE: Final = int(Opcode.MESSAGE)
_PREFIX_BYTES: Final = 9
_FIELDS_BYTES: Final = 22

# Why a walk stopped.
AT_END: Final = 0
CUT_SHORT: Final = 1  # a record goes on beyond the data
WRONG_LENGTH: Final = 2  # a message record too short for its own fields
WRONG_TIME: Final = 3  # a time beyond 2**63 - 1 ns
OTHER_RECORD: Final = 4  # no message (only `run_length` stops there)
TOO_MANY: Final = 5  # records that are no messages


def distinct(values: NDArray[_Number]) -> NDArray[_Number]:
    """The values, each once: mostly they are all one, which is seen sooner than sorted."""
    if values.size and (values == values[0]).all():
        return values[:1]
    return np.unique(values)


@compiled
def _u64(data: Bytes, at: int) -> np.uint64:
    value = np.uint64(0)
    for index in range(8):
        value |= np.uint64(data[at + index]) << np.uint64(8 * index)
    return value


@entry_point
def _walk(data: Bytes, only_messages: bool) -> tuple[int, int, int, int]:
    position = 0
    messages = 0
    others = 0
    size = data.size
    while position < size:
        if size - position < _PREFIX_BYTES:
            return position, messages, others, CUT_SHORT
        opcode = data[position]
        if only_messages and opcode != _MESSAGE:
            return position, messages, others, OTHER_RECORD
        length = _u64(data, position + 1)
        if length > np.uint64(size - position - _PREFIX_BYTES):
            return position, messages, others, CUT_SHORT
        if opcode == _MESSAGE:
            if length < np.uint64(_FIELDS_BYTES):
                return position, messages, others, WRONG_LENGTH
            messages += 1
        else:
            others += 1
        position += _PREFIX_BYTES + np.int64(length)  # type: ignore[assignment]
    return position, messages, others, AT_END


@entry_point
def _fill(
    data: Bytes,
    end: int,
    channel: NDArray[np.uint16],
    sequence: NDArray[np.uint32],
    log_time: Ints,
    publish_time: Ints,
    offset: Ints,
    length: Ints,
    other: Ints,
) -> int:
    position = 0
    messages = 0
    others = 0
    limit = np.uint64(2**63 - 1)
    while position < end:
        size = np.int64(_u64(data, position + 1))
        content = position + _PREFIX_BYTES
        if data[position] == _MESSAGE:
            channel[messages] = np.uint16(data[content]) | np.uint16(data[content + 1]) << np.uint16(8)
            number = np.uint32(0)
            for index in range(4):
                number |= np.uint32(data[content + 2 + index]) << np.uint32(8 * index)
            sequence[messages] = number
            logged = _u64(data, content + 6)
            published = _u64(data, content + 14)
            if logged > limit or published > limit:
                return position
            log_time[messages] = np.int64(logged)
            publish_time[messages] = np.int64(published)
            offset[messages] = content + _FIELDS_BYTES
            length[messages] = size - _FIELDS_BYTES
            messages += 1
        else:
            other[others] = position
            others += 1
        position = content + size  # type: ignore[assignment]
    return -1


@entry_point
def _copy_rows(data: Bytes, offset: Ints, size: int, rows: Bytes) -> None:
    width = rows.shape[1]
    for row in range(offset.size):
        start = offset[row]
        for index in range(4):
            rows[row, index] = 0
        for index in range(size):
            rows[row, 4 + index] = data[start + index]
        for index in range(4 + size, width):
            rows[row, index] = 0


class Table(NamedTuple):
    """The messages in a piece of a bag, in file order: seven arrays of one length.

    `offset` and `length` (bytes) say where in `data` each message's CDR lies; times are in nanoseconds.
    """

    data: Bytes
    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log_time: Ints
    publish_time: Ints
    offset: Ints
    length: Ints

    def only(self, which: Any) -> Table:
        """Return the messages that an index, mask or slice selects."""
        return Table(self.data, *(column[which] for column in self[1:]))


class Walk(NamedTuple):
    """What a walk found; `stop` says why it ended at byte `position`."""

    table: Table
    others: Ints  # positions of the records that are no messages
    position: int
    stop: int


def run_length(data: Bytes) -> tuple[int, int]:
    """Return how many bytes of whole message records `data` begins with, and why the run ends."""
    position, _, _, stop = _walk(data, True)
    return position, stop


def walk(data: Bytes, most_others: int) -> Walk:
    """Index the records in `data`: all of them, or those before the first that is wrong.

    None when more than `most_others` of them are no messages.
    """
    position, messages, others, stop = _walk(data, False)
    if others > most_others:
        position, messages, others, stop = 0, 0, 0, TOO_MANY
    table = Table(
        data,
        np.empty(messages, np.uint16),
        np.empty(messages, np.uint32),
        *(np.empty(messages, np.int64) for _ in range(4)),
    )
    other = np.empty(others, np.int64)
    wrong = _fill(data, position, *table[1:], other)
    if wrong >= 0:
        return Walk(table, other, wrong, WRONG_TIME)
    return Walk(table, other, position, stop)


def gather(data: Bytes, offset: Ints, size: int) -> Bytes:
    """Copy messages of one size into rows whose fields are aligned.

    Returns:
        Array of shape (messages, width): four zero bytes, the message, and zeros to a multiple of eight, so that
        the message's body, after its 4-byte head, begins at byte 8.
    """
    rows = np.empty((offset.size, (4 + size + 7) // 8 * 8), np.uint8)
    _copy_rows(data, offset, size, rows)
    return rows
