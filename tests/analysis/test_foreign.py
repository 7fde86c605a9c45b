"""Anybody's bag: every number is right, or there is none and a reason."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from foreign_bags import (
    COMMAND,
    FLOAT64,
    FLOAT64_ARRAY,
    H_NS,
    JOINT_STATE,
    START_NS,
    STATE,
    STORE,
    TAU,
    TRAJECTORY_STATE,
    float64,
    floats,
    follows,
    header,
    joints,
    measured,
    setpoints,
    state,
    write,
)
from loop_bags import EVENT, parameter_event

from tdof_npid_ros.analysis import AnalysisError
from tdof_npid_ros.analysis.compare import Recorded
from tdof_npid_ros.analysis.report import Report, analyze
from tdof_npid_ros.analysis.sources import Chosen
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.cli import main
from tdof_npid_ros.metrics import SetpointMetrics
from tdof_npid_ros.responses import Response

POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
DURATION = STORE.types["builtin_interfaces/msg/Duration"]
STEP = follows(0.0, [(1.0, 1.0)])
STANDS = follows(5.0, [])
SETTLES_S = 0.6  # 1 - exp(-t/0.2) is within 5 % from 0.599 s on


def by_joint(report: Report) -> dict[str | None, list[Response]]:
    """The responses of each joint, of all episodes."""
    return {
        joint: list(found)
        for one in report.episodes
        for joint, found in zip(one.episode.joints, one.responses, strict=True)
    }


def steps(report: Report) -> list[Response]:
    return [r for one in report.episodes for lane in one.responses for r in lane if r.kind == "setpoint"]


def is_the_step(response: Response, size: float = 1.0, late_s: float = 0.0) -> bool:
    """A step that a first-order loop follows."""
    metrics = response.metrics
    assert isinstance(metrics, SetpointMetrics), response
    return (
        metrics.overshoot_percent < 0.01
        and metrics.settling_time_s == pytest.approx(SETTLES_S - late_s, abs=0.0101)
        and metrics.iae == pytest.approx(TAU * abs(size) * np.exp(-late_s / TAU), rel=0.01)
    )


# Names


def test_one_joint_driven_of_three_is_one_row(tmp_path) -> None:
    bag = measured({"shoulder": STANDS, "elbow": STEP, "wrist": STANDS}) + setpoints(
        [(0, {"elbow": 0}), (1, {"elbow": 1})]
    )
    report = analyze([write(tmp_path / "bag", bag)])
    assert list(by_joint(report)) == ["elbow"]
    assert is_the_step(by_joint(report)["elbow"][0])
    assert "elbow" in report.table()
    assert [row["joint"] for row in csv.DictReader(io.StringIO(report.as_csv()))] == ["elbow"]
    assert [lane["joint"] for lane in report.as_json()["episodes"][0]["lanes"]] == ["elbow"]


def test_two_joints_driven_of_three_are_two_rows(tmp_path) -> None:
    told = setpoints([(0, {"wrist": 5, "elbow": 0}), (1, {"wrist": 5, "elbow": 1})])
    report = analyze([write(tmp_path / "bag", measured({"shoulder": STANDS, "elbow": STEP, "wrist": STANDS}) + told)])
    found = by_joint(report)
    assert list(found) == ["elbow", "wrist"]
    assert is_the_step(found["elbow"][0])
    assert (found["wrist"][0].kind, found["wrist"][0].iae) == ("tracking", 0.0)


def test_joints_may_change_places_from_message_to_message(tmp_path) -> None:
    outputs = {"a": STEP, "b": STANDS}
    turned = {"b": STANDS, "a": STEP}
    bag = measured(outputs, 2.0) + [m for m in measured(turned) if m[0] >= 2 * 10**9]
    bag += setpoints([(0, {"b": 5, "a": 0}), (1, {"a": 1, "b": 5}), (3, {"b": 5, "a": 1})])
    found = by_joint(analyze([write(tmp_path / "bag", bag)]))
    assert is_the_step(found["a"][0]) and len(found["a"]) == 1
    assert found["b"][0].iae == 0.0


@pytest.mark.parametrize(
    "parts", [({"a": STEP}, {"b": STANDS}), ({"a": STEP, "c": STANDS}, {"b": STANDS, "d": STANDS})]
)
def test_publishers_of_other_joints_are_loops_of_their_own(tmp_path, parts) -> None:
    bag = measured(parts[0]) + measured(parts[1], offset_ns=H_NS // 2)
    bag += setpoints([(0, {"a": 0, "b": 5}), (1, {"a": 1, "b": 5})])
    report = analyze([write(tmp_path / "bag", bag)])
    assert [one.episode.joints for one in report.episodes] == [("a",), ("b",)]
    assert all(one.episode.sample_period_ns == H_NS for one in report.episodes)
    assert is_the_step(by_joint(report)["a"][0]) and by_joint(report)["b"][0].iae == 0.0


def test_setpoints_that_are_not_a_number_are_not_meant(tmp_path) -> None:
    told = setpoints([(0, {"a": 0, "b": np.nan, "c": 5}), (1, {"a": 1, "b": np.nan, "c": np.nan})])
    found = by_joint(analyze([write(tmp_path / "bag", measured({"a": STEP, "b": STANDS, "c": STANDS}) + told)]))
    assert list(found) == ["a", "c"]
    assert is_the_step(found["a"][0]) and found["c"][0].iae == 0.0


def test_setpoints_of_some_joints_come_in_turn(tmp_path) -> None:
    told = setpoints([(0, {"a": 0}), (0.5, {"b": 5}), (1, {"a": 1}), (2, {"b": 5})])
    found = by_joint(analyze([write(tmp_path / "bag", measured({"a": STEP, "b": STANDS}) + told)]))
    assert is_the_step(found["a"][0]) and len(found["a"]) == 1
    assert [r.kind for r in found["b"]] == ["tracking"] and found["b"][0].iae == 0.0


def test_an_effort_goes_by_the_names_that_it_bears(tmp_path) -> None:
    efforts = [
        (t + 1000, "/control_effort", JOINT_STATE, joints({"b": 2.0, "a": 1.0}, START_NS + t, "effort"))
        for t in range(0, 5 * 10**9, H_NS)
    ]
    report = analyze([write(tmp_path / "bag", measured({"a": STEP, "b": STANDS}) + efforts)])
    assert report.episodes[0].episode.joints == ("a", "b")
    assert [use.peak for use in report.episodes[0].effort] == [1.0, 2.0]


def test_a_setpoint_for_other_joints_is_not_this_one_s(tmp_path) -> None:
    report = analyze([write(tmp_path / "bag", measured({"a": STEP}) + setpoints([(0, {"b": 0}), (1, {"b": 1})]))])
    assert [r.iae for r in by_joint(report)["a"]] == [None]
    assert "the setpoint is not in the bag" in report.table()


def test_messages_without_joints_do_not_matter(tmp_path) -> None:
    empty = [(0, "/joint_states", JOINT_STATE, joints({}, START_NS))]
    told = setpoints([(0, {"a": 0}), (1, {"a": 1})])
    bag = write(tmp_path / "bag", empty + measured({"a": STEP}, offset_ns=H_NS) + told)
    assert is_the_step(by_joint(analyze([bag]))["a"][0])


def test_names_may_be_padded_with_zeros(tmp_path) -> None:
    told = setpoints([(0, {"a": 0}), (1, {"a": 1})])
    (response,) = by_joint(analyze([write(tmp_path / "bag", measured({"a\0\0": STEP}) + told)]))["a"]
    assert is_the_step(response)


# Nothing invented


@pytest.mark.parametrize("offset_ns", [0, 4_000_000])
def test_outputs_of_one_joint_from_two_publishers_have_no_metrics(tmp_path, offset_ns) -> None:
    """A robot and its simulation, for example."""
    half = lambda t: STEP(t) / 2  # noqa: E731
    bag = measured({"a": STEP, "b": STANDS}) + [
        (t + 1000, *of) for t, *of in measured({"a": half}, offset_ns=offset_ns)
    ]
    report = analyze([write(tmp_path / "bag", bag + setpoints([(0, {"a": 0, "b": 5}), (1, {"a": 1, "b": 5})]))])
    found = by_joint(report)
    assert (found["a"][0].metrics, found["a"][0].iae) == (None, None) and found["b"][0].iae == 0.0
    assert "a goes to and fro between two values: of two publishers" in report.table()


def test_the_last_digit_of_an_encoder_may_go_to_and_fro(tmp_path) -> None:
    digit = lambda t: STEP(t) + 1e-3 * (round(t * 100) % 2)  # noqa: E731
    bag = [(t + t // H_NS % 2 * 3_000_000, *of) for t, *of in measured({"a": digit}, stamp=lambda _: 0)]
    report = analyze([write(tmp_path / "bag", bag + setpoints([(0, {"a": 0}), (1, {"a": 1})]))])
    (response,) = by_joint(report)["a"]
    assert response.iae == pytest.approx(TAU, rel=0.02)


def test_a_joint_may_come_late_or_leave(tmp_path) -> None:
    late = [m for m in measured({"a": STEP, "late": follows(1.0, [(3.0, 2.0)])}) if m[0] >= 2 * 10**9]
    early = [m for m in measured({"a": STEP, "leaves": STANDS}) if m[0] < 2 * 10**9]
    told = setpoints([(0, {"a": 0, "late": 1, "leaves": 5}), (1, {"a": 1}), (3, {"late": 2, "leaves": 6})])
    found = by_joint(analyze([write(tmp_path / "bag", early + late + told)]))
    assert is_the_step(found["a"][0]) and is_the_step(found["late"][0])
    assert found["leaves"][0].metrics is None and "outputs are missing" in str(found["leaves"][0].reason)


def test_before_a_first_setpoint_there_is_none(tmp_path) -> None:
    bag = measured({"a": follows(5.0, [(2.0, 6.0)])}) + setpoints([(2, {"a": 6})])
    report = analyze([write(tmp_path / "bag", bag)])
    (response,) = by_joint(report)["a"]
    assert response.start_s == 2.0 and is_the_step(response)
    assert np.isnan(report.episodes[0].episode.setpoint[:200]).all()


def test_a_first_setpoint_where_the_output_is_already_is_no_step(tmp_path) -> None:
    noise = np.random.default_rng(1).normal(0, 1e-3, 1000)
    output = lambda t: 2.0 + noise[round(t * 100)]  # noqa: E731
    report = analyze([write(tmp_path / "bag", measured({"a": output}) + setpoints([(2, {"a": 2})]))])
    (response,) = by_joint(report)["a"]
    assert response.kind == "tracking" and response.iae == pytest.approx(3 * 1e-3 * np.sqrt(2 / np.pi), rel=0.2)


@pytest.mark.parametrize("long_before_s", [5.0, 0.5])
def test_a_setpoint_that_stood_before_the_recording_is_no_step(tmp_path, long_before_s) -> None:
    moving = follows(0.0, [(-long_before_s, 2.0)])
    told = setpoints([(-long_before_s, {"a": 2})])
    (response,) = by_joint(analyze([write(tmp_path / "bag", measured({"a": moving}) + told)]))["a"]
    assert response.kind == "tracking" and response.reason == "no single step"
    assert response.iae == pytest.approx(2 * TAU * np.exp(-long_before_s / TAU), rel=0.01)


def test_rounding_is_no_step(tmp_path) -> None:
    exact, rounded = 0.1, float(np.float32(0.1))
    told = setpoints(
        [(0, {"a": 0}), (1, {"a": exact}), (2, {"a": rounded}), (3, {"a": exact}), (4, {"a": exact + 1e-5})]
    )
    (response,) = by_joint(analyze([write(tmp_path / "bag", measured({"a": follows(0, [(1, 0.1)])}) + told)]))["a"]
    assert is_the_step(response, 0.1)


def test_the_rounding_of_a_large_setpoint_is_no_step_even_if_it_is_all_that_changes(tmp_path) -> None:
    told = setpoints([(0, {"a": 1000.1}), (2, {"a": float(np.float32(1000.1))})])
    (response,) = by_joint(analyze([write(tmp_path / "bag", measured({"a": follows(1000.1, [])}) + told)]))["a"]
    assert response.kind == "tracking"


def test_a_response_ends_before_the_next_step(tmp_path) -> None:
    """The outputs come half a period after the setpoints, so the first of them has moved already."""
    y = follows(0.0, [(1.0, 1.0), (3.0, -1.0), (3.5, 0.5)])
    bag = measured({"a": y}, offset_ns=H_NS // 2) + setpoints(
        [(0.0, {"a": 0}), (1, {"a": 1}), (3, {"a": -1}), (3.5, {"a": 0.5})]
    )
    first, second, third = by_joint(analyze([write(tmp_path / "bag", bag)]))["a"]
    assert is_the_step(first, late_s=0.005)
    assert isinstance(third.metrics, SetpointMetrics) and third.metrics.settling_time_s is not None
    assert isinstance(second.metrics, SetpointMetrics) and second.metrics.overshoot_percent == 0.0
    assert second.metrics.settling_time_s is None and "does not settle" in (second.reason or "")
    assert (first.start_s, first.end_s, second.start_s) == (1.0, 2.99, 3.0)


def test_a_step_down_is_a_step(tmp_path) -> None:
    bag = measured({"a": follows(2.0, [(1, -1.0)])}) + setpoints([(0, {"a": 2}), (1, {"a": -1})])
    (response,) = by_joint(analyze([write(tmp_path / "bag", bag)]))["a"]
    assert is_the_step(response, 3.0)


def test_a_ramp_is_no_step_and_a_step_after_it_is_one(tmp_path) -> None:
    ramp = [(1 + k * 0.02, {"a": k * 0.02}) for k in range(51)]
    y = follows(0.0, [(t, v["a"]) for t, v in ramp] + [(4.0, 2.0)])
    bag = write(tmp_path / "bag", measured({"a": y}, 7.0) + setpoints([(0, {"a": 0.0}), *ramp, (4, {"a": 2.0})]))
    path, step = by_joint(analyze([bag]))["a"]
    assert (path.kind, step.kind) == ("tracking", "setpoint")
    assert is_the_step(step)
    assert path.iae == pytest.approx(TAU * 1.0, rel=0.05)  # a ramp of 1/s is followed TAU s late, for 1 s


def test_a_slow_ramp_of_small_changes_is_not_taken_for_rounding(tmp_path) -> None:
    """Each change is far below a hundredth of the one step; together they are as large."""
    ramp = [(2 + k * 0.01, {"a": 1 + k * 0.001}) for k in range(1001)]
    bag = measured({"a": follows(0, [(1, 1.0), *((t, v["a"]) for t, v in ramp)])}, 14.0)
    bag += setpoints([(0, {"a": 0.0}), (1, {"a": 1.0}), *ramp])
    step, path = by_joint(analyze([write(tmp_path / "bag", bag)]))["a"]
    assert (step.kind, path.kind) == ("setpoint", "tracking")


def test_duplicated_messages_change_nothing(tmp_path) -> None:
    told = setpoints([(0, {"a": 0}), (0, {"a": 0}), (1, {"a": 1}), (1, {"a": 1})])
    bag = write(tmp_path / "bag", [m for m in measured({"a": STEP}) for _ in range(2)] + told)
    (response,) = by_joint(analyze([bag]))["a"]
    assert is_the_step(response)


# Times


def test_stamps_that_are_never_set_are_replaced_and_said_to_be(tmp_path, capsys) -> None:
    bag = measured({"a": STEP}, stamp=lambda _: 0) + setpoints([(0, {"a": 0}), (1, {"a": 1})])
    report = analyze([write(tmp_path / "bag", bag)])
    assert is_the_step(by_joint(report)["a"][0])
    assert "/joint_states: header.stamp is never set: its times are those of receiving" in report.table()
    assert report.as_json()["episodes"][0]["notes"]


def test_one_stamp_that_is_not_set_spoils_nothing(tmp_path) -> None:
    bag = measured({"a": STEP}, stamp=lambda t: 0 if t == 10**9 + 5 * H_NS else START_NS + t)
    report = analyze([write(tmp_path / "bag", bag + setpoints([(0, {"a": 0}), (1, {"a": 1})]))])
    (response,) = steps(report)
    assert response.metrics is not None and response.metrics.iae == pytest.approx(TAU, rel=0.05)


def test_a_simulation_s_clock_may_run_at_another_speed(tmp_path) -> None:
    """Outputs are stamped with the simulation's time, at half the speed of the wall clock of the setpoints."""
    slow = lambda t: STEP(t / 2)  # noqa: E731
    bag = measured({"a": slow}, 10.0, stamp=lambda t: 10**9 + t // 2, period_ns=2 * H_NS)
    report = analyze([write(tmp_path / "bag", bag + setpoints([(0, {"a": 0}), (2, {"a": 1})]))])
    (response,) = by_joint(report)["a"]
    assert response.start_s == 1.0 and is_the_step(response)


def test_times_are_readable_and_exact(tmp_path) -> None:
    report = analyze([write(tmp_path / "bag", measured({"a": STEP}) + setpoints([(0, {"a": 0}), (1, {"a": 1})]))])
    assert "1.7e" not in report.table()
    episode = report.as_json()["episodes"][0]
    assert (episode["first_stamp_ns"], episode["lanes"][0]["responses"][0]["start_s"]) == (START_NS, 1.0)


def test_jitter_of_the_stamps_is_no_error(tmp_path) -> None:
    """Within a sample: the first output after the setpoint may come a period later."""
    jitter = np.random.default_rng(2).integers(-300_000, 300_000, 500)
    times = np.arange(1, 501) * H_NS + jitter
    outputs = [(int(t), "/joint_states", JOINT_STATE, joints({"a": STEP(t / 1e9)}, START_NS + int(t))) for t in times]
    report = analyze([write(tmp_path / "bag", outputs + setpoints([(0, {"a": 0}), (1, {"a": 1})]))])
    (response,) = by_joint(report)["a"]
    assert response.iae == pytest.approx(TAU, abs=0.0101)
    assert isinstance(response.metrics, SetpointMetrics)
    assert response.metrics.settling_time_s == pytest.approx(SETTLES_S, abs=0.0151)


# Other people's loops


def float64_loop(topics=("/setpoint", "/state", "/control_effort")) -> list:
    messages = []
    for t in range(0, 5 * 10**9, H_NS):
        r = 1.0 if t >= 10**9 else 0.0
        for shift, topic, value in zip((-1000, 0, 1000), topics, (r, STEP(t / 1e9), 0.1), strict=True):
            messages.append((t + shift, topic, FLOAT64, float64(value)))
    return messages


def test_a_float64_loop_is_guessed_and_the_guess_is_told(tmp_path) -> None:
    report = analyze([write(tmp_path / "bag", float64_loop())])
    assert is_the_step(steps(report)[0])
    assert report.episodes[0].effort[0].peak == 0.1
    assert "taken as output /state:data, setpoint /setpoint:data, effort /control_effort:data" in report.table()


def test_topics_of_any_name_are_named(tmp_path, capsys) -> None:
    bag = write(tmp_path / "bag", float64_loop(("/wanted", "/level", "/valve")))
    assert main(["analyze", str(bag)]) == 2
    told = capsys.readouterr().err
    assert "--output TOPIC:FIELD" in told and "/level (std_msgs/msg/Float64)" in told
    options = ["--output", "/level:data", "--setpoint", "/wanted", "--effort", "/valve:data"]
    assert main(["analyze", str(bag), *options]) == 0
    assert "0.6000" in capsys.readouterr().out
    assert main(["analyze", str(bag), "--output", "/level:data"]) == 0
    assert "choose it with --setpoint TOPIC:FIELD of /valve (std_msgs/msg/Float64), /wanted" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "word"),
    [
        ("/no/topic:data", "no topic /no/topic"),
        ("/level:position", "no field 'position': there are data"),
        ("/level:data[1]", "data"),
        ("/level:", "write TOPIC:FIELD"),
        ("/level sensor_msgs/msg/Imu data", "is of type std_msgs/msg/Float64"),
    ],
)
def test_a_wrong_choice_is_refused_with_what_there_is(tmp_path, capsys, option, word) -> None:
    bag = write(tmp_path / "bag", float64_loop(("/wanted", "/level", "/valve")))
    assert main(["analyze", str(bag), "--output", option]) == 2
    told = capsys.readouterr().err
    assert word in told and told.count("\n") == 1


