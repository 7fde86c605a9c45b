"""The sampled law says what the paper's equations say."""

import math

import numpy as np
import pytest

from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.exponential import exp_minus
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, Gains, GainsError

PERIOD_NS = 10_000_000
H = 0.01


def answers(gains: Gains, setpoint: list[float], output: list[float]) -> list[float]:
    controller = Controller(gains, PERIOD_NS)
    efforts = []
    for k, (r, y) in enumerate(zip(setpoint, output, strict=True)):
        controller.answer(k * PERIOD_NS, np.full(gains.lanes, r), np.full(gains.lanes, y))
        efforts.append(float(controller.effort[0]))
    return efforts


def test_exp_minus_is_within_two_units_in_the_last_place() -> None:
    for q in np.concatenate([np.linspace(0, 1, 2001), np.linspace(0, 700, 20001)]):
        exact = math.exp(-q)
        assert abs(exp_minus(float(q)) - exact) <= 2 * math.ulp(exact)
    assert exp_minus(0.0) == 1.0


def test_exp_minus_of_anything_large_is_finite_and_negligible() -> None:
    for q in (701.0, 1e10, 1e300, math.inf):
        assert 0.0 < exp_minus(q) < 1e-300


def test_proportional_action_weighs_the_setpoint_by_one_minus_alpha() -> None:
    assert answers(Gains("tdof_npid1", kp=2.0, alpha=0.25), [1.0], [0.5]) == [2.0 * (0.75 * 1.0 - 0.5)]
    assert answers(Gains("npid", kp=2.0, alpha=0.25), [1.0], [0.5]) == [2.0 * (1.0 - 0.5)]


def test_integral_action_scales_the_error_by_the_gaussian_gain() -> None:
    e, sigma = 0.8, 0.5
    _, second = answers(Gains("npid", kp=1e-300, ki=3.0, sigma=sigma), [e, e], [0.0, 0.0])
    assert second == pytest.approx(3.0 * H * math.exp(-(e**2) / (2 * sigma**2)) * e, rel=1e-14)
    _, linear = answers(Gains("pid", kp=1e-300, ki=3.0, sigma=sigma), [e, e], [0.0, 0.0])
    assert linear == pytest.approx(3.0 * H * e, rel=1e-14)


def test_derivative_action_delivers_the_filters_exact_integral_under_a_held_input() -> None:
    """The sum of h·u_d over all time is K_d·Δe_d, whatever the ratio of h to the filter's time."""
    for kd in (1e-4, 0.01, 1.0, 100.0):
        steps = 5000 if kd < 50 else 200_000
        efforts = answers(Gains("pid", kp=1.0, kd=kd), [1.0] * steps, [0.0] * steps)
        assert sum(u - 1.0 for u in efforts) * H == pytest.approx(kd, rel=1e-6)


def test_derivative_action_becomes_the_backward_difference_for_a_fast_filter() -> None:
    first, second, third = answers(Gains("pid", kp=1.0, kd=1e-3), [0.0, 1.0, 1.0], [0.0] * 3)
    assert (first, third) == (0.0, pytest.approx(1.0))
    assert second == pytest.approx(1.0 + 1e-3 / H)


def test_beta_weighs_the_setpoint_in_the_derivative_action_alone() -> None:
    full = answers(Gains("tdof_npid2", kp=1.0, kd=0.5, beta=1.0), [0.0, 1.0], [0.0, 0.0])
    assert full == [0.0, 1.0]
    ignored = answers(Gains("tdof_npid1", kp=1.0, kd=0.5, beta=1.0), [0.0, 1.0], [0.0, 0.0])
    assert ignored == answers(Gains("npid", kp=1.0, kd=0.5), [0.0, 1.0], [0.0, 0.0])


def test_changing_ki_does_not_make_the_effort_jump() -> None:
    controller = Controller(Gains("pid", kp=1.0, ki=5.0), PERIOD_NS)
    r, y = np.ones(1), np.zeros(1)
    for k in range(100):
        controller.answer(k * PERIOD_NS, r, y)
    before = controller.effort[0] + 5.0 * H
    controller.change_gains(controller.gains.with_values(ki=50.0))
    controller.answer(100 * PERIOD_NS, r, y)
    assert controller.effort[0] == pytest.approx(before, rel=1e-12)


