"""The walk goes along a bent valley with kinked sides to its end, within 0 to 1, and is its numbers."""

import numpy as np
import pytest

from tdof_npid_ros.tuning.quadratic import Array
from tdof_npid_ros.tuning.walk import LEAST_SAMPLES, Walk


def bent_kinked_valley(x: Array) -> Array:
    """0 at 0.8 in the first parameter, along a valley a thousandth wide."""
    off = np.abs(x[:, 1:] - 0.2 - 0.5 * x[:, :1] ** 2).sum(axis=1)
    return np.asarray(np.abs(x[:, 0] - 0.8) + 30.0 * off)


def test_it_goes_along_a_bent_valley_to_its_end() -> None:
    for seed in range(5):
        walk, random = Walk.begun_at(np.array([0.2, 0.22, 0.22])), np.random.default_rng(seed)
        best = np.inf
        for _ in range(400):
            points = walk.samples(random, 6)
            values = bent_kinked_valley(points)
            walk, best = walk.moved(points[np.argsort(values)]), min(best, float(values.min()))
        assert best < 0.01


def test_samples_are_within_the_bounds_and_at_least_eight() -> None:
    walk, random = Walk.begun_at(np.array([0.0, 1.0])), np.random.default_rng(1)
    assert len(walk.samples(random, 20)) == 20
    points = walk.samples(random, 1)
    assert len(points) == LEAST_SAMPLES
    assert ((points >= 0.0) & (points <= 1.0)).all()


def test_a_walk_is_its_numbers() -> None:
    walk, random = Walk.begun_at(np.array([0.3, 0.6])), np.random.default_rng(1)
    for _ in range(5):
        walk = walk.moved(walk.samples(random, 8))
    again = Walk.of_numbers(walk.numbers(), 2)
    assert again is not None
    np.testing.assert_array_equal(again.samples(np.random.default_rng(2), 8), walk.samples(np.random.default_rng(2), 8))
    assert Walk.of_numbers(np.empty(0), 2) is None
    with pytest.raises(ValueError, match="walk"):
        Walk.of_numbers(walk.numbers()[:-1], 2)
