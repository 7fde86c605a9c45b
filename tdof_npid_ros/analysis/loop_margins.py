"""The margins of a recorded loop, where its plant is a model and its gains are in the bag."""

from __future__ import annotations

import numpy as np

from tdof_npid_ros.analysis.episodes import Episode
from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.plants.catalog import effort_limits
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.stability.margins import Margins, margins, one_lane

MOST_LOOPS = 64  # different loops of an episode whose margins are computed


def episode_margins(episode: Episode) -> tuple[Margins | None, ...]:
    """The margins of each lane with the gains in force at the end, about its last setpoint and disturbance.

    Returns:
        By lane; None where the bag does not hold the plant's model or the controller's gains, as a robot's does not.
    """
    if "model" not in episode.plant or not episode.gains:
        return (None,) * episode.lanes
    segments = episode.plan.sampled(episode.sample_period_ns).segments if episode.plan is not None else ()
    plant = {**episode.plant, **(segments[-1].plant if segments else {})}
    gains = episode.gains[-1]
    case = Case("", episode.sample_period_ns, str(plant["model"]), plant, effort_limits(plant), gains, {})
    known: dict[tuple[Gains, float, float], Margins] = {}
    return tuple(_margins(episode, case, lane, known) for lane in range(episode.lanes))


def _margins(episode: Episode, case: Case, lane: int, known: dict[tuple[Gains, float, float], Margins]) -> Margins:
    if not episode.plainly_operated:
        return Margins(None, "the controller's options acted on the loop: 'tdof-npid margins' with its parameter file")
    gains = one_lane(case.gains, lane if case.gains.lanes > 1 else 0)
    loop = gains, _last(episode.setpoint[:, lane]), _last(episode.disturbance[:, lane])
    if loop not in known:
        if len(known) == MOST_LOOPS:
            return Margins(None, f"more than {MOST_LOOPS} different loops in one episode")
        try:
            known[loop] = margins(case, *loop[:1], setpoint=loop[1], disturbance=loop[2])
        except PlantError as error:
            known[loop] = Margins(None, str(error))
    return known[loop]


def _last(values: np.ndarray) -> float:
    """The last known value; 0 if none is."""
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if len(finite) else 0.0
