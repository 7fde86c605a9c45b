"""First gains by published rules: the rules' own examples, and loops that are stable with room to spare."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.loop import simulate
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.scenario import parse_plan
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.rules import RuleGains, imc_oscillating, simc, unstable_first_order


def step_response(plant: TransferFunction, rule: RuleGains, period: float, end: float) -> np.ndarray:
    gains = Gains("pid", rule.kp, rule.ki, rule.kd)
    steps = round(end / period)
    plan = parse_plan(["0 setpoint 1", f"{steps * period!r} end"], round(period * 1e9), {})
    return simulate(lambda _: plant, gains, plan.sampled(round(period * 1e9)), (-math.inf, math.inf)).output[:, 0]


def test_simc_gives_the_settings_of_its_paper() -> None:
    first = simc(1.0, [10.0], 1.0)
    assert (first.kp, first.kp / first.ki, first.kd) == pytest.approx((5.0, 8.0, 0.0))
    second = simc(1.0, [1.0, 20.0], 1.0)  # series form: 10, 8 s, 1 s
    assert (second.kp, second.kp / second.ki, second.kd) == pytest.approx((10 * (1 + 1 / 8), 9.0, 10.0))
    integrating = simc(0.5, [], 2.0, integrating=True)
    assert (integrating.kp, integrating.kp / integrating.ki) == pytest.approx((0.5, 16.0))
    assert simc(1.0, [], 2.0).ki == pytest.approx(0.25)


def test_simc_halves_what_it_neglects() -> None:
    assert simc(1.0, [4.0, 2.0, 1.0, 0.2], 0.3) == simc(1.0, [4.0, 2.5], 1.0)


def test_a_zero_counts_as_dead_time_or_cancels_a_lag() -> None:
    assert simc(1.0, [4.0], 1.0, zero=-0.5) == simc(1.0, [4.0], 1.5)
    assert simc(1.0, [4.0, 2.0], 1.0, zero=1.5) == simc(1.0, [4.0, 0.5], 1.0)
    assert simc(1.0, [4.0, 2.0], 1.0, zero=8.0) == simc(2.0, [2.0], 1.0)


@pytest.mark.parametrize("gain", [0.02, -3.0])
@pytest.mark.parametrize("ratio", [0.0, 0.05, 0.3, 1.0, 5.0])
def test_loops_by_rule_settle(gain: float, ratio: float) -> None:
    period, dead_time = 0.02, ratio * 2.0
    plants = [
        (TransferFunction((gain,), (2.0, 1.0), dead_time), simc(gain, [2.0], dead_time, sample_period=period)),
        (
            TransferFunction((gain,), (3.0, 4.0, 1.0), dead_time),
            simc(gain, [1.0, 3.0], dead_time, sample_period=period),
        ),
        (
            TransferFunction((gain,), (1.0, 0.0), dead_time),
            simc(gain, [], dead_time, integrating=True, sample_period=period),
        ),
        (
            TransferFunction((gain,), (2.0, 1.0, 0.0), dead_time),
            simc(gain, [2.0], dead_time, integrating=True, sample_period=period),
        ),
        (
            TransferFunction((gain,), (4.0, 1.2, 1.0), dead_time),
            imc_oscillating(gain, 2.0, 0.3, dead_time, sample_period=period),
        ),
        (
            TransferFunction((-gain, gain), (1.0, 3.0, 3.0, 1.0), dead_time),
            simc(gain, [1.0, 1.0, 1.0], dead_time, zero=-1.0, sample_period=period),
        ),
    ]
    for plant, rule in plants:
        y = step_response(plant, rule, period, 60.0 * (1.0 + dead_time))
        assert np.all(np.abs(y[-len(y) // 10 :] - 1.0) < 0.02), (plant, rule)
        assert y.max() < 1.6, (plant, rule)


@pytest.mark.parametrize("ratio", [0.0, 0.1, 0.4, 0.6])
def test_an_unstable_process_is_held(ratio: float) -> None:
    plant = TransferFunction((2.0,), (5.0, -1.0), 5.0 * ratio)
    y = step_response(plant, unstable_first_order(2.0, 5.0, 5.0 * ratio, sample_period=0.02), 0.02, 400.0)
    assert np.all(np.abs(y[-2000:] - 1.0) < 0.02)


def test_what_no_rule_is_for_is_refused() -> None:
    with pytest.raises(TuningError, match="next to no margin"):
        unstable_first_order(1.0, 5.0, 4.0)
    with pytest.raises(TuningError, match="closed_loop_time"):
        simc(1.0, [], 0.0)
    with pytest.raises(TuningError, match="gain is 0"):
        simc(0.0, [1.0], 1.0)
    with pytest.raises(TuningError, match="not negative"):
        simc(1.0, [-1.0], 1.0)
