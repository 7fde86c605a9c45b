"""A loop on foreign topics: any field as output and setpoint, the effort into any field; recorded and verified."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.control.fields import FieldWriter, parse_fields
from tdof_npid_ros.interfaces import message_class


def writer(texts: Any) -> FieldWriter:
    return FieldWriter(parse_fields(texts), lambda kind: message_class(kind)())


def test_an_effort_is_written_into_a_place_a_field_or_a_whole_array() -> None:
    three = np.array([1.0, 2.0, 3.0])
    array = writer("/arm std_msgs/msg/Float64MultiArray data")
    array.write(0, three)
    assert list(array.messages["/arm"][1].data) == [1.0, 2.0, 3.0] and array.fits(3)
    places = writer([f"/arm std_msgs/msg/Float64MultiArray data[{place}] 2" for place in (2, 0)])
    places.write(0, three[:2])
    assert list(places.messages["/arm"][1].data) == [4.0, 0.0, 2.0] and not places.fits(3)
    drive = writer(["/cmd geometry_msgs/msg/TwistStamped twist.linear.x", "/lift std_msgs/msg/Float32 data -1 1"])
    drive.write(2_000_000_001, three[:2])
    twist = drive.messages["/cmd"][1]
    assert (twist.header.stamp.sec, twist.header.stamp.nanosec, twist.twist.linear.x) == (2, 1, 1.0)
    assert drive.messages["/lift"][1].data == -1.0


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        ("/cmd std_msgs/msg/Int32 data", "does not take the number 0.5"),
        ("/cmd std_msgs/msg/String data", "does not take"),
        ("/cmd geometry_msgs/msg/Twist linear", "does not take"),
        ("/cmd geometry_msgs/msg/Twist linear.w", "no field 'w'"),
        ("/cmd sensor_msgs/msg/JointState effort[elbow]", "say the place"),
        ("/cmd sensor_msgs/msg/JointState effort[100001]", "say the place"),
        ("/cmd sensor_msgs/msg/Imu orientation_covariance[9]", "it has 9 elements"),
        ("/cmd sensor_msgs/msg/Imu orientation_covariance", "it has 9 elements"),
        ("/cmd std_msgs/msg/Float64 data[0]", "does not take"),
        ("/cmd nothing_msgs/msg/Nothing data", "not installed"),
        (["/cmd std_msgs/msg/Float64 data", "/cmd std_msgs/msg/Float32 data"], "one type"),
    ],
)
def test_a_field_that_cannot_hold_an_effort_is_refused_at_the_start(texts: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        writer(texts)


@pytest.mark.parametrize(
    ("parameter", "text", "reason"),
    [
        ("output_from", "/imu sensor_msgs/msg/Imu angular_velocity.w", "no field 'w'"),
        ("output_from", "/output sensor_msgs/msg/JointState velocity", "own topic output"),
        ("setpoint_from", "/goal std_msgs/msg/Float65 data", "not installed"),
        ("effort_to", ["/a std_msgs/msg/Float64 data", "/b std_msgs/msg/Float64 data"], "no field for each of 1 lanes"),
    ],
)
def test_a_controller_that_cannot_do_it_does_not_start_and_says_why(
    graph: Any, parameter: str, text: Any, reason: str
) -> None:
    controller = graph.start("controller", **{parameter: text})
    controller.expected_status = 2
    controller.process.wait(60)
    assert parameter in controller.log and reason in controller.log


def test_an_imu_drives_and_the_effort_goes_to_a_forward_command_controller(graph: Any, tmp_path: Path) -> None:
    from geometry_msgs.msg import Vector3
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu, JointState
    from std_msgs.msg import Float64, Float64MultiArray

    commands, efforts = graph.collect("/arm/commands", Float64MultiArray), graph.collect("control_effort", JointState)
    controller = graph.start(
        "controller", type="pid", kp=2.0, ki=1.0, setpoint=0.0,
        output_from="/imu/data sensor_msgs/msg/Imu angular_velocity.z 2.0",
        setpoint_from="/goal std_msgs/msg/Float64 data 0.5 1.0",
        effort_to="/arm/commands std_msgs/msg/Float64MultiArray data[1] 10.0",
    )  # fmt: skip
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"))
    graph.wait_for_nodes("/controller", "/recorder")
    assert "waiting for /imu/data" in controller.log
    listeners = {"/output": 1, "/control_effort": 2}  # the recorder, which must have the first answer
    graph.wait_until(lambda: all(graph.node.count_subscribers(t) >= n for t, n in listeners.items()), what="a listener")
    graph.wait_for_nodes("/controller", "/recorder")  # a second later it has met the controller, too
    sensor = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    imu, goal = graph.publisher("/imu/data", Imu, sensor), graph.publisher("/goal", Float64)
    message = Imu(angular_velocity=Vector3(z=0.25))
    message.header.stamp.sec = 5

    def answer() -> Any:
        message.header.stamp.nanosec += 10_000_000
        stamp = message.header.stamp
        graph.publish_until(imu, message, lambda: efforts and efforts[-1].header.stamp == stamp, what="an answer")
        return efforts[-1]

    assert list(answer().effort) == [-1.0]
    graph.wait_until(lambda: commands, what="a command")
    assert list(commands[-1].data) == [0.0, -10.0]
    graph.publish_until(goal, Float64(data=4.0), lambda: answer().position[0] == 3.0, what="the setpoint")
    for _ in range(20):
        answer()
    recorder.stop()
    account = verify(tmp_path / "bag")
    assert account.different == 0 and account.equal >= 20, account


def test_best_effort_joint_states_drive_the_controller_and_what_is_lost_is_counted(graph: Any) -> None:
    """A sensor's burst while the controller stands still: more than its socket holds, and nobody sends it again."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    controller = graph.start("controller", type="pid", kp=2.0, setpoint=1.0, reliability="best_effort")
    sensor = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    states, message = graph.publisher("output", JointState, sensor), JointState(position=[0.25])
    message.header.stamp.sec = 5
    graph.publish_until(states, message, lambda: efforts, what="an answer")
    assert list(efforts[-1].effort) == [1.5]
    assert graph.fresh_fact("/controller", "lost", "0") == "0"
    controller.send(signal.SIGSTOP)
    for _ in range(20_000):
        message.header.stamp.nanosec += 10_000
        states.publish(message)
    controller.send(signal.SIGCONT)
    graph.publish_until(states, message, lambda: int(graph.fact("/controller", "lost", 0)) > 1000, what="the losses")
    assert "output: messages were lost on the way" in controller.log
    message.header.stamp.nanosec += 10_000
    stamp = message.header.stamp
    graph.publish_until(states, message, lambda: efforts[-1].header.stamp == stamp, what="that it goes on")


