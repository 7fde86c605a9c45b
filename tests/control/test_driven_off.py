"""A loop that was driven off: how it is noticed, and how full_unwinding brings it back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.controller import Controller, parameters_digest
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.control.stall import Stall, StallWatch
from tdof_npid_ros.loop import simulate, simulate_operated
from tdof_npid_ros.stability.certificate import certify
from tdof_npid_ros.stability.creep import time_to_expect

PERIOD_NS = 100_000_000
GAINS = Gains("npid", kp=2.0, ki=1.0, sigma=1.0)


def after(controller: Controller, errors: list[float], integral: float = 0.0) -> list[Stall | None]:
    """What is seen at each of these errors, one a sample period."""
    controller.begin_within(np.zeros(1), np.array([integral]))
    watch, seen = StallWatch(), []
    for k, error in enumerate(errors):
        controller.answer(k * PERIOD_NS, np.zeros(1), np.array([-error]))
        seen.append(watch.look(controller))
    return seen


def test_an_error_of_six_sigma_that_stays_is_told_after_five_seconds() -> None:
    seen = after(Controller(GAINS, PERIOD_NS), [6.0] * 60, integral=-596.0)
    assert seen[:50] == [None] * 50
    stall = seen[50]
    assert stall is not None and (stall.error, stall.in_sigma, stall.unwinds) == (6.0, 6.0, True)
    assert stall.scale == pytest.approx(np.exp(-18.0)) and stall.rate == pytest.approx(6.0 * np.exp(-18.0))
    assert "6 sigma" in str(stall)


@pytest.mark.parametrize(
    ("gains", "errors"),
    [
        (GAINS, [2.5] * 200),  # slow, but it moves
        (GAINS, list(np.linspace(8.0, 0.0, 200))),  # it comes back
        (GAINS, [6.0, 1.0] * 100),
        (GAINS.with_values(type="pid"), [6.0] * 200),
        (GAINS.with_values(ki=0.0), [6.0] * 200),
        (GAINS.with_values(effort_max=1.0), [6.0] * 200),  # the actuator can do no more
    ],
)
def test_what_is_not_driven_off(gains: Gains, errors: list[float]) -> None:
    assert after(Controller(gains, PERIOD_NS), errors) == [None] * len(errors)


def test_full_unwinding_is_seen_as_what_it_is() -> None:
    unwinding = Controller(GAINS.with_values(full_unwinding=True), PERIOD_NS)
    assert after(unwinding, [6.0] * 60, integral=-596.0) == [None] * 60  # it unwinds
    seen = after(unwinding, [6.0] * 60, integral=596.0)
    assert seen[-1] is not None and not seen[-1].unwinds  # it would have to grow


def test_full_unwinding_is_no_part_of_the_digests_of_before() -> None:
    assert parameters_digest(Gains(), 10_000_000) == "fadb02299d2d"
    assert parameters_digest(Gains(full_unwinding=True), 10_000_000) != "fadb02299d2d"


@pytest.fixture(scope="module")
def driven_off() -> tuple[Case, Gains]:
    """A disturbance that grows bit by bit until the integral action is at -3.6, and is gone then: 4.8 sigma."""
    growing = [f"{10 * k} disturbance {0.6 * (k + 1):.1f}" for k in range(6)]
    episodes = {"disturbance": (*growing, "60 disturbance 0", "120 end")}
    gains = Gains("tdof_npid2", kp=0.5, ki=0.5, kd=0.1, sigma=0.5)
    return replace(load_case("p1-c0.5"), episodes=episodes), gains


def test_the_integral_action_unwinds(driven_off: tuple[Case, Gains]) -> None:
    """One lane or many, compiled or stepped by the Controller: the same bits; off, the law is as it was."""
    case, gains = driven_off
    signals = case.plans["disturbance"].sampled(case.sample_period_ns)
    on, many = gains.with_values(full_unwinding=True), gains.with_values(full_unwinding=True, kp=(0.3, 0.5, 0.7))
    run = {g: simulate(case.plant_at, g, signals, case.effort_limits) for g in (gains, on, many)}
    for g in (gains, on):
        stepped = simulate_operated(case.plant_at, g, ControllerOptions(), signals, case.effort_limits)
        assert stepped.control_effort.tobytes() == run[g].control_effort.tobytes()
    assert run[many].output[:, 1].tobytes() == run[on].output[:, 0].tobytes()
    left = {g: abs(run[g].output[-1, 0]) for g in (gains, on)}
    assert left[on] < 0.001 and left[gains] > 2.0, left


def test_the_certificate_covers_it_by_the_circle_and_not_by_a_multiplier() -> None:
    case = load_case("p1-c0.5")
    found = certify(case, case.gains.with_values(full_unwinding=True))
    assert (found.status, found.method) == ("certified", "circle")
    assert any("full_unwinding" in line for line in found.not_claimed)
    case = load_case("p2-c5")  # its printed gains: by a multiplier alone
    gains = Gains("tdof_npid1", kp=5.724, ki=2.083, kd=14.208, alpha=0.241, sigma=1.0, full_unwinding=True)
    found = certify(case, gains)
    assert (found.status, found.method) == ("not certified", None)
    assert "multipliers do not cover full_unwinding" in found.reasons[0]


def test_the_time_to_expect_is_that_of_the_simulated_loop() -> None:
    """The integral action alone brings the error from what the PD loop leaves, 3 sigma, down to sigma."""
    case = replace(load_case("p1-c4"), episodes={"setpoint": ("0 setpoint 3.3", "500 end")})
    gains = Gains("npid", kp=0.1, ki=0.05, sigma=1.0)
    run = simulate(case.plant_at, gains, case.plans["setpoint"].sampled(case.sample_period_ns), case.effort_limits)
    there = float(run.time[np.argmax(3.3 - run.output[:, 0] < 1.0)])
    assert time_to_expect(case, gains, 0, 3.0) == pytest.approx(there, rel=0.2)
