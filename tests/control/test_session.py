"""What a controller decides about each output: where a loop begins, goes on, is joined or disturbed. No ROS."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import Gains, gains_from_mapping
from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.control.options import PLAIN, ControllerOptions
from tdof_npid_ros.control.session import (
    FAR_AHEAD,
    NOT_STAMPED_ANEW,
    OFF_RATE,
    OTHER_EPISODE,
    OUT_OF_STEP,
    UNLABELLED,
    UNSTAMPED,
    Answer,
    Outcome,
    Place,
    Session,
)
from tdof_npid_ros.plants.lockstep import Episode
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.wire import NO_VALUES, EpisodeLabel, Sample

PERIOD_NS = 10_000_000
MS = 1_000_000
GAINS = Gains("tdof_npid2", kp=2.0, ki=1.0, kd=0.5, alpha=0.2, beta=0.3, sigma=1.0)
LIVE, NEXT, OTHER = "-/a.1", "-/a.2", "-/b.1"
ROBOT = "base_link"


def session(gains: Gains = GAINS, options: ControllerOptions = PLAIN) -> Session:
    made = Session(Controller(gains, PERIOD_NS, options), Joints(()))
    made.set_setpoint(np.ones(1))
    made.timeout_ns = 500 * MS
    return made


def output(frame: str, stamp_ns: int, y: float = 0.5, applied: float | None = 0.25) -> Sample:
    effort = NO_VALUES if applied is None else np.array([applied])
    return Sample(stamp_ns, frame, (), np.array([y]), NO_VALUES, effort)


# A row: what came before, each 10 ms after the one before; the output then, how long after, and what is decided.
STEADY = [(LIVE, k * PERIOD_NS) for k in range(200)]
STEADY_ROBOT = [(ROBOT, 10**12 + k * PERIOD_NS) for k in range(200)]
PLAN = "0123456789ab"
TABLE = [
    ("the first output of a plant", [], (LIVE, 0), 10, "start"),
    ("the first one that a late controller hears", [], (LIVE, 30 * MS), 10, "start"),
    ("a plant that has been running", [], (LIVE, 5000 * MS), 10, "join"),
    ("a plant whose number of resets is high", [], ("-/a.7", 5000 * MS), 10, "join"),
    ("a plant in lockstep", [], (f"{PLAN}/a.1", 0), 10, "start"),
    ("a plant in lockstep, met in the middle", [], (f"{PLAN}/a.1", 10 * MS), 10, "join"),
    ("the next output", STEADY, (LIVE, 2000 * MS), 10, "new"),
    ("an output again", STEADY, (LIVE, 1990 * MS), 10, "same"),
    ("an older output", STEADY, (LIVE, 1980 * MS), 10, "late"),
    ("some outputs lost", STEADY, (LIVE, 2300 * MS), 300, "new"),
    ("the plant was reset", STEADY, (NEXT, 0), 10, "start"),
    ("reset, and its first outputs lost", STEADY, (NEXT, 7000 * MS), 10, "start"),
    ("reset, and stamped with a clock of its own", STEADY, (NEXT, 10**18), 10, "start"),
    ("the plant was started again", STEADY, (OTHER, 0), 1200, "start"),
    ("the same episode is replayed", STEADY, (LIVE, 0), 10, "start"),
    ("an episode before", [*STEADY, (NEXT, 0)], (LIVE, 2000 * MS), 10, "refused"),
    ("an unstamped message beside a plant", STEADY, ("", 0), 10, "refused"),
    ("a stamped message beside a plant", STEADY, ("", 2000 * MS), 10, "refused"),
    ("one with a robot's frame", STEADY, (ROBOT, 2000 * MS), 10, "refused"),
    ("one far ahead", STEADY, ("", 10**18), 10, "refused"),
    ("a robot after the plant has ended", STEADY, (ROBOT, 10**18), 700, "join"),
    ("a robot after a plant in lockstep", [(f"{PLAN}/a.1", 0)], (ROBOT, 10**18), 700, "refused"),
    ("the plant after a silence", STEADY, (LIVE, 2600 * MS), 700, "join"),
    ("a plant in lockstep after a pause", [(f"{PLAN}/a.1", 0)], (f"{PLAN}/a.1", PERIOD_NS), 9000, "new"),
    ("a robot", [], (ROBOT, 10**18), 10, "join"),
    ("a robot whose clock starts at 0", [], (ROBOT, 0), 10, "join"),
    ("a robot that never stamps", [], ("", 0), 10, "join"),
    ("a robot's next output", STEADY_ROBOT, (ROBOT, 10**12 + 2000 * MS), 10, "new"),
    ("a robot's output again", STEADY_ROBOT, (ROBOT, 10**12 + 1990 * MS), 10, "same"),
    ("a robot's older output", STEADY_ROBOT, (ROBOT, 10**12), 10, "late"),
    ("a robot's much older output", STEADY_ROBOT, (ROBOT, 5 * MS), 10, "late"),
    ("an unstamped message beside a robot", STEADY_ROBOT, ("", 0), 10, "refused"),
    ("one far ahead beside a robot", STEADY_ROBOT, (ROBOT, 10**18), 10, "refused"),
    ("a robot after a silence", STEADY_ROBOT, (ROBOT, 10**12 + 9000 * MS), 7000, "join"),
    ("a robot that was started again", STEADY_ROBOT, (ROBOT, 7), 7000, "join"),
    ("a plant after a robot", STEADY_ROBOT, (LIVE, 0), 10, "start"),
    ("a running plant after a stray message", [("", 0)], (LIVE, 7000 * MS), 10, "join"),
    ("a running plant in lockstep after a stray message", [("", 0)], (f"{PLAN}/a.1", PERIOD_NS), 10, "join"),
]


@pytest.mark.parametrize(
    ("before", "then", "after_ms", "decision"), [row[1:] for row in TABLE], ids=[r[0] for r in TABLE]
)
def test_the_decision_about_an_output(
    before: list[tuple[str, int]], then: tuple[str, int], after_ms: int, decision: str
) -> None:
    one = session()
    one.plan = replace(load_case("p1-c0.5").plans["setpoint"])
    now = 0
    place = {PLAN: one.plan.digest}

    def take(frame: str, stamp_ns: int) -> Outcome:
        return one.take(output(frame.replace(PLAN, place[PLAN]), stamp_ns), now)

    for frame, stamp_ns in before:
        now += PERIOD_NS
        assert take(frame, stamp_ns).answer is not None
    now += after_ms * MS
    outcome = take(*then)
    assert outcome.decision == decision
    assert (outcome.answer is None) == (decision in ("late", "refused"))
    assert bool(outcome.why) == (decision == "refused")


def test_who_comes_upon_a_plant_that_nobody_drives_begins_the_loop_whatever_its_stamps() -> None:
    """ROS time tells no start; a plant in which no effort acts has nothing to go on from, unless we have."""
    first = 1_800_000_000 * 10**9
    for applied, decision in ((0.0, "start"), (0.25, "join"), (None, "join")):
        assert session().take(output(LIVE, first, applied=applied), 0).decision == decision
    paused = session()
    paused.saved_integral = np.array([0.4])
    outcome = paused.take(output(LIVE, first, applied=0.0), 0)
    assert outcome.decision == "join" and outcome.answer is not None and outcome.answer.began_with == 0.4
    lockstep = session()
    lockstep.plan = load_case("p1-c0.5").plans["setpoint"]
    assert lockstep.take(output(f"{lockstep.plan.digest}/a.1", PERIOD_NS, applied=0.0), 0).decision == "join"


def test_a_replay_of_an_episode_in_ros_time_begins_with_its_first_output_again() -> None:
    one, first = session(), 1_800_000_000 * 10**9
    for begins in (first, first):
        decisions = [one.take(output(LIVE, begins + k * PERIOD_NS, applied=0.0), 0).decision for k in range(30)]
        assert decisions == ["start", *["new"] * 29]


def test_silence_counts_in_simulated_time_which_may_not_have_begun_or_begin_again() -> None:
    one, first = session(), 10**18
    assert one.take(output(ROBOT, first), None).answer is not None
    assert not one.look_for_silence(None) and not one.look_for_silence(10**18)  # the first /clock
    assert not one.look_for_silence(10**18 + 400 * MS)
    assert not one.look_for_silence(5 * MS)  # the simulation has been reset
    assert one.take(output(ROBOT, first + PERIOD_NS), 10 * MS).decision == "new"
    assert one.look_for_silence(520 * MS)


def test_an_unstamped_message_at_a_steady_loop_changes_nothing_and_is_told() -> None:
    """What `ros2 topic pub --once /output sensor_msgs/msg/JointState "{position: [2.0]}"` sends."""
    for frame, first, why in ((LIVE, 0, UNLABELLED), (ROBOT, 10**18, UNSTAMPED)):
        disturbed, left_alone = session(), session()
        for k in range(300):
            for one in (disturbed, left_alone):
                outcome = one.take(output(frame, first + k * PERIOD_NS, math.sin(k / 50)), k * PERIOD_NS)
                assert outcome.answer is not None
            if k in (100, 101, 200):
                stray = disturbed.take(output("", 0, 2.0), k * PERIOD_NS + 1)
                assert (stray.decision, stray.answer, stray.why) == ("refused", None, why)
            assert effort_of(disturbed) == effort_of(left_alone)


@pytest.mark.parametrize(
    ("position", "why", "detail"),
    [
        ([math.nan], "output that is not finite refused", ""),
        ([math.inf], "output that is not finite refused", ""),
        ([], "output refused", ": it has 0 values for 1 lanes"),
        (
            [1.0, 2.0],
            "output refused",
            ": it has 2 values for 1 lanes; name the joints to control in joint_names, or give kp one value each",
        ),
    ],
)
def test_what_is_no_output_is_refused_with_the_reason(position: list[float], why: str, detail: str) -> None:
    one = session()
    first = one.take(output(LIVE, 0), 0).answer
    bad = Sample(PERIOD_NS, LIVE, (), np.array(position), NO_VALUES, NO_VALUES)
    assert one.take(bad, PERIOD_NS) == Outcome("refused", None, why, detail)
    assert one.answer is first


def test_joints_that_are_missing_are_named() -> None:
    one = Session(Controller(GAINS, PERIOD_NS), Joints(["elbow"]))
    outcome = one.take(Sample(0, "", ("wrist",), np.zeros(1), NO_VALUES, NO_VALUES), 0)
    assert (outcome.why, outcome.detail) == ("output refused", ": it has no joint elbow: it has wrist")


def test_an_output_again_gets_the_answer_of_before_whatever_has_changed_since() -> None:
    one = session()
    first = one.take(output(LIVE, 0), 0).answer
    one.controller.change_gains(GAINS.with_values(kp=9.0))
    one.set_setpoint(np.full(1, 5.0))
    again = one.take(output(LIVE, 0, y=7.0), MS)
    assert (again.decision, again.answer) == ("same", first)


def test_a_robot_that_does_not_stamp_anew_is_told_to() -> None:
    one = session()
    one.take(output(ROBOT, 0, 0.5), 0)
    assert one.take(output(ROBOT, 0, 0.5), PERIOD_NS).decision == "same"
    outcome = one.take(output(ROBOT, 0, 0.6), PERIOD_NS)
    assert (outcome.decision, outcome.why) == ("refused", NOT_STAMPED_ANEW)


def test_a_clock_that_was_set_is_followed_after_three_outputs_in_a_row() -> None:
    for jump in (-(10**11), 10**11):
        one = session()
        for k in range(100):
            one.take(output(ROBOT, 10**12 + k * PERIOD_NS), k * PERIOD_NS)
        decisions = [
            one.take(output(ROBOT, 10**12 + jump + k * PERIOD_NS), k * PERIOD_NS).decision for k in range(100, 105)
        ]
        stray = "late" if jump < 0 else "refused"
        assert decisions == [stray, stray, "join", "new", "new"]


def test_strays_never_take_a_loop_over_however_many_come() -> None:
    one = session()
    for k in range(100):
        assert one.take(output(LIVE, k * PERIOD_NS), k * PERIOD_NS).answer is not None
        for i in range(10):
            assert one.take(output("", k * i * PERIOD_NS, 9.0), k * PERIOD_NS + i).answer is None


def test_of_two_plants_the_newer_one_is_followed_and_the_older_one_joined_when_it_has_left() -> None:
    one = session()
    for k in range(50):
        one.take(output(LIVE, k * PERIOD_NS), k * PERIOD_NS)
    for k in range(50, 80):
        assert one.take(output(OTHER, (k - 50) * PERIOD_NS), k * PERIOD_NS).answer is not None
        outcome = one.take(output(LIVE, k * PERIOD_NS), k * PERIOD_NS)
        assert (outcome.answer, outcome.why) == (None, OTHER_EPISODE)
    decisions = [one.take(output(LIVE, k * PERIOD_NS), k * PERIOD_NS).decision for k in range(80, 85)]
    assert decisions == ["refused", "join", "new", "new", "new"]


def test_plant_and_controller_with_different_periods_are_told() -> None:
    one, plan = session(), load_case("p1-c0.5").plans["setpoint"]
    one.plan = plan
    one.take(output(f"{plan.digest}/a.1", 0), 0)
    outcome = one.take(output(f"{plan.digest}/a.1", 5 * MS), 0)
    assert (outcome.decision, outcome.why, one.is_out_of_step) == ("new", OUT_OF_STEP, True)
    assert outcome.answer is not None and outcome.detail == ": it is 0.005 s and 0.01 s"


def robot(periods_ns: Sequence[int]) -> Iterator[Sample]:
    """Outputs that lie so far apart."""
    stamp = 10**18
    for k, period_ns in enumerate(periods_ns):
        stamp += period_ns
        yield output(ROBOT, stamp, 0.5 + k % 2)


@pytest.mark.parametrize(
    ("periods_ns", "told"),
    [
        ([PERIOD_NS] * 300, ""),
        ([2 * PERIOD_NS] * 60, OFF_RATE),
        ([PERIOD_NS // 2] * 60, OFF_RATE),
        ([PERIOD_NS + PERIOD_NS // 10] * 300, ""),  # 10 per cent
        ([PERIOD_NS // 2, PERIOD_NS * 3 // 2] * 150, ""),  # jitter
        ([PERIOD_NS] * 20 + [40 * PERIOD_NS] + [PERIOD_NS] * 40, ""),  # a gap
    ],
)
def test_a_rate_that_is_not_sample_period_s_is_told(periods_ns: list[int], told: str) -> None:
    one = session()
    outcomes = [one.take(sample, k * PERIOD_NS) for k, sample in enumerate(robot(periods_ns))]
    assert all(outcome.answer is not None for outcome in outcomes)
    assert {outcome.why for outcome in outcomes} == {"", told}
    assert one.is_out_of_step == bool(told)


def test_a_rate_that_is_told_and_then_mended_is_right_again() -> None:
    one = session()
    for k, sample in enumerate(robot([2 * PERIOD_NS] * 60 + [PERIOD_NS] * 100)):
        one.take(sample, k * PERIOD_NS)
    assert not one.is_out_of_step


def test_a_robot_that_never_stamps_is_stuck_whether_it_moves_or_not() -> None:
    for moves in (0.0, 0.1):
        one = session()
        for k in range(20):
            one.take(output(ROBOT, 0, moves * k), k * PERIOD_NS)
        assert one.is_stuck
        one.take(output(ROBOT, PERIOD_NS, 0.5), 20 * PERIOD_NS)
        assert not one.is_stuck


# Joints


def test_single_gains_serve_every_joint() -> None:
    names = ["elbow", "wrist", "hand"]
    one = gains_from_mapping({"kp": 2.0, "ki": 1.0, "joint_names": names})
    assert one.lanes == 3 and one.per_lane("kp").tolist() == [2.0] * 3
    assert gains_from_mapping({"kp": 2.0, "joint_names": [""]}) == gains_from_mapping({"kp": 2.0})
    assert gains_from_mapping({"kp": 2.0, "joint_names": ["elbow"]}) == gains_from_mapping({"kp": 2.0})
    some = {"kp": 2.0, "effort_max": [1.0, 2.0, 3.0], "joint_names": names}
    assert gains_from_mapping(some).kp == 2.0  # as in recordings of before: their digests stay


NAN = math.nan


@pytest.mark.parametrize(
    ("names", "values", "merged"),
    [
        ((), [5.0], [5.0]),
        ((), [5.0, 6.0, 7.0], [5.0, 6.0, 7.0]),
        ((), [NAN, 6.0, NAN], [1.0, 6.0, 3.0]),
        (("wrist",), [6.0], [1.0, 6.0, 3.0]),
        (("hand", "base", "elbow"), [7.0, 9.0, 5.0], [5.0, 2.0, 7.0]),
        (("hand", "elbow"), [NAN, 5.0], [5.0, 2.0, 3.0]),
        ((), [5.0, 6.0], "2 values for 3 lanes"),
        ((), [NAN], "not finite"),
        ((), [math.inf, NAN, 1.0], "beyond"),
        (("base",), [1.0], "no joint of elbow, wrist, hand: it has base"),
        (("elbow", "wrist"), [1.0], "1 values for 2 names"),
    ],
)
def test_a_setpoint_for_some_of_the_joints_leaves_the_others(
    names: tuple[str, ...], values: list[float], merged: list[float] | str
) -> None:
    joints, before = Joints(["elbow", "wrist", "hand"]), np.array([1.0, 2.0, 3.0])
    if isinstance(merged, str):
        with pytest.raises(ValueError, match=merged):
            joints.merged(names, np.array(values), before, 1e100)
    else:
        assert joints.merged(names, np.array(values), before, 1e100).tolist() == merged


def test_joints_without_a_setpoint_are_held_when_the_first_one_is_for_others() -> None:
    joints = Joints(["elbow", "wrist"])
    one = Session(Controller(gains_from_mapping({**GAINS.as_dict(), "joint_names": joints.names}), PERIOD_NS), joints)
    one.holds_output = True
    one.set_setpoint(joints.merged(("wrist",), np.array([0.75]), one.lanes_setpoint, 1e100))
    y = np.array([0.25, 0.5])
    answer = one.take(Sample(10**18, ROBOT, ("elbow", "wrist"), y, NO_VALUES, NO_VALUES), 0).answer
    assert answer is not None and answer.setpoint.tolist() == [0.25, 0.75]
    assert not one.holds_output


def test_an_output_waits_for_its_plan() -> None:
    one, plan = session(), load_case("p1-c0.5").plans["setpoint"]
    first = output(f"{plan.digest}/a.1", 0)
    assert one.take(first, 0).decision == "waiting"
    assert one.waiting is first
    one.plan = plan
    assert one.take(first, 0).decision == "start"
    assert one.waiting is None


# How it begins


def test_it_joins_without_a_jump_and_tells_with_which_integral_action() -> None:
    joined = session().take(output(ROBOT, 10**18, y=0.4, applied=0.75), 0).answer
    assert joined is not None and joined.effort[0] == pytest.approx(0.75, abs=1e-12)
    assert len(joined.began_with) == 1
    started = session().take(output(LIVE, 0, y=0.4, applied=0.0), 0).answer
    assert started is not None and len(started.began_with) == 0


def test_it_joins_a_robot_that_reports_no_effort_without_integral_action() -> None:
    one = session()
    answer = one.take(output(ROBOT, 10**18, y=0.4, applied=None), 0).answer
    assert answer is not None and answer.began_with.tolist() == [0.0]
    assert answer.effort[0] == 2.0 * (0.8 * 1.0 - 0.4)  # the proportional action; the derivative rests
    one.timeout_ns = 20 * MS
    before = effort_of(one)
    after = one.take(output(ROBOT, 10**18 + 10**9, y=0.3, applied=None), 10**9).answer
    assert after is not None and after.effort[0] == pytest.approx(before, abs=1e-12)  # its own latest


def test_the_first_output_is_the_setpoint_if_it_is_to_be_held() -> None:
    one = session()
    one.holds_output = True
    one.take(output(ROBOT, 10**18, y=0.4), 0)
    answer = one.take(output(ROBOT, 10**18 + PERIOD_NS, y=0.6), PERIOD_NS).answer
    assert answer is not None and answer.setpoint.tolist() == [0.4]


def test_silence_is_noticed_once_and_only_in_realtime() -> None:
    one, plan = session(), load_case("p1-c0.5").plans["setpoint"]
    one.take(output(LIVE, 0), 0)
    assert [one.look_for_silence(ms * MS) for ms in (100, 600, 650)] == [False, True, False]
    assert one.take(output(LIVE, 700 * MS), 700 * MS).after_silence
    one.plan = plan
    one.take(output(f"{plan.digest}/a.2", 0), 800 * MS)
    assert not one.look_for_silence(10**12)


@pytest.mark.parametrize("first_line", ["0 setpoint 1", "0 start 60"])
@pytest.mark.parametrize("options", [PLAIN, ControllerOptions(setpoint_rate=2.0, effort_rate=50.0, filter_time=0.02)])
def test_two_episodes_through_a_session_are_the_simulation(first_line: str, options: ControllerOptions) -> None:
    """distributed = local, without ROS; and taken again as `verify` does."""
    case = replace(
        load_case("p1-c0.5"), options=options, episodes={"e": (first_line, "0.4 disturbance 0.5", "0.9 end")}
    )
    plan, local = case.plans["e"], case.simulate("e")
    live, again = (Session(Controller(case.gains, case.sample_period_ns, options), Joints(())) for _ in range(2))
    live.plan = again.plan = plan
    for number in (1, 2):
        simulator = PlantSimulator(case.plant, case.sample_period_ns, 1, case.effort_limits)
        label = EpisodeLabel(plan.digest, "a", number)
        episode, efforts = Episode(plan, simulator, case.plant_at, label), []
        running = True
        while running:
            y, applied = simulator.output.copy(), simulator.applied_effort.copy()
            sample = Sample(episode.stamp_ns, str(label), (), y, NO_VALUES, applied)
            answer = live.take(sample, episode.stamp_ns).answer
            assert answer is not None
            again.retake(Place(label, episode.stamp_ns), answer.setpoint, y, applied, None)
            assert effort_of(again) == effort_of(live)
            efforts.append(answer.effort.copy())
            running = episode.answer(answer.effort)
        assert np.array(efforts).tobytes() == local.control_effort.tobytes()


def effort_of(one: Session) -> float:
    assert isinstance(one.answer, Answer)
    return float(one.answer.effort[0])


def test_far_ahead_is_told() -> None:
    one = session()
    one.take(output(ROBOT, 10**12), 0)
    assert one.take(output(ROBOT, 10**15), PERIOD_NS).why == FAR_AHEAD
