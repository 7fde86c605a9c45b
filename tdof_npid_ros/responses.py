"""The responses of a lane: what changes in its setpoint, disturbance and plant, and what its output does then.

The same rules for a simulated episode and for a recording of any origin (docs/analysis.md).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from tdof_npid_ros.metrics import (
    RECOVERY_BAND,
    DisturbanceMetrics,
    SetpointMetrics,
    difference,
    disturbance_metrics,
    integral_absolute_error,
    setpoint_metrics,
)

MOST_STEPS = 20  # an episode with more steps follows a path: then only its error is measured
PATH_GAP = 10  # samples: changes as close as this …
PATH_CHANGES = 5  # … and as many as this are a ramp or a sine, not steps
SMALLEST_STEP = 0.1 * RECOVERY_BAND  # of the largest step of the episode; what is smaller changes no metric
ROUNDING = 4 * float(np.finfo(np.float32).eps)  # of a value that was a float32 on its way, say
CLEAR_OF_NOISE = 6.0  # standard deviations of the output's noise by which a first setpoint must differ from it
NO_SETPOINT = "the setpoint is not in the bag"

Kind = Literal["setpoint", "disturbance", "plant", "tracking"]


@dataclass(frozen=True)
class Response:
    """What one lane does from one change to the next.

    Attributes:
        kind: what changed; `tracking`: the setpoint or disturbance follows a path, or nothing changed.
        start_s, end_s: within the episode.
        metrics: the paper's; None for `tracking`, and where samples are missing.
        iae: integral of the absolute error (9); None where samples are missing.
        reason: why something is None.
    """

    kind: Kind
    start_s: float
    end_s: float
    metrics: SetpointMetrics | DisturbanceMetrics | None
    iae: float | None
    reason: str | None = None


@dataclass(frozen=True)
class Lane:
    """What drives one lane and what it does, sample by sample; NaN where it is not known.

    Attributes:
        sample_period: s.
        time: s, (samples,).
        setpoint, disturbance, output: (samples,).
        plant_changes: samples at which the plant's parameters change.
        setpoint_is_new: the first setpoint came with the first sample; else it stood before.
        disturbance_is_new: likewise.
        seen_late: a change is seen at the first output after it, which may have moved already.
        largest_step: of the setpoint, in the case's scenario: what the recovery band is a fraction of.
        begins: the plant's output at the first sample, without the noise of what is measured; None: it is not known.
        turn: of angles, else 0.
    """

    sample_period: float
    time: np.ndarray
    setpoint: np.ndarray
    disturbance: np.ndarray
    output: np.ndarray
    plant_changes: Collection[int] = ()
    setpoint_is_new: bool = True
    disturbance_is_new: bool = True
    seen_late: bool = False
    largest_step: float | None = None
    begins: float | None = None
    turn: float = 0.0


class _Change(NamedTuple):
    """At which sample, what, and from which value (of a setpoint)."""

    at: int
    kind: Kind
    before: float = 0.0


def responses(lane: Lane) -> list[Response]:
    """The responses of a lane, in order; one, of kind `tracking`, where nothing steps."""
    known = np.flatnonzero(~np.isnan(lane.setpoint))
    last = len(lane.time) - 1
    if not known.size:
        return [Response("tracking", float(lane.time[0]), float(lane.time[last]), None, None, NO_SETPOINT)]
    first = int(known[0])
    changes = [change for change in _changes(lane, first) if change.at < last]
    if not changes or len(changes) > MOST_STEPS or (len(changes) == 1 and changes[0].kind == "tracking"):
        return [_measured(lane, _Change(first, "tracking"), last)]
    ends = [(change.at - lane.seen_late, change.kind == "setpoint") for change in changes[1:]]
    return [
        _measured(lane, change, max(end, change.at), steps_at_end)
        for change, (end, steps_at_end) in zip(changes, [*ends, (last, False)], strict=True)
    ]


def largest_move(setpoint: np.ndarray, start: float, turn: float = 0.0) -> float:
    """The largest step that a plan's setpoint (samples,) makes, the first one from the output at the start.

    A ramp or sine counts as one step, as far as it goes.
    """
    sizes = [abs(float(difference(setpoint[0], start, turn)))]
    for at, end in _moves(setpoint):
        sizes += [float(np.abs(difference(setpoint[at:end], setpoint[at - 1], turn)).max())]
    return max(sizes)


def _changes(lane: Lane, first: int) -> list[_Change]:
    """What changes, in order; where several things change at once, the setpoint before disturbance and plant."""
    found = {at: _Change(at, "plant") for at in lane.plant_changes if at >= first}
    for at, kind in _disturbance_changes(lane):
        if at >= first - PATH_GAP:  # in realtime it may come just before the setpoint of the same episode
            found[max(at, first)] = _Change(max(at, first), kind)
    for change in _setpoint_changes(lane, first):
        found[change.at] = change
    return [found[at] for at in sorted(found)]


def _setpoint_changes(lane: Lane, first: int) -> list[_Change]:
    r = lane.setpoint
    moves = [(change, first + 1) for change in _first_setpoint(lane, first)]
    standing = float(r[first])
    for at, end in _moves(r[first:], first):
        # A path begins where it leaves the value that stood.
        is_path = end - at > 1
        moves.append((_Change(max(at - 1, first), "tracking") if is_path else _Change(at, "setpoint", standing), end))
        standing = float(r[end - 1])
    sizes = [_extent(lane, change, end) for change, end in moves]
    smallest = max(SMALLEST_STEP * max(sizes, default=0.0), ROUNDING * float(np.nanmax(np.abs(r))))
    kept: list[_Change] = []
    standing = float(r[first])
    for change, end in moves:
        if change.kind == "setpoint" and change.at > first:
            # Many small changes add up: what counts is how far it is from the value that stood.
            change = change._replace(before=standing)
        if _extent(lane, change, end) > smallest:
            kept.append(change)
            standing = float(r[end - 1])
    return kept


def _extent(lane: Lane, change: _Change, end: int) -> float:
    """How far the setpoint goes in a change that ends before the sample `end`."""
    before = lane.setpoint[change.at] if change.kind == "tracking" else change.before
    return float(np.abs(difference(lane.setpoint[change.at : end], before, lane.turn)).max())


def _first_setpoint(lane: Lane, first: int) -> list[_Change]:
    """The first setpoint, if it came within the recording: from the output at that moment, for want of another.

    A setpoint that stood when the recording began is no step: when it came, and what the output was then, is not known.
    """
    if first == 0 and not lane.setpoint_is_new:
        return []
    y = lane.output
    before = float(y[first - 1] if lane.seen_late and first > 0 and not np.isnan(y[first - 1]) else y[first])
    from_ = before if lane.seen_late or lane.begins is None else lane.begins
    size = abs(float(difference(lane.setpoint[first], from_, lane.turn)))
    noise = CLEAR_OF_NOISE * _noise(y[:first] if first >= PATH_GAP else y) if lane.seen_late else 0.0
    if np.isnan(before) or np.isnan(size) or size <= noise:
        return []
    return [_Change(first, "setpoint", before)]


def _noise(y: np.ndarray) -> float:
    """The standard deviation of white noise on a signal that is smooth beside it."""
    bends = np.diff(y[~np.isnan(y)], 2)
    return float(np.median(np.abs(bends))) / (0.6745 * np.sqrt(6.0)) if bends.size else 0.0


def _disturbance_changes(lane: Lane) -> list[tuple[int, Kind]]:
    d = lane.disturbance
    size = np.abs(d)
    largest = float(np.nanmax(size)) if size.size and not np.isnan(size).all() else 0.0
    found: list[tuple[int, Kind]] = [(0, "disturbance")] if lane.disturbance_is_new and size[0] > 0 else []
    for at, end in _moves(d):
        if np.abs(d[at:end] - d[at - 1]).max() > SMALLEST_STEP * largest:
            found.append((at - 1, "tracking") if end - at > 1 else (at, "disturbance"))
    return found


def _moves(values: np.ndarray, offset: int = 0) -> list[tuple[int, int]]:
    """Where values change: the first sample of the new value and the sample after the last change.

    Many changes close together are one move, a path; what differs by rounding is no change.
    """
    changed = np.flatnonzero(values[1:] != values[:-1]) + 1
    changed = changed[~(np.isnan(values[changed]) | np.isnan(values[changed - 1]))]
    scale = ROUNDING * np.maximum(np.abs(values[changed]), np.abs(values[changed - 1]))
    changed = changed[np.abs(values[changed] - values[changed - 1]) > scale]
    if not changed.size:
        return []
    breaks = [0, *(np.flatnonzero(np.diff(changed) > PATH_GAP) + 1).tolist(), changed.size]
    moves: list[tuple[int, int]] = []
    for a, b in pairwise(breaks):
        run = (changed[a:b] + offset).tolist()
        moves += [(run[0], run[-1] + 1)] if len(run) >= PATH_CHANGES else [(at, at + 1) for at in run]
    return moves


def _measured(lane: Lane, change: _Change, last: int, steps_at_end: bool = False) -> Response:
    """The response to a change, up to and with the sample `last`, at which the setpoint may step again."""
    window = slice(change.at, last + 1)
    y, r = lane.output[window], lane.setpoint[window]
    start_s, end_s = float(lane.time[change.at]), float(lane.time[last])
    missing = int(np.isnan(y).sum())
    if missing:
        return Response(
            change.kind, start_s, end_s, None, None, f"{missing} outputs are missing from the bag, or are no numbers"
        )
    if np.isnan(r).any():
        return Response(change.kind, start_s, end_s, None, None, NO_SETPOINT)
    period, turn = lane.sample_period, lane.turn
    if change.kind == "tracking":
        if steps_at_end and not lane.seen_late:
            r = np.append(r[:-1], r[-2])
        iae = integral_absolute_error(r, y, period, turn)
        return Response(change.kind, start_s, end_s, None, iae, "no single step")
    metrics: SetpointMetrics | DisturbanceMetrics
    if change.kind == "setpoint":
        metrics = setpoint_metrics(y, change.before, float(r[0]), period, turn)
    else:
        metrics = disturbance_metrics(y, float(r[0]), period, lane.largest_step, turn)
    return Response(change.kind, start_s, end_s, metrics, metrics.iae, metrics.reason)
