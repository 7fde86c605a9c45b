"""The quadratic model behind the HGA's polish, in arithmetic whose every bit is the same on every machine.

Only +, -, *, / and sqrt on arrays: BLAS and LAPACK order their sums by the processor they find.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tdof_npid_ros.compiled import entry_point

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
    shape = regularised_cholesky(covariance)
    whitened = forward(shape, np.ascontiguousarray((points - points[0]).T)).T
    gradient, hessian = _fit(whitened, values)
    step = _trust_region_step(gradient, hessian, radius)
    centre = points[0].copy()
    for j in range(dimension):
        centre = centre + shape[:, j] * step[j]
    return centre, shape


def _fit(points: Array, values: Array) -> tuple[Array, Array]:
    """Gradient [d] and Hessian [d, d] at 0 of the least-squares quadratic; better points weigh more."""
    count, dimension = points.shape
    rows, columns = _pairs(dimension)
    terms = np.column_stack([np.ones(count), points, points[:, rows] * points[:, columns]])
    weighted = terms / np.sqrt(1.0 + np.arange(count))[:, None]
    normal = (weighted[:, :, None] * terms[:, None, :]).sum(axis=0)
    factor = regularised_cholesky(normal)
    coefficients = _backward(factor, forward(factor, (weighted * (values - values[0])[:, None]).sum(axis=0)))
    hessian = np.zeros((dimension, dimension))
    hessian[rows, columns] = coefficients[1 + dimension :]
    return coefficients[1 : 1 + dimension], hessian + hessian.T


@lru_cache
def _pairs(dimension: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The variables of each quadratic term."""
    return np.triu_indices(dimension)


def _trust_region_step(gradient: Array, hessian: Array, radius: float) -> Array:
    """Minimise g·s + s·H·s/2 over |s| ≤ radius: the multiplier doubles until the step is short enough."""
    identity = np.eye(gradient.size)
    multiplier = 0.0
    unit = 1e-3 * float(np.abs(hessian).max()) + 1e-300
    while True:
        factor = _cholesky(hessian + multiplier * identity)
        if factor is not None:
            step = -_backward(factor, forward(factor, gradient))
            if float((step * step).sum()) <= radius * radius:
                return step
        multiplier = max(2.0 * multiplier, unit)


def regularised_cholesky(matrix: Array) -> Array:
    """Lower factor of a symmetric matrix [n, n], with as little added to its diagonal as makes it positive definite."""
    ridge = RIDGE
    diagonal = np.diag(matrix) + 1e-300
    while True:
        factor = _cholesky(matrix + np.diag(ridge * diagonal))
        if factor is not None:
            return factor
        ridge *= 10.0


def _cholesky(matrix: Array) -> Array | None:
    """Lower factor of a symmetric matrix, or None where it is not positive definite."""
    lower = np.zeros_like(matrix)
    return lower if _factorise(matrix.copy(), lower) else None


@entry_point
def _factorise(rest: Array, lower: Array) -> bool:
    """Write the lower factor of `rest`, which is used up; False where it is not positive definite."""
    n = len(rest)
    for j in range(n):
        if not rest[j, j] > 0.0:
            return False
        root = np.sqrt(rest[j, j])
        for i in range(j, n):
            lower[i, j] = rest[i, j] / root
        for i in range(j, n):
            for k in range(j, n):
                rest[i, k] -= lower[i, j] * lower[k, j]
    return True


def forward(lower: Array, right: Array) -> Array:
    """Solve L x = right, right [n] or [n, k]."""
    x = right.reshape(len(right), -1).copy()
    _substitute_forward(lower, x)
    return x.reshape(right.shape)


@entry_point
def _substitute_forward(lower: Array, x: Array) -> None:
    n, columns = x.shape
    for j in range(n):
        for k in range(columns):
            x[j, k] /= lower[j, j]
        for i in range(j + 1, n):
            for k in range(columns):
                x[i, k] -= lower[i, j] * x[j, k]


def _backward(lower: Array, right: Array) -> Array:
    """Solve Lᵀ x = right, right [n]."""
    x = right.copy()
    _substitute_backward(lower, x)
    return x


@entry_point
def _substitute_backward(lower: Array, x: Array) -> None:
    for j in range(len(x) - 1, -1, -1):
        x[j] /= lower[j, j]
        for i in range(j):
            x[i] -= lower[j, i] * x[j]
