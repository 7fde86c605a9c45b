"""One role of a loop as a topic tells it: values with the names that they bear, message by message.

Names are those of the message itself, so joints may come in any order, some of them only, and from several publishers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

Key = str | int  # of a value: the name that it bears, or its place in a message without names
JUDGED = 5  # messages from which on a publisher's clock is judged
CLOCK_NOISE_NS = 1_000_000  # a message is not published later than this after it was logged
CLOCK_SKEW_NS = 50_000_000  # between the least delays of two topics: their publishers' clocks differ
LATE_PERIODS = 3  # sample periods by which an output may be late; later ones come in bursts
NAMED_LANE = "lane"  # our own signals call their lanes lane0, lane1, …: that is a place, no joint


class Layout(NamedTuple):
    """Messages with the same names: which ones, (rows,), and their values, (rows, keys)."""

    keys: tuple[Key, ...]
    rows: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Track:
    """The messages of one role, in the order in which they were received.

    Attributes:
        source: topic and field, for people.
        stamp_ns: of the headers, (messages,); 0 where there is none.
        receive_ns: when they were published (where that is not known, logged), ns since the epoch, (messages,); see
            `on_one_clock`.
        log_ns: when they were logged, (messages,).
        frame_id: of the headers, (messages,).
        layouts: the values; together of each message with values, once.
        has_header: whether the messages have stamps at all.
        for_all: whether a message of one value without name is for every joint, as in our own signals.
    """

    source: str
    stamp_ns: np.ndarray
    receive_ns: np.ndarray
    log_ns: np.ndarray
    frame_id: np.ndarray
    layouts: tuple[Layout, ...]
    has_header: bool = True
    for_all: bool = False

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.stamp_ns)

    @property
    def keys(self) -> tuple[Key, ...]:
        """All that bears values, in the order of their first coming."""
        return tuple(dict.fromkeys(key for layout in self.layouts for key in layout.keys))

    @property
    def bears_names(self) -> bool:
        """Whether values go by names of joints, not by place."""
        return any(isinstance(key, str) for key in self.keys)

    def only(self, messages: np.ndarray) -> Track:
        """The track of some messages, by their indices in order."""
        place = np.full(len(self), -1)
        place[messages] = np.arange(len(messages))
        layouts = []
        for layout in self.layouts:
            rows = place[layout.rows]
            if (rows >= 0).any():
                layouts.append(Layout(layout.keys, rows[rows >= 0], layout.values[rows >= 0]))
        return replace(
            self,
            stamp_ns=self.stamp_ns[messages],
            receive_ns=self.receive_ns[messages],
            log_ns=self.log_ns[messages],
            frame_id=self.frame_id[messages],
            layouts=tuple(layouts),
        )

    def table(self, keys: Sequence[Key]) -> np.ndarray:
        """Values by message and key, (messages, keys); NaN where a message does not tell."""
        table = np.full((len(self), len(keys)), np.nan)
        for layout in self.layouts:
            if layout.keys == tuple(keys):
                table[layout.rows] = layout.values
                continue
            place = {key: i for i, key in enumerate(layout.keys)}
            for column, key in enumerate(keys):
                if key in place:
                    table[layout.rows, column] = layout.values[:, place[key]]
        return table

    def driven(self) -> set[Key]:
        """What has a value at some time, NaN being none."""
        return {
            key
            for layout in self.layouts
            for key, told in zip(layout.keys, ~np.isnan(layout.values).all(axis=0), strict=True)
            if told
        }

    def groups(self) -> Iterator[Track]:
        """Yield a track for each set of joints that come together in messages: several publishers' apart."""
        groups: list[set[Key]] = []
        for layout in self.layouts:
            together = set(layout.keys).union(*(group for group in groups if group & set(layout.keys)))
            groups = [*(group for group in groups if not group & together), together]
        order = {key: i for i, key in enumerate(self.keys)}
        for group in sorted(groups, key=lambda group: min(order[key] for key in group)):
            mine = [layout.rows for layout in self.layouts if group & set(layout.keys)]
            yield self.only(np.sort(np.concatenate(mine)))


def matched(track: Track, keys: Sequence[Key]) -> np.ndarray:
    """The values of a track for the joints of an output, (messages, keys).

    By name where both bear names, else by place: as many values as joints, or one for all of them.
    """
    names = [key for key in keys if isinstance(key, str)]
    table = np.full((len(track), len(keys)), np.nan)
    for layout in track.layouts:
        if names and any(isinstance(key, str) for key in layout.keys):
            known = {key: i for i, key in enumerate(layout.keys)}
            columns = [known.get(key) for key in keys]
            for column, there in enumerate(columns):
                if there is not None:
                    table[layout.rows, column] = layout.values[:, there]
        elif len(layout.keys) == len(keys):
            table[layout.rows] = layout.values
        elif len(layout.keys) == 1 and track.for_all:
            table[layout.rows] = np.repeat(layout.values, len(keys), axis=1)
    return table


