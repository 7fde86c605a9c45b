"""Tuning through a live loop, without ROS: integrals from outputs, shares of a generation, trials by steps."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from tdof_npid_ros.case import EPISODES, load_case
from tdof_npid_ros.control.gains import gains_from_candidates
from tdof_npid_ros.loop import Integrals
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.alternate import StepTest, Trial
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.live import EpisodeOutputs, LoopLostError, integrals_of, measure, work_of_loops
from tdof_npid_ros.tuning.objective import Objective, scores
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.wire import EpisodeLabel

SHORT = {"setpoint": ("0 setpoint 1", "5 end"), "disturbance": ("0 disturbance 1", "5 end")}
CASE = replace(load_case("p3-c1"), episodes=SHORT)
PROBLEM = TuningProblem(CASE, "tdof_npid2")


def candidates(count: int) -> Array:
    """From all over the bounds: some are unstable, some diverge."""
    lower, upper = np.array(PROBLEM.bounds).T
    return lower + np.random.default_rng(3).random((count, len(lower))) * (upper - lower)


class LocalLoop:
    """A loop that runs in process; `good_for` episodes, then it is lost until `good_for` is raised."""

    def __init__(self, good_for: float = math.inf) -> None:
        self.good_for = good_for
        self.ran = 0

    def run_episode(self, episode: str, candidates: Array) -> Integrals:
        if self.ran >= self.good_for:
            raise LoopLostError("gone")
        self.ran += 1
        gains = gains_from_candidates(PROBLEM.base, PROBLEM.names, candidates)
        return integrals_of(CASE.signals[episode], CASE.simulate(episode, gains).output)


def values_by(loops: list[LocalLoop], some: Array, lost: list[str] | None = None) -> Scores:
    usable = list(loops)

    def put_out(loop: LocalLoop, error: LoopLostError) -> None:
        usable.remove(loop)
        if lost is not None:
            lost.append(str(error))

    return scores(PROBLEM, some, *measure(some, lambda: usable, put_out))


def same(measured: Scores, computed: Scores) -> None:
    assert np.array_equal(measured.objective, computed.objective)
    assert np.array_equal(measured.violation, computed.violation)


def test_integrals_from_outputs_are_those_of_the_compiled_loop_bit_for_bit() -> None:
    gains = gains_from_candidates(PROBLEM.base, PROBLEM.names, np.vstack([candidates(30), [[1e6, 0.0, 0.0, 0.0, 0.0]]]))
    for episode in EPISODES:
        compiled = CASE.integrals(episode, gains)
        measured = integrals_of(CASE.signals[episode], CASE.simulate(episode, gains).output)
        for field in fields(Integrals):
            assert np.array_equal(getattr(measured, field.name), getattr(compiled, field.name)), field.name
        assert (compiled.rest_error[:-1] > 0).all()
        assert (compiled.finite_fraction[:-1] == 1).any()
        assert compiled.finite_fraction[-1] < 1


@pytest.mark.parametrize("loops", [1, 2, 3, 5])
def test_values_do_not_depend_on_the_number_of_loops(loops: int) -> None:
    some = candidates(7)
    same(values_by([LocalLoop() for _ in range(loops)], some), Objective(PROBLEM)(some))


@pytest.mark.parametrize("good_for", [0, 1])
def test_what_a_lost_loop_leaves_undone_the_others_do(good_for: int) -> None:
    some, lost = candidates(7), list[str]()
    loops = [LocalLoop(good_for), LocalLoop(), LocalLoop(0)]
    same(values_by(loops, some, lost), Objective(PROBLEM)(some))
    assert "gone" in lost


def test_each_candidate_runs_each_episode_once() -> None:
    for count, loops in [(1, 1), (5, 1), (5, 2), (5, 3), (2, 7), (40, 4)]:
        waiting = {"setpoint": np.arange(count), "disturbance": np.arange(1, count)}
        given = work_of_loops(waiting, loops)
        assert len(given) == loops
        for episode, wanted in waiting.items():
            parts = [part for share in given for name, part in share if name == episode]
            assert np.array_equal(np.sort(np.concatenate([*parts, np.arange(0)])), wanted)


def test_two_loops_run_an_episode_each() -> None:
    first, second = work_of_loops({"setpoint": np.arange(6), "disturbance": np.arange(6)}, 2)
    assert [name for name, _ in first] == ["setpoint"]
    assert [name for name, _ in second] == ["disturbance"]


# Outputs as they arrive

SIGNALS = CASE.signals["setpoint"]
PERIOD = CASE.sample_period_ns


PLAN, OTHER = "0123456789ab", "ba9876543210"


def label(number: int, plan: str = PLAN, activation: str = "a") -> EpisodeLabel:
    return EpisodeLabel(plan, activation, number)


def send(outputs: EpisodeOutputs, episode: EpisodeLabel | None, steps: range, output: float = 0.5) -> None:
    for step in steps:
        outputs.take(episode, step * PERIOD, np.full(2, output))


def test_an_episode_is_complete_with_its_last_output_repeated_ones_or_not() -> None:
    outputs = EpisodeOutputs(PLAN, SIGNALS, 2)
    send(outputs, label(2), range(SIGNALS.steps))
    send(outputs, label(2), range(10))
    outputs.started(label(2))
    assert not outputs.complete
    send(outputs, label(2), range(SIGNALS.steps, SIGNALS.steps + 1))
    assert outputs.complete
    assert not outputs.cut
    assert outputs.integrals.iae == pytest.approx([2.5, 2.5])


def test_only_the_episode_that_was_started_last_counts() -> None:
    outputs = EpisodeOutputs(PLAN, SIGNALS, 2)
    send(outputs, label(1), range(SIGNALS.steps + 1), output=7.0)
    outputs.started(label(2))
    assert not outputs.complete
    send(outputs, label(2), range(SIGNALS.steps + 1))
    send(outputs, label(1), range(3), output=7.0)
    assert outputs.complete
    assert outputs.integrals.iae == pytest.approx([2.5, 2.5])


def test_an_episode_is_cut_by_another_plan_or_a_missing_output() -> None:
    for episode, steps in [(label(3, OTHER), range(1)), (label(2), range(5, SIGNALS.steps + 1))]:
        outputs = EpisodeOutputs(PLAN, SIGNALS, 2)
        outputs.started(label(2))
        send(outputs, label(2), range(2))
        send(outputs, episode, steps)
        assert outputs.cut
        assert not outputs.complete


def test_outputs_with_other_lanes_or_of_a_robot_are_passed_over() -> None:
    outputs = EpisodeOutputs(PLAN, SIGNALS, 3)
    outputs.started(label(1))
    send(outputs, label(1), range(5))
    send(outputs, None, range(5))
    assert (outputs.received, outputs.cut) == (0, False)


def test_a_plant_that_is_activated_again_counts_anew() -> None:
    outputs = EpisodeOutputs(PLAN, SIGNALS, 2)
    send(outputs, label(7), range(3), output=7.0)
    outputs.started(label(1, activation="b"))
    send(outputs, label(1, activation="b"), range(SIGNALS.steps + 1))
    assert outputs.complete
    assert outputs.integrals.iae == pytest.approx([2.5, 2.5])


# Steps back and forth

TEST = StepTest((0.0, 2.0), 0.05, 0.5, 10.0, (-1.0, 3.0), (-50.0, 50.0))


def respond(trial: Trial, lag: float, period: float = 0.01) -> Trial:
    """Feed a trial with a first-order response of that lag in s."""
    output, k = trial.setpoint, 0
    while not trial.outcome and k < 10_000:
        trial.take(k * period, output, 1.0)
        output += (trial.setpoint - output) * (1.0 - math.exp(-period / lag))
        k += 1
    return trial


def test_a_trial_integrates_its_step_until_it_has_settled() -> None:
    trial = respond(Trial(TEST, 0.0, 2.0), lag=0.5)
    assert trial.outcome == "measured"
    assert trial.setpoint == 2.0
    assert trial.iae == pytest.approx(0.5, rel=0.05)  # of a step of 1, but for what is left in the band
    assert trial.fraction == 1.0


def test_a_slow_candidate_pays_for_the_whole_time_limit() -> None:
    quick, slow = respond(Trial(TEST, 2.0, 0.0), lag=1.0), respond(Trial(TEST, 2.0, 0.0), lag=20.0)
    assert slow.outcome == "measured"
    assert slow.iae > 5 * quick.iae


@pytest.mark.parametrize(("output", "effort"), [(3.1, 0.0), (-1.1, 0.0), (0.0, 51.0), (math.nan, 0.0), (0.0, math.nan)])
def test_a_trial_ends_when_output_or_effort_leaves_its_range(output: float, effort: float) -> None:
    trial = Trial(TEST, 0.0, 2.0)
    trial.take(0.0, 0.0, 0.0)
    trial.take(0.01, output, effort)
    assert trial.outcome == "unsafe"
    assert trial.fraction == 0.0


def test_a_trial_that_failed_later_has_come_further() -> None:
    shares_ = []
    for until in (1.0, 2.0):
        trial = Trial(TEST, 0.0, 2.0)
        for k in range(round(until / 0.01)):
            trial.take(k * 0.01, 0.0, 0.0)
        trial.take(until, 9.0, 0.0)
        shares_.append(trial.fraction)
    assert 0.0 < shares_[0] < shares_[1] < 1.0


def test_a_candidate_that_never_settles_before_its_step_has_failed() -> None:
    trial = Trial(TEST, 0.0, 2.0)
    for k in range(1002):
        trial.take(k * 0.01, math.sin(k * 0.01), 0.0)
    assert (trial.outcome, trial.fraction, trial.setpoint) == ("unsettled", 0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"levels": (1.0, 1.0)}, "two different"),
        ({"levels": (0.0, 5.0)}, "safe_range.output"),
        ({"safe_effort": (1.0, -1.0)}, "safe_range.effort"),
        ({"settle_time": 20.0}, "settle_time"),
    ],
)
def test_a_step_test_that_cannot_be_is_refused(change: dict[str, tuple[float, float]], reason: str) -> None:
    with pytest.raises(TuningError, match=reason):
        replace(TEST, **change)  # type: ignore[arg-type]