def test_the_state_of_a_pid_controller_holds_the_whole_loop(tmp_path) -> None:
    bag = [
        (t, "/pid_controller/controller_state", STATE, state({
            "a": (float(t >= 10**9), STEP(t / 1e9), 0.5), "b": (5.0, 5.0, 0.1)
        }, START_NS + t))
        for t in range(0, 5 * 10**9, H_NS)
    ]  # fmt: skip
    report = analyze([write(tmp_path / "bag", bag + measured({"a": STEP, "b": STANDS, "c": STANDS}))])
    found = by_joint(report)
    assert list(found) == ["a", "b"]
    assert is_the_step(found["a"][0]) and found["b"][0].iae == 0.0
    assert [use.peak for use in report.episodes[0].effort] == [0.5, 0.1]
    assert "taken as output /pid_controller/controller_state:dof_states.feedback" in report.table()


def test_where_positions_are_empty_another_field_is_asked_for(tmp_path) -> None:
    bag = [
        (t, "/joint_states", JOINT_STATE, joints({"a": STEP(t / 1e9)}, START_NS + t, "velocity"))
        for t in range(0, 5 * 10**9, H_NS)
    ]
    with pytest.raises(AnalysisError, match="hold no values: choose another field with --output"):
        analyze([write(tmp_path / "bag", bag)])
    chosen = Chosen.read("/joint_states:velocity", None, None)
    assert list(by_joint(analyze([tmp_path / "bag"], chosen))) == ["a"]


