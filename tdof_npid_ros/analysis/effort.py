"""What an episode shows: responses to changes of setpoint, disturbance and plant, their metrics, and effort use."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tdof_npid_ros.analysis.episodes import Episode
from tdof_npid_ros.case import Case
from tdof_npid_ros.control.law import limits_of
from tdof_npid_ros.loop import simulate
from tdof_npid_ros.metrics import (
    DisturbanceMetrics,
    SetpointMetrics,
    disturbance_metrics,
    integral_absolute_error,
    setpoint_metrics,
)
from tdof_npid_ros.plants.plant import PlantError

MOST_STEPS = 20  # an episode with more changes follows a ramp or a sine: then only its error is measured
Kind = Literal["setpoint", "disturbance", "plant", "tracking"]


@dataclass(frozen=True)
class Response:
    """What one lane does from one change to the next.

    Attributes:
        kind: what changed; `tracking`: the whole episode, for want of single steps.
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
class EffortUse:
    """What one lane's control costs; None where the bag holds no control effort, or no limits.

    Attributes:
        total_variation: sum of |u[k+1] - u[k]|.
        peak: largest |u|.
        saturated_share: fraction of the samples at a limit.
    """

    total_variation: float | None
    peak: float | None
    saturated_share: float | None


@dataclass(frozen=True)
class Deviation:
    """The largest distance from the in-process simulation (E1: 0); None with the reason where there is none."""

    output: float | None
    control_effort: float | None
    reason: str | None = None


def responses(episode: Episode, lane: int) -> list[Response]:
    """The responses of one lane, in order."""
    changes = _changes(episode, lane)
    last = len(episode.time) - 1
    if not changes or len(changes) > MOST_STEPS:
        return [_measured(episode, lane, "tracking", 0, last, 0.0, 1.0)]
    found = []
    step = 1.0  # the setpoint step that the recovery band is a fraction of; the paper's is 1
    ends = [*(at for at, _, _ in changes[1:]), last]
    for (first, kind, before), end in zip(changes, ends, strict=True):
        if kind == "setpoint":
            step = abs(episode.setpoint[first, lane] - before)
        found.append(_measured(episode, lane, kind, first, end, before, step))
    return found


def effort_use(episode: Episode, lane: int) -> EffortUse:
    """What one lane's control costs over the episode."""
    u = episode.control_effort[:, lane]
    u = u[~np.isnan(u)]
    if not u.size:
        return EffortUse(None, None, None)
    fraction = None
    if episode.gains:
        limits = [limits_of(gains, min(lane, gains.lanes - 1))[:2] for gains in episode.gains]
        limits.append(_limits(episode))
        low, high = max(pair[0] for pair in limits), min(pair[1] for pair in limits)
        fraction = float(np.mean((u <= low) | (u >= high)))
    return EffortUse(float(np.abs(np.diff(u)).sum()), float(np.abs(u).max()), fraction)


def deviation(episode: Episode) -> Deviation:
    """How far the episode is from the in-process simulation of its plan, gains and plant."""
    reason = _not_simulated(episode)
    if reason is not None:
        return Deviation(None, None, reason)
    assert episode.plan is not None
    plant = dict(episode.plant)
    case = Case("", episode.sample_period_ns, str(plant["model"]), plant, _limits(episode), episode.gains[0], {})
    signals = episode.plan.sampled(episode.sample_period_ns)
    try:
        wanted = simulate(case.plant_at, episode.gains[0], signals, case.effort_limits)
    except PlantError as error:
        return Deviation(None, None, str(error))
    return Deviation(_largest(wanted.output, episode.output), _largest(wanted.control_effort, episode.control_effort))


def _largest(wanted: np.ndarray, recorded: np.ndarray) -> float:
    known = ~np.isnan(recorded)
    return float(np.abs(wanted[known] - recorded[known]).max(initial=0.0))


def _not_simulated(episode: Episode) -> str | None:
    if episode.plan is None:
        return "no plan"
    if "model" not in episode.plant:
        return "the plant's parameters are not in the bag"
    if not episode.gains:
        return "the controller's parameters are not in the bag"
    if len(set(episode.gains)) > 1:
        return "the gains change during the episode"
    if not episode.plainly_operated:
        return "the controller is operated: manual mode, rate limits, filters"
    if episode.gains[0].lanes != episode.lanes:
        return f"the gains are for {episode.gains[0].lanes} lanes, the outputs for {episode.lanes}"
    return None


def _limits(episode: Episode) -> tuple[float, float]:
    """The plant's own limits on the effort."""
    values = episode.plant
    low, high = values.get("effort_min", -math.inf), values.get("effort_max", math.inf)
    assert isinstance(low, (int, float)) and isinstance(high, (int, float))
    return float(low), float(high)


def _changes(episode: Episode, lane: int) -> list[tuple[int, Kind, float]]:
    """Sample, what changes there, and the setpoint before it."""
    r, d = episode.setpoint[:, lane], episode.disturbance
    from_rest = episode.time[0] == 0.0  # at time 0, everything has just come from 0
    before = np.concatenate([[0.0 if from_rest else r[0]], r[:-1]])
    known = ~np.isnan(r) & ~np.isnan(before)
    setpoint = set(np.flatnonzero(known & (r != before)).tolist())
    disturbance = set(np.flatnonzero(np.diff(d, prepend=0.0 if from_rest else d[0])).tolist())
    plant = (
        {segment.first for segment in episode.plan.sampled(episode.sample_period_ns).segments[1:]}
        if episode.plan is not None
        else set()
    )
    kinds: dict[int, Kind] = {}
    kinds.update(dict.fromkeys(plant, "plant"))
    kinds.update(dict.fromkeys(disturbance, "disturbance"))
    kinds.update(dict.fromkeys(setpoint, "setpoint"))
    return [(k, kinds[k], float(before[k])) for k in sorted(kinds) if k < len(r) - 1]


def _measured(episode: Episode, lane: int, kind: Kind, first: int, last: int, before: float, step: float) -> Response:
    period = episode.sample_period_ns / 1e9
    window = slice(first, last + 1)
    y, r = episode.output[window, lane], episode.setpoint[window, lane]
    start_s, end_s = float(episode.time[first]), float(episode.time[last])
    missing = int(np.isnan(y).sum())
    if missing:
        return Response(kind, start_s, end_s, None, None, f"{missing} outputs are missing from the bag")
    if np.isnan(r).any():
        return Response(kind, start_s, end_s, None, None, "the setpoint is not in the bag")
    if kind == "tracking":
        return Response(kind, start_s, end_s, None, integral_absolute_error(r, y, period), "no single step")
    metrics: SetpointMetrics | DisturbanceMetrics
    if kind == "setpoint":
        metrics = setpoint_metrics(y, before, float(r[0]), period)
    else:
        metrics = disturbance_metrics(y, float(r[0]), period, step)
    return Response(kind, start_s, end_s, metrics, metrics.iae, metrics.reason)
