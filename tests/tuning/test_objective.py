"""The objective (10): finite, ordered, and the same bits on any number of cores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.loop import Integrals
from tdof_npid_ros.plants import linear
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array
from tdof_npid_ros.tuning.objective import LARGEST_IAE, Objective, objective_values
from tdof_npid_ros.tuning.problem import TuningProblem

SHORT = {"setpoint": ("0 setpoint 1", "5 end"), "disturbance": ("0 disturbance 1", "5 end")}
CASE = replace(load_case("p3-c1"), episodes=SHORT)
PROBLEM = TuningProblem(CASE, "tdof_npid2")


def integrals(iae: list[float], finite_fraction: list[float]) -> Integrals:
    return without_rest(np.array(iae), np.array(finite_fraction))


def without_rest(iae: Array, finite_fraction: Array) -> Integrals:
    return Integrals(iae, finite_fraction, *np.zeros((3, len(iae))))


def candidates(count: int) -> Array:
    lower, upper = np.array(PROBLEM.bounds).T
    return lower + np.random.default_rng(5).random((count, len(lower))) * (upper - lower)


def test_the_objective_is_the_weighted_sum_of_both_episodes() -> None:
    values = objective_values(integrals([2.0, 3.0], [1.0, 1.0]), integrals([0.25, 0.5], [1.0, 1.0]), weight=2.0)
    assert values.tolist() == [2.5, 4.0]


def test_a_lane_that_diverged_later_costs_less_and_any_sound_lane_costs_less_still() -> None:
    shares = [0.0, 0.1, 0.5, 0.999, 1.0, 1.0, 1.0, 1.0]
    iaes = [1e99, 1e100, 1e101, 1e102, 1e99, 1e40, 2e30, 3.0]
    values = objective_values(integrals(iaes, shares), integrals([1.0] * 8, [1.0] * 8), weight=1.0)
    assert np.all(np.diff(values) < 0)


def test_the_order_of_useless_but_finite_errors_is_kept() -> None:
    iaes = np.sort(
        np.concatenate([10.0 ** np.arange(-300.0, 300.0, 3.7), LARGEST_IAE * np.array([0.9999, 1.0, 1.0001])])
    )
    values = objective_values(without_rest(iaes, np.ones_like(iaes)), without_rest(0 * iaes, np.ones_like(iaes)), 1.0)
    assert np.all(np.diff(values) > 0)
    assert np.array_equal(values[iaes <= LARGEST_IAE], iaes[iaes <= LARGEST_IAE])


@pytest.mark.parametrize("iae", [np.nan, np.inf, 1e308])
def test_the_objective_is_finite_whatever_was_measured(iae: float) -> None:
    values = objective_values(integrals([iae, iae], [1.0, 0.3]), integrals([1.0, iae], [1.0, 1.0]), weight=1.0)
    assert np.isfinite(values).all()
    assert (values >= LARGEST_IAE).all()


def test_the_objective_of_candidates_is_what_the_case_gives_for_their_gains() -> None:
    some = candidates(5)
    for candidate, value in zip(some, Objective(PROBLEM)(some).objective, strict=True):
        gains = PROBLEM.gains(candidate)
        setpoint, disturbance = CASE.setpoint_response(gains), CASE.disturbance_response(gains)
        if value < LARGEST_IAE:
            assert value == setpoint.iae + disturbance.iae


def test_unstable_candidates_get_a_finite_penalty() -> None:
    case = replace(CASE, bounds={**CASE.bounds, "kp": (0.1, 1e6)})
    problem = TuningProblem(case, "pid")
    scores = Objective(problem)(np.array([[1.0, 0.5, 1.0], [1e6, 0.5, 1.0], [1e5, 0.5, 1.0]]))
    assert np.isfinite(scores.values).all()
    assert scores.objective[0] < LARGEST_IAE < scores.objective[2] < scores.objective[1]
    assert scores.values[0] < scores.values[2] < scores.values[1]


@pytest.mark.parametrize("count", [1, 2, 6, 40, 100])
def test_values_do_not_depend_on_the_number_of_threads(count: int) -> None:
    some = candidates(count)
    one, *others = (Objective(PROBLEM, threads)(some).values for threads in (1, 2, 3, 8))
    assert one.shape == (count,)
    for other in others:
        assert np.array_equal(one, other)


def test_the_first_values_of_a_process_are_the_same_on_any_number_of_threads() -> None:
    some, values = candidates(64), []
    for threads in (1, 8, 8, 8):
        linear._sample.cache_clear()  # mpmath's precision is global: threads that discretise at once spoil it
        values.append(Objective(PROBLEM, threads)(some).values)
    assert all(np.array_equal(values[0], other) for other in values)


def test_values_do_not_depend_on_the_company_of_other_candidates() -> None:
    some = candidates(20)
    objective = Objective(PROBLEM)
    assert np.array_equal(
        objective(some).values, np.concatenate([objective(some[i : i + 1]).values for i in range(20)])
    )


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        ({"kp": (0.0, 5.0)}, "kp must stay above 0"),
        ({"kp": (-1.0, 5.0)}, "kp must stay above 0"),
        ({"ki": (-1.0, 5.0)}, "kp must stay above 0"),
        ({"kp": (-5.0, -1.0)}, "kp must stay above 0"),
        ({"sigma": (0.0, 5.0)}, "sigma"),
    ],
)
def test_bounds_that_hold_invalid_gains_are_refused(bounds: dict[str, tuple[float, float]], told: str) -> None:
    with pytest.raises(TuningError, match=told):
        TuningProblem(replace(CASE, bounds={**CASE.bounds, **bounds}), "npid", ("sigma",))


def test_a_reverse_acting_controller_can_be_tuned() -> None:
    bounds = {"kp": (-5.0, -0.1), "ki": (-2.0, 0.0), "kd": (-3.0, 0.0)}
    case = replace(CASE, plant_values={**CASE.plant_values, "gain": -1.0}, bounds=bounds)
    reverse = Objective(TuningProblem(case, "npid"))(np.array([[-1.2, -0.5, -1.0]])).objective
    direct = Objective(TuningProblem(CASE, "npid"))(np.array([[1.2, 0.5, 1.0]])).objective
    assert reverse == pytest.approx(direct, rel=1e-12)


@pytest.mark.parametrize(("name", "told"), [("episodes", "no episode 'setpoint'"), ("bounds", r"no bounds\.kp")])
def test_a_case_that_lacks_something_is_refused(name: str, told: str) -> None:
    with pytest.raises(TuningError, match=told):
        TuningProblem(replace(CASE, **{name: {}}), "pid")
