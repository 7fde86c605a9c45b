"""The quadratic model of the HGA's polish."""

from __future__ import annotations

import numpy as np
import pytest

from tdof_npid_ros.tuning.quadratic import coefficients, model_step


def sorted_points(dimension: int, minimum: np.ndarray, hessian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(dimension).uniform(-1.0, 1.0, (3 * coefficients(dimension), dimension))
    offsets = points - minimum
    values = 7.0 + 0.5 * ((offsets @ hessian) * offsets).sum(axis=1)
    order = np.argsort(values)
    return points[order], values[order]


@pytest.mark.parametrize("dimension", [1, 2, 5])
def test_the_minimum_of_a_quadratic_is_found_in_one_step(dimension: int) -> None:
    half = np.random.default_rng(9).standard_normal((dimension, dimension))
    minimum = np.linspace(-0.3, 0.4, dimension)
    points, values = sorted_points(dimension, minimum, half @ half.T + np.eye(dimension))
    centre, shape = model_step(points, values, radius=10.0)
    assert np.allclose(centre, minimum, atol=1e-6)
    assert np.allclose(shape @ shape.T, np.cov(points.T, bias=True), rtol=1e-6)
    assert np.array_equal(shape, np.tril(shape))


def test_a_step_stays_within_the_radius_also_where_the_model_falls_for_ever() -> None:
    points, values = sorted_points(2, np.zeros(2), np.diag([1.0, -2.0]))
    centre, shape = model_step(points, values, radius=0.5)
    assert 0.2 < np.linalg.norm(np.linalg.solve(shape, centre - points[0])) <= 0.5
