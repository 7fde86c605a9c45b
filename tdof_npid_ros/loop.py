"""The one closed loop: plant and controller under a plan, for any number of lanes, compiled.

The step order is that of the nodes in lockstep: the plant gives y[k], the controller answers with u[k], the plant
advances to k+1 under u[k] and d[k].

Two compiled drivers run the same step: `_run_lane` keeps one lane's state in registers, `_run_block` steps a block of
lanes side by side so that the compiler can vectorise over them. Both give the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np

from tdof_npid_ros.compiled import compiled, entry_point, inlined_implementation_of
from tdof_npid_ros.control.controller import Controller, rest_setpoint
from tdof_npid_ros.control.gains import LIMITS_PER_LANE, Gains, GainsError
from tdof_npid_ros.control.law import (
    COEFFICIENTS,
    Limits,
    coefficients,
    conditional_integration,
    lane_coefficients,
    law,
    limits_of,
    settled,
    unwinding_of,
)
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.plants.kernels import check_same_delay, kernel_for, plant_input, plant_output
from tdof_npid_ros.plants.lanes import advance_bounded, applied
from tdof_npid_ros.plants.noise import first_measured
from tdof_npid_ros.plants.per_lane import LanePlants, has_own_delays, is_direct, keep_due, of_lane
from tdof_npid_ros.plants.plant import PlantAt
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.plants.start import plant_at_start
from tdof_npid_ros.plants.states import loaded, store
from tdof_npid_ros.scenario import SampledPlan, Segment

VECTOR = 8  # lanes: block widths are multiples of it, and at least two of it
LARGEST_BLOCK = 64  # lanes
LARGEST_OUTPUT = (
    1e12  # |y| from which on a lane counts as diverged; seen in the outputs alone, so the live tuner sees it
)

# A lane's rows: its coefficients, then these, then the plant's state.
(_U_I, _Z, _ERROR_SUM, _FINITE, _LARGEST, _Y, _U, _V, _V_OLD, _V_DUE, _X) = range(COEFFICIENTS, COEFFICIENTS + 11)


@dataclass(frozen=True)
class Trajectory:
    """An episode of the closed loop.

    Attributes:
        time: s, (steps + 1,).
        setpoint, disturbance: (steps + 1,).
        output: y, (steps + 1, lanes).
        control_effort: u as the controller gives it, (steps + 1, lanes); the last one moves nothing any more.
    """

    time: np.ndarray
    setpoint: np.ndarray
    disturbance: np.ndarray
    output: np.ndarray
    control_effort: np.ndarray


@dataclass(frozen=True)
class Integrals:
    """What tuning needs of an episode, per lane.

    Attributes:
        iae: integral of the absolute error (9), trapezoidal rule, (lanes,).
        finite_fraction: fraction of the outputs below LARGEST_OUTPUT, (lanes,); 1 for a lane that did not diverge.
        early_rest_iae, late_rest_iae: the parts of the IAE from the halves of `SampledPlan.rest`, (lanes,).
        rest_error: the largest absolute error in the late half, (lanes,); all three 0 for a plan without rest.
    """

    iae: np.ndarray
    finite_fraction: np.ndarray
    early_rest_iae: np.ndarray
    late_rest_iae: np.ndarray
    rest_error: np.ndarray

    def __getitem__(self, lanes: Any) -> Integrals:
        """Those of some lanes."""
        return Integrals(*(getattr(self, field.name)[lanes] for field in fields(self)))

    def put(self, lanes: Any, measured: Integrals) -> None:
        """Take those of some lanes."""
        for field in fields(self):
            getattr(self, field.name)[lanes] = getattr(measured, field.name)


def joined(parts: Sequence[Integrals]) -> Integrals:
    """Those of several runs, lane after lane."""
    return Integrals(*(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(Integrals)))


Plants = PlantAt | LanePlants  # the plant of all lanes, or one for each


def simulate(plants: Plants, gains: Gains, signals: SampledPlan, effort_limits: tuple[float, float]) -> Trajectory:
    """Run one episode and keep its trajectory.

    Args:
        plants: the plant of all lanes for a set of changed parameters, for example `case.plant_at`; or each lane's own.
        gains: for one lane or many; for one where there are more plants: all have them.
        signals: the sampled plan.
        effort_limits: the plant's own, after those of the controller.
    """
    output, effort = np.empty((2, signals.steps + 1, _lanes_of(plants, gains)))
    _run(plants, gains, signals, effort_limits, output, effort)
    return Trajectory(signals.time, signals.setpoint, signals.disturbance, output, effort)


def simulate_operated(
    plant_at: PlantAt,
    gains: Gains,
    options: ControllerOptions,
    signals: SampledPlan,
    effort_limits: tuple[float, float],
) -> Trajectory:
    """As `simulate`, with options around the law: stepped one by one, by the same classes as in the nodes."""
    period_ns, lanes = signals.sample_period_ns, gains.lanes
    controller = Controller(gains, period_ns, options)
    simulator = PlantSimulator(
        plant_at_start(plant_at, signals.start, signals.segments[0].plant, effort_limits, signals.identity),
        period_ns,
        lanes,
        effort_limits,
    )
    if (rest := rest_setpoint(signals.start, simulator.output, simulator.applied_effort)) is not None:
        controller.begin_at_rest(simulator.applied_effort, rest)
    plants = {segment.first: plant_at(segment.plant) for segment in signals.segments}
    output, effort = np.empty((2, signals.steps + 1, lanes))
    for k in range(signals.steps + 1):
        output[k] = simulator.output
        controller.answer(k * period_ns, np.full(lanes, signals.setpoint[k]), simulator.output)
        effort[k] = controller.effort
        if k in plants:
            simulator.change_plant(plants[k])
        simulator.advance(controller.effort, np.full(lanes, signals.disturbance[k]))
    return Trajectory(signals.time, signals.setpoint, signals.disturbance, output, effort)


def integrals(plants: Plants, gains: Gains, signals: SampledPlan, effort_limits: tuple[float, float]) -> Integrals:
    """Run one episode and keep only its integrals; arguments as for `simulate`."""
    nothing = np.empty((0, _lanes_of(plants, gains)))
    return _run(plants, gains, signals, effort_limits, nothing, nothing)


def _lanes_of(plants: Plants, gains: Gains) -> int:
    """How many lanes there are.

    Raises:
        GainsError: there are gains for another number of lanes than there are plants.
    """
    if not isinstance(plants, LanePlants):
        return gains.lanes
    wanted = 1 + plants.gains.max(initial=0)
    if gains.lanes not in (1, wanted):
        raise GainsError(f"gains for {gains.lanes} lanes, but plants for {wanted}: give one, or one per lane")
    return plants.lanes


def _run(
    plants: Plants,
    gains: Gains,
    signals: SampledPlan,
    limits: tuple[float, float],
    output: np.ndarray,
    effort: np.ndarray,
) -> Integrals:
    steps, lanes = signals.steps, _lanes_of(plants, gains)
    c = coefficients(gains, signals.sample_period_ns / 1e9)
    iae, finite, early, late, largest = np.zeros((5, lanes))
    own = plants.gains if isinstance(plants, LanePlants) else np.arange(lanes)
    of_gains = np.minimum(own, gains.lanes - 1)
    for block in _blocks(gains, of_gains):
        law_limits = limits_of(gains, int(of_gains[block.start]))
        bounds = law_limits, conditional_integration(gains), unwinding_of(gains), limits
        width = _width(block.stop - block.start, isinstance(plants, LanePlants))
        y, u = np.empty((2, steps + 1 if len(output) else 0, width))
        of_block = np.minimum(np.arange(block.start, block.start + width), block.stop - 1)
        its = plants[of_block] if isinstance(plants, LanePlants) else plants
        c_block = np.ascontiguousarray(c[:, of_gains[of_block]])
        lane_rows, sums = _run_block_of(its, gains, c_block, bounds, signals, y, u)
        iae[block], finite[block] = lane_rows[_ERROR_SUM : _FINITE + 1, : block.stop - block.start]
        if signals.rest is not None:
            before, half, whole = (sums[k][: block.stop - block.start] for k in (*signals.rest, steps + 1))
            early[block], late[block] = half - before, whole - half
            largest[block] = lane_rows[_LARGEST, : block.stop - block.start]
        if len(output):
            output[:, block], effort[:, block] = y[:, : block.stop - block.start], u[:, : block.stop - block.start]
    h = signals.sample_period_ns / 1e9
    return Integrals(iae * h, finite / (steps + 1), early * h, late * h, largest)


def _blocks(gains: Gains, of_gains: np.ndarray) -> Iterator[slice]:
    """Lanes that run at once: neighbours with the same limits; `of_gains`: which gains each has, (lanes,)."""
    low, high = (gains.per_lane(name)[of_gains] for name in LIMITS_PER_LANE)
    changes = 1 + np.flatnonzero((low[1:] != low[:-1]) | (high[1:] != high[:-1]))
    for begin, end in pairwise([0, *changes.tolist(), len(of_gains)]):
        for first in range(begin, end, LARGEST_BLOCK):
            yield slice(first, min(first + LARGEST_BLOCK, end))


def _width(lanes: int, own_plants: bool) -> int:
    return 1 if lanes == 1 and not own_plants else max(2 * VECTOR, -(-lanes // VECTOR) * VECTOR)


def _run_block_of(
    plants: Plants,
    gains: Gains,
    c: np.ndarray,
    bounds: _Bounds,
    signals: SampledPlan,
    y: np.ndarray,
    u: np.ndarray,
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Run `width` lanes through every segment of the plan.

    Returns:
        The lanes' rows, (_X + states, width), and their sum of errors before the samples where their rest begins, where
        its late half does, and at the end.
    """
    width = c.shape[1]
    initial, state, y_0, u_0 = _beginning(plants, signals, bounds[3], width)
    own_rows = plants.own_rows() if isinstance(plants, LanePlants) else 0
    rows = _aligned_zeros(_X + len(initial) + own_rows, width)
    rows[:COEFFICIENTS] = c
    rows[_X : _X + len(initial)] = state
    rows[_V_OLD] = u_0
    if (rest := rest_setpoint(signals.start, y_0, u_0)) is not None:
        rows[_U_I : _Z + 1] = settled(c, gains, rest, y_0, u_0)
    ring: np.ndarray | None = None
    sums = {}
    inputs = signals.setpoint, signals.disturbance, signals.weight
    outputs = y.ravel(), u.ravel()
    for segment, plan_segment in _with_rest_apart(signals):
        sampled: Any
        if isinstance(plants, LanePlants):
            sampled, rows[_X + len(initial) :] = plants.sampled(plan_segment)
        else:
            sampled = plants(segment.plant).sampled(signals.sample_period_ns)
        if ring is None:
            ring = _aligned_zeros(sampled.delay + 2, width)
            ring += u_0
        check_same_delay(sampled, len(ring))
        last = segment.last + (segment.last == signals.steps)  # the last output is answered too
        memory = rows.ravel(), ring.ravel()
        arguments = (sampled, initial, inputs, (segment.first, last), bounds, memory, outputs)
        if width == 1:
            kernel_for(sampled, _run_lane)(*arguments)
        else:
            kernel_for(sampled, _run_block)(*arguments, (0,) * width)
        sums[last] = rows[_ERROR_SUM].copy()
        if signals.rest is not None and last == signals.rest.middle:
            rows[_LARGEST] = 0.0
    return rows, sums


