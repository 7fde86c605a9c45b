"""`replay` publishes a bag again, and compares a live controller's efforts with the recorded ones."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "analysis"))
from loop_bags import JOINT_STATE, STEP_NS, LoopBag, joint_state

from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.controller import Controller

CASE = dataclasses.replace(load_case("p1-c0.5"), episodes={"setpoint": ("0 setpoint 1", "1 end")})


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(CASE, CASE.gains)
        writer.episode(CASE, CASE.gains, "setpoint", 1)
    return tmp_path / "bag"


def wait_for_end(graph: Any, replay: Any, status: int) -> None:
    replay.expected_status = status
    graph.wait_until(lambda: replay.process.poll() is not None, 60, "the end of the replay")
    assert replay.process.returncode == status, replay.log


def test_every_message_is_published_again_in_order(graph: Any, bag: Path) -> None:
    from sensor_msgs.msg import JointState

    outputs = graph.collect("output", JointState)
    replay = graph.start("replay", bag=str(bag), rate=0.01)
    graph.wait_until(lambda: len(outputs) > 10, 60, "outputs")
    wait_for_end(graph, replay, 0)
    graph.wait_until(lambda: outputs[-1].header.stamp.sec == 1, what="the last output")
    y = CASE.simulate("setpoint").output[:, 0]
    found = np.array([message.position[0] for message in outputs])
    assert np.array_equal(found, y[len(y) - len(found) :])


def test_start_and_namespace_and_clock(graph: Any, bag: Path) -> None:
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState

    outputs, clock = graph.collect("/left/output", JointState), graph.collect("/clock", Clock)
    replay = graph.start("replay", namespace="/left", bag=str(bag), rate=0.01, start=0.02, clock=True, loop=True)
    began = time.monotonic()
    graph.wait_until(lambda: len(outputs) > 2 and clock, 60, "outputs and clock")
    assert outputs[0].header.stamp.nanosec >= 0.4e9 and time.monotonic() > began
    replay.stop()


def test_rate_and_loop(graph: Any, bag: Path) -> None:
    """Not faster than asked for, and from the beginning again."""
    from sensor_msgs.msg import JointState

    arrivals: list[tuple[float, int]] = []

    def on_output(message: JointState) -> None:
        arrivals.append((time.monotonic(), message.header.stamp.sec * 10**9 + message.header.stamp.nanosec))

    def rounds() -> list[int]:
        return [i for i in range(1, len(arrivals)) if arrivals[i][1] < arrivals[i - 1][1]]

    graph.node.create_subscription(JointState, "output", on_output, 10_000)
    replay = graph.start("replay", bag=str(bag), rate=0.05, loop=True)
    graph.wait_until(lambda: len(rounds()) == 3, 60, "three rounds")
    begin, end = rounds()[0], rounds()[1] - 1
    assert [stamp for _, stamp in arrivals[begin : end + 1]] == list(range(0, 10**9 + 1, CASE.sample_period_ns))
    recorded = 2 * 200 * STEP_NS / 1e9  # s; an answer lies between two outputs
    assert arrivals[end][0] - arrivals[begin][0] > 0.9 * recorded / 0.05
    replay.stop()


def written_by_mcap(folder: Path, encoding: str, schema_encoding: str, messages: list[bytes]) -> Path:
    """A file by the mcap package, without a checksum over all data."""
    file = folder / "foreign.mcap"
    writer = Writer(str(file), compression=CompressionType.NONE)
    writer.start()
    schema = writer.register_schema(JOINT_STATE, schema_encoding, b"")
    channel = writer.register_channel("/output", encoding, schema)
    for time_ns, data in enumerate(messages, start=1):
        writer.add_message(channel, log_time=time_ns, publish_time=time_ns, data=data)
    writer.finish()
    return file


def test_a_start_after_the_end_is_refused(graph: Any, bag: Path) -> None:
    replay = graph.start("replay", bag=str(bag), start=10.0)
    wait_for_end(graph, replay, 2)
    assert "nothing in it after 10 s: it lasts 0.04" in replay.log


def test_a_type_that_is_not_installed_is_left_out(graph: Any, bag: Path, tmp_path: Path) -> None:
    with BagReader(bag) as reader, BagWriter(tmp_path / "more") as writer:
        output = writer.add_topic("/output", JOINT_STATE)
        foreign = writer.add_topic("/gripper", "robot_msgs/msg/Grip", definition="float64 force", type_hash="")
        for _, log_time, publish_time, data in reader.messages(["/output"]):
            writer.write(output, data, log_time, publish_time)
            writer.write(foreign, bytes(12), log_time, publish_time)
    replay = graph.start("replay", bag=str(tmp_path / "more"))
    wait_for_end(graph, replay, 0)
    assert "/gripper is not replayed: the message type robot_msgs/msg/Grip is not installed" in replay.log


def test_what_is_no_cdr_is_left_out(graph: Any, tmp_path: Path) -> None:
    file = written_by_mcap(tmp_path, "json", "jsonschema", [b"{}"])
    replay = graph.start("replay", bag=str(file))
    wait_for_end(graph, replay, 0)
    assert "/output is not replayed: it is in json, not CDR" in replay.log


def test_a_replay_that_broke_off_is_no_success(graph: Any, tmp_path: Path) -> None:
    file = written_by_mcap(tmp_path, "cdr", "ros2msg", [joint_state(k, "base_link") for k in range(10)])
    file.write_bytes(file.read_bytes().replace(b"base_link", b"BASE_LINK", 1))
    replay = graph.start("replay", bag=str(file))
    wait_for_end(graph, replay, 1)
    assert "checksum" in replay.log


def test_a_robots_joint_states_are_given_to_the_controller(graph: Any, tmp_path: Path) -> None:
    """Its frame is no episode, and its outputs have another topic."""
    controller = Controller(CASE.gains, CASE.sample_period_ns)
    with LoopBag(tmp_path / "robot") as writer:
        writer.configuration(CASE, CASE.gains)
        for k in range(100):
            stamp, y = k * CASE.sample_period_ns, np.array([np.sin(k / 30)])
            controller.answer(stamp, np.zeros(1), y)
            writer.write("joint_states", JOINT_STATE, joint_state(stamp, "robot1/base_link", y))
            answer = joint_state(stamp, controller.digest, [0.0], controller.effort)
            writer.write("control_effort", JOINT_STATE, answer)
    graph.start("controller", "-r", "output:=joint_states", case="p1-c0.5")
    replay = graph.start("replay", bag=str(tmp_path / "robot"), compare=True)
    wait_for_end(graph, replay, 0)
    assert "100 control efforts equal bit for bit, 0 differ" in replay.log


def test_nothing_compared_is_no_success(graph: Any, bag: Path) -> None:
    """After the last answer there is nothing to wait for."""
    graph.start("controller", case="p1-c0.5")
    replay = graph.start("replay", bag=str(bag), compare=True, start=(2 * 201 + 3) * STEP_NS / 1e9)
    wait_for_end(graph, replay, 1)
    assert "nothing was compared" in replay.log


def test_the_same_controller_gives_the_recorded_efforts(graph: Any, bag: Path) -> None:
    graph.start("controller", case="p1-c0.5")
    replay = graph.start("replay", bag=str(bag), compare=True)
    wait_for_end(graph, replay, 0)
    assert "201 control efforts equal bit for bit, 0 differ" in replay.log


def test_another_controller_is_told_apart(graph: Any, bag: Path) -> None:
    graph.start("controller", case="p1-c0.5", kp=5.0)
    replay = graph.start("replay", bag=str(bag), compare=True)
    wait_for_end(graph, replay, 0)
    assert "other parameters" in replay.log and " 0 differ" not in replay.log


def test_first_messages_far_before_the_rest_are_not_waited_for(graph: Any, tmp_path: Path) -> None:
    """As those that came before the first `/clock`, and so bear the time 0."""
    from sensor_msgs.msg import JointState

    with BagWriter(tmp_path / "robot") as writer:
        topic = writer.add_topic("/joint_states", JOINT_STATE)
        for step, time_ns in enumerate((0, *range(1000 * 10**9, 1001 * 10**9, 10**7))):
            writer.write(topic, joint_state(step, "base"), time_ns, time_ns)
    states = graph.collect("joint_states", JointState)
    replay = graph.start("replay", bag=str(tmp_path / "robot"), rate=0.2)
    graph.wait_until(lambda: len(states) >= 10, 30, "joint states")
    assert "first messages lie 1000 s before all others" in replay.log


NUMBERS = "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 1"
WORDS = "- history: keep_last\n  depth: 1\n  reliability: reliable\n  durability: transient_local"


@pytest.mark.parametrize("qos", [NUMBERS, WORDS])
def test_what_was_latched_is_latched_again_whichever_distribution_wrote_it(
    graph: Any, tmp_path: Path, qos: str
) -> None:
    from rclpy.qos import DurabilityPolicy

    with BagWriter(tmp_path / "robot") as writer:
        latched, other = (
            writer.add_topic(name, JOINT_STATE, qos=text) for name, text in (("/map", qos), ("/odom", ""))
        )
        for time_ns in range(0, 50 * 10**9, 10**9):
            for topic in (latched, other):
                writer.write(topic, joint_state(0, ""), time_ns, time_ns)
    graph.start("replay", bag=str(tmp_path / "robot"))

    def durability(topic: str) -> Any:
        found = graph.node.get_publishers_info_by_topic(topic)
        return found[0].qos_profile.durability if found else None

    graph.wait_until(lambda: durability("/map") and durability("/odom"), 60, "the publishers")
    assert durability("/map") == DurabilityPolicy.TRANSIENT_LOCAL
    assert durability("/odom") == DurabilityPolicy.VOLATILE


def test_a_missing_bag_is_refused_in_one_line(graph: Any, tmp_path: Path) -> None:
    replay = graph.start("replay", bag=str(tmp_path / "none"))
    wait_for_end(graph, replay, 2)
    assert "none" in replay.log
