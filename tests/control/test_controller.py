"""What an operator may do to a running controller, and what it does to the effort."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.control.controller import Controller, parameters_digest
from tdof_npid_ros.control.gains import (
    CONTROLLER_TYPES,
    LARGEST_GAIN,
    LARGEST_SIGNAL,
    AntiWindup,
    ControllerType,
    Gains,
    GainsError,
    gains_from_mapping,
)
from tdof_npid_ros.control.options import PLAIN, ControllerOptions, options_from_mapping

H = 0.01  # s
PERIOD_NS = 10_000_000
GAINS = Gains("tdof_npid2", kp=2.0, ki=1.5, kd=0.3, alpha=0.3, beta=0.2, sigma=0.8)


class Loop:
    """A controller on y' = u - y, which is slow enough that a jump of u stands out."""

    def __init__(self, gains: Gains = GAINS, options: ControllerOptions = PLAIN, setpoint: float = 1.0) -> None:
        self.controller = Controller(gains, PERIOD_NS, options)
        self.setpoint, self.y, self.k = setpoint, 0.0, 0
        self.efforts: list[float] = []

    def run(self, steps: int) -> list[float]:
        """The efforts of so many steps."""
        for _ in range(steps):
            self.controller.answer(self.k * PERIOD_NS, np.array([self.setpoint]), np.array([self.y]))
            self.efforts.append(float(self.controller.effort[0]))
            self.y += H * (self.efforts[-1] - self.y)
            self.k += 1
        return self.efforts[-steps:]

    def change(self, gains: dict[str, Any] | None = None, **options: Any) -> None:
        values = self.controller.options.as_dict() | options
        self.controller.change(self.controller.gains.with_values(**(gains or {})), ControllerOptions(**values))


@pytest.mark.parametrize(
    "change",
    [
        *({"type": kind} for kind in CONTROLLER_TYPES),
        {"kp": 9.0}, {"ki": 0.1}, {"kd": 2.0}, {"kd": 0.0}, {"alpha": 0.9}, {"beta": 0.9}, {"sigma": 0.1}, {"n": 3.0},
        {"kp": 0.1, "kd": 1.0, "alpha": 1.0, "type": "npid"},
        {"anti_windup": "back_calculation"},
    ],
    ids=str,
)  # fmt: skip
def test_changing_any_gain_or_the_type_is_bumpless(change: dict[str, Any]) -> None:
    changed, unchanged = Loop(), Loop()
    changed.run(60)
    unchanged.run(60)
    changed.change(change)
    (u,), (expected,) = changed.run(1), unchanged.run(1)
    assert u == pytest.approx(expected, abs=1e-12)
    assert max(abs(np.diff([u, *changed.run(3)]))) < 0.2  # and nothing that was put off comes after


@pytest.mark.parametrize("kd", [0.001, 0.01, 0.05])
def test_a_smaller_derivative_gain_jumps_neither_at_once_nor_later(kd: float) -> None:
    """With it the filter is faster: what it is given at the change would be gone a sample later."""
    changed, unchanged = Loop(), Loop()
    changed.run(60)
    unchanged.run(60)
    changed.change({"kd": kd})
    largest = max(abs(np.diff(unchanged.run(20))))
    assert max(abs(np.diff(changed.efforts[-1:] + changed.run(20)))) < 2.0 * largest


@pytest.mark.parametrize("change", [{"n": 11.0}, {"tracking_time": 2.0}, {"manual_effort": 1.0}], ids=str)
def test_a_change_without_effect_has_none_at_a_limit(change: dict[str, Any]) -> None:
    """A limit in force is no reason to throw the integral action away."""
    gains = Gains("pid", kp=5.0, ki=1.0, effort_min=-12.0, effort_max=12.0)
    changed, unchanged = Loop(gains, setpoint=10.0), Loop(gains, setpoint=10.0)
    assert changed.run(50)[-1] == unchanged.run(50)[-1] == 12.0
    is_gain = "manual_effort" not in change
    changed.change(change if is_gain else {}, **({} if is_gain else change))
    assert changed.run(500) == pytest.approx(unchanged.run(500), abs=1e-9)


