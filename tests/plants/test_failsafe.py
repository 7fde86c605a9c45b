"""What an actuator does without its controller: the contract that a real one should keep, too."""

from __future__ import annotations

import numpy as np
import pytest

from tdof_npid_ros.plants.failsafe import FailSafe

MS = 1_000_000  # ns


def test_before_the_first_effort_it_takes_the_fallback_and_is_not_silent() -> None:
    failsafe = FailSafe(1, 100 * MS, 0.3, 100 * MS)
    assert failsafe.effort_at(10_000 * MS) == [0.3]
    assert not failsafe.silent and not failsafe.is_driven


@pytest.mark.parametrize(("fallback", "then"), [(0.0, 0.0), (0.25, 0.25), (None, 1.0)])
def test_after_the_timeout_it_takes_the_fallback_or_holds(fallback: float | None, then: float) -> None:
    failsafe = FailSafe(1, 100 * MS, fallback, 100 * MS)
    failsafe.take(np.ones(1), 0)
    assert failsafe.effort_at(100 * MS) == [1.0] and not failsafe.silent
    assert failsafe.effort_at(101 * MS) == [then] and failsafe.silent


def test_another_fallback_holds_at_once_where_the_fallback_is_in_force() -> None:
    failsafe = FailSafe(1, 100 * MS, 0.0, 100 * MS)
    failsafe.change(100 * MS, 0.5, 100 * MS)
    assert failsafe.effort_at(0) == [0.5]
    failsafe.take(np.ones(1), 0)
    failsafe.change(100 * MS, 0.25, 100 * MS)
    assert failsafe.effort_at(50 * MS) == [1.0]
    assert failsafe.effort_at(101 * MS) == [0.25] and failsafe.silent
    failsafe.change(100 * MS, 0.75, 100 * MS)
    assert failsafe.effort_at(110 * MS) == [0.75]


def test_it_goes_over_to_new_efforts_without_a_jump() -> None:
    failsafe = FailSafe(2, 100 * MS, 0.0, 200 * MS)
    failsafe.take(np.ones(2), 0)
    failsafe.effort_at(101 * MS)
    applied = []
    for ms in range(500, 800, 10):
        assert failsafe.take(np.array([1.0, -2.0]), ms * MS) == (ms == 500)
        applied.append(failsafe.effort_at(ms * MS))
    assert np.max(np.abs(np.diff(applied, axis=0))) <= 2.0 * 10 / 200 + 1e-12
    assert applied[0].tolist() == [0.0, 0.0] and applied[-1].tolist() == [1.0, -2.0]


def test_falling_silent_again_on_the_way_back_holds_what_was_applied() -> None:
    failsafe = FailSafe(1, 100 * MS, None, 1000 * MS)
    failsafe.take(np.zeros(1), 0)
    failsafe.effort_at(101 * MS)
    failsafe.take(np.ones(1), 200 * MS)
    before = failsafe.effort_at(299 * MS)
    assert failsafe.effort_at(301 * MS) == pytest.approx(before, abs=0.01) and failsafe.silent


def test_without_timeout_it_holds_for_ever() -> None:
    failsafe = FailSafe(1, 0, 0.0, 100 * MS)
    failsafe.take(np.ones(1), 0)
    assert failsafe.effort_at(10**15) == [1.0] and not failsafe.silent


def test_the_way_between_the_largest_efforts_is_finite() -> None:
    failsafe = FailSafe(1, 100 * MS, -1.7e308, 100 * MS)
    failsafe.take(np.ones(1), 0)
    failsafe.effort_at(101 * MS)
    failsafe.take(np.full(1, 1.7e308), 200 * MS)
    assert np.isfinite(failsafe.effort_at(250 * MS)).all()
