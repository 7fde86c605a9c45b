"""replayed = recorded: `verify` finds every bit that is off, and says what it could not check."""

from dataclasses import replace

import numpy as np
import pytest
from loop_bags import JOINT_STATE, START_NS, TRAJECTORY, LoopBag, joint_state, plan_message

from tdof_npid_ros.analysis import AnalysisError, verify
from tdof_npid_ros.analysis.verify import NO_PARAMETERS, UNKNOWN_STATE
from tdof_npid_ros.analysis.verify_messages import NO_ANSWER, STATE
from tdof_npid_ros.analysis.verify_plant import APPLIED, BEFORE_THE_BAG
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.controller import Controller, parameters_digest
from tdof_npid_ros.control.law import TERMS
from tdof_npid_ros.control.options import PLAIN


@pytest.fixture(scope="module")
def case() -> Case:
    return replace(
        load_case("p1-c0.5"),
        episodes={"setpoint": ("0 setpoint 1", "2 end"), "disturbance": ("0 disturbance 1", "2 end")},
    )


def write(folder, case, gains=None, **options) -> None:
    gains = gains or case.gains
    with LoopBag(folder) as bag:
        bag.configuration(case, gains)
        bag.episode(case, gains, "setpoint", 1, **options)
        bag.episode(case, gains, "disturbance", 2)


def test_a_sound_bag_is_verified_step_by_step(tmp_path, case, capsys) -> None:
    write(tmp_path / "bag", case)
    account = verify.verify(tmp_path / "bag")
    assert (account.equal, account.different, account.unverifiable) == (802, 0, {})
    assert main(["verify", str(tmp_path / "bag")]) == 0
    assert "802 control efforts verified" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["pid", "npid", "tdof_npid1", "tdof_npid2"])
@pytest.mark.parametrize("limits", [(-np.inf, np.inf), (-2.0, 3.0)])
def test_every_type_of_controller_many_lanes(tmp_path, case, kind, limits) -> None:
    gains = case.gains.with_values(type=kind, kp=(9.0, 5.0, 2.0), effort_min=limits[0], effort_max=limits[1])
    write(tmp_path / "bag", case, gains)
    assert verify.verify(tmp_path / "bag").equal == 802


def test_full_unwinding_is_verified(tmp_path, case) -> None:
    plain = case.gains.with_values(sigma=0.05)
    for name, gains in (("on", plain.with_values(full_unwinding=True)), ("off", plain)):
        write(tmp_path / name, case, gains)
        account = verify.verify(tmp_path / name)
        assert (account.equal, account.different, account.unverifiable) == (802, 0, {})


def test_one_bit_in_one_effort_is_found_and_named(tmp_path, case, capsys) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        original, seen = bag.write, []

        def tampered(topic: str, type_name: str, data: bytes) -> None:
            seen.append(topic)
            if topic == "control_effort" and seen.count(topic) == 100:
                data = data[:-8] + bytes([data[-8] ^ 1]) + data[-7:]
            original(topic, type_name, data)

        bag.write = tampered  # type: ignore[method-assign]
        bag.configuration(case, case.gains)
        bag.episode(case, case.gains, "setpoint", 1)
    account = verify.verify(tmp_path / "bag")
    assert (account.equal, account.different) == (400, 1)
    assert account.first is not None and account.first.step == 99
    assert account.first.stamp_ns == 99 * case.sample_period_ns
    assert main(["verify", str(tmp_path / "bag")]) == 1
    printed = capsys.readouterr().out
    assert "first difference: control effort in /control_effort, message 99, at 0.495 s" in printed
    assert "kp" in printed and "proportional" in printed


def test_a_setpoint_that_is_not_the_plans_is_found(tmp_path, case) -> None:
    other = replace(case, episodes={"setpoint": ("0 setpoint 1", "1 setpoint 1.5", "2 end")})
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        run, plan = other.simulate("setpoint"), case.plans["setpoint"]
        from loop_bags import TRAJECTORY, plan_message

        from tdof_npid_ros.control.controller import parameters_digest

        bag.write("scenario_plan", TRAJECTORY, plan_message(plan))
        digest = parameters_digest(case.gains, case.sample_period_ns)
        for k in range(len(run.time)):
            stamp, frame = k * case.sample_period_ns, f"{plan.digest}/1"
            bag.write("output", JOINT_STATE, joint_state(stamp, frame, run.output[k]))
            answer = joint_state(stamp, f"{digest} {frame}", [run.setpoint[k]], run.control_effort[k])
            bag.write("control_effort", JOINT_STATE, answer)
    account = verify.verify(tmp_path / "bag")
    assert account.first is not None and account.first.what == "setpoint"
    assert account.first.stamp_ns == 10**9 and account.different == 201