@pytest.mark.parametrize("anti_windup", ["none", "conditional", "back_calculation"])
def test_a_smaller_gain_at_a_limit_does_not_wind_up(anti_windup: AntiWindup) -> None:
    gains = Gains("pid", kp=50.0, ki=5.0, effort_min=-12.0, effort_max=12.0, anti_windup=anti_windup)
    loop = Loop(gains, setpoint=10.0)
    loop.run(50)
    before = float(loop.controller.integral[0])
    loop.change({"kp": 5.0})
    loop.run(1)
    needed = 12.0 - 5.0 * (10.0 - loop.y)
    assert loop.controller.integral_before[0] <= max(before, needed) + 1.0


def test_lifting_a_limit_or_a_rate_does_not_make_the_effort_jump() -> None:
    for lift in ({"effort_rate": math.inf}, {"effort_max": math.inf}):
        limited = {"effort_rate": 20.0} if "effort_rate" in lift else {}
        most = 4.0 if "effort_max" in lift else math.inf
        loop = Loop(Gains("pid", kp=50.0, ki=5.0, effort_max=most), ControllerOptions(**limited), setpoint=10.0)
        before = loop.run(20)[-1]
        gains = {name: value for name, value in lift.items() if name == "effort_max"}
        loop.change(gains, **{name: value for name, value in lift.items() if name == "effort_rate"})
        assert loop.run(1)[0] == pytest.approx(before, abs=0.5), lift


def test_a_larger_derivative_gain_leaves_nothing_behind() -> None:
    """A kick that the old filter holds must not be made larger, and taken back by the integral action."""
    loop = Loop(Gains("pid", kp=2.0, ki=1.0, kd=0.1))
    loop.run(500)
    loop.setpoint = 2.0
    loop.change({"kd": 0.5})
    assert min(loop.run(50)) > 0.0


def test_without_integral_action_there_is_nothing_to_track() -> None:
    gains = Gains("pid", kp=5.0, ki=0.0, effort_min=-1.0, effort_max=1.0)
    tracking, plain = Loop(gains.with_values(anti_windup="back_calculation", tracking_time=1.0)), Loop(gains)
    assert tracking.run(500) == plain.run(500)


def test_without_bumpless_a_change_acts_at_once() -> None:
    loop = Loop(options=ControllerOptions(bumpless=False))
    before = loop.run(60)[-1]
    loop.change({"kp": 9.0})
    assert abs(loop.run(1)[0] - before) > 1.0


def test_a_gain_without_integral_action_keeps_its_meaning() -> None:
    loop = Loop(Gains("pid", kp=2.0))
    loop.run(100)
    loop.change({"kp": 3.0})
    y = loop.y
    assert loop.run(1)[0] == pytest.approx(3.0 * (1.0 - y))


def test_manual_mode_and_bumpless_return() -> None:
    loop = Loop()
    loop.run(300)
    loop.change(manual=True, manual_effort=0.4)
    assert set(loop.run(200)) == {0.4}
    loop.change(manual=False)
    efforts = loop.run(1000)
    assert efforts[0] == pytest.approx(0.4, abs=1e-12)
    assert max(abs(np.diff(efforts))) < 0.02
    assert loop.y == pytest.approx(1.0, abs=0.01)


def test_manual_effort_keeps_the_limits() -> None:
    loop = Loop(GAINS.with_values(effort_max=0.5), ControllerOptions(manual=True, manual_effort=3.0, effort_rate=10.0))
    assert loop.run(8)[:6] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.5])