def on_one_clock(tracks: Sequence[Track]) -> tuple[list[Track], str | None]:
    """The tracks with receive times that can be compared, and a note where these are not the publish times.

    Publish times are finer, but may be of hosts whose clocks differ; then it is the log times. Where all is logged at
    one time, or outputs come late, in bursts, the stamps must do, if all have them.

    Args:
        tracks: the output's first.
    """
    offsets = [track.log_ns - track.receive_ns for track in tracks if len(track)]
    least = [int(offset.min()) for offset in offsets if offset.size >= JUDGED]
    skewed = any(int(offset.min()) < -CLOCK_NOISE_NS for offset in offsets) or (
        len(least) > 1 and max(least) - min(least) > CLOCK_SKEW_NS
    )
    note = None
    found = list(tracks)
    if skewed:
        found = [replace(track, receive_ns=track.log_ns) for track in found]
        note = "the publishers' clocks differ: messages are put in order by the times at which they were logged"
    output = found[0]
    if len(output) > 1 and (output.receive_ns == output.receive_ns[0]).all() and output.stamp_ns.any():
        found = [replace(track, receive_ns=track.stamp_ns) if track.stamp_ns.any() else track for track in found]
        note = "all messages bear one receive time: they are put in order by their stamps"
    elif (late_ns := _lateness(output)) > 0:
        if all(_is_stamped_like(track, late_ns) for track in found):
            found = [replace(track, receive_ns=track.stamp_ns) for track in found]
            note = "outputs were received late: messages are put in order by their stamps"
        else:
            note = f"outputs were received up to {late_ns / 1e9:.2g} s late: when a setpoint came is known no better"
    return found, note


def _lateness(output: Track) -> int:
    """How many ns outputs of a clock that agrees are received late, if many come later than some sample periods."""
    steps = np.diff(output.stamp_ns)
    if len(output) < JUDGED or not (output.stamp_ns > 0).all() or (steps < 0).any() or not (steps > 0).any():
        return 0
    delays = output.receive_ns - output.stamp_ns
    period = np.median(steps[steps > 0])
    agrees = abs(int(delays.min())) <= CLOCK_SKEW_NS
    return int(np.ptp(delays)) if agrees and np.quantile(delays, 0.9) > LATE_PERIODS * period else 0


def _is_stamped_like(track: Track, late_ns: int) -> bool:
    """Whether all messages of a track bear stamps of the clock by which they were received, up to so much earlier."""
    delays = track.receive_ns - track.stamp_ns
    return bool((np.abs(delays - late_ns // 2) <= late_ns // 2 + CLOCK_SKEW_NS).all())


def by_place(track: Track) -> Track:
    """The track without its names."""
    layouts = tuple(layout._replace(keys=tuple(range(len(layout.keys)))) for layout in track.layouts)
    return replace(track, layouts=layouts, for_all=False)


def held(table: np.ndarray) -> np.ndarray:
    """The table with each NaN replaced by the value before it in its column; NaN before the first."""
    if not np.isnan(table).any():
        return table
    filled: np.ndarray = np.take_along_axis(table, latest_told(table), axis=0)
    return filled


def latest_told(table: np.ndarray) -> np.ndarray:
    """For each place of a table the row, at or above it, that is the last one with a value; 0 where there is none."""
    latest = np.where(np.isnan(table), 0, np.arange(len(table))[:, None])
    return np.maximum.accumulate(latest, axis=0, out=latest)


def layouts_of(names: np.ndarray, values: np.ndarray) -> tuple[Layout, ...]:
    """Layouts from columns: names and values of each message, (messages, n) or (messages,) of arrays.

    A message without values tells nothing; one with other than one name per value goes by place. What is infinite is
    NaN, no value.
    """
    found = []
    for keys, rows in _alike(names, values):
        mine = np.stack([values[row] for row in rows]) if values.dtype == object else values[rows]
        if keys:
            infinite = np.isinf(mine)
            found.append(Layout(keys, rows, np.where(infinite, np.nan, mine) if infinite.any() else mine))
    return tuple(found)


def _alike(names: np.ndarray, values: np.ndarray) -> list[tuple[tuple[Key, ...], np.ndarray]]:
    """Messages by their keys."""
    if names.dtype != object and values.dtype != object:
        if not len(names):
            return []
        different = np.flatnonzero((names != names[0]).any(axis=1))
        if not different.size:
            return [(_keys(names[0].tolist(), values.shape[1]), np.arange(len(names)))]
    found: dict[tuple[Key, ...], list[int]] = {}
    known: dict[tuple[tuple[str, ...], int], tuple[Key, ...]] = {}
    for i in range(len(values)):
        label = (tuple(map(str, names[i])), len(values[i]))
        if label not in known:
            known[label] = _keys(label[0], label[1])
        found.setdefault(known[label], []).append(i)
    return [(keys, np.array(rows)) for keys, rows in found.items()]


def _keys(names: Sequence[str], count: int) -> tuple[Key, ...]:
    names = [name.rstrip("\0") for name in names]  # of drivers that copy texts of fixed length
    is_place = all(name == f"{NAMED_LANE}{i}" for i, name in enumerate(names))
    if len(names) == count and not is_place and len(set(names)) == count and all(names):
        return tuple(names)
    return tuple(range(count))
