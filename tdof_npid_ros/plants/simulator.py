"""A plant that is stepped: the state of all lanes and the compiled step, for the plant node."""

from __future__ import annotations

import numpy as np

from tdof_npid_ros.plants.kernels import check_same_delay, kernel_for
from tdof_npid_ros.plants.lanes import advance_lanes, output_lanes
from tdof_npid_ros.plants.per_lane import check_lanes, initial_lanes, sampled_plants
from tdof_npid_ros.plants.plant import Plant


class PlantSimulator:
    """A plant's lanes in simulation; every lane has the same parameters, or with an `EachLane` its own, and its own
    effort.

    Attributes:
        output: y, (lanes,).
        applied_effort: u of the latest step after the plant's limits, (lanes,).
    """

    def __init__(self, plant: Plant, sample_period_ns: int, lanes: int, effort_limits: tuple[float, float]) -> None:
        self.lanes = lanes
        self.sample_period_ns = sample_period_ns
        self.effort_limits = effort_limits
        self._ring: np.ndarray | None = None
        self._initial = plant
        self.reset()

    def change_plant(self, plant: Plant) -> None:
        """Go on with other parameters; the state is kept.

        Raises:
            PlantError: the dead time is another one, or there are plants for another number of lanes.
        """
        check_lanes(plant, self.lanes)
        sampled, own = sampled_plants(plant, self.sample_period_ns)
        if self._ring is not None:
            check_same_delay(sampled, len(self._ring) // self.lanes)
        self._sampled, self._own = sampled, own
        self._advance_lanes = kernel_for(self._sampled, advance_lanes)

    def reset(self, plant: Plant | None = None) -> None:
        """Back to the initial state at time 0, with the parameters of `plant`, by default those at the start."""
        plant = plant or self._initial
        self._ring = None
        self._like, states, efforts = initial_lanes(plant, self.lanes)
        self.change_plant(plant)
        self._x = states.ravel()
        self._ring = np.tile(efforts, self._sampled.delay + 2)
        self._step = 0
        self.applied_effort = efforts
        self.output = np.zeros(self.lanes)
        kernel_for(self._sampled, output_lanes)(self._sampled, self._own, self._like, self._x, self.output)

    def warm_up(self) -> None:
        """Compile what a step needs, so that no step waits for it; the plant is at its initial state again."""
        self.advance(np.zeros(self.lanes), np.zeros(self.lanes))
        self.reset()

    def advance(self, effort: np.ndarray, disturbance: np.ndarray) -> None:
        """One step on, under `effort` and `disturbance`, (lanes,) each, held."""
        self._advance_lanes(
            self._sampled, self._own, self._like, self._x, self._ring, self._step, self.effort_limits,
            effort, disturbance, self.applied_effort, self.output,
        )  # fmt: skip
        self._step += 1
