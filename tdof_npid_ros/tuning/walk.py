"""A walk along a narrow, bent valley: CMA-ES (Hansen 2016), in arithmetic whose every bit is the same on every machine.

A valley with steep and kinked sides, such as the border of what is allowed, is no quadratic, and points that are kept
for being best gather where they are. CMA-ES goes by the order of the points alone, and lengthens its steps the way it
goes. It takes many evaluations, but it arrives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tdof_npid_ros.control.law import exp_minus_of
from tdof_npid_ros.tuning.quadratic import Array, forward, regularised_cholesky

FIRST_STEP = 0.01
"""Standard deviation at first, in each parameter, of its range."""

LEAST_SAMPLES = 8
"""In a generation."""

UNIFORMS = 12
"""Whose sum, less 6, is a normal draw: NumPy's own would go through the C library."""


@dataclass(frozen=True)
class Walk:
    """Where a walk is, in 0 .. 1.

    Attributes:
        mean: [d].
        step: standard deviation along a unit of `shape`.
        shape: [d, d], the covariance of the samples over step squared.
        path: [d], of the means, by which the shape learns where it goes; `whitened`: [d], by which the step does.
    """

    mean: Array
    step: float
    shape: Array
    path: Array
    whitened: Array

    @classmethod
    def begun_at(cls, point: Array) -> Walk:
        """A walk that begins at a point [d]."""
        d = point.size
        return cls(point.copy(), FIRST_STEP, np.eye(d), np.zeros(d), np.zeros(d))

    def samples(self, random: np.random.Generator, count: int) -> Array:
        """So many points [n, d], at least `LEAST_SAMPLES`."""
        count, d = max(count, LEAST_SAMPLES), self.mean.size
        normal = random.random((UNIFORMS, count, d)).sum(axis=0) - UNIFORMS / 2
        factor = regularised_cholesky(self.shape)
        offsets = (factor[None, :, :] * normal[:, None, :]).sum(axis=2)
        clipped: Array = np.clip(self.mean + self.step * offsets, 0.0, 1.0)
        return clipped

    def moved(self, points: Array) -> Walk:
        """The walk after its samples [n, d], best first."""
        d, parents = self.mean.size, len(points) // 2
        weights = np.arange(parents, 0, -1.0) ** 2
        weights /= weights.sum()
        mass = 1.0 / float((weights * weights).sum())
        for_step = (mass + 2.0) / (d + mass + 5.0)
        for_path = (4.0 + mass / d) / (d + 4.0 + 2.0 * mass / d)
        of_path = 2.0 / ((d + 1.3) * (d + 1.3) + mass)
        of_points = min(1.0 - of_path, 2.0 * (mass - 2.0 + 1.0 / mass) / ((d + 2.0) * (d + 2.0) + mass))
        expected = np.sqrt(d) * (1.0 - 1.0 / (4.0 * d) + 1.0 / (21.0 * d * d))

        steps = (points - self.mean) / self.step
        mean_step = (weights[:, None] * steps[:parents]).sum(axis=0)
        factor = regularised_cholesky(self.shape)
        white = forward(factor, mean_step)
        whitened = (1.0 - for_step) * self.whitened + np.sqrt(for_step * (2.0 - for_step) * mass) * white
        length = float(np.sqrt((whitened * whitened).sum()))
        path = (1.0 - for_path) * self.path
        if length < (1.4 + 2.0 / (d + 1.0)) * expected:
            path = path + np.sqrt(for_path * (2.0 - for_path) * mass) * mean_step
        # The worst steps, shortened to those expected, take from the shape what the best ones add.
        worst = steps[: -parents - 1 : -1]
        white_worst = forward(factor, np.ascontiguousarray(worst.T))
        worst = worst * (np.sqrt(d) / np.sqrt((white_worst * white_worst).sum(axis=0) + 1e-300))[:, None]
        less = min(
            1.0 + of_path / of_points, 1.0 + 2.0 * mass / (mass + 2.0), (1.0 - of_path - of_points) / (d * of_points)
        )
        shape = (
            (1.0 - of_path - of_points * (1.0 - less)) * self.shape
            + of_path * path[:, None] * path[None, :]
            + of_points * (weights[:, None, None] * steps[:parents, :, None] * steps[:parents, None, :]).sum(axis=0)
            - less * of_points * (weights[:, None, None] * worst[:, :, None] * worst[:, None, :]).sum(axis=0)
        )
        damping = 1.0 + for_step + 2.0 * max(0.0, float(np.sqrt((mass - 1.0) / (d + 1.0))) - 1.0)
        step = self.step * _exponential(min(for_step / damping * (length / expected - 1.0), 1.0))
        return Walk(self.mean + self.step * mean_step, step, shape, path, whitened)

    def numbers(self) -> Array:
        """All that it is, flat."""
        return np.concatenate([[self.step], self.mean, self.path, self.whitened, self.shape.ravel()])

    @classmethod
    def of_numbers(cls, numbers: Array, dimension: int) -> Walk | None:
        """What `numbers` gave; None for none. Raises ValueError where they cannot be."""
        if not numbers.size:
            return None
        d = dimension
        if numbers.size != 1 + 3 * d + d * d or not numbers[0] > 0.0:
            raise ValueError("walk")
        mean, path, whitened = numbers[1 : 1 + 3 * d].reshape(3, d)
        return cls(mean, float(numbers[0]), numbers[1 + 3 * d :].reshape(d, d), path, whitened)


def _exponential(x: float) -> float:
    return exp_minus_of(-x) if x < 0.0 else 1.0 / exp_minus_of(x)