def _beginning(
    plants: Plants, signals: SampledPlan, limits: tuple[float, float], width: int
) -> tuple[tuple[float, ...], np.ndarray, np.ndarray, np.ndarray]:
    """How a block of lanes begins: one lane's state, all states, (states, width) or (states, 1), the first outputs as
    they are measured, and the efforts that were on before, (width,)."""
    if isinstance(plants, LanePlants):
        return plants.like, plants.state, plants.measured, plants.effort
    plant = plant_at_start(plants, signals.start, signals.segments[0].plant, limits, signals.identity)
    initial, effort = plant.initial_state, np.full(width, plant.initial_effort)
    return initial, np.reshape(initial, (-1, 1)), np.full(width, first_measured(plant)), effort


def _with_rest_apart(signals: SampledPlan) -> Iterator[tuple[Segment, int]]:
    """The plan's segments, the last of them cut where its rest begins and where the late half of that does; and the
    first step of the plan's segment that each belongs to."""
    *before, final = signals.segments
    yield from ((segment, segment.first) for segment in before)
    cuts = [k for k in signals.rest or () if k > final.first]
    for first, last in pairwise([final.first, *cuts, final.last]):
        yield Segment(first, last, final.plant), final.first


def _aligned_zeros(rows: int, width: int) -> np.ndarray:
    """Zeros, (rows, width), that begin at a cache line, as then does every row of a block: a vector lies in one
    line."""
    flat = np.zeros(rows * width + VECTOR)
    first = -flat.ctypes.data % (flat.itemsize * VECTOR) // flat.itemsize
    return flat[first : first + rows * width].reshape(rows, width)


