"""An episode of a simulated plant in lockstep: which stamp it waits for, and what happens when it is answered."""

from __future__ import annotations

import numpy as np

from tdof_npid_ros.plants.plant import PlantAt
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.plants.start import plant_at_start
from tdof_npid_ros.scenario import Plan
from tdof_npid_ros.wire import AnswerLabel, EpisodeLabel


class Episode:
    """One run of a plan by a plant that takes only the answer to its latest output.

    Attributes:
        label: what outputs bear in `header.frame_id`.
        steps: number of steps; the outputs are those of steps 0 to `steps`.
        stamp_ns: of the output that waits for an answer.
    """

    def __init__(self, plan: Plan, simulator: PlantSimulator, plant_at: PlantAt, label: EpisodeLabel) -> None:
        plant_at(plan.plant_changes(0))  # its names first: to sample a plan takes memory
        signals = plan.sampled(simulator.sample_period_ns)
        limits = simulator.effort_limits
        simulator.reset(plant_at_start(plant_at, plan.start, signals.segments[0].plant, limits, signals.identity))
        self.label = label
        self.steps = signals.steps
        self.stamp_ns = 0
        self._simulator = simulator
        self._disturbance = signals.disturbance
        self._row = np.zeros(simulator.lanes)
        self._plants = {segment.first: plant_at(segment.plant) for segment in signals.segments}
        self._k = 0

    def awaits(self, stamp_ns: int, answer: AnswerLabel) -> bool:
        """Whether an answer of that stamp is the one; an answer that names an episode must name this one."""
        return stamp_ns == self.stamp_ns and answer.episode in (None, self.label)

    def answer(self, effort: np.ndarray) -> bool:
        """Take the answer, (lanes,), and go on one step. Returns False if the episode ends with it."""
        k = self._k
        if k == self.steps:
            return False
        plant = self._plants.get(k)
        if plant is not None:
            self._simulator.change_plant(plant)
        self._row.fill(self._disturbance[k])
        self._simulator.advance(effort, self._row)
        self._k = k + 1
        self.stamp_ns += self._simulator.sample_period_ns
        return True
