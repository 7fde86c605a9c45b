"""What an episode's control costs, and how far the episode is from the in-process simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tdof_npid_ros.analysis.episodes import Episode
from tdof_npid_ros.case import Case
from tdof_npid_ros.control.law import limits_of
from tdof_npid_ros.loop import simulate
from tdof_npid_ros.metrics import EffortUse, effort_use
from tdof_npid_ros.plants.plant import PlantError


@dataclass(frozen=True)
class Deviation:
    """The largest distance from the in-process simulation, 0 if distributed = local; None with the reason if there is
    none."""

    output: float | None
    control_effort: float | None
    reason: str | None = None


def episode_effort(episode: Episode, lane: int) -> EffortUse:
    """What one lane's control costs over the episode."""
    u = episode.control_effort[:, lane]
    tightest = None
    if episode.gains:
        limits = [limits_of(gains, min(lane, gains.lanes - 1))[:2] for gains in episode.gains]
        limits.append(_limits(episode))
        tightest = max(pair[0] for pair in limits), min(pair[1] for pair in limits)
    return effort_use(u[~np.isnan(u)], tightest)


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