# What the compiled drivers are given, in plain tuples (see `control/law.py`); arrays of lanes are flat.
_Inputs = tuple[np.ndarray, np.ndarray, np.ndarray]  # setpoint, disturbance and weight of the error, each (steps + 1,)
_Stretch = tuple[int, int]  # the first step, and the one after the last
# The law's limits, anti-windup and unwinding, the actuator's limits
_Bounds = tuple[Limits, float, float | None, tuple[float, float]]
_Memory = tuple[np.ndarray, np.ndarray]  # the lanes' rows, and the efforts on their way through the dead time
_Outputs = tuple[np.ndarray, np.ndarray]  # y and u, empty if they are not asked for


@compiled
def answered(plant: Any, x: Any, u_i: float, z: float, c: Any, bounds: _Bounds, r: float, d: float) -> Any:
    """The first half of a step of one lane: y, u and the plant's input v, then the controller's state after it."""
    y = plant_output(plant, x)
    limits, conditional, unwinding, actuator = bounds
    u, u_i, z, _, _, _, _ = law(c, limits, conditional, unwinding, r, y, u_i, z)
    return y, u, plant_input(plant, applied(u, actuator), d), u_i, z


@entry_point
def _run_lane(
    plant: Any, x: Any, inputs: _Inputs, stretch: _Stretch, bounds: _Bounds, memory: _Memory, outputs: _Outputs
) -> None:
    """Run one lane through a stretch."""
    setpoint, disturbance, weight = inputs
    first, last = stretch
    rows, ring = memory
    y_out, u_out = outputs
    size = np.uint64(plant.delay + 2)
    new = np.uint64(first) % size
    c = lane_coefficients(rows, 0, 1)
    x = loaded(x, rows, _X, 1)
    u_i, z, error_sum, finite_outputs, largest = rows[_U_I], rows[_Z], rows[_ERROR_SUM], rows[_FINITE], rows[_LARGEST]
    for k in range(np.uint64(first), np.uint64(last)):
        r, d = setpoint[k], disturbance[k]
        oldest = _next_slot(new, size)
        due = _next_slot(oldest, size)
        y, u, v, u_i, z = answered(plant, x, u_i, z, c, bounds, r, d)
        ring[new] = v
        x = advance_bounded(plant, x, ring[oldest], v if plant.delay == 0 else ring[due], d)
        error = abs(r - y)
        error_sum += weight[k] * error
        if error > largest:
            largest = error
        if abs(y) < LARGEST_OUTPUT:
            finite_outputs += 1.0
        if y_out.shape[0]:
            y_out[k] = y
            u_out[k] = u
        new = oldest
    store(x, rows, _X, 1)
    rows[_U_I], rows[_Z], rows[_ERROR_SUM], rows[_FINITE], rows[_LARGEST] = u_i, z, error_sum, finite_outputs, largest


