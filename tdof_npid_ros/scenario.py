"""Scenarios: what the setpoint, the disturbance and the plant's parameters do during an episode.

A plan is written as lines, each `TIME SIGNAL WHAT`, and ends with `TIME end` (times in s):

    0    setpoint 1                      step to 1
    10   setpoint ramp 2 over 5          from where it is to 2 within 5 s
    20   disturbance sine 0.5 period 4 for 12
    0    plant.a 0.6                     a parameter of the plant
    40   plant.a 0.72
    60   end

A value holds until its signal's next line. Setpoint and disturbance start at 0; a plant's parameter that changes
needs a line at 0 too, so that a plan says by itself what it does.

With `0 start 60` the episode begins at rest: plant and controller are settled at output and setpoint 60, and the
setpoint starts there.
"""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameters import LARGEST_SIGNAL

SIGNALS = ("setpoint", "disturbance")
PLANT = "plant."  # before the names of the plant's parameters
START = "start"  # the column of a plan that begins at rest; its value is the same at each point
LONGEST_REST, SHORTEST_REST = 0.2, 0.05  # fractions of an episode: the stretch from which is judged whether it rests
LEAST_REST = 2  # samples, of which the late half is one
LARGEST_PLAN = 10_000_000  # samples: beyond it a plan is taken for a mistake
LONGEST_TIME = 1e9  # s, thirty years: of a plan and of whatever lasts in it
MOST_VALUES = 150_000  # points times signals, as many as ramps over two minutes at 1 ms make: a plan is one message
GRAMMAR = (
    "TIME setpoint|disturbance|plant.NAME VALUE, TIME SIGNAL ramp VALUE over SECONDS, "
    "TIME SIGNAL sine AMPLITUDE period SECONDS for SECONDS, 0 start VALUE, or TIME end"
)


class PlanError(ValueError):
    """A plan that cannot be run; the message quotes the line that is wrong."""


class Rest(NamedTuple):
    """The end of an episode, where nothing changes any more: samples `first` to the last, and the half of them from
    `middle` on."""

    first: int
    middle: int


class Segment(NamedTuple):
    """Steps `first` to `last` (excluded) during which the plant's parameters are `plant`."""

    first: int
    last: int
    plant: dict[str, float]