def test_after_lost_answers_the_rest_of_the_episode_is_not_verifiable(tmp_path, case) -> None:
    write(tmp_path / "bag", case, lost=range(100, 103))
    account = verify.verify(tmp_path / "bag")
    assert (account.equal, account.different) == (100 + 401, 0)
    assert account.unverifiable == {UNKNOWN_STATE: 298}


def test_a_bag_without_parameters_verifies_nothing_and_fails(tmp_path, case, capsys) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        bag.episode(case, case.gains, "setpoint", 1)
    assert verify.verify(tmp_path / "bag").unverifiable == {NO_PARAMETERS: 401}
    assert main(["verify", str(tmp_path / "bag")]) == 3
    assert "nothing was verified" in capsys.readouterr().out


def test_gains_that_change_during_an_episode(tmp_path, case) -> None:
    """Realtime, from live setpoints; the answers bear the digest of what they were computed with."""
    changed = case.gains.with_values(kp=5.0, alpha=0.1)
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        controller = Controller(case.gains, case.sample_period_ns)
        for k in range(300):
            if k == 150:
                controller.change_gains(changed)
            if k == 160:  # the event arrives late
                bag.parameters("controller", {"kp": 5.0, "alpha": 0.1})
            y = np.array([np.sin(k / 30)])
            controller.answer(k * case.sample_period_ns, np.ones(1), y)
            bag.write("output", JOINT_STATE, joint_state(k * case.sample_period_ns, "", y))
            answer = joint_state(k * case.sample_period_ns, controller.digest, [1.0], controller.effort)
            bag.write("control_effort", JOINT_STATE, answer)
    assert verify.verify(tmp_path / "bag").equal == 300


def test_a_controller_that_is_restarted_begins_afresh(tmp_path, case) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        controller = Controller(case.gains, case.sample_period_ns)
        for k in range(200):
            if k == 120:
                controller.reset()
                bag._sequence["/control_effort"] = 0
            y = np.array([np.cos(k / 30)])
            controller.answer(k * case.sample_period_ns, np.ones(1), y)
            bag.write("output", JOINT_STATE, joint_state(k * case.sample_period_ns, "", y))
            answer = joint_state(k * case.sample_period_ns, controller.digest, [1.0], controller.effort)
            bag.write("control_effort", JOINT_STATE, answer)
    assert verify.verify(tmp_path / "bag").equal == 200


def test_a_bag_without_efforts_is_refused(tmp_path) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        bag.write("output", JOINT_STATE, joint_state(0, "", [1.0]))
    with pytest.raises(AnalysisError, match="no control efforts"):
        verify.verify(tmp_path / "bag")


def test_a_controller_that_begins_within_a_running_loop_tells_its_integral_action(tmp_path, case) -> None:
    """A robot's loop, manual mode and a rate limit in between; joints by name."""
    options = PLAIN
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        controller = Controller(case.gains, case.sample_period_ns)
        for k in range(300):
            stamp, y = 10**10 + k * case.sample_period_ns, np.array([np.sin(k / 30)])
            if k == 0:
                controller.begin_within(np.array([0.3]))
            if k in (100, 150):
                options = replace(options, manual=k == 100, manual_effort=0.7, effort_rate=5.0)
                bag.parameters("controller", {"manual": k == 100, "manual_effort": 0.7, "effort_rate": 5.0})
                controller.change(case.gains, options)
            controller.answer(stamp, np.ones(1), y)
            begun = controller.integral_before if k == 0 else ()
            bag.write("output", JOINT_STATE, joint_state(stamp, "robot1/base_link", y, [0.3]))
            answer = joint_state(stamp, controller.digest, [1.0], controller.effort, begun)
            bag.write("control_effort", JOINT_STATE, answer)
    assert verify.verify(tmp_path / "bag").equal == 300


def test_a_robot_s_loop_whose_first_outputs_are_not_in_the_bag_is_not_verifiable_and_not_different(
    tmp_path, case
) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        controller = Controller(case.gains, case.sample_period_ns)
        for k in range(50):
            stamp, y = 10**18 + k * case.sample_period_ns, np.array([np.sin(k / 30)])
            controller.answer(stamp, np.ones(1), y)
            if k >= 5:
                bag.write("output", JOINT_STATE, joint_state(stamp, "base_link", y))
            bag.write("control_effort", JOINT_STATE, joint_state(stamp, controller.digest, [1.0], controller.effort))
    account = verify.verify(tmp_path / "bag")
    assert (account.equal, account.different, account.unverifiable[UNKNOWN_STATE]) == (0, 0, 45)