def test_two_lanes_from_two_topics(graph: Any, tmp_path: Path) -> None:
    """Each answer has something new of both; a setpoint of one lane leaves the other."""
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64

    efforts = graph.collect("control_effort", JointState)
    controller = graph.start(
        "controller", type="pid", kp=2.0, joint_names=["left", "right"], setpoint=0.0, sample_period=0.1,
        output_from=[f"/{side}/level std_msgs/msg/Float64 data" for side in ("left", "right")],
        setpoint_from=[f"/{side}/goal std_msgs/msg/Float64 data" for side in ("left", "right")],
    )  # fmt: skip
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"))
    left, right = (graph.publisher(f"/{side}/level", Float64) for side in ("left", "right"))
    goal = graph.publisher("/right/goal", Float64)
    graph.wait_for_nodes("/controller", "/recorder")
    waits = "nothing on /right/level yet"
    graph.publish_until(left, Float64(data=0.25), lambda: waits in graph.fact("/controller", "message"), what=waits)
    assert not efforts

    def answered() -> Any:
        left.publish(Float64(data=0.25))
        right.publish(Float64(data=0.5))
        return efforts

    graph.wait_until(answered, what="an answer")
    assert (list(efforts[-1].effort), list(efforts[-1].name)) == ([-0.5, -1.0], ["left", "right"])

    def commanded() -> Any:
        goal.publish(Float64(data=2.0))
        return answered() and list(efforts[-1].position) == [0.0, 2.0]

    graph.wait_until(commanded, what="the setpoint of one")
    recorder.stop()
    account = verify(tmp_path / "bag")
    assert account.different == 0 and account.equal > 1 and "Traceback" not in controller.log


def test_without_a_header_the_stamp_is_the_time_of_sending(graph: Any) -> None:
    import time

    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64

    efforts, outputs = graph.collect("control_effort", JointState), graph.collect("output", JointState)
    graph.start("controller", type="pid", kp=2.0, output_from="/level std_msgs/msg/Float64 data", setpoint=1.0)
    level = graph.publisher("/level", Float64)
    graph.publish_until(level, Float64(data=0.25), lambda: len(efforts) >= 3 and len(outputs) >= 3, what="answers")
    sent_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in efforts]
    assert sent_ns == sorted(set(sent_ns)) and abs(sent_ns[-1] - time.time_ns()) < 60 * 10**9
    assert list(efforts[-1].effort) == [1.5] and list(outputs[-1].position) == [0.25]
    assert {m.header.stamp.nanosec for m in efforts[-2:]} <= {m.header.stamp.nanosec for m in outputs}


@pytest.mark.parametrize("seconds", [5, 2**31 - 1])
def test_a_malformed_stamp_is_refused_and_the_controller_goes_on(graph: Any, seconds: int) -> None:
    from builtin_interfaces.msg import Time
    from sensor_msgs.msg import Imu, JointState

    efforts = graph.collect("control_effort", JointState)
    field = "/imu/data sensor_msgs/msg/Imu angular_velocity.z"
    controller = graph.start("controller", type="pid", kp=2.0, setpoint=1.0, output_from=field, setpoint_from=field)
    imu, message = graph.publisher("/imu/data", Imu), Imu()
    message.header.stamp = Time(sec=seconds, nanosec=2**32 - 1)
    graph.publish_until(imu, message, lambda: int(graph.fact("/controller", "rejected", 0)), what="a refusal")
    assert not efforts and "is no time" in controller.log
    message.header.stamp = Time(sec=5, nanosec=10_000_000)
    graph.publish_until(imu, message, lambda: efforts, what="an answer")
