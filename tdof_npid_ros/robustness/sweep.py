"""What gains achieve on each of many plants: independent chunks of lanes, put together in the order of the lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from tdof_npid_ros.case import EPISODES, Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.loop import LARGEST_BLOCK, LARGEST_OUTPUT, VECTOR
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.robustness.spread import Spread, changes_of
from tdof_npid_ros.stability.plant import linear_loop_plants
from tdof_npid_ros.stability.screen import Screen

METRICS: Final = {
    "overshoot_percent": "M_p (%)",
    "settling_time_s": "t_s (s)",
    "iae_setpoint": "IAE_SP",
    "peak": "M_peak",
    "recovery_time_s": "t_rcy (s)",
    "iae_disturbance": "IAE_DIS",
    "objective": "IAE_SP + w·IAE_DIS",
    "m_s": "M_s",
}

CHUNK = 512  # plants: some tenths of a second, and a few MB
FAN_LANES = 400  # plants whose responses the picture is made of: the first ones
FAN_POINTS = 300  # at most, of a response in the picture
OUTPUTS_AT_ONCE = 64 << 20  # bytes of outputs, roughly, that a chunk holds


@dataclass(frozen=True)
class Sweep:
    """What all chunks of a sweep share.

    Attributes:
        case: the loop, with the model's plant.
        gains: of one lane.
        spreads: in the order of the samples' columns.
    """

    case: Case
    gains: Gains
    spreads: tuple[Spread, ...]


class Chunk(NamedTuple):
    """Some neighbouring samples: the first one's number, and their values, (plants, spreads)."""

    first: int
    values: np.ndarray


def chunks_of(values: np.ndarray) -> list[Chunk]:
    """Samples (plants, spreads) in chunks."""
    return [Chunk(first, values[first : first + CHUNK]) for first in range(0, len(values), CHUNK)]


def measured(sweep: Sweep, chunk: Chunk) -> dict[str, np.ndarray]:
    """What the gains achieve on a chunk's plants.

    Returns:
        By name of `METRICS`, (plants,), inf for what has no number: a time that is not reached, or anything of an
        unstable loop; `unstable`, 1 or 0; and `fan.<episode>`, (points, plants), the outputs of those plants that are
        in the picture.

    Raises:
        PlanError, PlantError: the case has no such responses, or a plant cannot be.
    """
    case = sweep.case
    changes = [changes_of(case, sweep.spreads, row, chunk.first + j) for j, row in enumerate(chunk.values.tolist())]
    found = {name: np.full(len(changes), np.inf) for name in METRICS}
    fans = max(0, min(len(changes), FAN_LANES - chunk.first))
    diverged = np.zeros(len(changes), dtype=bool)
    noise_bounds = [case.noise_bound_at(changed) for changed in changes]
    for episode in EPISODES:
        plants = case.lane_plants(episode, changes)
        shown = shown_samples(case.signals[episode].steps)
        fan: np.ndarray = np.empty((len(shown), fans))
        size = _block_size(case.signals[episode].steps)
        for first in range(0, len(changes), size):
            output = case.simulate(episode, sweep.gains, plants[first : first + size]).output.T.copy()
            for j, y in enumerate(output, first):
                if not np.abs(y).max() < LARGEST_OUTPUT:
                    diverged[j] = True
                    continue
                for name, value in _metrics(case, episode, y, noise_bounds[j]):
                    found[name][j] = np.inf if value is None else value
            kept = max(0, min(fans - first, len(output)))
            fan[:, first : first + kept] = output[:kept, shown].T
        found[f"fan.{episode}"] = fan
    found["objective"] = found["iae_setpoint"] + case.weight * found["iae_disturbance"]
    if is_linear(case):
        screens = [Screen(plant)(sweep.gains, modes=False) for plant in linear_loop_plants(case, changes)]
        unstable = np.array([not one.stable[0] for one in screens])
        found["m_s"] = np.array([one.m_s[0] for one in screens])
    else:
        del found["m_s"]
        unstable = diverged | ~np.isfinite(found["settling_time_s"]) | ~np.isfinite(found["recovery_time_s"])
    for name in METRICS.keys() & found.keys():
        found[name][unstable] = np.inf
    return found | {"unstable": unstable.astype(np.float64)}


def is_linear(case: Case) -> bool:
    """Whether stability is known by the modes of the linear loop, not by the outputs alone."""
    return isinstance(case.plant, TransferFunction)


def shown_samples(steps: int) -> np.ndarray:
    """The samples of a response that a picture of many shows."""
    return np.unique(np.linspace(0, steps, min(FAN_POINTS, steps + 1)).round().astype(int))


def joined(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The results of all chunks, in the order of the chunks."""
    return {name: np.concatenate([part[name] for part in parts], axis=-1) for name in parts[0]}


def _metrics(case: Case, episode: str, output: np.ndarray, noise_bound: float) -> list[tuple[str, Any]]:
    if episode == "setpoint":
        step = case.setpoint_metrics(output)
        return [
            ("overshoot_percent", step.overshoot_percent),
            ("settling_time_s", step.settling_time_s),
            ("iae_setpoint", step.iae),
        ]
    pushed = case.disturbance_metrics(output, noise_bound)
    return [
        ("peak", pushed.peak),
        ("recovery_time_s", pushed.recovery_time_s),
        ("iae_disturbance", pushed.iae),
    ]


def _block_size(steps: int) -> int:
    """How many lanes run at once."""
    fit = OUTPUTS_AT_ONCE // (3 * 8 * (steps + 1))
    return max(2 * VECTOR, min(LARGEST_BLOCK, fit // VECTOR * VECTOR))