@entry_point
def _run_block(
    plant: Any,
    x: Any,
    inputs: _Inputs,
    stretch: _Stretch,
    bounds: _Bounds,
    memory: _Memory,
    outputs: _Outputs,
    lanes: tuple[int, ...],
) -> None:
    """Run a block of lanes side by side through a stretch; rows are as long as `lanes`.

    For the compiler to vectorise, it must see that lanes do not overlap in memory. So the width is the length of a
    tuple, which is part of its type, and the loop over the lanes touches one array only.
    """
    setpoint, disturbance, weight = inputs
    first, last = stretch
    rows, ring = memory
    y_out, u_out = outputs
    w = len(lanes)
    size = np.uint64(plant.delay + 2)
    new = np.uint64(first) % size
    for k in range(np.uint64(first), np.uint64(last)):
        r = setpoint[k]
        d = disturbance[k]
        oldest = _next_slot(new, size)
        due = _next_slot(oldest, size)
        _take_due(plant, ring, (new, oldest, due, size), rows, lanes)
        for j in range(w):
            x = loaded(x, rows, _X * w + j, w)
            own = of_lane(plant, rows, (_X + len(x)) * w + j, w)
            c = lane_coefficients(rows, j, w)
            y, u, v, rows[_U_I * w + j], rows[_Z * w + j] = answered(
                own, x, rows[_U_I * w + j], rows[_Z * w + j], c, bounds, r, d
            )
            v_due = v if is_direct(plant, rows, (_X + len(x)) * w + j) else rows[_V_DUE * w + j]
            x = advance_bounded(own, x, rows[_V_OLD * w + j], v_due, d)
            keep_due(plant, rows, _V_OLD * w + j, v_due)
            rows[_V * w + j] = v
            store(x, rows, _X * w + j, w)
            error = abs(r - y)
            rows[_ERROR_SUM * w + j] += weight[k] * error
            rows[_LARGEST * w + j] = error if error > rows[_LARGEST * w + j] else rows[_LARGEST * w + j]
            rows[_FINITE * w + j] += 1.0 if abs(y) < LARGEST_OUTPUT else 0.0
            rows[_Y * w + j] = y
            rows[_U * w + j] = u
        _copy_row(rows, np.uint64(_V), ring, new, lanes)
        if y_out.shape[0]:
            _copy_row(rows, np.uint64(_Y), y_out, k, lanes)
            _copy_row(rows, np.uint64(_U), u_out, k, lanes)
        new = oldest


