"""Scales of the search: bounds to the last bit, decades evenly, 0 included, there and back."""

from __future__ import annotations

import numpy as np
import pytest

from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.space import DECADES_FROM_ZERO, Space

LOWER, UPPER = [0.01, 0.0, -50.0, 0.2, -1.0], [50.0, 3.0, -0.5, 20.0, 1.0]
SPACE = Space.of_bounds(LOWER, UPPER, [True, True, True, True, False])


def test_the_ends_of_the_scales_are_the_bounds() -> None:
    assert SPACE.at(np.zeros(5)).tolist() == [0.01, 0.0, -0.5, 0.2, -1.0]
    assert SPACE.at(np.ones(5)).tolist() == [50.0, 3.0, -50.0, 20.0, 1.0]


def test_points_stay_within_the_bounds_and_grow_with_their_size() -> None:
    unit = np.linspace(0.0, 1.0, 1001)[:, None] * np.ones(5)
    points = SPACE.at(unit)
    assert ((points >= SPACE.lower) & (points <= SPACE.upper)).all()
    assert (np.diff(np.abs(points[:, :4]), axis=0) > 0).all()


def test_a_logarithmic_scale_gives_each_decade_its_part() -> None:
    wide = Space.of_bounds([1e-3], [1e3], [True])
    assert wide.at(np.array([[0.5], [1 / 6], [5 / 6]]))[:, 0] == pytest.approx([1.0, 1e-2, 1e2])
    from_zero = Space.of_bounds([0.0], [1.0], [True]).at(np.array([[0.25], [0.5], [0.75]]))[:, 0]
    assert from_zero == pytest.approx(10.0 ** (-DECADES_FROM_ZERO * np.array([0.75, 0.5, 0.25])), rel=0.2)


def test_parameters_come_back() -> None:
    unit = np.random.default_rng(0).random((50, 5))
    points = SPACE.at(unit)
    np.testing.assert_allclose(SPACE.of(points), unit, atol=1e-12)
    np.testing.assert_allclose(SPACE.at(SPACE.of(points)), points, rtol=1e-12)


@pytest.mark.parametrize(("scales", "told"), [([True], "one scale"), ([False] * 4 + [True], "through 0")])
def test_scales_that_do_not_fit_the_bounds_are_refused(scales: list[bool], told: str) -> None:
    with pytest.raises(TuningError, match=told):
        Space.of_bounds(LOWER, UPPER, scales)


def test_a_start_out_of_bounds_is_refused() -> None:
    with pytest.raises(TuningError, match="within the bounds"):
        SPACE.checked([[100.0, 0.0, -1.0, 1.0, 0.0]])