@pytest.mark.parametrize(
    "options", [PLAIN, ControllerOptions(effort_rate=1e6), ControllerOptions(manual=True, manual_effort=9.0)]
)
def test_every_lane_keeps_limits_of_its_own(options: ControllerOptions) -> None:
    gains = Gains("pid", kp=5.0, effort_min=-1.0, effort_max=(0.5, 2.0, 7.0))
    controller = Controller(gains, PERIOD_NS, options)
    controller.answer(0, np.ones(3), np.zeros(3))
    assert controller.effort.tolist() == [0.5, 2.0, 7.0 if options.manual else 5.0]
    assert controller.saturated
    controller.answer(PERIOD_NS, np.ones(3), np.full(3, 3.0))
    assert controller.effort.tolist() == ([0.5, 2.0, 7.0] if options.manual else [-1.0] * 3)
    if not options.manual:
        controller.answer(2 * PERIOD_NS, np.ones(3), np.ones(3))
        assert not controller.saturated


@pytest.mark.parametrize("most", [(1.0, -2.0), (1.0, -math.inf), (1.0, 2.0, 3.0)])
def test_wrong_limits_of_lanes_are_refused(most: tuple[float, ...]) -> None:
    with pytest.raises(GainsError, match="effort_m"):
        Gains(kp=(1.0, 2.0), effort_min=(-1.0, -1.0), effort_max=most)


def test_setpoint_ramp_starts_from_the_output_and_keeps_its_rate() -> None:
    ramped = Loop(Gains("pid", kp=1.0), ControllerOptions(setpoint_rate=2.0))
    ramped.y = 0.5
    ramped.controller.answer(0, np.ones(1), np.array([0.5]))
    assert ramped.controller.effort[0] == pytest.approx(0.02)
    for k in range(1, 40):
        ramped.controller.answer(k * PERIOD_NS, np.ones(1), np.zeros(1))
    assert ramped.controller.effort[0] == 1.0  # exactly the setpoint, once it is reached


def test_setpoint_limits() -> None:
    loop = Loop(Gains("pid", kp=1.0), ControllerOptions(setpoint_min=-0.5, setpoint_max=0.25))
    assert loop.run(1) == [0.25]
    loop.setpoint, loop.y = -3.0, 0.0
    assert loop.run(1) == [-0.5]


def test_effort_rate_limit_holds_and_the_integral_does_not_wind_up() -> None:
    gains = Gains("pid", kp=5.0, ki=20.0, anti_windup="conditional")
    loop, wound_up = (
        Loop(gains.with_values(anti_windup=kind), ControllerOptions(effort_rate=3.0))
        for kind in ("conditional", "none")
    )
    efforts = loop.run(1500)
    assert max(abs(np.diff([0.0, *efforts]))) <= 3.0 * H + 1e-12
    assert loop.y == pytest.approx(1.0, abs=1e-3)
    assert max(efforts) < 0.8 * max(wound_up.run(1500))


def test_dead_band_ignores_small_errors_without_a_step() -> None:
    loop = Loop(Gains("pid", kp=10.0, ki=1.0), ControllerOptions(dead_band=0.1))
    for k, y in enumerate([0.91, 1.09, 1.0]):
        loop.controller.answer(k * PERIOD_NS, np.ones(1), np.array([y]))
        assert loop.controller.effort[0] == 0.0
    loop.controller.answer(3 * PERIOD_NS, np.ones(1), np.array([0.85]))
    assert loop.controller.effort[0] == pytest.approx(0.5)


def test_measurement_filter_is_a_first_order_lag() -> None:
    controller = Controller(Gains("pid", kp=1.0), PERIOD_NS, ControllerOptions(filter_time=0.1))
    controller.answer(0, np.zeros(1), np.zeros(1))
    for k in range(1, 11):
        controller.answer(k * PERIOD_NS, np.zeros(1), np.ones(1))
    assert -controller.effort[0] == pytest.approx(1.0 - math.exp(-1.0))


