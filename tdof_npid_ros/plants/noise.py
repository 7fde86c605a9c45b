"""Measurement noise of a simulated plant: what is published is the output plus noise, rounded to a quantum.

The noise of a sample follows from the seed, the episode and the step alone (a counter, no state of a generator), in
integers and one multiplication: the same bits on every processor, in every way of running, and in every repetition.
An episode is known by its plan: the same plan has the same noise each time. All lanes have the same noise, too, so that
candidates of a tuner are compared under the same.

The generator is SplitMix64 (Steele, Lea and Flood 2014). The noise is the sum of twelve uniform numbers: nearly normal,
and never beyond six standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

from tdof_npid_ros.plants.kernels import SampledNoisy, measured
from tdof_npid_ros.plants.plant import EachLane, Plant

LARGEST_NOISE: Final = 6.0  # standard deviations; no noise is larger


@dataclass(frozen=True)
class NoisyPlant:
    """A plant whose measured output bears noise.

    Its state is the plant's own, the step, and the episode: all that the noise follows from, besides the seed.

    Attributes:
        plant: without noise.
        noise: standard deviation, in the output's unit.
        quantum: step of what is measured, in the output's unit; 0: none.
        seed: from 0 on.
        episode: what the episode is known by, a whole number below 2**53.
    """

    plant: Plant
    noise: float
    quantum: float
    seed: int
    episode: int = 0

    @property
    def initial_state(self) -> tuple[float, ...]:
        """As of the plant, then step 0 and the episode."""
        return (*self.plant.initial_state, 0.0, float(self.episode))

    @property
    def initial_output(self) -> float:
        """y at time 0, without noise."""
        return self.plant.initial_output

    @property
    def initial_effort(self) -> float:
        """As of the plant."""
        return self.plant.initial_effort

    def at_rest(self, output: float) -> NoisyPlant:
        """As of the plant."""
        return replace(self, plant=self.plant.at_rest(output))

    def in_episode(self, episode: int) -> NoisyPlant:
        """With the noise of that episode."""
        return replace(self, episode=episode)

    def sampled(self, sample_period_ns: int) -> SampledNoisy:
        """As of the plant, with noise."""
        plant: Any = self.plant.sampled(sample_period_ns)
        return SampledNoisy(plant, self.noise, self.quantum, float(self.seed), plant.delay)


def largest_noise(plant: Plant) -> float:
    """How far a measured output is from the plant's at the most, in the output's unit."""
    if isinstance(plant, EachLane):
        return max(map(largest_noise, plant.plants))
    return LARGEST_NOISE * plant.noise + 0.5 * plant.quantum if isinstance(plant, NoisyPlant) else 0.0


def noiseless(plant: Plant) -> Plant:
    """The plant itself, without the noise of what is measured."""
    if isinstance(plant, EachLane):
        return EachLane(tuple(map(noiseless, plant.plants)))
    return plant.plant if isinstance(plant, NoisyPlant) else plant


def in_episode(plant: Plant, episode: int) -> Plant:
    """The plant with the noise of an episode, if it has any."""
    return plant.in_episode(episode) if isinstance(plant, NoisyPlant) else plant


def first_measured(plant: Plant) -> float:
    """The output at time 0 as it is measured."""
    if not isinstance(plant, NoisyPlant):
        return plant.initial_output
    return float(measured(plant.initial_output, plant.noise, plant.quantum, plant.seed, 0.0, float(plant.episode)))
