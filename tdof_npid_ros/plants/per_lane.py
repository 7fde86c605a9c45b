"""Each lane its own plant: what the compiled loop reads of plants that differ from lane to lane.

All lanes' plants are of one kind, so one step is compiled for them; the numbers in which they differ lie in the lanes'
rows, behind the state. Where every lane has the same plant, nothing of this is compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import types

from tdof_npid_ros.compiled import implementation_of, inlined_implementation_of
from tdof_npid_ros.plants.kernels import (
    SampledLinear,
    SampledNoisy,
    SampledOde,
    SampledOffset,
    SampledSprott,
    is_sampled,
)
from tdof_npid_ros.plants.linear import TransferFunction, sampled_lanes
from tdof_npid_ros.plants.noise import NoisyPlant, first_measured, noiseless
from tdof_npid_ros.plants.plant import EachLane, Plant, PlantAt, PlantError
from tdof_npid_ros.plants.start import plant_at_start
from tdof_npid_ros.plants.states import loaded
from tdof_npid_ros.scenario import SampledPlan


class SampledLanes(NamedTuple):
    """Plants of one kind, one for each lane of a block.

    A lane's rows behind its state: whether its input has no dead time (1 or 0), then its plant's numbers.

    Attributes:
        plant: one of them; what all have in common is taken from it.
        delay: the longest.
        delays: of each lane, (width,), whole numbers; or an empty tuple where all are the same.
    """

    plant: Any
    delay: int
    delays: Any


class Segment(NamedTuple):
    """The plants of all lanes in one segment of a plan.

    Attributes:
        plant: the first lane's, sampled.
        numbers: see `_numbers`, (numbers, lanes).
        delays: in samples, (lanes,).
    """

    plant: Any
    numbers: np.ndarray
    delays: np.ndarray


@dataclass(frozen=True)
class LanePlants:
    """A plant of its own for each lane, as one episode needs them.

    Attributes:
        like: the first lane's state at time 0.
        state: at time 0, (states, lanes).
        effort: that was on before, (lanes,).
        measured: the first output, (lanes,).
        segments: by the plan's segments' first steps.
        gains: which lane of the gains each has, (lanes,).
    """

    like: tuple[float, ...]
    state: np.ndarray
    effort: np.ndarray
    measured: np.ndarray
    segments: dict[int, Segment]
    gains: np.ndarray

    @property
    def lanes(self) -> int:
        """How many there are."""
        return int(self.state.shape[1])

    def __getitem__(self, lanes: Any) -> LanePlants:
        """Those of some lanes: a slice, or an array of indices, each as often as it is named."""
        segments = {
            first: Segment(plant, numbers[:, lanes], delays[lanes])
            for first, (plant, numbers, delays) in self.segments.items()
        }
        return replace(
            self,
            state=self.state[:, lanes],
            effort=self.effort[lanes],
            measured=self.measured[lanes],
            segments=segments,
            gains=self.gains[lanes],
        )

    def with_each_of(self, gains: int) -> LanePlants:
        """These plants with each of so many lanes of gains: first all plants with the first gains, and so on."""
        lanes = self[np.tile(np.arange(self.lanes), gains)]
        return replace(lanes, gains=np.repeat(np.arange(gains), self.lanes))

    def own_rows(self) -> int:
        """How many rows a lane has behind its state."""
        return 1 + len(next(iter(self.segments.values())).numbers)

    def sampled(self, first: int) -> tuple[SampledLanes, np.ndarray]:
        """What the compiled loop takes in the segment that begins with step `first`, and the rows behind the state."""
        return _in_rows(self.segments[first])


def _in_rows(segment: Segment) -> tuple[SampledLanes, np.ndarray]:
    plant, numbers, delays = segment
    same = bool(np.all(delays == delays[0]))
    own = np.vstack([(delays == 0).astype(np.float64), numbers])
    return SampledLanes(plant, int(delays.max()), () if same else np.ascontiguousarray(delays)), own


def sampled_plants(plant: Plant, sample_period_ns: int) -> tuple[Any, np.ndarray]:
    """What compiled code takes as the plant of all lanes or of each, and what lies in the lanes' own rows, flat.

    Raises:
        PlantError: the lanes' plants are of different kinds.
    """
    if not isinstance(plant, EachLane):
        return plant.sampled(sample_period_ns), np.empty(0)
    sampled, own = _in_rows(_segment(_of_one_kind(list(plant.plants)), sample_period_ns))
    return sampled, own.ravel()


def check_lanes(plant: Plant, lanes: int) -> None:
    """Make sure that plants of their own are for so many lanes: compiled code does not look.

    Raises:
        PlantError: they are not.
    """
    if isinstance(plant, EachLane) and len(plant.plants) != lanes:
        raise PlantError(f"lanes is {lanes}, but there are plants for {len(plant.plants)}: give one number per lane")


def initial_lanes(plant: Plant, lanes: int) -> tuple[tuple[float, ...], np.ndarray, np.ndarray]:
    """Of all lanes: a state like theirs, their states at time 0, (states, lanes), and efforts before, (lanes,).

    Raises:
        PlantError: there are plants for another number of lanes.
    """
    if not isinstance(plant, EachLane):
        state = plant.initial_state
        return state, np.repeat(np.array(state)[:, None], lanes, axis=1), np.full(lanes, plant.initial_effort)
    check_lanes(plant, lanes)
    plants = _of_one_kind(list(plant.plants))
    return plants[0].initial_state, _states(plants), np.array([one.initial_effort for one in plants])


def _states(plants: Sequence[Plant]) -> np.ndarray:
    """At time 0, (states, lanes)."""
    states = [plant.initial_state for plant in plants]
    if len(set(map(len, states))) > 1:
        raise PlantError("the lanes' plants differ in their number of states: a sweep needs the same for all")
    return np.array(states).T


def lane_plants(plants: Sequence[PlantAt], signals: SampledPlan, effort_limits: tuple[float, float]) -> LanePlants:
    """The plants of many lanes for an episode.

    Args:
        plants: of each lane, for a set of changed parameters.
        signals: the sampled plan.
        effort_limits: the actuator's.

    Raises:
        PlantError: a plant cannot be made or does not rest where the plan starts; they are of different kinds; or a
            dead time changes within the plan.
    """
    first = signals.segments[0].plant
    begun = _of_one_kind(
        [plant_at_start(plant_at, signals.start, first, effort_limits, signals.identity) for plant_at in plants]
    )
    states = _states(begun)
    segments = {}
    for segment in signals.segments:
        segments[segment.first] = _segment(
            _of_one_kind([plant_at(segment.plant) for plant_at in plants]), signals.sample_period_ns
        )
    delays = [segment.delays for segment in segments.values()]
    if any(np.any(one != delays[0]) for one in delays):
        raise PlantError("dead_time cannot change while the loop runs: begin a new episode with it")
    return LanePlants(
        begun[0].initial_state,
        states,
        np.array([plant.initial_effort for plant in begun]),
        np.array([first_measured(plant) for plant in begun]),
        segments,
        np.arange(len(plants)),
    )


def _of_one_kind(plants: list[Plant]) -> list[Plant]:
    """Where some measure with noise, the others do, too: with none."""
    if not any(isinstance(plant, NoisyPlant) for plant in plants):
        return plants
    episode = next(plant.episode for plant in plants if isinstance(plant, NoisyPlant))
    return [plant if isinstance(plant, NoisyPlant) else NoisyPlant(plant, 0.0, 0.0, 0, episode) for plant in plants]


def _segment(plants: list[Plant], sample_period_ns: int) -> Segment:
    inner = [noiseless(plant) for plant in plants]
    linear = [plant for plant in inner if isinstance(plant, TransferFunction)]
    bare: Sequence[Any]
    if len(linear) == len(inner):
        bare = sampled_lanes(linear, sample_period_ns)
        if len({type(one) for one in bare}) > 1:
            bare = [_with_constant(one) for one in bare]
    else:
        bare = [plant.sampled(sample_period_ns) for plant in inner]
    sampled = [
        SampledNoisy(one, plant.noise, plant.quantum, float(plant.seed), one.delay)
        if isinstance(plant, NoisyPlant)
        else one
        for plant, one in zip(plants, bare, strict=True)
    ]
    common = {_common(one) for one in sampled}
    if len(common) > 1:
        raise PlantError("the lanes' plants differ in more than numbers: model and substeps must be the same for all")
    return Segment(
        sampled[0], np.array([_numbers(one) for one in sampled]).T, np.array([one.delay for one in sampled], np.int64)
    )


def _with_constant(plant: SampledLinear | SampledOffset) -> SampledOffset:
    """A plant about 0 as one about an operating point, of 0."""
    return plant if isinstance(plant, SampledOffset) else SampledOffset(*plant, constant=(0.0,) * len(plant.phi))


def _numbers(plant: Any) -> tuple[float, ...]:
    """The numbers of a sampled plant in which lanes may differ, in the order in which `rebuilt` takes them."""
    if isinstance(plant, SampledNoisy):
        return (plant.noise, plant.quantum, plant.seed, *_numbers(plant.plant))
    if isinstance(plant, SampledOde):
        return plant.parameters
    if isinstance(plant, SampledSprott):
        return plant.a, plant.b, plant.c
    flat = (*(x for row in plant.phi for x in row), *plant.gamma_old, *plant.gamma_new)
    return (*flat, *plant.constant) if isinstance(plant, SampledOffset) else flat


def _common(plant: Any) -> tuple[Any, ...]:
    """What all lanes must have in common."""
    if isinstance(plant, SampledNoisy):
        return (SampledNoisy, *_common(plant.plant))
    if isinstance(plant, SampledOde):
        return (SampledOde, plant.derivative, plant.output, plant.step, plant.substeps)
    if isinstance(plant, SampledSprott):
        return (SampledSprott, plant.step)
    return (type(plant), len(plant.phi))


# What the drivers ask of a plant that lanes may have of their own. For any other plant it compiles to nothing.


def of_lane(plant: Any, rows: Any, own: Any, stride: Any) -> Any:
    """The plant of the lane whose own rows begin at rows[own]."""


def is_direct(plant: Any, rows: Any, own: Any) -> Any:
    """Whether the lane's plant has no dead time, so that it takes the effort of the same sample."""