def test_the_state_of_a_trajectory_controller_names_its_joints(tmp_path) -> None:
    """Its names lie beside the messages that hold the values, and change places."""
    point = lambda values: STORE.types[POINT](np.array(values, np.float64), *[np.zeros(0)] * 3, DURATION(0, 0))  # noqa: E731
    bag = []
    for t in range(0, 5 * 10**9, H_NS):
        loop = {"a": (float(t >= 10**9), STEP(t / 1e9)), "b": (5.0, 5.0)}
        names = sorted(loop, reverse=t // H_NS % 2 == 1)
        reference, feedback = (point([loop[name][i] for name in names]) for i in range(2))
        state = STORE.types[TRAJECTORY_STATE](header(START_NS + t), names, reference, feedback, point([]), point([]))
        bag.append((t, "/jtc/controller_state", TRAJECTORY_STATE, state))
    found = by_joint(analyze([write(tmp_path / "bag", bag)]))
    assert list(found) == ["a", "b"]
    assert is_the_step(found["a"][0]) and found["b"][0].iae == 0.0


def test_a_command_to_many_goes_by_its_names(tmp_path) -> None:
    told = [
        (
            round(t * 1e9) - 1000,
            "/reference",
            COMMAND,
            STORE.types[COMMAND](["b", "a"], np.array([5.0, r]), np.zeros(0)),
        )
        for t, r in ((0, 0.0), (1, 1.0))
    ]
    found = by_joint(analyze([write(tmp_path / "bag", measured({"a": STEP, "b": STANDS}) + told)]))
    assert is_the_step(found["a"][0]) and found["b"][0].iae == 0.0


def test_a_controller_in_a_namespace_beside_the_robot_s_joint_states(tmp_path) -> None:
    told = {"/left/control_effort": {"a": lambda t: float(t >= 1)}, "/right/control_effort": {"b": lambda t: 5.0}}
    efforts = [
        (t + 1000, topic, JOINT_STATE, joints({j: r(t / 1e9) for j, r in of.items()}, START_NS + t, effort=[0.1]))
        for t in range(0, 5 * 10**9, H_NS)
        for topic, of in told.items()
    ]
    report = analyze([write(tmp_path / "bag", measured({"a": STEP, "b": STANDS, "c": STANDS}) + efforts)])
    left, right = report.episodes
    assert (left.episode.namespace, left.episode.joints) == ("/left/", ("a",))
    assert (right.episode.namespace, right.episode.joints) == ("/right/", ("b",))
    assert is_the_step(by_joint(report)["a"][0]) and by_joint(report)["b"][0].iae == 0.0


def test_a_setpoint_in_an_array_without_names_goes_by_place(tmp_path) -> None:
    told = [(round(t * 1e9) - 1000, "/reference", FLOAT64_ARRAY, floats(r)) for t, r in ((0, [0, 5]), (1, [1, 5]))]
    bag = write(tmp_path / "bag", measured({"a": STEP, "b": STANDS}) + told)
    found = by_joint(analyze([bag]))
    assert is_the_step(found["a"][0]) and found["b"][0].iae == 0.0
    chosen = Chosen.read("/joint_states:position[a]", "/reference:data[0]", None)
    found = by_joint(analyze([bag], chosen))
    assert list(found) == ["a"] and is_the_step(found["a"][0])
    with pytest.raises(AnalysisError, match="no message has that element"):
        analyze([bag], Chosen.read("/joint_states:position[a]", "/reference:data[2]", None))


def test_a_lone_number_is_no_setpoint_for_many_joints(tmp_path) -> None:
    told = [(t, "/setpoint", FLOAT64, float64(1.0)) for t in range(0, 10**9, H_NS)]
    report = analyze([write(tmp_path / "bag", measured({"a": STEP, "b": STANDS}) + told)])
    assert [r.iae for found in by_joint(report).values() for r in found] == [None, None]


def test_a_bag_is_not_changed_by_being_read(tmp_path) -> None:
    bag = write(tmp_path / "bag", float64_loop())
    before = {file: file.read_bytes() for file in Path(bag).iterdir()}
    analyze([bag])
    assert {file: file.read_bytes() for file in Path(bag).iterdir()} == before


def test_the_loop_to_compare_a_live_controller_with_may_be_named(tmp_path) -> None:
    efforts = [
        (t + 1000, "/arm/u", JOINT_STATE, joints({"a": 1.0}, START_NS + t, effort=[0.5])) for t in range(0, 10**9, H_NS)
    ]
    bag = write(tmp_path / "bag", measured({"a": STEP}, 1.0, topic="/arm/measured") + efforts)
    with BagReader(bag) as reader:
        recorded = Recorded.read(reader, str(bag), Chosen.read("/arm/measured", "/arm/measured", "/arm/u"))
        assert (recorded.output, recorded.setpoint, len(recorded.answers)) == ("/arm/measured", "/arm/measured", 100)
        with pytest.raises(AnalysisError, match="no topic /arm/v"):
            Recorded.read(reader, str(bag), Chosen.read("/arm/measured", None, "/arm/v"))


def test_a_publish_time_of_0_is_no_time(tmp_path) -> None:
    told = measured({"a": STEP}) + setpoints([(0, {"a": 0}), (1, {"a": 1})])
    with BagWriter(tmp_path / "bag") as writer:
        topics = {topic: writer.add_topic(topic, type_name) for _, topic, type_name, _ in told}
        for time_ns, topic, type_name, message in sorted(told, key=lambda one: one[0]):
            data = bytes(STORE.serialize_cdr(message, type_name))
            writer.write(topics[topic], data, START_NS + time_ns, 0, 0)
    (response,) = by_joint(analyze([tmp_path / "bag"]))["a"]
    assert is_the_step(response)


def test_publishers_whose_clocks_differ_are_put_in_order_by_the_log(tmp_path) -> None:
    """The robot's clock is an hour ahead of that of the setpoints."""
    told = measured({"a": STEP}) + setpoints([(0, {"a": 0}), (1, {"a": 1})])
    with BagWriter(tmp_path / "bag") as writer:
        topics = {topic: writer.add_topic(topic, type_name) for _, topic, type_name, _ in told}
        for time_ns, topic, type_name, message in sorted(told, key=lambda one: one[0]):
            data = bytes(STORE.serialize_cdr(message, type_name))
            ahead = 3600 * 10**9 if topic == "/joint_states" else 0
            writer.write(topics[topic], data, START_NS + time_ns, START_NS + time_ns + ahead, 0)
    report = analyze([tmp_path / "bag"])
    (response,) = by_joint(report)["a"]
    assert is_the_step(response) and "clocks differ" in report.table()


def test_where_all_is_logged_at_one_time_the_stamps_do(tmp_path) -> None:
    told = [
        (t, "/setpoint", JOINT_STATE, joints({"a": r}, START_NS + t)) for t, r in ((0, 0.0), (10**9 - 1000, 1.0))
    ] + measured({"a": STEP})
    report = analyze([write(tmp_path / "bag", [(0, *message[1:]) for message in told])])
    (response,) = by_joint(report)["a"]
    assert is_the_step(response) and "one receive time" in report.table()


def test_parameter_events_of_another_type_spoil_nothing(tmp_path) -> None:
    odd = [(0, "/parameter_events", FLOAT64, float64(1.0)), (0, "/scenario_plan", FLOAT64, float64(1.0))]
    told = measured({"a": STEP}) + setpoints([(0, {"a": 0}), (1, {"a": 1})])
    assert is_the_step(by_joint(analyze([write(tmp_path / "bag", odd + told)]))["a"][0])


def test_parameters_of_other_nodes_are_not_taken_for_ours(tmp_path) -> None:
    """As `ros2 bag record -a` finds them on a robot: names that ours have, too, values of every type, a model."""
    odd = {"p": 1.0, "kp": "1", "kd": [1.0, 2.0], "model": "os:system", "lanes": 7, "angle": True, "sample_period": 0.5}
    told = measured({"a": STEP}) + setpoints([(0, {"a": 0}), (1, {"a": 1})])
    with BagWriter(tmp_path / "bag") as writer:
        events = writer.add_topic("/parameter_events", EVENT)
        for node in ("/amcl", "/arm/driver", "/x"):
            writer.write(events, parameter_event(node, odd) + bytes(3), START_NS, START_NS, 1)
        topics = {topic: writer.add_topic(topic, type_name) for _, topic, type_name, _ in told}
        for time_ns, topic, type_name, message in sorted(told, key=lambda one: one[0]):
            data = bytes(STORE.serialize_cdr(message, type_name))
            writer.write(topics[topic], data, START_NS + time_ns, START_NS + time_ns, 0)
    report = analyze([tmp_path / "bag"])
    (response,) = by_joint(report)["a"]
    assert is_the_step(response) and report.episodes[0].episode.turn == (0.0,)


# What is missing, and what comes late


def test_a_gap_in_the_outputs_is_not_filled(tmp_path) -> None:
    """A few lost messages are no matter; of a second without outputs nobody knows the error."""
    slow = follows(0.0, [(1.0, 1.0)], tau=1.0)
    lost = np.random.default_rng(0).random(800) < 0.1
    told = setpoints([(0, {"a": 0}), (1, {"a": 1})])
    few = [m for m in measured({"a": slow}, 8.0) if not lost[m[0] // H_NS]]
    (response,) = by_joint(analyze([write(tmp_path / "few", few + told)]))["a"]
    assert response.iae == pytest.approx(1.0, rel=0.01)
    many = [m for m in measured({"a": slow}, 8.0) if not 1.2e9 < m[0] < 2.2e9]
    report = analyze([write(tmp_path / "many", many + told)])
    (response,) = by_joint(report)["a"]
    assert (response.metrics, response.iae) == (None, None)
    assert "outputs are missing" in report.table() and report.as_json()["episodes"][0]["missing"] > 80


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_output_that_is_no_number_is_missing(tmp_path, value) -> None:
    told = setpoints([(0, {"a": 0}), (1, {"a": 1})])
    for count, is_known in ((3, True), (30, False)):
        broken = lambda t: value if 2 <= t < 2 + count / 100 else STEP(t)  # noqa: B023, E731
        bag = write(tmp_path / f"{count}", measured({"a": broken, "b": STANDS}) + told)
        (response,) = by_joint(analyze([bag]))["a"]
        assert is_the_step(response) if is_known else response.iae is None and "no numbers" in str(response.reason)


@pytest.mark.parametrize("begin", [-np.pi, 0.0])
def test_an_angle_that_turns_over_is_measured_as_one(tmp_path, begin) -> None:
    """Nothing else tells in a robot's bag: the joint jumps by a turn."""
    inside = lambda angle: (angle - begin) % (2 * np.pi) + begin  # noqa: E731
    start, end = begin - 0.1, begin + 0.2
    way = follows(start, [(1.0, end)])
    bag = measured({"a": lambda t: inside(way(t)), "b": STANDS})
    told = setpoints([(0, {"a": inside(start), "b": 5}), (1, {"a": inside(end)})])
    report = analyze([write(tmp_path / "bag", bag + told)])
    (response,) = by_joint(report)["a"]
    assert is_the_step(response, 0.3) and by_joint(report)["b"][0].iae == 0.0
    assert "a turns over at its end: measured as an angle" in report.table()


def test_outputs_that_are_received_in_bursts_are_put_in_order_by_stamps_that_all_have(tmp_path) -> None:
    bursts = [((m[0] // 10**8 + 1) * 10**8 + m[0] // H_NS % 10, *m[1:]) for m in measured({"a": STEP})]
    stamped = [(t, "/setpoint", JOINT_STATE, joints({"a": r}, START_NS + t)) for t, r in ((0, 0.0), (10**9 - 1000, 1))]
    report = analyze([write(tmp_path / "stamped", bursts + stamped)])
    (response,) = by_joint(report)["a"]
    assert is_the_step(response) and "put in order by their stamps" in report.table()
    report = analyze([write(tmp_path / "not", bursts + setpoints([(0, {"a": 0}), (1, {"a": 1})]))])
    assert "outputs were received up to 0.09 s late: when a setpoint came is known no better" in report.table()
