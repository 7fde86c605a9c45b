"""How well the record tells each parameter: 95 % intervals, from the curvature of the residuals at the best fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from tdof_npid_ros.identification.fit import Problem, Solution
from tdof_npid_ros.plants.linear import TransferFunction

CONFIDENCE = 0.95
POSITIVE = ("time_constant", "time_constant_1", "time_constant_2", "natural_period", "damping")
DIFFERENCE = 1e-6


@dataclass(frozen=True)
class Interval:
    """A parameter and where it lies.

    Attributes:
        value: the best.
        low, high: of the 95 % interval.
        deviation: the standard deviation of the estimate; of a positive parameter its logarithm's times the value.
    """

    value: float
    low: float
    high: float
    deviation: float

    @property
    def relative(self) -> float:
        """Half the interval's width over the value."""
        return 0.5 * (self.high - self.low) / abs(self.value) if self.value else math.inf


def intervals(problem: Problem, solution: Solution) -> dict[str, Interval]:
    """The interval of each physical parameter, by name.

    The residuals are whitened, so their curvature holds for noise that is correlated, too. A parameter that is
    positive by its nature has its interval on a logarithmic scale.
    """
    structure = problem.structure
    point = np.concatenate([solution.numerator, solution.point.shape, [solution.point.dead_time]])
    best = _physical(problem, point)
    parameters = len(point) + 2 * sum(problem.loaded) + sum(map(len, (*solution.initial, *solution.level)))
    freedom = max(solution.count - parameters, 1)
    covariance = _covariance(problem, solution)[: len(point), : len(point)] * solution.rss / freedom
    width = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, freedom))
    found = {}
    for name, value in best.items():
        slope = np.zeros(len(point))
        for i in range(len(point)):
            step = DIFFERENCE * (abs(point[i]) if i < structure.numerators and point[i] else 1.0)
            if i == len(point) - 1:
                step = DIFFERENCE * max(point[i], problem.stretches[0].period)
            moved = point.copy()
            moved[i] += step
            slope[i] = (_physical(problem, moved).get(name, value) - value) / step
        deviation = math.sqrt(max(float(slope @ covariance @ slope), 0.0))
        if name in POSITIVE:
            factor = math.exp(min(width * deviation / value, 50.0))
            found[name] = Interval(value, value / factor, value * factor, deviation)
        else:
            low = value - width * deviation
            found[name] = Interval(
                value, max(low, 0.0) if name == "dead_time" else low, value + width * deviation, deviation
            )
    return found


def drawn(problem: Problem, solution: Solution, count: int, seed: int = 0) -> list[TransferFunction]:
    """Plants that the record allows: drawn from the joint distribution that the intervals are of."""
    structure = problem.structure
    best = np.concatenate([solution.numerator, solution.point.shape, [solution.point.dead_time]])
    size, n = len(best), structure.numerators
    parameters = size + 2 * sum(problem.loaded) + sum(map(len, (*solution.initial, *solution.level)))
    freedom = max(solution.count - parameters, 1)
    covariance = _covariance(problem, solution)[:size, :size] * solution.rss / freedom
    values, vectors = np.linalg.eigh(covariance)
    spread = vectors * np.sqrt(np.maximum(values, 0.0))
    random = np.random.default_rng(seed)
    points = best + random.standard_normal((count, size)) @ spread.T
    return [
        structure.transfer_function(point[n : n + structure.shape], max(float(point[-1]), 0.0), point[:n])
        for point in points
    ]


def _physical(problem: Problem, point: np.ndarray) -> Mapping[str, float]:
    structure = problem.structure
    n = structure.numerators
    return structure.physical(point[n : n + structure.shape], float(point[-1]), point[:n])


def _covariance(problem: Problem, solution: Solution) -> np.ndarray:
    assert solution.normal is not None
    matrix = solution.normal
    scale = np.sqrt(np.diag(matrix))
    scale[~(scale > 0.0)] = 1.0
    inverse = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-14, hermitian=True)
    return np.asarray(inverse / np.outer(scale, scale))