@pytest.mark.parametrize(("r", "y", "error"), [(3.1, -3.1, -0.083185), (-3.1, 3.1, 0.083185), (7.0, 0.5, 0.216815)])
def test_angles_go_the_shorter_way_round(r: float, y: float, error: float) -> None:
    controller = Controller(Gains("pid", kp=1.0), PERIOD_NS, ControllerOptions(angle=True))
    controller.answer(0, np.array([r]), np.array([y]))
    assert controller.effort[0] == pytest.approx(error, abs=1e-6)


def test_an_angle_passing_half_a_turn_gives_no_derivative_kick() -> None:
    controller = Controller(Gains("tdof_npid2", kp=1.0, kd=1.0, alpha=0.5), PERIOD_NS, ControllerOptions(angle=True))
    efforts = []
    for k, angle in enumerate(np.arange(3.0, 3.3, 0.01)):
        wrapped = angle if angle < math.pi else angle - 2 * math.pi
        controller.answer(k * PERIOD_NS, np.array([wrapped]), np.array([wrapped]))
        efforts.append(controller.effort[0])
    assert max(abs(np.diff(efforts[5:]))) < 0.1


def test_reverse_action() -> None:
    direct, reverse = Loop(GAINS), Loop(GAINS.with_values(kp=-2.0, ki=-1.5, kd=-0.3))
    for k in range(20):
        y = np.array([0.1 * k])
        direct.controller.answer(k * PERIOD_NS, np.ones(1), y)
        reverse.controller.answer(k * PERIOD_NS, np.ones(1), y)
        assert reverse.controller.effort[0] == -direct.controller.effort[0]


def test_beginning_within_a_running_loop_goes_on_from_the_applied_effort() -> None:
    loop = Loop()
    loop.run(200)
    newcomer = Controller(GAINS, PERIOD_NS)
    newcomer.begin_within(np.array([loop.efforts[-1]]))
    newcomer.answer(loop.k * PERIOD_NS, np.ones(1), np.array([loop.y]))
    assert newcomer.effort[0] == pytest.approx(loop.efforts[-1], abs=1e-12)
    again = Controller(GAINS, PERIOD_NS)  # as `verify` does it, from the integral action that the answer bears
    again.begin_within(np.array([loop.efforts[-1]]), newcomer.terms[3].copy())
    again.answer(loop.k * PERIOD_NS, np.ones(1), np.array([loop.y]))
    assert again.effort[0] == newcomer.effort[0]