def test_a_realtime_loop_recorded_before_outputs_bore_labels_began_from_nothing_at_each_stamp_of_0(
    tmp_path, case
) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        controller = Controller(case.gains, case.sample_period_ns)
        for k in range(300):
            if k % 120 == 0:
                controller.reset()
            stamp, y = (k % 120) * case.sample_period_ns, np.array([np.cos(k / 30)])
            controller.answer(stamp, np.ones(1), y)
            bag.write("output", JOINT_STATE, joint_state(stamp, "", y, [0.5]))
            bag.write("control_effort", JOINT_STATE, joint_state(stamp, controller.digest, [1.0], controller.effort))
    assert verify.verify(tmp_path / "bag").equal == 300


@pytest.mark.parametrize("first_ns", [0, 1_800_000_000_000_000_007])
def test_a_loop_with_labels_begins_at_each_that_is_new_whatever_the_stamp(tmp_path, case, first_ns) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        controller = Controller(case.gains, case.sample_period_ns)
        for k in range(300):
            if k in (0, 120):
                controller.reset()
            stamp, label = first_ns + k * case.sample_period_ns, f"-/a.{1 + (k >= 120)}"
            y = np.array([np.cos(k / 30)])
            controller.answer(stamp, np.ones(1), y)
            bag.write("output", JOINT_STATE, joint_state(stamp, label, y, [0.0]))
            answer = joint_state(stamp, f"{controller.digest} {label}", [1.0], controller.effort)
            bag.write("control_effort", JOINT_STATE, answer)
    assert verify.verify(tmp_path / "bag").equal == 300


def realtime_bag(folder, case, step, applied, limit=2.0, first=0, first_effort=0) -> None:
    """Thirty outputs of a plant in realtime, from the first one recorded on, that of `step` with another applied
    effort."""
    limited = replace(case, effort_limits=(-limit, limit))
    with LoopBag(folder) as bag:
        bag.configuration(limited, case.gains, mode="realtime", fallback="effort", fallback_effort=0.25)
        controller = Controller(case.gains, case.sample_period_ns)
        before = 0.0
        for k in range(30):
            stamp, y = START_NS + k * case.sample_period_ns, np.array([0.5 * np.sin(k / 10)])
            told = applied(before) if k == step else before
            controller.answer(stamp, np.ones(1), y)
            before = float(np.clip(controller.effort[0], -limit, limit))
            if k < first:
                bag.skip("output"), bag.skip("control_effort")
                continue
            bag.write("output", JOINT_STATE, joint_state(stamp, "-/0011aabb.1", y, [told]))
            if k < first_effort:
                bag.skip("control_effort")
                continue
            answer = joint_state(stamp, f"{controller.digest} -/0011aabb.1", [1.0], controller.effort)
            bag.write("control_effort", JOINT_STATE, answer)


@pytest.mark.parametrize(
    ("applied", "status"),
    [
        (lambda it: it, 0),
        (lambda it: 1e6, 1),  # never an effort
        (lambda it: 2.0, 0),  # at the plant's limit, which an effort went beyond
        (lambda it: 0.25, 0),  # the fallback
    ],
)
def test_an_applied_effort_in_realtime_is_a_recorded_one_within_the_limits_or_the_fallback(
    tmp_path, case, applied, status
) -> None:
    realtime_bag(tmp_path / "bag", case, 20, applied)
    account = verify.verify(tmp_path / "bag")
    assert account.status == status, account.lines()


def test_every_flipped_bit_of_an_applied_effort_in_realtime_is_found(tmp_path, case) -> None:
    for bit in range(64):
        flip = lambda it: float((np.array(it).view(np.uint64) ^ np.uint64(1 << bit)).view(np.float64))  # noqa: B023, E731
        realtime_bag(tmp_path / f"{bit}", case, 20, flip, 1e3)
        assert verify.verify(tmp_path / f"{bit}").status == 1, bit


def test_an_effort_is_not_applied_before_the_output_that_it_answers(tmp_path, case) -> None:
    first: list[float] = []
    realtime_bag(tmp_path / "bag", case, 25, lambda it: first.append(it) or it, 1e3)
    assert verify.verify(tmp_path / "bag").status == 0
    realtime_bag(tmp_path / "early", case, 20, lambda it: first[0], 1e3)
    assert verify.verify(tmp_path / "early").status == 1