def _take_due(plant: Any, ring: Any, slots: Any, rows: Any, lanes: Any) -> Any:
    """Write what enters the plants at this step to the lanes' rows: what was put into the dead time's begin `delay`
    samples ago, and one more; the latter is there already where lanes have dead times of their own."""


@inlined_implementation_of(_take_due)
def _take_due_of(plant: Any, ring: Any, slots: Any, rows: Any, lanes: Any) -> Any:
    if has_own_delays(plant):
        return _gather_due
    return _copy_due


def _copy_due(plant: Any, ring: Any, slots: Any, rows: Any, lanes: Any) -> None:
    _, oldest, due, _ = slots
    _copy_row(ring, oldest, rows, np.uint64(_V_OLD), lanes)
    _copy_row(ring, due, rows, np.uint64(_V_DUE), lanes)


def _gather_due(plant: Any, ring: Any, slots: Any, rows: Any, lanes: Any) -> None:
    new, _, _, size = slots
    delays, w = plant.delays, len(lanes)
    now, turn = np.int64(new), np.int64(size)
    for j in range(w):
        slot = now - delays[j]
        slot = slot + turn if slot < 0 else slot
        rows[_V_DUE * w + j] = ring[slot * w + j]


@compiled
def _copy_row(source: Any, row: Any, target: Any, to: Any, lanes: Any) -> Any:
    """Copy a row of one flat array to a row of another, VECTOR numbers at once: all are read before one is written."""
    width, one = np.uint64(len(lanes)), np.uint64(1)
    for j in range(np.uint64(0), width, np.uint64(VECTOR)):
        store(loaded(lanes[:VECTOR], source, row * width + j, one), target, to * width + j, one)


@compiled
def _next_slot(slot: Any, size: Any) -> Any:
    following = slot + np.uint64(1)
    return np.uint64(0) if following == size else following
