"""The behaviours that control_toolbox's `pid_tests` pin down, as statements about our equivalents.

Where theirs is a time step given with each call, ours is the sample period; their `i_term` is our term `integral`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import AntiWindup, Gains, GainsError
from tdof_npid_ros.control.law import TERMS, tracking_time
from tdof_npid_ros.control.session import OutputSequence, Place
from tdof_npid_ros.parameters import sample_period_in_ns

H = 1.0  # s: as there, so that an error of 1 adds ki to the integral action
PERIOD_NS = 1_000_000_000


def run(gains: Gains, errors: Sequence[float]) -> tuple[list[float], list[float]]:
    """Efforts, and the integral action after each answer, for a setpoint of 0 and outputs -error."""
    controller = Controller(gains, PERIOD_NS)
    efforts, integrals = [], []
    for k, error in enumerate(errors):
        controller.answer(k * PERIOD_NS, np.zeros(1), np.array([-error]))
        efforts.append(float(controller.effort[0]))
        integrals.append(float(controller.integral[0]))
    return efforts, integrals


@pytest.mark.parametrize(
    "wrong",
    [
        {"integral_min": 1.0, "integral_max": -1.0},
        {"effort_min": 1.0, "effort_max": -1.0},
        {"kp": math.nan}, {"ki": math.inf}, {"kd": -math.inf}, {"effort_max": math.nan},
        {"tracking_time": -1.0}, {"anti_windup": "unknown"},
    ],
    ids=str,
)  # fmt: skip
def test_invalid_gains_are_refused_and_the_old_ones_stay(wrong: dict[str, object]) -> None:
    controller = Controller(Gains("pid", kp=1.0, ki=2.0), PERIOD_NS)
    with pytest.raises(GainsError):
        controller.change_gains(controller.gains.with_values(**wrong))
    assert controller.gains == Gains("pid", kp=1.0, ki=2.0)


def test_equal_limits_are_valid() -> None:
    efforts, _ = run(Gains("pid", kp=1.0, effort_min=0.5, effort_max=0.5), [1.0, -1.0])
    assert efforts == [0.5, 0.5]


def test_gains_that_are_set_are_the_gains_that_are_read_and_copies_are_independent() -> None:
    gains = Gains("pid", kp=1.0, ki=2.0, kd=3.0, integral_max=5.0, integral_min=-5.0)
    one, other = Controller(gains, PERIOD_NS), Controller(gains, PERIOD_NS)
    one.answer(0, np.ones(1), np.zeros(1))
    assert other.integral[0] == 0.0
    other.change_gains(gains.with_values(kp=9.0))
    assert one.gains == gains


def test_proportional_action_alone() -> None:
    assert run(Gains("pid", kp=10.0), [-0.5, 0.0, 1.0])[0] == [-5.0, 0.0, 10.0]


def test_integral_action_alone_adds_up_the_errors_of_the_samples_before() -> None:
    efforts, integrals = run(Gains("pid", kp=0.0, ki=10.0), [-0.5, -0.5, 0.0, 1.0])
    assert efforts == [0.0, -5.0, -10.0, -10.0]
    assert integrals == [-5.0, -10.0, -10.0, 0.0]


def test_derivative_action_alone_answers_changes_only() -> None:
    efforts, _ = run(Gains("pid", kp=1e-9, kd=10.0, n=1e15), [0.0, 0.5, 0.5, -0.5])
    assert efforts == pytest.approx([0.0, 5.0, 0.0, -10.0], abs=1e-6)


def test_the_three_actions_add_up() -> None:
    errors = [0.5, 0.5, 1.0, -0.2]
    gains = Gains("pid", kp=2.0, ki=0.7, kd=0.3, n=20.0)
    controller = Controller(gains, PERIOD_NS)
    for k, error in enumerate(errors):
        controller.answer(k * PERIOD_NS, np.zeros(1), np.array([-error]))
        p, i, d, raw = (controller.terms[TERMS.index(t), 0] for t in ("proportional", "integral", "derivative",
        "unlimited_effort"))  # fmt: skip
        assert controller.effort[0] == raw == p + i + d


@pytest.mark.parametrize("anti_windup", ["none", "conditional", "back_calculation"])
def test_the_effort_keeps_its_limits_in_both_directions(anti_windup: str) -> None:
    gains = Gains("pid", kp=1.0, ki=1.0, effort_min=-1.0, effort_max=1.0, anti_windup=anti_windup)  # type: ignore[arg-type]
    efforts, _ = run(gains, [5.0] * 5 + [-5.0] * 9)
    assert max(efforts) == 1.0
    assert min(efforts) == -1.0


def test_without_limits_the_effort_is_not_clamped() -> None:
    errors = [0.5, 1.0, 2.0, 10.0, 50.0, 100.0, -0.5, -1.0, -2.0, -10.0, -50.0, -100.0]
    assert run(Gains("pid", kp=1.0, anti_windup="none"), errors)[0] == errors


def test_integral_clamp_holds_in_both_directions() -> None:
    _, integrals = run(Gains("pid", kp=0.0, ki=1.0, integral_min=-1.0, integral_max=1.0), [-10.0, -10.0, 30.0, 30.0])
    assert integrals == [-1.0, -1.0, 1.0, 1.0]


@pytest.mark.parametrize("anti_windup", ["none", "conditional", "back_calculation"])
def test_without_integral_gain_nothing_is_integrated_or_tracked(anti_windup: AntiWindup) -> None:
    gains = Gains("pid", kp=0.0, integral_min=-1.0, integral_max=1.0, effort_min=-20.0, effort_max=20.0,
                  anti_windup=anti_windup)  # fmt: skip
    efforts, integrals = run(gains, [-1.0, -1.0, -1.0, 10.0, 10.0, 10.0])
    assert efforts == integrals == [0.0] * 6


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_clamped_integral_leaves_its_bound_with_the_first_error_of_the_other_sign(sign: float) -> None:
    gains = Gains("pid", kp=0.0, ki=2.0 * sign, integral_min=-1.0, integral_max=1.0)
    _, integrals = run(gains, [sign * e for e in (-1.0, -1.0, 0.5, 0.0)])
    assert integrals == [-1.0, -1.0, 0.0, 0.0]


def test_conditional_integration_stops_only_what_drives_further_into_the_limit() -> None:
    gains = Gains("pid", kp=1.0, ki=1.0, effort_min=-2.0, effort_max=2.0, anti_windup="conditional")
    efforts, integrals = run(gains, [3.0, 3.0, 1.0, 1.0, -0.5, -0.5])
    assert integrals[:2] == [0.0, 0.0]  # saturated, and the error drives on
    assert integrals[2:] == [1.0, 2.0, 1.5, 1.0]  # at the limit but not beyond it; then back at once
    assert efforts == [2.0, 2.0, 1.0, 2.0, 1.5, 1.0]


def test_conditional_integration_through_saturation_and_back() -> None:
    gains = Gains("pid", kp=0.0, ki=1.0, effort_min=-5.0, effort_max=5.0, anti_windup="conditional")
    efforts, integrals = run(gains, [1.0, 2.0, 3.0, 1.0, 2.0, -1.0, 0.0])
    assert efforts == [0.0, 1.0, 3.0, 5.0, 5.0, 5.0, 5.0]
    assert integrals == [1.0, 3.0, 6.0, 6.0, 6.0, 5.0, 5.0]


def test_back_calculation_through_saturation_and_back() -> None:
    gains = Gains("pid", kp=0.0, ki=1.0, effort_min=-5.0, effort_max=5.0, anti_windup="back_calculation",
                  tracking_time=1.0)  # fmt: skip
    errors = [1.0, 2.0, 3.0, 1.0, 2.0, -1.0, 1.0]
    efforts, integrals = run(gains, errors)
    assert efforts[:6] == [0.0, 1.0, 3.0, 5.0, 5.0, 5.0] and efforts[6] < 5.0
    for before, error, after in zip([0.0, *integrals], errors, integrals, strict=False):
        excess = before - min(before, 5.0)
        assert after == pytest.approx(before + error - (1.0 - math.exp(-1.0)) * excess)


def test_back_calculation_pulls_the_integral_action_towards_the_limit_at_its_tracking_rate() -> None:
    gains = Gains("pid", kp=1.0, ki=1.0, effort_max=2.0, anti_windup="back_calculation", tracking_time=4.0)
    efforts, integrals = run(gains, [3.0, 3.0])
    share = 1.0 - math.exp(-H / 4.0)  # exact for the continuous law u_i' = ki e + (u - raw)/T_t
    assert integrals[0] == pytest.approx(3.0 + share * (2.0 - 3.0))
    assert integrals[1] == pytest.approx(integrals[0] + 3.0 + share * (2.0 - (3.0 + integrals[0])))
    assert efforts == [2.0, 2.0]


@pytest.mark.parametrize(
    ("gains", "expected"),
    [
        (Gains("pid", kp=4.0, ki=1.0, kd=9.0), 3.0),  # sqrt(kd/ki)
        (Gains("pid", kp=4.0, ki=2.0), 2.0),  # kp/ki without derivative action
        (Gains("pid", kp=4.0), math.inf),  # nothing to track
        (Gains("pid", kp=4.0, ki=1.0, kd=9.0, tracking_time=0.5), 0.5),
    ],
)
def test_default_tracking_time_is_that_of_control_toolbox(gains: Gains, expected: float) -> None:
    assert tracking_time(gains)[0] == expected


def test_reset_forgets_the_integral_action_unless_it_is_saved() -> None:
    controller = Controller(Gains("pid", kp=1.0, ki=1.0), PERIOD_NS)
    for k in range(3):
        controller.answer(k * PERIOD_NS, np.ones(1), np.zeros(1))
    saved = controller.integral
    controller.reset()
    controller.answer(0, np.ones(1), np.zeros(1))
    assert controller.effort[0] == 1.0
    controller.begin_within(np.zeros(1), saved)
    controller.answer(9 * PERIOD_NS, np.ones(1), np.zeros(1))
    assert controller.effort[0] == 1.0 + saved[0]


def test_no_time_passed_is_the_same_answer_and_no_integration() -> None:
    controller = Controller(Gains("pid", kp=1.0, ki=1.0), PERIOD_NS)
    controller.answer(5, np.ones(1), np.zeros(1))
    before, integral = controller.effort[0], controller.integral[0]
    assert controller.answer(5, np.full(1, 7.0), np.zeros(1))[0] == before
    assert (controller.effort[0], controller.integral[0]) == (before, integral)


def test_time_that_goes_back_is_not_answered() -> None:
    sequence, decisions = OutputSequence(PERIOD_NS), []
    for stamp in (10, 20, 15, 20, 30):
        decisions.append(sequence.judge(Place(None, stamp)).decision)
        if decisions[-1] in ("join", "new"):
            sequence.accept(Place(None, stamp))
    assert decisions == ["join", "new", "late", "same", "new"]


@pytest.mark.parametrize("period", [0.0, -0.01, math.nan, math.inf, "fast", True])
def test_time_steps_that_are_zero_negative_or_no_number_are_refused(period: object) -> None:
    with pytest.raises(ValueError, match="sample_period"):
        sample_period_in_ns(period)


def test_saved_or_forgotten_the_integral_action_is_as_after_their_resets() -> None:
    controller = Controller(Gains("pid", kp=0.0, ki=1.0), PERIOD_NS)
    controller.answer(0, np.full(1, 0.5), np.zeros(1))
    controller.answer(PERIOD_NS, np.zeros(1), np.zeros(1))
    assert controller.effort[0] == 0.5
    saved = controller.integral
    controller.begin_within(np.zeros(1), saved)  # reset(save_i_term=true)
    controller.answer(2 * PERIOD_NS, np.zeros(1), np.zeros(1))
    assert controller.effort[0] == 0.5
    controller.reset()  # reset(save_i_term=false)
    controller.answer(0, np.zeros(1), np.zeros(1))
    assert controller.effort[0] == 0.0


def test_inputs_of_zero_gains_give_no_effort() -> None:
    assert run(Gains("pid", kp=0.0), [5.0, -3.0])[0] == [0.0, 0.0]
