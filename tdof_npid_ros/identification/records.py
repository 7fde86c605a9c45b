"""Records for identification from bags: stretches of output and applied effort, on the time of the stamps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tdof_npid_ros.analysis.recording import Loop, Signal, read_loops
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.identification import IdentificationError
from tdof_npid_ros.identification.fit import Stretch
from tdof_npid_ros.plants.catalog import make_plant
from tdof_npid_ros.wire import EpisodeLabel

LEAST_STRETCH = 10  # samples; shorter ones are left out
GAP = 20.0  # periods without an output end a stretch
EVEN = 1e-6  # of a period: stamps that are nearer to a grid are on it


@dataclass(frozen=True)
class Record:
    """A stretch with what is known beside it.

    Attributes:
        name: of the episode, or `recording`.
        number: counts the stretches of its bag, from 1.
        stretch: output and applied effort.
        setpoint: at each stamp, (samples,); NaN where it is not known.
        limits: of the effort; infinite where they are not known.
        notes: what was made of the bag, for people.
    """

    name: str
    number: int
    stretch: Stretch
    setpoint: np.ndarray
    limits: tuple[float, float]
    notes: tuple[str, ...] = ()


def read_records(bags: Sequence[str | Path], episode: str | None = None, lane: str | int | None = None) -> list[Record]:
    """The records in some bags.

    Args:
        episode: only stretches of that name or number; None: all.
        lane: the joint's name or place; None: there must be one alone.

    Raises:
        IdentificationError: there is none, or several loops or joints.
        AnalysisError, BagError: a bag cannot be read.
    """
    records: list[Record] = []
    for bag in bags:
        with BagReader(Path(bag)) as reader:
            loops = read_loops(reader, str(bag))
            if len(loops) > 1:
                raise IdentificationError(
                    f"{bag}: outputs of several loops in it ({', '.join(loop.topic for loop in loops)}): choose one "
                    f"with --output"
                )
            records += _records(loops[0], lane)
    if episode is not None:
        names = list(dict.fromkeys(record.name for record in records))
        records = [record for record in records if episode in (record.name, str(record.number))]
        if not records:
            raise IdentificationError(
                f"no episode {episode!r}: there are {', '.join(names) or 'none'}, and numbers from 1"
            )
    if not records:
        raise IdentificationError(
            f"{', '.join(map(str, bags))}: no stretch of {LEAST_STRETCH} outputs with an effort: record longer"
        )
    return records


def _records(loop: Loop, lane: str | int | None) -> Iterator[Record]:
    output = loop.output
    column = _column(loop, lane)
    number = 0
    for part in _parts(output):
        label = EpisodeLabel.named_in(str(output.frame_id[part.start]))
        stamps, first = np.unique(output.stamp_ns[part], return_index=True)
        if len(stamps) < LEAST_STRETCH:
            continue
        number += 1
        y = _values(output.position[part], column)[first]
        applied, notes = _applied(loop, part, first, stamps, column)
        if applied is None:
            continue
        known = np.isfinite(y) & np.isfinite(applied)
        if np.count_nonzero(known) < LEAST_STRETCH:
            continue
        stamps, y, applied = stamps[known], y[known], applied[known]
        plan = loop.plans.get(label.plan) if label is not None else None
        time = (stamps - stamps[0]) / 1e9
        period = float(np.median(np.diff(time)))
        even = bool(np.abs(time - np.arange(len(time)) * period).max() < EVEN * period * len(time) and _is_even(time))
        before, limits = _from_plant(loop, float(output.publish_ns[part.start]))
        at_rest = label is not None and known[0] and (plan is None or stamps[0] == 0)
        stretch = Stretch(time, applied, y, at_rest, before if at_rest else float(applied[0]), even)
        setpoint = np.full(len(time), np.nan)
        if plan is not None:
            signals = plan.sampled(round(period * 1e9))
            at = np.minimum(np.round(stamps / (period * 1e9)).astype(int), signals.steps)
            setpoint = signals.setpoint[at]
            if np.any(signals.disturbance[at]):
                stretch = replace(stretch, effort=stretch.effort + signals.disturbance[at])
                notes = (*notes, "the plan's disturbance is added to the effort")
        elif loop.control_effort is not None and len(loop.control_effort):
            setpoint = _by_stamp(loop.control_effort, "position", stamps, column)
        yield Record(
            label.plan if label is not None and label.plan else "recording", number, stretch, setpoint, limits, notes
        )


def _is_even(time: np.ndarray) -> bool:
    steps = np.diff(time)
    return bool(steps.max() - steps.min() <= 2e-9 + EVEN * steps.mean())


def _parts(output: Signal) -> list[slice]:
    """Stretches in which the episode is the same and the stamps go on, without a gap."""
    count = len(output)
    if count < 2:
        return []
    steps = np.diff(output.stamp_ns)
    forward = steps[steps > 0]
    period = float(np.median(forward)) if len(forward) else 1.0
    broken = (steps < 0) | (steps > GAP * period) | (output.frame_id[1:] != output.frame_id[:-1])
    starts = [0, *(np.flatnonzero(broken) + 1).tolist(), count]
    return [slice(a, b) for a, b in zip(starts, starts[1:], strict=False)]


def _column(loop: Loop, lane: str | int | None) -> int:
    names = [str(name) for name in loop.output.name[0]] if len(loop.output.name) else []
    count = len(loop.output.position[0]) if len(loop.output) else 0
    if lane is None:
        if count != 1:
            raise IdentificationError(
                f"{loop.bag}: {loop.topic} has {count} joints ({', '.join(names) or 'without names'}): choose one, "
                f"as in "
                f"--output {loop.topic}:position[{names[-1] if names else 0}]"
            )
        return 0
    if isinstance(lane, int) and lane < count:
        return lane
    if lane in names:
        return names.index(str(lane))
    raise IdentificationError(f"{loop.bag}: {loop.topic} has no joint {lane}: there are {', '.join(names) or count}")


def _values(rows: np.ndarray, column: int) -> np.ndarray:
    if rows.dtype != object:
        return rows[:, column].astype(np.float64) if rows.shape[1] > column else np.full(len(rows), np.nan)
    return np.array([row[column] if len(row) > column else np.nan for row in rows], dtype=np.float64)


def _applied(
    loop: Loop, part: slice, first: np.ndarray, stamps: np.ndarray, column: int
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """The effort held from each stamp on.

    `output.effort` is the one that was applied until its stamp, so that of the next output counts. Without it, the
    controller's answers are taken from the stamps on that they answer.
    """
    told = _values(loop.output.effort[part], column)[first]
    if np.isfinite(told).sum() > 1 and np.ptp(told[np.isfinite(told)]) > 0.0:
        return np.append(told[1:], told[-1]), ("the effort is the output's, the one that was applied",)
    if loop.control_effort is None or not len(loop.control_effort):
        return (None, ()) if not np.isfinite(told).any() else (np.append(told[1:], told[-1]), ())
    return _by_stamp(loop.control_effort, "effort", stamps, column), (
        "the effort is the controller's, before any limit of the plant",
    )


def _by_stamp(signal: Signal, field: str, stamps: np.ndarray, column: int) -> np.ndarray:
    """The newest value at each stamp; NaN before the first."""
    times, last = np.unique(signal.stamp_ns[::-1], return_index=True)
    values = _values(getattr(signal, field), column)[::-1][last]
    at = np.searchsorted(times, stamps, side="right") - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], np.nan)


def _from_plant(loop: Loop, time_ns: float) -> tuple[float, tuple[float, float]]:
    """The effort before an episode and its limits, as far as a simulated plant's parameters tell."""
    if loop.plant is None:
        return 0.0, (-math.inf, math.inf)
    values = loop.plant.at(round(time_ns))
    limits = (float(values.get("effort_min", -math.inf)), float(values.get("effort_max", math.inf)))
    try:
        return float(make_plant(str(values["model"]), values).initial_effort), limits
    except ValueError:
        return 0.0, limits