def test_the_same_stamp_gets_the_same_answer_and_no_state_advances() -> None:
    once, twice = (Controller(Gains("tdof_npid2", kp=2.0, ki=3.0, kd=1.0), PERIOD_NS) for _ in range(2))
    rng = np.random.default_rng(0)
    for k, y in enumerate(rng.normal(size=50)):
        expected = once.answer(k * PERIOD_NS, np.ones(1), np.array([y]))[0]
        assert twice.answer(k * PERIOD_NS, np.ones(1), np.array([y]))[0] == expected
        assert twice.answer(k * PERIOD_NS, np.zeros(1), np.array([-y]))[0] == expected


@pytest.mark.parametrize("strategy", ["none", "conditional", "back_calculation"])
def test_effort_stays_within_its_limits(strategy: str) -> None:
    gains = Gains("pid", kp=5.0, ki=20.0, kd=1.0, effort_min=-1.0, effort_max=2.0, anti_windup=strategy)  # type: ignore[arg-type]
    efforts = answers(gains, [1.0] * 200 + [-1.0] * 200, [0.0] * 400)
    assert max(efforts) == 2.0
    assert min(efforts) == -1.0


def test_anti_windup_lets_the_effort_leave_its_limit_at_once() -> None:
    def steps_at_the_limit(strategy: str) -> int:
        gains = Gains("pid", kp=1.0, ki=10.0, effort_max=2.0, anti_windup=strategy)  # type: ignore[arg-type]
        efforts = answers(gains, [1.0] * 300 + [-0.5] * 300, [0.0] * 600)
        return sum(u == 2.0 for u in efforts[300:])

    assert steps_at_the_limit("none") > 100
    assert steps_at_the_limit("conditional") == 0
    assert steps_at_the_limit("back_calculation") == 0


def test_integral_action_stays_within_its_clamp() -> None:
    gains = Gains("pid", kp=1e-300, ki=1.0, integral_min=-0.1, integral_max=0.2)
    assert answers(gains, [1.0] * 1000, [0.0] * 1000)[-1] == 0.2
    assert answers(gains, [-1.0] * 1000, [0.0] * 1000)[-1] == -0.1


def test_reverse_action_mirrors_direct_action() -> None:
    direct = answers(Gains("tdof_npid2", kp=2.0, ki=1.0, kd=0.5, alpha=0.2, beta=0.3), [1.0] * 50, [0.3] * 50)
    reverse = answers(Gains("tdof_npid2", kp=-2.0, ki=-1.0, kd=-0.5, alpha=0.2, beta=0.3), [1.0] * 50, [0.3] * 50)
    assert reverse == [-u for u in direct]


@pytest.mark.parametrize("kind", CONTROLLER_TYPES)
def test_each_lane_answers_as_if_it_were_alone(kind: str) -> None:
    rng = np.random.default_rng(1)
    kp, ki = rng.uniform(0.5, 3, 5), rng.uniform(0, 2, 5)
    together = Controller(Gains(kind, tuple(kp), tuple(ki), 0.4, 0.2, 0.1), PERIOD_NS)  # type: ignore[arg-type]
    alone = [Controller(Gains(kind, a, b, 0.4, 0.2, 0.1), PERIOD_NS) for a, b in zip(kp, ki, strict=True)]  # type: ignore[arg-type]
    for k in range(200):
        y = rng.normal(size=5)
        together.answer(k * PERIOD_NS, np.ones(5), y)
        for j, controller in enumerate(alone):
            controller.answer(k * PERIOD_NS, np.ones(1), y[j : j + 1])
            assert controller.effort[0] == together.effort[j]


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"kp": math.nan}, "kp"),
        ({"kp": "2"}, "kp"),
        ({"kp": True}, "kp"),
        ({"kp": ()}, "kp"),
        ({"ki": math.inf}, "ki"),
        ({"sigma": 0.0}, "sigma"),
        ({"n": 0.0}, "n is"),
        ({"kp": 0.0, "kd": 1.0}, "kd"),
        ({"kp": 1.0, "ki": -1.0}, "sign"),
        ({"kp": (1.0, 2.0), "ki": (1.0, 2.0, 3.0)}, "lanes"),
        ({"effort_min": 1.0, "effort_max": 0.0}, "effort_min"),
        ({"anti_windup": "maybe"}, "anti_windup"),
        ({"type": "p"}, "type"),
        ({"tracking_time": -1.0}, "tracking_time"),
    ],
)
def test_gains_that_make_no_controller_are_refused_with_the_reason(values: dict[str, object], word: str) -> None:
    with pytest.raises(GainsError, match=word):
        Gains(**values)  # type: ignore[arg-type]