def dead_samples(plant: Any, lane: Any) -> Any:
    """The dead time of a lane's plant, in whole samples."""


def keep_due(plant: Any, rows: Any, at: Any, v_due: Any) -> Any:
    """Write the input that was due to rows[at], where the next step looks for the one before."""


def rebuilt(plant: Any, rows: Any, at: Any, stride: Any) -> Any:
    """A sampled plant of the same type with the numbers at rows[at], rows[at + stride], …"""


def matrix(like: Any, rows: Any, at: Any, stride: Any) -> Any:
    """A tuple of tuples, row by row."""


def has_own_delays(plant: Any) -> bool:
    """Whether a plant's type, as Numba knows it, has a dead time of its own for each lane."""
    return is_sampled(plant, SampledLanes) and isinstance(plant[2], types.Array)


@inlined_implementation_of(of_lane)
def _of_lane(plant: Any, rows: Any, own: Any, stride: Any) -> Any:
    if is_sampled(plant, SampledLanes):
        return lambda plant, rows, own, stride: rebuilt(plant.plant, rows, own + stride, stride)
    return lambda plant, rows, own, stride: plant


@inlined_implementation_of(is_direct)
def _is_direct(plant: Any, rows: Any, own: Any) -> Any:
    if has_own_delays(plant):
        return lambda plant, rows, own: rows[own] > 0.0
    return lambda plant, rows, own: plant.delay == 0