def test_an_effort_of_before_the_recording_is_not_checked_and_not_different(tmp_path, case) -> None:
    realtime_bag(tmp_path / "bag", case, 20, lambda it: it, 1e3, first=10)
    account = verify.verify(tmp_path / "bag")
    assert not account.differs and account.unchecked == {BEFORE_THE_BAG: 1}
    assert account.checks[APPLIED].equal == 19
    realtime_bag(tmp_path / "other", case, 20, lambda it: 1e6, 1e3, first=10)
    assert verify.verify(tmp_path / "other").status == 1


def test_efforts_that_the_recorder_came_too_late_for_are_not_checked_and_not_different(tmp_path, case) -> None:
    realtime_bag(tmp_path / "bag", case, 20, lambda it: it, 1e3, first_effort=11)
    account = verify.verify(tmp_path / "bag")
    assert not account.differs and account.unchecked[BEFORE_THE_BAG] == 11
    realtime_bag(tmp_path / "other", case, 20, lambda it: 1e6, 1e3, first_effort=11)
    assert verify.verify(tmp_path / "other").status == 1


def terms_bag(folder, case, lost, wrong=()) -> None:
    """An episode played twice, with the law's terms; of the second the answers `lost` are missing."""
    names = list(TERMS)
    plan, run = case.plans["setpoint"], case.simulate("setpoint")
    with LoopBag(folder) as bag:
        bag.configuration(case, case.gains)
        bag.write("scenario_plan", TRAJECTORY, plan_message(plan))
        for number, alpha in ((1, 0.0), (2, 0.5)):
            gains = case.gains.with_values(alpha=alpha)
            bag.parameters("controller", {"alpha": alpha})
            run, label = case.simulate("setpoint", gains), f"{plan.digest}/0011aabb.{number}"
            controller = Controller(gains, case.sample_period_ns)
            for k, y in enumerate(run.output):
                stamp, r = k * case.sample_period_ns, run.setpoint[k : k + 1]
                controller.answer(stamp, r, y)
                applied = run.control_effort[k - 1] if k else [0.0]
                bag.write("output", JOINT_STATE, joint_state(stamp, label, y, applied))
                if number == 1 or k not in lost:
                    answer = joint_state(stamp, f"{controller.digest} {label}", r, controller.effort)
                    bag.write("control_effort", JOINT_STATE, answer)
                else:
                    bag.skip("control_effort")
                terms = controller.terms.ravel() + ((number, k) in wrong)
                bag.write("controller_state", JOINT_STATE, joint_state(stamp, "", terms, names=names))


def test_the_terms_of_an_answer_that_is_not_in_the_bag_are_not_those_of_another_episode(tmp_path, case) -> None:
    terms_bag(tmp_path / "whole", case, ())
    assert verify.verify(tmp_path / "whole").status == 0
    terms_bag(tmp_path / "bag", case, range(300, 310))
    account = verify.verify(tmp_path / "bag")
    assert not account.differs and account.unchecked[NO_ANSWER] == 101  # all from the first one lost on
    assert account.checks[STATE].equal == 701
    for at in ((1, 100), (2, 100)):  # both answers there, one with other terms
        terms_bag(tmp_path / f"{at}", case, (), {at})
        account = verify.verify(tmp_path / f"{at}")
        assert account.checks[STATE].different == 1 and not account.unchecked


def test_the_law_alone(tmp_path, case, capsys) -> None:
    """Outputs without applied efforts and plans that are missing do not matter to it."""
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        run, digest = case.simulate("setpoint"), parameters_digest(case.gains, case.sample_period_ns)
        for k in range(len(run.time)):
            stamp, frame = k * case.sample_period_ns, f"{case.plans['setpoint'].digest}/1"
            bag.write("measured", JOINT_STATE, joint_state(stamp, frame, run.output[k]))
            bag.write("u", JOINT_STATE, joint_state(stamp, f"{digest} {frame}", [1.0], run.control_effort[k]))
    names = ["--output", "/measured", "--effort", "/u"]
    assert main(["verify", str(tmp_path / "bag"), *names, "--law-only"]) == 0
    assert "401 control efforts verified" in capsys.readouterr().out
    assert main(["verify", str(tmp_path / "bag"), *names]) == 3
    assert "their plan is not in the bag" in capsys.readouterr().out
