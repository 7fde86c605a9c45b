"""The fit of one structure to a record: nonlinear least squares with the linear parameters solved for at each step.

The residual is that of the output simulated from the recorded effort (output error), whitened where a noise model
is given. For an unstable structure it is that of the stable predictor with the mirrored pole, which has the same
spectrum (Forssell and Ljung 2000). Initial state, level and load step are unknowns of each stretch of the record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from tdof_npid_ros.identification.kernels import (
    STATES,
    TABLE,
    Coefficients,
    Data,
    Form,
    Systems,
    accumulate,
    eliminated,
    grid_values,
    prepare,
    residual_sums,
    solved,
)
from tdof_npid_ros.identification.structures import Structure

VARIATION = 1e-6  # of a parameter, for its sensitivity
NO_WHITENING = np.zeros(0)


@dataclass(frozen=True)
class Stretch:
    """A stretch of a record without a break.

    Attributes:
        time: s, from 0 on, (samples,).
        effort: held from each stamp on, (samples,).
        output: (samples,).
        at_rest: whether the plant is known to have been at rest, with the effort `before`, until the first stamp.
        before: the effort before the first stamp.
        even: whether the stamps are even.
        shift: how much later than stamped the outputs are, s: half a block of averages.
        used: which samples count.
    """

    time: np.ndarray
    effort: np.ndarray
    output: np.ndarray
    at_rest: bool
    before: float
    even: bool
    shift: float = 0.0
    used: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        if not len(self.used):
            object.__setattr__(self, "used", np.ones(len(self.time), bool))

    @cached_property
    def period(self) -> float:
        """Median step of the stamps, s."""
        if self.even:
            return float(self.time[-1]) / max(len(self.time) - 1, 1)
        return float(np.median(np.diff(self.time)))

    def averaged(self, block: int) -> Stretch:
        """The averages over blocks of samples: as if recorded `block` times more slowly.

        Output j + 1 is the mean of block j, which lies (block + 1)/2 samples before its stamp: see `shift`.
        """
        blocks = len(self.time) // block
        if block == 1 or blocks < 2:
            return self
        whole = blocks * block

        def mean(values: np.ndarray) -> np.ndarray:
            return np.asarray(values[:whole].reshape(blocks, block).mean(axis=1))

        effort, output = mean(self.effort), mean(self.output)
        used = self.used[:whole].reshape(blocks, block).all(axis=1)
        time = np.append(self.time[:whole:block], 2.0 * self.time[whole - block] - self.time[whole - 2 * block])
        return Stretch(
            time,
            np.append(effort, effort[-1]),
            np.insert(output, 0, self.output[0]),
            self.at_rest,
            self.before,
            self.even,
            0.5 * (block + 1) * self.period,
            np.insert(used, 0, False),
        )

    @cached_property
    def data(self) -> Data:
        """As the compiled functions take it."""
        return Data(self.time, self.effort - self.before, self.output, self.used, self.even, self.period)

    @property
    def duration(self) -> float:
        """In s."""
        return float(self.time[-1])


@dataclass(frozen=True)
class Point:
    """Parameters of a fit.

    Attributes:
        shape: of the denominator, (structure.shape,).
        dead_time: s.
        load_time: when each load step reaches the plant, s, by stretch; infinity without one.
        load: its size, by stretch.
    """

    shape: np.ndarray
    dead_time: float
    load_time: np.ndarray
    load: np.ndarray


@dataclass(frozen=True)
class Solution:
    """A point with its linear parameters.

    Attributes:
        point: where.
        rss: the residual sum of squares, whitened.
        count: the residuals in it.
        numerator: (numerators,).
        initial, level: by stretch.
        normal: of numerator and nonlinear parameters, (parameters, parameters); None before `Problem.refined`.
    """

    point: Point
    rss: float
    count: int
    numerator: np.ndarray
    initial: tuple[np.ndarray, ...]
    level: tuple[np.ndarray, ...]
    normal: np.ndarray | None = None


@dataclass(frozen=True)
class Problem:
    """A structure to be fitted to stretches.

    Attributes:
        structure, stretches: what to what.
        loaded: which stretches have a load step, (stretches,).
        whitening: the noise is e[k] plus these times the noise before, (lags,).
    """

    structure: Structure
    stretches: Sequence[Stretch]
    loaded: tuple[bool, ...]
    whitening: np.ndarray = field(default_factory=lambda: NO_WHITENING)

    def unloaded(self) -> Point:
        """No load steps, at no point."""
        count = len(self.stretches)
        return Point(np.zeros(self.structure.shape), 0.0, np.full(count, np.inf), np.zeros(count))

    def solved(self, point: Point) -> Solution:
        """The best linear parameters at a point."""
        numerators = self.structure.numerators
        shared = np.zeros((numerators + 1, numerators + 1))
        follows, count = [], 0
        for i, stretch in enumerate(self.stretches):
            gram, _ = self._pass(i, point, self._blank(i, point), sensitivities=False)
            rest, follow = eliminated(gram, numerators)
            follows.append(follow)
            shared += rest
            count += self._count(stretch)
        numerator = solved(shared[:-1, :-1], shared[:-1, -1:])[:, 0]
        rss = shared[-1, -1] - numerator @ shared[:-1, -1]
        initial, level = [], []
        for i, follow in enumerate(follows):
            nuisance = follow[:, -1] - follow[:, :-1] @ numerator
            initial.append(nuisance[: self._frees(i)])
            level.append(nuisance[self._frees(i) :])
        return Solution(point, float(max(rss, 0.0)), count, numerator, tuple(initial), tuple(level))

    def values(self, points: Sequence[tuple[Sequence[float], float]], loads: Point) -> np.ndarray:
        """The residual sum of squares at many points, each a shape and a dead time; load steps as in `loads`."""
        numerators = self.structure.numerators
        rests = np.zeros((len(points), numerators + 1, numerators + 1))
        shapes = [np.array(shape) for shape, _ in points]
        dead_times = np.array([dead_time for _, dead_time in points])
        for i, stretch in enumerate(self.stretches):
            form = Form(self.structure.integrating, self.structure.unstable, self.loaded[i], False)
            load_times = np.full(len(points), loads.load_time[i] + stretch.shift)
            systems = self._blank_systems(stretch, shapes, dead_times + stretch.shift, load_times)
            prepare(systems, stretch.period, stretch.even, self.structure.unstable)
            grid_values(stretch.data, systems, form, self._blank(i, loads), self.whitening, rests)
        return np.asarray(residual_sums(rests))

    def normal(self, solution: Solution) -> tuple[np.ndarray, np.ndarray, float]:
        """Normal matrix and right side of [numerator, nonlinear parameters], and the residual sum of squares."""
        numerators, nonlinear = self.structure.numerators, self.structure.nonlinear
        loads = [i for i, there in enumerate(self.loaded) if there]
        size = numerators + nonlinear + 2 * len(loads)
        matrix, right, rss = np.zeros((size, size)), np.zeros(size), 0.0
        for i in range(len(self.stretches)):
            gram, _ = self._pass(i, solution.point, self._at(i, solution), sensitivities=True)
            here = list(range(numerators + nonlinear))
            if self.loaded[i]:
                first = numerators + nonlinear + 2 * loads.index(i)
                here += [first, first + 1]
            rest, _ = eliminated(gram, len(here))
            matrix[np.ix_(here, here)] += rest[:-1, :-1]
            right[here] += rest[:-1, -1]
            rss += rest[-1, -1]
        return matrix, right, float(rss)

    def residuals(self, solution: Solution) -> list[np.ndarray]:
        """Of each stretch, not whitened, (samples,)."""
        return [
            self._pass(i, solution.point, self._at(i, solution), sensitivities=True, keep=True)[1]
            for i in range(len(self.stretches))
        ]

    def refined(self, start: Point, iterations: int = 30, tolerance: float = 1e-10) -> Solution:
        """The minimum near a point, by damped Gauss-Newton steps."""
        solution, damping = self.solved(start), 1e-3
        matrix, right, rss = self.normal(solution)
        for _ in range(iterations):
            step = self._step(matrix, right, damping, solution.point)
            moved = self.solved(self._moved(solution.point, step))
            if moved.rss < solution.rss:
                gained = solution.rss - moved.rss
                solution, damping = moved, max(damping * 0.1, 1e-9)
                matrix, right, rss = self.normal(solution)
                if gained < tolerance * solution.rss or solution.rss <= 0.0:
                    break
            else:
                damping = max(damping, 1e-6) * 10.0
                if damping > 1e6:
                    break
        return replace(solution, normal=matrix, rss=max(rss, 0.0))

    def _step(self, matrix: np.ndarray, right: np.ndarray, damping: float, point: Point) -> np.ndarray:
        """Of the nonlinear parameters."""
        numerators = self.structure.numerators
        damped = matrix.copy()
        inner = np.arange(numerators, len(matrix))
        damped[inner, inner] *= 1.0 + damping
        dead = numerators + self.structure.shape
        step = solved(damped, right[:, None])[:, 0]
        if point.dead_time <= 0.0 and step[dead] < 0.0:  # at its bound
            others = np.delete(np.arange(len(matrix)), dead)
            step = np.zeros(len(matrix))
            step[others] = solved(damped[np.ix_(others, others)], right[others, None])[:, 0]
        return np.asarray(step[numerators:])

    def _moved(self, point: Point, step: np.ndarray) -> Point:
        shapes = self.structure.shape
        longest = max(stretch.duration for stretch in self.stretches)
        shortest = min(stretch.period for stretch in self.stretches)
        shape = point.shape + np.clip(step[:shapes], -0.7, 0.7)
        if shapes:
            shape[0] = np.clip(shape[0], math.log(0.02 * shortest), math.log(100.0 * longest))
        if shapes > 1:
            shape[1] = np.clip(shape[1], math.log(0.01), math.log(30.0))
        limit = max(0.3 * longest, 2.0 * shortest)
        dead_time = float(np.clip(point.dead_time + np.clip(step[shapes], -limit, limit), 0.0, 0.9 * longest))
        load_time, load = point.load_time.copy(), point.load.copy()
        for j, i in enumerate(i for i, there in enumerate(self.loaded) if there):
            duration = self.stretches[i].duration
            move = np.clip(step[shapes + 1 + 2 * j], -0.1 * duration, 0.1 * duration)
            load_time[i] = np.clip(load_time[i] + move, 0.0, duration)
            load[i] += step[shapes + 2 + 2 * j]
        return Point(shape, dead_time, load_time, load)

    def _frees(self, i: int) -> int:
        if self.stretches[i].at_rest:
            return 1 if self.structure.integrating else 0
        return self.structure.order

    def _count(self, stretch: Stretch) -> int:
        return int(np.count_nonzero(stretch.used[len(self.whitening) :]))

    def _blank(self, i: int, point: Point) -> Coefficients:
        return Coefficients(
            np.zeros(self.structure.numerators), np.zeros(self._frees(i)), np.zeros(1), float(point.load[i])
        )

    def _at(self, i: int, solution: Solution) -> Coefficients:
        return Coefficients(solution.numerator, solution.initial[i], solution.level[i], float(solution.point.load[i]))

    def _pass(
        self, i: int, point: Point, at: Coefficients, sensitivities: bool, keep: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        stretch, loaded = self.stretches[i], self.loaded[i]
        systems = self._systems(stretch, point, i, sensitivities)
        form = Form(self.structure.integrating, self.structure.unstable, loaded, sensitivities)
        prepare(systems, stretch.period, stretch.even, self.structure.unstable)
        columns = len(at.numerator) + len(at.initial) + len(at.level) + 1
        columns += len(systems.scale) - 1 + loaded if sensitivities else 0
        gram = np.zeros((columns, columns))
        residual = np.zeros(len(stretch.time) if keep else 0)
        accumulate(stretch.data, systems, form, at, self.whitening, gram, residual)
        if sensitivities:
            step = np.ones(columns)
            first = len(at.numerator)
            step[first : first + len(systems.scale) - 1] = 1.0 / self._variations(stretch, loaded)
            gram *= np.outer(step, step)
        return gram, residual

    def _variations(self, stretch: Stretch, loaded: bool) -> np.ndarray:
        time = VARIATION * stretch.period
        return np.array([VARIATION] * self.structure.shape + [time] * (1 + loaded))

    def _systems(self, stretch: Stretch, point: Point, i: int, sensitivities: bool) -> Systems:
        structure, loaded = self.structure, self.loaded[i]
        shapes = [point.shape]
        dead_times, load_times = [point.dead_time + stretch.shift], [float(point.load_time[i]) + stretch.shift]
        if sensitivities:
            variations = self._variations(stretch, loaded)
            for j in range(structure.shape):
                shapes.append(point.shape + variations[j] * (np.arange(structure.shape) == j))
            shapes += [point.shape] * (1 + loaded)
            dead_times += [dead_times[0]] * structure.shape + [dead_times[0] + variations[structure.shape]]
            load_times += [load_times[0]] * (structure.shape + 1)
            if loaded:
                dead_times.append(dead_times[0])
                load_times.append(load_times[0] + variations[-1])
        return self._blank_systems(stretch, shapes, np.array(dead_times), np.array(load_times))

    def _blank_systems(
        self, stretch: Stretch, shapes: Sequence[np.ndarray], dead_times: np.ndarray, load_times: np.ndarray
    ) -> Systems:
        count, table = len(shapes), 0 if stretch.even else TABLE
        return Systems(
            phi=np.zeros((count, STATES, STATES)),
            gamma=np.zeros((count, STATES)),
            gamma_old=np.zeros((count, STATES)),
            gamma_new=np.zeros((count, STATES)),
            delay=np.zeros(count, np.int64),
            dead_time=dead_times,
            load_time=load_times,
            load_index=np.zeros(count, np.int64),
            load_first=np.zeros((count, STATES)),
            growth=np.ones(count),
            a=np.array([self.structure.denominator(shape) for shape in shapes]),
            scale=np.array([self.structure.scale(shape) for shape in shapes]),
            table_phi=np.zeros((count, table, STATES, STATES)),
            table_gamma=np.zeros((count, table, STATES)),
        )