@inlined_implementation_of(dead_samples)
def _dead_samples(plant: Any, lane: Any) -> Any:
    if has_own_delays(plant):
        return lambda plant, lane: plant.delays[lane]
    return lambda plant, lane: plant.delay


@inlined_implementation_of(keep_due)
def _keep_due(plant: Any, rows: Any, at: Any, v_due: Any) -> Any:
    if not has_own_delays(plant):
        return lambda plant, rows, at, v_due: None

    def keep(plant: Any, rows: Any, at: Any, v_due: Any) -> None:
        rows[at] = v_due

    return keep


@implementation_of(matrix)
def _matrix(like: Any, rows: Any, at: Any, stride: Any) -> Any:
    if len(like) == 0:
        return lambda like, rows, at, stride: ()
    width = len(like[0])
    return lambda like, rows, at, stride: (
        loaded(like[0], rows, at, stride),
        *matrix(like[1:], rows, at + width * stride, stride),
    )


@implementation_of(rebuilt)
def _rebuilt(plant: Any, rows: Any, at: Any, stride: Any) -> Any:
    if is_sampled(plant, SampledNoisy):
        return lambda plant, rows, at, stride: SampledNoisy(
            rebuilt(plant.plant, rows, at + 3 * stride, stride),
            rows[at],
            rows[at + stride],
            rows[at + 2 * stride],
            plant.delay,
        )
    if is_sampled(plant, SampledOde):
        return lambda plant, rows, at, stride: SampledOde(
            plant.derivative,
            plant.output,
            loaded(plant.parameters, rows, at, stride),
            plant.step,
            plant.substeps,
            plant.delay,
        )
    if is_sampled(plant, SampledSprott):
        return lambda plant, rows, at, stride: SampledSprott(
            rows[at], rows[at + stride], rows[at + 2 * stride], plant.step, plant.delay
        )
    n = len(plant[1])
    old, new, constant = n * n, n * n + n, n * n + 2 * n
    if is_sampled(plant, SampledOffset):
        return lambda plant, rows, at, stride: SampledOffset(
            matrix(plant.phi, rows, at, stride),
            loaded(plant.gamma_old, rows, at + old * stride, stride),
            loaded(plant.gamma_new, rows, at + new * stride, stride),
            plant.delay,
            loaded(plant.constant, rows, at + constant * stride, stride),
        )
    return lambda plant, rows, at, stride: SampledLinear(
        matrix(plant.phi, rows, at, stride),
        loaded(plant.gamma_old, rows, at + old * stride, stride),
        loaded(plant.gamma_new, rows, at + new * stride, stride),
        plant.delay,
    )