def test_answers_depend_only_on_what_each_was_computed_with() -> None:
    """Changes between two answers leave no trace but the last one: what `verify` relies on."""
    once, often = Loop(), Loop()
    once.run(20)
    often.run(20)
    once.change({"kp": 3.0}, dead_band=0.01)
    for kp in (7.0, 0.5, 3.0):
        often.change({"kp": kp, "type": "pid"}, effort_rate=kp)
    often.change({"kp": 3.0, "type": "tdof_npid2"}, dead_band=0.01, effort_rate=math.inf)
    assert once.run(50) == often.run(50)
    assert once.controller.digest == often.controller.digest


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"setpoint_rate": 0.0}, "above 0"), ({"effort_rate": -1.0}, "above 0"), ({"dead_band": -1.0}, "not below 0"),
        ({"filter_time": math.inf}, "finite"), ({"manual": 1}, "true or "
        "false"), ({"manual_effort": math.inf}, "finite"),
        ({"setpoint_min": 1.0, "setpoint_max": 0.0}, "need setpoint_min"), ({"setpoint_rate": math.nan}, "nan"),
    ],
)  # fmt: skip
def test_wrong_operation_is_refused(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(GainsError, match=reason):
        options_from_mapping(values)


def test_manual_effort_must_fit_the_lanes() -> None:
    with pytest.raises(GainsError, match="2 lanes"):
        Controller(GAINS.with_values(kp=(1.0, 2.0)), PERIOD_NS, ControllerOptions(manual_effort=(1.0, 2.0, 3.0)))


def test_every_operation_has_a_name_of_its_own() -> None:
    digests = {
        parameters_digest(GAINS, PERIOD_NS, o)
        for o in (PLAIN, ControllerOptions(dead_band=0.1), ControllerOptions(manual=True))
    }
    assert len(digests) == 3


ANSWERS_OF_ALL_KINDS = """
import numpy as np
from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import answer_lanes
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.control.shaping import shape_lanes

def compiled():
    return len(answer_lanes.signatures), len(shape_lanes.signatures)

controller, y = Controller(Gains(kp=2.0, ki=1.0, kd=0.1), 10_000_000), np.zeros(1)
controller.warm_up()
before = compiled()
assert before == (1, 1) and controller.stamp_ns is None
controller.answer(0, y, y)
controller.change_gains(Gains(type="pid", kp=3.0, ki=1.0, kd=0.1))
controller.answer(1, y, y)
controller.begin_within(y + 1.0)
controller.answer(2, y, y)
controller.change(Gains(kp=2.0, ki=1.0), ControllerOptions(setpoint_rate=1.0, effort_rate=2.0))
controller.answer(3, y, y)
controller.change(Gains(kp=2.0, ki=1.0), ControllerOptions(manual=True))
controller.answer(4, y, y)
assert compiled() == before
"""


def test_nothing_is_compiled_while_the_loop_runs() -> None:
    subprocess.run([sys.executable, "-c", ANSWERS_OF_ALL_KINDS], check=True)


@pytest.mark.parametrize("kind", CONTROLLER_TYPES)
@pytest.mark.parametrize("anti_windup", ["none", "conditional", "back_calculation"])
def test_no_effort_is_ever_infinite_or_nan(kind: ControllerType, anti_windup: AntiWindup) -> None:
    """With the largest and smallest gains, signals, filters and limits that are not refused."""
    rng = np.random.default_rng(1)
    extremes = [0.0, 1.0 / LARGEST_GAIN, 1e-9, 1.0, 1e9, LARGEST_GAIN]
    signals = [s * sign for s in (0.0, 1e-300, 1.0, LARGEST_SIGNAL) for sign in (1.0, -1.0)]
    for _ in range(300):
        values = {name: float(rng.choice(extremes)) for name in ("kp", "ki", "kd", "alpha", "beta")}
        values["kd"] *= values["kp"] != 0.0  # T_d = kd/kp
        values |= {"sigma": float(rng.choice(extremes[1:])), "n": float(rng.choice([5e-324, 1.0, 1e308]))}
        values |= {
            "tracking_time": float(rng.choice([0.0, 5e-324, 1e308])),
            "effort_max": float(rng.choice([1.0, math.inf])),
        }
        options = ControllerOptions(
            filter_time=float(rng.choice([0.0, 5e-324, 1e308])),
            dead_band=float(rng.choice([0.0, 1e308])),
            setpoint_rate=float(rng.choice([5e-324, math.inf])),
            manual=bool(rng.random() < 0.1),
        )
        controller = Controller(Gains(kind, anti_windup=anti_windup, **values), PERIOD_NS, options)
        if rng.random() < 0.5:
            controller.begin_within(np.array([rng.choice([-1e308, 1e308])]))
        for k in range(20):
            controller.answer(k * PERIOD_NS, np.array([rng.choice(signals)]), np.array([rng.choice(signals)]))
            assert np.isfinite(controller.effort[0]) and np.isfinite(controller.terms).all(), (values, options)


@pytest.mark.parametrize(
    ("low", "high"), [("effort_min", "effort_max"), ("integral_min", "integral_max"), ("setpoint_min", "setpoint_max")]
)
def test_limits_that_leave_no_finite_value_are_refused(low: str, high: str) -> None:
    kind = options_from_mapping if low == "setpoint_min" else gains_from_mapping
    for limits in ({low: math.inf}, {high: -math.inf}, {low: math.inf, high: math.inf}):
        with pytest.raises(GainsError, match=f"{low} is"):
            kind(limits)
