"""The search: every structure from several starts, with and without a load step; then the one worth its parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tdof_npid_ros.identification.fit import NO_WHITENING, Point, Problem, Solution, Stretch
from tdof_npid_ros.identification.kernels import solved
from tdof_npid_ros.identification.noise import autoregression
from tdof_npid_ros.identification.structures import STRUCTURES, Structure

COARSE = 300  # samples, for the search
STARTS = 3  # that are followed to their minimum, for each coefficient of the numerator
LOAD_TIMES = 40  # candidates in a stretch
LOAD_PARAMETERS = 3  # its size, its time, and one for having looked everywhere
WORTH = 10.0  # of the criterion: a structure with more parameters must be that much better (Burnham and Anderson 2002)
CANCELLED = 0.02  # of a step's response: a slow pole that makes less of it, for a zero cancels it, is drift
RESOLUTION = 1e-7  # of the output's range: residuals below it say nothing


@dataclass(frozen=True)
class Fitted:
    """A structure's best fit.

    Attributes:
        problem, solution: of the fit.
        criterion: the corrected Akaike information criterion; less is better, differences count.
    """

    problem: Problem
    solution: Solution
    criterion: float

    @property
    def structure(self) -> Structure:
        """What was fitted."""
        return self.problem.structure

    @property
    def is_cancelled(self) -> bool:
        """Whether a zero cancels its slow pole: a plant with fewer parameters, which drifts or is not quite linear."""
        return self.structure.slow_share(self.solution.point.shape, self.solution.numerator) < CANCELLED


def fit_all(
    stretches: Sequence[Stretch], structures: Sequence[Structure] = tuple(STRUCTURES.values())
) -> tuple[list[Fitted], np.ndarray]:
    """Every structure's best fit, in the order of the criterion, and the noise's model with which they were made."""
    coarse = averaged(stretches, COARSE)
    plain = {structure.name: _best_of(structure, coarse) for structure in structures}
    loaded = {name: _with_load(fit) for name, fit in plain.items()}
    best = min(loaded.values(), key=lambda fit: fit.criterion)
    if any(best.problem.loaded):  # a load step that one structure found may have misled another
        for structure in structures:
            other = _best_of(structure, coarse, best.problem.loaded, best.solution.point)
            if other.criterion < loaded[structure.name].criterion:
                loaded[structure.name] = other
    fits = [_on(stretches, plain[structure.name], loaded[structure.name]) for structure in structures]
    best = min(fits, key=lambda fit: fit.criterion)
    whitening = noise_model(best)
    if len(whitening):
        fits = [_again(fit, whitening) for fit in fits]
    return sorted(fits, key=lambda fit: fit.criterion), whitening


def averaged(stretches: Sequence[Stretch], samples: int) -> list[Stretch]:
    """As many averages as to have about `samples` in all, but at least 20 of each stretch."""
    total = sum(len(stretch.time) for stretch in stretches)
    return [stretch.averaged(max(1, min(total // samples, len(stretch.time) // 20))) for stretch in stretches]


def chosen(fits: Sequence[Fitted]) -> Fitted:
    """The one with the fewest parameters of those that the best does not beat by `WORTH`; none whose zero cancels its
    slow pole, if there are others."""
    fits = [fit for fit in fits if not fit.is_cancelled] or fits
    best = min(fit.criterion for fit in fits)
    return min(
        (fit for fit in fits if fit.criterion <= best + WORTH), key=lambda f: (f.structure.parameters, f.criterion)
    )


def noise_model(fit: Fitted) -> np.ndarray:
    """How the residuals are correlated; as if white where they are below what can be resolved."""
    if fit.solution.rss <= 10.0 * floor(fit.problem.stretches):
        return NO_WHITENING
    residuals = fit.problem.residuals(fit.solution)
    return autoregression([r[stretch.used] for r, stretch in zip(residuals, fit.problem.stretches, strict=True)])


def floor(stretches: Sequence[Stretch]) -> float:
    """A residual sum of squares that is as good as none."""
    spread = max(float(np.ptp(stretch.output)) for stretch in stretches)
    return sum(len(stretch.time) for stretch in stretches) * (RESOLUTION * spread) ** 2


def criterion(problem: Problem, solution: Solution) -> float:
    """AICc of a fit; a load step counts for `LOAD_PARAMETERS`."""
    nuisance = sum(len(a) + len(b) for a, b in zip(solution.initial, solution.level, strict=True))
    parameters = problem.structure.parameters + nuisance + LOAD_PARAMETERS * sum(problem.loaded) + 1
    count = solution.count
    if count <= parameters + 2:
        return math.inf
    deviance = count * math.log((solution.rss + floor(problem.stretches)) / count)
    return deviance + 2.0 * parameters * (1.0 + (parameters + 1.0) / (count - parameters - 1.0))


def _best_of(
    structure: Structure, stretches: Sequence[Stretch], loaded: tuple[bool, ...] = (), loads: Point | None = None
) -> Fitted:
    """The best of several starts, with load steps as given, by default none."""
    problem = Problem(structure, stretches, loaded or (False,) * len(stretches))
    solutions = [problem.refined(point) for point in _starts(problem, loads or problem.unloaded())]
    best = min(solutions, key=lambda solution: solution.rss)
    return Fitted(problem, best, criterion(problem, best))


def _on(stretches: Sequence[Stretch], *fits: Fitted) -> Fitted:
    """The best of the fits, made again on other stretches of the same record."""
    again = []
    for fit in {id(fit): fit for fit in fits}.values():
        problem = replace(fit.problem, stretches=stretches)
        solution = problem.refined(fit.solution.point)
        again.append(Fitted(problem, solution, criterion(problem, solution)))
    plain, *loaded = again
    return min(
        [plain, *(fit for fit in loaded if fit.criterion < plain.criterion - WORTH)], key=lambda fit: fit.criterion
    )


def _again(fit: Fitted, whitening: np.ndarray) -> Fitted:
    problem = replace(fit.problem, whitening=whitening)
    solution = problem.refined(fit.solution.point)
    return Fitted(problem, solution, criterion(problem, solution))


def _with_load(fit: Fitted) -> Fitted:
    """With a load step in each stretch in which one is worth it."""
    for i in range(len(fit.problem.stretches)):
        if fit.problem.loaded[i]:
            continue
        problem = replace(fit.problem, loaded=tuple(there or i == j for j, there in enumerate(fit.problem.loaded)))
        starts = _load_starts(problem, fit.solution, i)
        solutions = [problem.refined(point) for point in starts]
        if solutions:
            best = min(solutions, key=lambda solution: solution.rss)
            loaded = Fitted(problem, best, criterion(problem, best))
            if loaded.criterion < fit.criterion - WORTH:
                fit = loaded
    return fit


def _load_starts(problem: Problem, solution: Solution, i: int) -> list[Point]:
    """The two most promising times of a load step in stretch i, each with its size: by the score of its column."""
    numerators, nonlinear = problem.structure.numerators, problem.structure.nonlinear
    before = sum(problem.loaded[:i])
    size_at = numerators + nonlinear + 2 * before + 1
    found = []
    for time in (np.arange(LOAD_TIMES) + 0.5) / LOAD_TIMES * problem.stretches[i].duration:
        load_time, load = solution.point.load_time.copy(), solution.point.load.copy()
        load_time[i], load[i] = time, 0.0
        point = replace(solution.point, load_time=load_time, load=load)
        matrix, right, _ = problem.normal(replace(solution, point=point))
        others = [j for j in range(len(matrix)) if j not in (size_at, size_at - 1)]
        follow = solved(matrix[np.ix_(others, others)], np.stack([matrix[others, size_at], right[others]], 1))
        curvature = matrix[size_at, size_at] - matrix[size_at, others] @ follow[:, 0]
        slope = right[size_at] - matrix[size_at, others] @ follow[:, 1]
        if curvature > 1e-9 * matrix[size_at, size_at]:
            load[i] = slope / curvature
            found.append((slope**2 / curvature, point))
    found.sort(key=lambda pair: -pair[0])
    spacing = 2.5 * problem.stretches[i].duration / LOAD_TIMES
    best = [point for _, point in found[:1]]
    best += [p for _, p in found if best and abs(p.load_time[i] - best[0].load_time[i]) > spacing][:1]
    return best


def _starts(problem: Problem, loads: Point) -> list[Point]:
    """The best points of a grid, no two of them neighbours."""
    grid = list(_grid(problem))
    values = problem.values([(shape, dead_time) for _, shape, dead_time in grid], loads)
    taken: list[tuple[tuple[int, ...], Point]] = []
    for at in np.argsort(values, kind="stable"):
        index, shape, dead_time = grid[at]
        if all(max(abs(a - b) for a, b in zip(index, other, strict=True)) > 1 for other, _ in taken):
            taken.append((index, replace(loads, shape=np.array(shape), dead_time=dead_time)))
            if len(taken) == STARTS * problem.structure.numerators:
                break
    return [point for _, point in taken]


def _grid(problem: Problem) -> Iterator[tuple[tuple[int, ...], tuple[float, ...], float]]:
    longest = max(stretch.duration for stretch in problem.stretches)
    period = min(stretch.period for stretch in problem.stretches)
    dead_times = [0.0, *np.geomspace(max(period, longest / 300.0), longest / 3.0, 9)]
    scales = np.log(np.geomspace(max(period, longest / 1000.0), longest, 11)) if problem.structure.shape else [None]
    dampings = np.log([0.12, 0.4, 1.0, 2.2]) if problem.structure.shape == 2 else [None]
    for i, scale in enumerate(scales):
        for j, damping in enumerate(dampings):
            for k, dead_time in enumerate(dead_times):
                yield (i, j, k), tuple(v for v in (scale, damping) if v is not None), float(dead_time)