@dataclass(frozen=True)
class SampledPlan:
    """A plan sampled: setpoint and disturbance of shape (steps + 1,), and the stretches of constant plant
    parameters."""

    sample_period_ns: int
    setpoint: np.ndarray
    disturbance: np.ndarray
    segments: tuple[Segment, ...]
    start: float | None = None  # the output at which everything is settled at time 0; None: the plant's own start
    identity: int = 0  # the plan's digest as a number below 2**48: what the noise of a simulated plant goes by

    @property
    def steps(self) -> int:
        """Number of steps: the last sample's index."""
        return len(self.setpoint) - 1

    @property
    def time(self) -> np.ndarray:
        """Time of each sample in s, (steps + 1,)."""
        return np.arange(self.steps + 1) * (self.sample_period_ns / 1e9)

    @cached_property
    def weight(self) -> np.ndarray:
        """Weight of each sample in an integral by the trapezoidal rule, in sample periods, (steps + 1,)."""
        weight = np.ones(self.steps + 1)
        weight[[0, -1]] = 0.5
        return weight

    @cached_property
    def rest(self) -> Rest | None:
        """The stretch at the end from which is judged whether a loop comes to rest: at most the last fifth.

        None where signals or plant change up to the end, so that no loop can, or where there are too few steps to tell.
        """
        moves = (signal[1:] != signal[:-1] for signal in (self.setpoint, self.disturbance))
        changes = [int(changed[-1]) + 1 for move in moves if (changed := np.flatnonzero(move)).size]
        first = max([*changes, self.segments[-1].first, math.ceil((1.0 - LONGEST_REST) * self.steps)])
        if self.steps - first < max(SHORTEST_REST * self.steps, LEAST_REST):
            return None
        return Rest(first, first + (self.steps - first + 1) // 2)


@dataclass(frozen=True)
class Plan:
    """Points in time, each holding until the next; the last one's time ends the episode.

    Args:
        names: `setpoint`, `disturbance`, `start`, `plant.<parameter>`, one per column.
        times_ns: strictly increasing, the first 0.
        values: (points, names), as nested tuples.

    Raises:
        PlanError: times out of order, unknown or repeated names, values that are not finite.
    """

    names: tuple[str, ...]
    times_ns: tuple[int, ...]
    values: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        for name in self.names:
            if name not in (*SIGNALS, START) and not (name.startswith(PLANT) and len(name) > len(PLANT)):
                raise PlanError(f"unknown signal {name!r}: a plan drives setpoint, disturbance and plant.<parameter>")
        if len(set(self.names)) != len(self.names):
            raise PlanError(f"a signal is named twice in {', '.join(self.names)}")
        if len(self.times_ns) < 2 or len(self.times_ns) != len(self.values):
            raise PlanError("a plan needs at least two points, its start and its end, with values for each")
        _check_size(len(self.times_ns), len(self.names))
        if self.times_ns[0] != 0:
            raise PlanError(f"the plan starts at {self.times_ns[0] / 1e9:g} s: its first point must be at 0 s")
        for i, (time, row) in enumerate(zip(self.times_ns, self.values, strict=True)):
            if i and time <= self.times_ns[i - 1]:
                raise PlanError(f"point {i} at {time / 1e9:g} s is not after {self.times_ns[i - 1] / 1e9:g} s")
            if len(row) != len(self.names):
                raise PlanError(f"point {i} has {len(row)} values for {len(self.names)} signals")
            if not all(map(math.isfinite, row)):
                raise PlanError(f"point {i} at {time / 1e9:g} s holds a value that is not finite: {list(row)}")
            if any(abs(value) > LARGEST_SIGNAL for value in row):
                raise PlanError(f"point {i} at {time / 1e9:g} s holds a value beyond {LARGEST_SIGNAL:g}: {list(row)}")
        if START in self.names and len({row[self.names.index(START)] for row in self.values}) > 1:
            raise PlanError(f"{START} changes within the plan: an episode begins at rest once, at 0 s")

    @property
    def start(self) -> float | None:
        """The output at which plant and controller are settled at time 0; None: not said."""
        return self.values[0][self.names.index(START)] if START in self.names else None

    @property
    def end_ns(self) -> int:
        """The episode's length."""
        return self.times_ns[-1]

    @cached_property
    def digest(self) -> str:
        """The plan's name: 12 hexadecimal digits made from its content alone."""
        content = hashlib.sha256(",".join(self.names).encode())
        content.update(np.asarray(self.times_ns, dtype="<i8").tobytes())
        content.update(np.asarray(self.values, dtype="<f8").tobytes())
        return content.hexdigest()[:12]

    def value_at(self, name: str, stamp_ns: int) -> float:
        """The value of a signal at `stamp_ns`, 0 for a signal that the plan does not name."""
        if name not in self.names:
            return 0.0
        point = bisect_right(self.times_ns, stamp_ns) - 1
        return self.values[max(point, 0)][self.names.index(name)]

    def plant_changes(self, point: int) -> dict[str, float]:
        """The plant's parameters, by their names in the plant, that the plan gives at a point."""
        row = zip(self.names, self.values[point], strict=True)
        return {name.removeprefix(PLANT): value for name, value in row if name.startswith(PLANT)}

    def steps(self, sample_period_ns: int) -> int:
        """Number of steps of an episode: samples are at 0, h, …, steps·h.

        Raises:
            PlanError: the plan is shorter than a step or absurdly long.
        """
        steps = self.end_ns // sample_period_ns
        if not 1 <= steps <= LARGEST_PLAN:
            raise PlanError(
                f"the plan of {self.end_ns / 1e9:g} s has {steps} samples of {sample_period_ns / 1e9:g} s: "
                f"it needs 1 to {LARGEST_PLAN}"
            )
        return steps

    def sampled(self, sample_period_ns: int) -> SampledPlan:
        """The plan at the stamps k·sample_period_ns."""
        steps = self.steps(sample_period_ns)
        # Point i holds from the first sample at its time or later, up to that of the next point.
        first = -(-np.asarray(self.times_ns, dtype=np.int64) // sample_period_ns)
        first = np.minimum(first, steps + 1)
        values = np.asarray(self.values, dtype=np.float64).reshape(len(self.times_ns), len(self.names))
        column = {name: values[:, i] for i, name in enumerate(self.names)}
        samples = np.diff(first, append=steps + 1)
        none = np.zeros(len(first))
        setpoint, disturbance = (np.repeat(column.get(name, none), samples) for name in SIGNALS)
        segments = self._segments(column, first, steps)
        return SampledPlan(sample_period_ns, setpoint, disturbance, segments, self.start, int(self.digest, 16))

    def _segments(self, column: Mapping[str, np.ndarray], first: np.ndarray, steps: int) -> tuple[Segment, ...]:
        """The stretches of constant plant parameters; `first` is each point's first sample."""
        parameters = [name for name in self.names if name.startswith(PLANT)]
        if not parameters:
            return (Segment(0, steps, {}),)
        holds = np.flatnonzero((np.diff(first, append=steps + 1) > 0) & (first < steps))
        table = np.stack([column[name][holds] for name in parameters])
        changes = np.concatenate([[True], np.any(np.diff(table, axis=1) != 0, axis=0)])
        starts = [*first[holds][changes].tolist(), steps]
        return tuple(
            Segment(a, b, dict(zip((name.removeprefix(PLANT) for name in parameters), row, strict=True)))
            for (a, b), row in zip(pairwise(starts), table[:, changes].T.tolist(), strict=True)
        )


def _check_size(points: int, signals: int) -> None:
    if points * signals > MOST_VALUES:
        raise PlanError(
            f"the plan has {points} points for {signals} signals: {MOST_VALUES} values at most; let ramps and sines "
            "be shorter or the sample period longer"
        )


def parse_plan(lines: Sequence[str], sample_period_ns: int, plant_parameters: Collection[str] | None = None) -> Plan:
    """A plan from its lines (see this module's docstring); ramps and sines become one point per sample.

    Args:
        plant_parameters: names of the plant's parameters that may change while it runs; None: not known here.

    Raises:
        PlanError: with the line that is wrong.
    """
    entries = [_parse_line(i, str(line), plant_parameters) for i, line in enumerate(lines)]
    for before, entry in pairwise(entries):
        if before.signal == "end":
            raise PlanError(f"{entry.where}: it comes after the end")
        if entry.time_ns < before.time_ns:
            raise PlanError(f"{entry.where}: its time is before the line above")
    if not entries or entries[-1].signal != "end":
        raise PlanError("a plan ends with the line 'TIME end'")
    names = list(dict.fromkeys(entry.signal for entry in entries[:-1])) or ["setpoint"]
    if START in names and "setpoint" not in names:
        names.append("setpoint")
    return _unroll(entries, names, sample_period_ns)


class _Entry(NamedTuple):
    where: str
    time_ns: int
    signal: str
    shape: str
    numbers: tuple[float, ...]

    @property
    def until_ns(self) -> int:
        return self.time_ns + (round(self.numbers[-1] * 1e9) if self.shape != "step" else 0)


_SHAPES = {"ramp": ("ramp", 0, "over", 0), "sine": ("sine", 0, "period", 0, "for", 0)}  # 0 stands for a number


def _parse_line(index: int, text: str, known: Collection[str] | None) -> _Entry:
    where = f"line {index + 1} {one_line(text, 100)!r}"
    words = text.split()
    if len(words) < 2:
        raise PlanError(f"{where}: expected {GRAMMAR}")
    time = _finite(words[0], where)
    if time < 0:
        raise PlanError(f"{where}: its time is negative")
    if time > LONGEST_TIME:
        raise PlanError(f"{where}: its time is beyond {LONGEST_TIME:g} s")
    signal = words[1]
    if signal == "end" and len(words) == 2:
        return _Entry(where, round(time * 1e9), "end", "step", ())
    if known is not None and signal.startswith(PLANT) and signal.removeprefix(PLANT) not in known:
        raise PlanError(f"{where}: unknown plant parameter; those that may change are {', '.join(known) or 'none'}")
    if signal not in (*SIGNALS, START) and not signal.startswith(PLANT):
        raise PlanError(f"{where}: unknown signal {signal!r}; expected {GRAMMAR}")
    shape, words = (words[2] if len(words) > 2 else ""), words[2:]
    if shape not in _SHAPES:
        if len(words) != 1:
            raise PlanError(f"{where}: expected {GRAMMAR}")
        return _Entry(where, round(time * 1e9), signal, "step", (_finite(words[0], where),))
    if signal == START:
        raise PlanError(f"{where}: an episode begins at rest at one value, as 0 start 60")
    pattern = _SHAPES[shape]
    if len(words) != len(pattern) or any(want not in (0, word) for want, word in zip(pattern, words, strict=True)):
        raise PlanError(f"{where}: expected {GRAMMAR}")
    numbers = tuple(_finite(word, where) for want, word in zip(pattern, words, strict=True) if want == 0)
    if any(number <= 0 for number in numbers[1:]):
        raise PlanError(f"{where}: durations and periods must be above 0")
    if numbers[-1] > LONGEST_TIME:
        raise PlanError(f"{where}: it lasts longer than {LONGEST_TIME:g} s")
    return _Entry(where, round(time * 1e9), signal, shape, numbers)


def _finite(word: str, where: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise PlanError(f"{where}: {word!r} is not a number; expected {GRAMMAR}") from None
    if not math.isfinite(value):
        raise PlanError(f"{where}: {word} is not finite")
    return value


def _unroll(entries: list[_Entry], names: list[str], period_ns: int) -> Plan:
    end_ns = entries[-1].time_ns
    if not 1 <= end_ns // period_ns <= LARGEST_PLAN:
        raise PlanError(f"{entries[-1].where}: an episode has 1 to {LARGEST_PLAN} samples of {period_ns / 1e9:g} s")
    starts = {"setpoint": _start(entries), "disturbance": 0.0}
    tracks: dict[str, dict[int, float]] = {name: {0: starts[name]} if name in starts else {} for name in names}
    stops_ns = _stops(entries)
    points = 0
    for entry, stop_ns in zip(entries[:-1], stops_ns, strict=True):
        track = tracks[entry.signal]
        if not track and (entry.time_ns, entry.shape) != (0, "step"):
            raise PlanError(f"{entry.where}: give {entry.signal} a value at 0 s first")
        points += (min(entry.until_ns, stop_ns) - entry.time_ns) // period_ns  # before they are made
        _check_size(points, 1)
        before = next(reversed(track.values()), 0.0)  # entries are in order, and no point lies beyond the next one
        track.update(_points(entry, before, stop_ns, period_ns))
    times = sorted({0, end_ns, *(t for track in tracks.values() for t in track if t < end_ns)})
    _check_size(len(times), len(names))
    columns = [_held(tracks[name], times) for name in names]
    return Plan(tuple(names), tuple(times), tuple(zip(*columns, strict=True)))


def _stops(entries: Sequence[_Entry]) -> list[int]:
    """For each entry but the last, the end, when the signal's next one begins, or else just after the end: what the end
    cuts off has a value there too."""
    following: dict[str, int] = {}
    stops = []
    for entry in reversed(entries[:-1]):
        stops.append(following.get(entry.signal, entries[-1].time_ns + 1))
        following[entry.signal] = entry.time_ns
    return stops[::-1]


def _start(entries: Sequence[_Entry]) -> float:
    """Where the setpoint starts."""
    lines = [entry for entry in entries if entry.signal == START]
    for entry in lines:
        if entry.time_ns or entry is not lines[0]:
            raise PlanError(f"{entry.where}: an episode begins at rest once, at 0 s")
    return lines[0].numbers[0] if lines else 0.0


def _points(entry: _Entry, start: float, stop_ns: int, period_ns: int) -> dict[int, float]:
    """The points that an entry adds to its signal: one, or one per sample while a ramp or sine lasts."""
    if entry.shape == "step":
        return {entry.time_ns: entry.numbers[0]}
    duration = entry.until_ns - entry.time_ns
    first = -(-entry.time_ns // period_ns) * period_ns
    points = {}
    for t in range(first, min(entry.until_ns, stop_ns), period_ns):
        passed = (t - entry.time_ns) / duration
        if entry.shape == "ramp":
            points[t] = start + (entry.numbers[0] - start) * passed
        else:
            amplitude, sine_period, seconds = entry.numbers
            points[t] = start + amplitude * math.sin(2 * math.pi * passed * seconds / sine_period)
    if entry.until_ns < stop_ns:
        points[entry.until_ns] = entry.numbers[0] if entry.shape == "ramp" else start
    return points


def _held(track: Mapping[int, float], times: Sequence[int]) -> list[float]:
    values, current = [], 0.0
    for t in times:
        current = track.get(t, current)
        values.append(current)
    return values


def read_episodes(scenario: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """The lines of each episode from the scenario's parameters `episodes` and `plan.<episode>`.

    Raises:
        PlanError: `episodes` is no list of names, or an episode has no plan.
    """
    names = scenario.get("episodes", [])
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names):
        raise PlanError(f"episodes is {names!r}: it must be a list of names, as [setpoint, disturbance]")
    episodes = {}
    for name in names:
        lines = scenario.get(f"plan.{name}")
        if not isinstance(lines, (list, tuple)) or not lines:
            raise PlanError(f"episode {name!r} has no plan: give its lines as the list of strings plan.{name}")
        episodes[name] = tuple(str(line) for line in lines)
    return episodes
