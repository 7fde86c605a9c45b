"""The compiled step of a plant by itself, for all its lanes: what the plant node calls."""

from __future__ import annotations

from typing import Any

import numpy as np

from tdof_npid_ros.compiled import compiled, entry_point
from tdof_npid_ros.plants.kernels import plant_advance, plant_input, plant_output
from tdof_npid_ros.plants.per_lane import dead_samples, of_lane
from tdof_npid_ros.plants.states import either, loaded, store

DIVERGED = 1e100  # |y| beyond it: the lane stays where it was, so that no infinity ever appears


@compiled
def advance_bounded(plant: Any, x: Any, v_old: Any, v_new: Any, d: Any) -> Any:
    """The plant's state one step on; a lane that diverges stays where it was."""
    moved = plant_advance(plant, x, v_old, v_new, d)
    return either(abs(plant_output(plant, moved)) < DIVERGED, moved, x)


@compiled
def applied(u: Any, limits: Any) -> Any:
    """The effort after the plant's own limits."""
    return min(max(u, limits[0]), limits[1])


@entry_point
def output_lanes(plant: Any, own: np.ndarray, like: Any, x: np.ndarray, y: np.ndarray) -> None:
    """The output y (lanes,) of every lane.

    Args:
        own: what the lanes' plants differ in, flat, as `per_lane.sampled_plants` gives it.
        like: a tuple as long as a state.
        x: the states, flat, (states * lanes,).
    """
    lanes = y.shape[0]
    for j in range(lanes):
        y[j] = plant_output(of_lane(plant, own, j, lanes), loaded(like, x, j, lanes))


@entry_point
def advance_lanes(
    plant: Any, own: Any, like: Any, x: Any, ring: Any, step: Any, limits: Any, u: Any, d: Any, u_applied: Any, y: Any
) -> None:
    """One step of every lane: x and ring advance, the effort applied and the next output are written."""
    lanes = y.shape[0]
    size = plant.delay + 2
    new = step % size
    for j in range(lanes):
        its = of_lane(plant, own, j, lanes)
        since = step + size - dead_samples(plant, j)
        oldest, due = (since - 1) % size, since % size
        u_applied[j] = applied(u[j], limits)
        ring[new * lanes + j] = plant_input(its, u_applied[j], d[j])
        state = advance_bounded(its, loaded(like, x, j, lanes), ring[oldest * lanes + j], ring[due * lanes + j], d[j])
        store(state, x, j, lanes)
        y[j] = plant_output(its, state)
