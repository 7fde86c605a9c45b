"""The quadratic model behind the HGA's polish, in arithmetic whose every bit is the same on every machine.

Only +, -, *, / and sqrt on arrays: BLAS and LAPACK order their sums by the processor they find.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RIDGE = 1e-9
"""Relative to the diagonal: keeps the fit defined when the points lie in a plane."""


def coefficients(dimension: int) -> int:
    """How many coefficients a quadratic in so many variables has."""
    return (dimension + 1) * (dimension + 2) // 2


def model_step(points: Array, values: Array, radius: float) -> tuple[Array, Array]:
    """Where a quadratic fitted to the points is lowest, and the shape of the cloud they form.

    Args:
        points: [m, d], best first.
        values: [m], ascending.
        radius: how far from the best point the model is trusted, in standard deviations of the cloud.

    Returns:
        centre: [d], the model's minimum within the radius.
        shape: [d, d], lower Cholesky factor of the cloud's covariance.
    """
    dimension = points.shape[1]
    offsets = points - points.sum(axis=0) / len(points)
    covariance = (offsets[:, :, None] * offsets[:, None, :]).sum(axis=0) / len(points)
    shape = _regularised_cholesky(covariance)
    whitened = _forward(shape, np.ascontiguousarray((points - points[0]).T)).T
    gradient, hessian = _fit(whitened, values)
    step = _trust_region_step(gradient, hessian, radius)
    centre = points[0].copy()
    for j in range(dimension):
        centre = centre + shape[:, j] * step[j]
    return centre, shape


def _fit(points: Array, values: Array) -> tuple[Array, Array]:
    """Gradient [d] and Hessian [d, d] at 0 of the least-squares quadratic; better points weigh more."""
    count, dimension = points.shape
    rows, columns = np.triu_indices(dimension)
    terms = np.column_stack([np.ones(count), points, points[:, rows] * points[:, columns]])
    weighted = terms / np.sqrt(1.0 + np.arange(count))[:, None]
    normal = (weighted[:, :, None] * terms[:, None, :]).sum(axis=0)
    factor = _regularised_cholesky(normal)
    coefficients = _backward(factor, _forward(factor, (weighted * (values - values[0])[:, None]).sum(axis=0)))
    hessian = np.zeros((dimension, dimension))
    hessian[rows, columns] = coefficients[1 + dimension :]
    return coefficients[1 : 1 + dimension], hessian + hessian.T


def _trust_region_step(gradient: Array, hessian: Array, radius: float) -> Array:
    """Minimise g·s + s·H·s/2 over |s| ≤ radius: the multiplier doubles until the step is short enough."""
    identity = np.eye(gradient.size)
    multiplier = 0.0
    unit = 1e-3 * float(np.abs(hessian).max()) + 1e-300
    while True:
        factor = _cholesky(hessian + multiplier * identity)
        if factor is not None:
            step = -_backward(factor, _forward(factor, gradient))
            if float((step * step).sum()) <= radius * radius:
                return step
        multiplier = max(2.0 * multiplier, unit)


def _regularised_cholesky(matrix: Array) -> Array:
    ridge = RIDGE
    diagonal = np.diag(matrix) + 1e-300
    while True:
        factor = _cholesky(matrix + np.diag(ridge * diagonal))
        if factor is not None:
            return factor
        ridge *= 10.0


def _cholesky(matrix: Array) -> Array | None:
    """Lower factor of a symmetric matrix, or None where it is not positive definite."""
    rest = matrix.copy()
    lower = np.zeros_like(rest)
    for j in range(len(rest)):
        pivot = rest[j, j]
        if not pivot > 0.0:
            return None
        lower[j:, j] = rest[j:, j] / np.sqrt(pivot)
        rest[j:, j:] -= lower[j:, j, None] * lower[None, j:, j]
    return lower


def _forward(lower: Array, right: Array) -> Array:
    """Solve L x = right, right [n] or [n, k]."""
    x = right.copy()
    for j in range(len(lower)):
        x[j] = x[j] / lower[j, j]
        x[j + 1 :] -= np.multiply.outer(lower[j + 1 :, j], x[j])
    return x


def _backward(lower: Array, right: Array) -> Array:
    """Solve Lᵀ x = right, right [n]."""
    x = right.copy()
    for j in range(len(lower) - 1, -1, -1):
        x[j] = x[j] / lower[j, j]
        x[:j] -= lower[j, :j] * x[j]
    return x
