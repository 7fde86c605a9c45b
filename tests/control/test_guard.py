"""What ends an experiment, and what is restored then: as a table, with a session that answers. No ROS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import gains_from_mapping
from tdof_npid_ros.control.guard import RESTORED, Guard
from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.control.options import options_from_mapping
from tdof_npid_ros.control.session import Outcome, Session
from tdof_npid_ros.parameters import EXPERIMENT, GAINS, OPTIONS
from tdof_npid_ros.wire import NO_VALUES, Sample

PERIOD_NS = 10_000_000
SECOND_NS = 1_000_000_000
SAFE = {"safe_range.output": [-2.0, 2.0], "safe_range.effort": [-5.0, 5.0]}
BEGIN = {"experiment": "step", **SAFE}


class Loop:
    """A session with parameters, as the controller node has them; the plant is an integrator."""

    def __init__(self, **values: Any) -> None:
        table = {**GAINS, **OPTIONS, **EXPERIMENT}
        self.values: dict[str, Any] = {name: its.default for name, its in table.items()}
        self.values |= {"type": "tdof_npid2", "kp": 2.0, "ki": 1.0, "alpha": 0.3, **values}
        self.session = Session(Controller(self._gains(), PERIOD_NS, self._options()), Joints(()))
        self.session.timeout_ns = SECOND_NS // 2
        self.session.end_experiment = self.end
        self.now_ns = self.stamp_ns = 10**18
        self.y = 0.5
        self.session.set_setpoint(np.array([0.5]))

    def _gains(self) -> Any:
        return gains_from_mapping(self.values)

    def _options(self) -> Any:
        return options_from_mapping(self.values)

    def set(self, changes: Mapping[str, Any]) -> None:
        session = self.session
        changes = session.guard.completed(changes, {name: self.values[name] for name in RESTORED})
        session.check_experiment(changes, {name: changes.get(name, self.values[name]) for name in EXPERIMENT})
        self.values |= changes
        session.controller.change(self._gains(), self._options())
        settings = {name: self.values[name] for name in EXPERIMENT}
        if session.guard.take(changes, settings, session.controller.integral, self.now_ns):
            session.go_back()

    def end(self, why: str) -> None:
        self.session.guard.note(why)
        self.set({"experiment": ""})

    def output(self, y: float | None = None, frame: str = "robot") -> Outcome:
        self.now_ns += PERIOD_NS
        self.stamp_ns += PERIOD_NS
        value = self.y if y is None else y
        applied = self.session.controller.effort.copy()
        outcome = self.session.take(
            Sample(self.stamp_ns, frame, (), np.array([value]), NO_VALUES, applied), self.now_ns
        )
        if outcome.answer is not None:
            self.y += 0.1 * float(outcome.answer.effort[0]) * PERIOD_NS / 1e9
        return outcome

    def run(self, outputs: int = 50) -> float:
        for _ in range(outputs):
            outcome = self.output()
        assert outcome.answer is not None
        return float(outcome.answer.effort[0])

    def all_is_as_before(self, before: Mapping[str, Any]) -> bool:
        return self.values == before and self.session.guard.setpoint is None


def at_rest(**values: Any) -> Loop:
    loop = Loop(**values)
    loop.run()
    return loop


# What an experiment does; what then happens; the reason that is told.
MOVES = {
    "setpoint": {"experiment_setpoint": 1.0},
    "effort": {"experiment_effort": 3.0},
    "gains": {"experiment": "step", "kp": 5.0, "type": "pid"},
}
BREACHES = {
    "output out of range": (lambda loop: loop.output(2.5), "output 2.5 is beyond safe_range.output, -2 to 2"),
    "nan": (lambda loop: loop.output(math.nan), "not finite"),
    "a new beginning": (lambda loop: loop.output(frame="-/abcdef01.2"), "anew"),
}


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("breach", BREACHES)
def test_a_breach_restores_all_before_the_output_is_answered(move: str, breach: str) -> None:
    loop = at_rest()
    before, effort = dict(loop.values), loop.run(1)
    loop.set({**BEGIN, **MOVES[move]})
    loop.run(20)
    happens, told = BREACHES[breach]
    outcome = happens(loop)
    assert loop.all_is_as_before(before) and told in loop.session.guard.why
    answer = outcome.answer or loop.output(0.5).answer
    assert answer is not None
    if breach != "a new beginning":
        y = 2.5 if outcome.answer else 0.5
        # With the integral action of before, the law of before answers what it would have: a jump by kp (y - y0) alone.
        assert answer.setpoint[0] == 0.5
        assert answer.effort[0] == pytest.approx(effort - 2.0 * (y - 0.5), abs=0.2)
        assert len(answer.began_with) == 1  # what verify needs


def test_an_effort_beyond_its_range_is_never_answered() -> None:
    loop = at_rest()
    before = dict(loop.values)
    loop.set({**BEGIN, "kp": 50.0, "experiment_setpoint": 0.5})
    loop.run(5)
    outcome = loop.output(0.3)
    assert outcome.answer is not None and abs(outcome.answer.effort[0]) < 1.0
    assert loop.all_is_as_before(before) and "effort" in loop.session.guard.why


def test_it_ends_after_its_duration_in_the_loops_time() -> None:
    loop = at_rest()
    before = dict(loop.values)
    loop.set({**BEGIN, "experiment_setpoint": 1.0, "experiment_duration": 0.2})
    loop.run(20)
    assert loop.session.guard.name
    loop.run(1)
    assert loop.all_is_as_before(before) and "experiment_duration" in loop.session.guard.why


@pytest.mark.parametrize(
    ("after_s", "outputs", "silent", "told"),
    [
        (1.9, True, False, ""),
        (2.1, True, False, "experiment_lease"),
        (2.1, False, False, "no output"),
        (0.6, False, True, "no output"),
    ],
)
def test_a_lease_that_is_not_renewed_or_no_outputs_end_it(
    after_s: float, outputs: bool, silent: bool, told: str
) -> None:
    loop = at_rest()
    loop.set(BEGIN)
    if outputs:
        loop.run(round(after_s * 1e9 / PERIOD_NS))
    else:
        loop.now_ns += round(after_s * 1e9)
    told_of = loop.session.guard.overdue(loop.now_ns, silent)
    assert (told in told_of) if told else told_of == ""


def test_setting_any_of_its_parameters_renews_the_lease() -> None:
    for renewal in (dict(BEGIN), {"experiment_setpoint": 0.6}, {"experiment": "step", "kp": 3.0}):
        loop = at_rest()
        loop.set(BEGIN)
        loop.run(150)
        loop.set(renewal)
        loop.run(150)
        assert loop.session.guard.overdue(loop.now_ns, False) == ""


@pytest.mark.parametrize(
    "takes_over",
    [
        {"experiment": ""},
        {"experiment": "", "safe_range.output": [-1.5, 1.5]},
        {"kp": 3.0},
        {"manual": True},
        {"setpoint": 1.0},
        {"filter_time": 0.1},
    ],
)
@pytest.mark.parametrize("move", MOVES)
def test_what_an_operator_sets_stays_and_all_else_is_restored(takes_over: dict[str, Any], move: str) -> None:
    loop = at_rest()
    before = dict(loop.values)
    loop.set({**BEGIN, **MOVES[move]})
    loop.run(20)
    loop.set(takes_over)
    assert loop.all_is_as_before({**before, **takes_over})
    with pytest.raises(ValueError, match="experiment step has ended"):
        loop.set({"experiment": "step"})


def test_limits_are_the_experiments_where_they_bear_its_name_and_else_stay() -> None:
    mine = {"safe_range.output": [-9.0, 9.0], "experiment_lease": 3.0}
    loop = at_rest(**mine)
    before = dict(loop.values)
    loop.set({**BEGIN, "experiment_lease": 8.0})
    loop.set({"experiment": "step", "safe_range.effort": [-4.0, 4.0], "experiment_duration": 9.0})
    loop.set({"safe_range.output": [-3.0, 3.0]})
    assert loop.values["safe_range.output"] == [-3.0, 3.0]
    loop.set({"experiment": ""})
    assert loop.all_is_as_before({**before, "safe_range.output": [-3.0, 3.0]})


@pytest.mark.parametrize("ended", ["without an output", "after one"])
def test_the_loop_goes_on_with_the_integral_action_of_before_an_experiment(ended: str) -> None:
    loop = at_rest(ki=10.0)
    before = loop.session.integral
    loop.set({**BEGIN, "experiment_setpoint": 1.0})
    loop.run(20)
    during = loop.session.integral
    assert before is not None and during is not None and abs(during[0] - before[0]) > 0.1
    loop.end("the controller was deactivated")
    if ended == "after one":
        loop.run(1)
    now = loop.session.integral
    assert now is not None and now == pytest.approx(before, abs=0.05)


def test_gains_that_are_set_with_the_end_stay_and_the_effort_does_not_jump() -> None:
    loop = at_rest()
    loop.set(BEGIN)
    effort = loop.run()
    loop.set({"experiment": "step", "kp": 4.0, "ki": 3.0})
    assert loop.run(1) == pytest.approx(effort, abs=1e-3)
    loop.set({"experiment": "", "kp": 4.0, "ki": 3.0})
    assert loop.run(1) == pytest.approx(effort, abs=1e-2)
    assert (loop.values["kp"], loop.values["ki"], loop.session.guard.name) == (4.0, 3.0, "")


def test_a_loop_in_manual_mode_goes_back_to_its_effort() -> None:
    loop = Loop(manual=True, manual_effort=0.25)
    assert loop.run(5) == 0.25
    loop.set({**BEGIN, "experiment_effort": 1.0})
    assert loop.run(5) == 1.0
    loop.set({"experiment": "step", "experiment_effort": math.inf})
    assert loop.run(1) == 0.25
    loop.set({"experiment": "step", "experiment_setpoint": 0.6, "manual": False})
    loop.run(5)
    loop.set({"experiment": ""})
    assert loop.run(1) == 0.25


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"experiment_setpoint": 1.0}, "none has the loop"),
        ({**BEGIN, "experiment_setpoint": 3.0}, "beyond safe_range.output"),
        ({**BEGIN, "experiment_effort": -6.0}, "beyond safe_range.effort"),
        ({"experiment": "x", "safe_range.output": [0.6, 1.0]}, "output 0.5 is beyond"),
    ],
)
def test_what_no_experiment_can_be_is_refused(changes: dict[str, Any], reason: str) -> None:
    loop = at_rest()
    with pytest.raises(ValueError, match=reason):
        loop.set(changes)
    assert not loop.session.guard.name


def test_none_begins_in_lockstep_or_before_the_first_output_or_within_another() -> None:
    loop = Loop()
    with pytest.raises(ValueError, match="realtime"):
        loop.set(BEGIN)
    loop.run(5)
    loop.set(BEGIN)
    with pytest.raises(ValueError, match="experiment step has the loop"):
        loop.set({"experiment": "other"})
    assert loop.session.guard.name == "step"


def test_a_guard_at_rest_changes_nothing() -> None:
    changes = {"kp": 2.0, "manual": True}
    assert Guard().completed(changes, {}) == changes
