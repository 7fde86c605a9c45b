"""The recorder: nothing is lost, a bag explains itself, is never overwritten, and disk trouble does not stop the
loop."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader as RosbagsReader

from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.graph.recorder.wanted import is_wanted, other_loops
from tdof_npid_ros.wire import JOINT_STATE

STEPS = int(os.environ.get("RECORDED_STEPS", 2_000))  # 100_000 for the full run
CASE = "p1-c0.5"
CALM = 20  # messages from one report to the next: when the loop has ended, there is little but diagnostics
GLOBAL_TOPICS = ("/parameter_events", "/rosout", "/diagnostics", "/clock")


def record(graph: Any, bag: Path, steps: int = STEPS, **options: Any) -> Any:
    """Run one episode with a recorder from the start; returns the stopped recorder."""
    graph.start("plant", case=CASE, lossless=bool(options.get("lossless", False)))
    graph.start("controller", case=CASE)
    recorder = graph.start("recorder", bag=str(bag), **options)
    graph.wait_for_nodes("/plant", "/controller", "/recorder")
    plan = ["0 setpoint 1", f"{steps * 0.005} end"]
    graph.start("scenario", case=CASE, episodes=["run"], plan__run=plan)
    graph.wait_until(lambda: graph.fact("/plant", "state") == "finished", 300, "the end of the episode")
    growth = CALM
    while growth >= CALM:
        before = int(graph.fact("/recorder", "recorded", 0))
        graph.wait_for_nodes("/recorder")
        growth = int(graph.fact("/recorder", "recorded", 0)) - before
    recorder.stop()
    return recorder


def test_lossless_at_full_speed_loses_nothing_and_e1_and_e2_hold(graph: Any, tmp_path: Path) -> None:
    recorder = record(graph, tmp_path / "bag", lossless=True)
    assert recorder.log.strip().endswith("0 lost")
    plant = next(process for process in graph.processes if process.node == "plant")
    assert "waiting for the recorder" not in plant.log and "no answer" not in plant.log  # all is well
    with BagReader(tmp_path / "bag") as reader:
        assert reader.custom_data["lost"] == "0"
        assert len(np.unique(reader.columns("/output", ["header.stamp"])["header.stamp"])) == STEPS + 1
    account = verify(tmp_path / "bag")
    assert account.sound and account.equal >= STEPS + 1 and not account.unverifiable
    (report,) = analyze([tmp_path / "bag"]).episodes
    assert (report.deviation.output, report.deviation.control_effort, report.episode.missing) == (0.0, 0.0, 0)


def test_a_bag_explains_itself(graph: Any, tmp_path: Path) -> None:
    """Parameters, offered QoS, type hashes, times of publishing and receiving, splits; also to software not ours."""
    record(graph, tmp_path / "bag", 400, max_duration=0.1, exclude=["controller_*"])
    with BagReader(tmp_path / "bag") as reader:
        topics = reader.topics
        assert "/controller_state" not in topics and {"/output", "/scenario_plan", *GLOBAL_TOPICS} <= topics.keys()
        assert "transient_local" in topics["/scenario_plan"].qos
        assert topics["/output"].type_hash.startswith("RIHS01_")
        columns = reader.columns("/output", ["header.stamp"])
        assert (columns["log_time"] > columns["publish_time"]).all()
        set_ = [p["name"] for row in reader.columns("/parameter_events")["new_parameters"] for p in row]
        assert {"kp", "model", "episodes", "compression"} <= set(set_)
    assert len(list((tmp_path / "bag").glob("*.mcap"))) > 1
    with RosbagsReader(tmp_path / "bag") as theirs:
        assert len(theirs.storage.files) > 1
        assert all(connection.digest.startswith("RIHS01_") for connection in theirs.connections)
        (plan,) = [connection for connection in theirs.connections if connection.topic == "/scenario_plan"]
        (qos,) = plan.ext.offered_qos_profiles
        assert (qos.reliability.name, qos.durability.name) == ("RELIABLE", "TRANSIENT_LOCAL")


def test_topics_by_pattern_and_a_new_file_at_a_size(graph: Any, tmp_path: Path) -> None:
    record(graph, tmp_path / "bag", 1000, topics=["out*", "/clock"], max_bytes=20_000, compression="none")
    with BagReader(tmp_path / "bag") as reader:
        assert reader.topics.keys() == {"/output", "/clock"}
        assert len(np.unique(reader.columns("/output", ["header.stamp"])["header.stamp"])) == 1001
    sizes = [path.stat().st_size for path in (tmp_path / "bag").glob("*.mcap")]
    assert len(sizes) > 4 and max(sizes) < 60_000


def test_a_loop_in_the_root_namespace_records_no_other_loop() -> None:
    names = ["/output", "/control_effort", "/plant/transition_event", "/left/output", "/left/control_effort"]
    topics = [(name, [JOINT_STATE]) for name in names]
    others = other_loops(topics, "/")
    default = ["*", "/parameter_events"]
    assert [name for name in names if is_wanted(name, "/", default, [""], others)] == names[:3]
    assert is_wanted("/left/output", "/", ["/left/*"], [""], others)
    assert is_wanted("/left/output", "/left", default, [""], other_loops(topics, "/left"))
    assert not is_wanted("/output", "/", default, ["output"], others)


def test_losses_are_counted_and_told(graph: Any, tmp_path: Path) -> None:
    """A recorder that is stopped for longer than a publisher keeps its messages."""
    from std_msgs.msg import Float64

    recorder = graph.start("recorder", bag=str(tmp_path / "bag"))
    graph.wait_for_nodes("/recorder")
    burst = graph.publisher("burst", Float64, 5)
    published = 0

    def publish(count: int) -> None:
        nonlocal published
        for _ in range(count):
            burst.publish(Float64(data=float(published)))
            published += 1

    publish(1)
    before = int(graph.fact("/recorder", "recorded", 0))
    graph.wait_until(lambda: int(graph.fact("/recorder", "recorded", 0)) > before, 20, "the first message")
    os.kill(recorder.process.pid, signal.SIGSTOP)
    publish(30_000)
    os.kill(recorder.process.pid, signal.SIGCONT)
    graph.wait_until(lambda: int(graph.fact("/recorder", "lost", 0)) > 0, 60, "the loss to be told")
    assert graph.fact("/recorder", "level") == 1 and "most on /burst" in graph.fact("/recorder", "message")
    publish(1)
    last = graph.fact("/recorder", "recorded")
    graph.wait_until(lambda: graph.fact("/recorder", "recorded") != last, 20, "the last message")
    recorder.stop()
    with BagReader(tmp_path / "bag") as reader:
        values = reader.columns("/burst")["data"]
        assert values[-1] == published - 1
        lost = int(reader.custom_data["lost /burst"])
        assert lost == published - len(values) > 0
        assert dict(reader.metadata)["recording"]["lost /burst"] == str(lost)
    assert recorder.log.strip().endswith(f"{lost} lost")


def test_a_second_publisher_is_no_loss(graph: Any, tmp_path: Path) -> None:
    """Each counts its own messages; the second one comes late, and its first ones before the recorder knows of it."""
    from std_msgs.msg import Float64

    recorder = graph.start("recorder", bag=str(tmp_path / "bag"), topics=["temperature"])
    graph.wait_for_nodes("/recorder")

    def recorded() -> int:
        return int(graph.fact("/recorder", "recorded", 0))

    first = graph.publisher("temperature", Float64, 1000)
    graph.publish_until(first, Float64(), recorded, what="the first message")
    for _ in range(500):
        first.publish(Float64())
    second = graph.node.create_publisher(Float64, "temperature", 1000)
    graph.wait_until(second.get_subscription_count, what="the recorder")
    before = recorded()

    def publish_both() -> int:
        first.publish(Float64())
        second.publish(Float64())
        return recorded()

    graph.wait_until(lambda: publish_both() > before + 700, what="messages of both")
    assert graph.fresh_fact("/recorder", "lost") == "0" and graph.fact("/recorder", "level") == 0
    recorder.stop()
    assert recorder.log.strip().endswith(" 0 lost")


def test_a_type_that_is_not_installed_is_left_out(graph: Any, tmp_path: Path) -> None:
    from std_msgs.msg import Float64
    from visualization_msgs.msg import Marker

    (tmp_path / "hidden" / "visualization_msgs").mkdir(parents=True)
    (tmp_path / "hidden" / "visualization_msgs" / "__init__.py").touch()
    graph.environment["PYTHONPATH"] = f"{tmp_path / 'hidden'}{os.pathsep}{graph.environment['PYTHONPATH']}"
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"))
    graph.node.create_publisher(Marker, "marker", 1)
    graph.wait_for_log(
        recorder, "/marker is not recorded: the Python package visualization_msgs is not the one installed", 60
    )
    graph.publisher("temperature", Float64).publish(Float64(data=20.0))
    before = int(graph.fact("/recorder", "recorded", 0))
    graph.wait_until(lambda: int(graph.fact("/recorder", "recorded", 0)) > before, 20, "the other topic")
    recorder.stop()
    assert recorder.log.count("/marker is not recorded") == 1
    with BagReader(tmp_path / "bag") as reader:
        assert "/temperature" in reader.topics and "/marker" not in reader.topics


def test_topics_that_appear_later_and_best_effort_ones(graph: Any, tmp_path: Path) -> None:
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64

    recorder = graph.start("recorder", bag=str(tmp_path / "bag"), topics=["temperature", "output"])
    graph.wait_for_nodes("/recorder")

    def recorded() -> int:
        return int(graph.fact("/recorder", "recorded", 0))

    late = graph.publisher("temperature", Float64)
    graph.publish_until(late, Float64(data=-1.0), recorded, what="the recorder to find the topic")
    # A robot that offers less than the loop's own nodes.
    weak = graph.node.create_publisher(
        JointState, "output", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    graph.wait_until(weak.get_subscription_count, 20, "the recorder to subscribe as best effort")
    for value in range(5):
        late.publish(Float64(data=float(value)))
    before = int(graph.fresh_fact("/recorder", "recorded", 0))
    graph.publish_until(
        weak, JointState(position=[1.0]), lambda: recorded() > before, what="the weak topic to be recorded"
    )
    recorder.stop()
    with BagReader(tmp_path / "bag") as reader:
        temperatures = reader.columns("/temperature")["data"].tolist()
        assert temperatures[-5:] == [0, 1, 2, 3, 4] and set(temperatures[:-5]) == {-1}
        assert reader.topics["/output"].count >= 1


def test_a_supervisor_records_bag_after_bag(graph: Any, tmp_path: Path) -> None:
    graph.start("plant", mode="realtime")
    graph.start("controller")
    graph.start("recorder", autostart=False, bag=str(tmp_path / "bag0"))
    graph.wait_for_nodes("/plant", "/controller", "/recorder")
    assert graph.change_state("/recorder", "configure")
    for number in range(3):
        assert graph.set_parameters("/recorder", bag=str(tmp_path / f"bag{number}"))[0].successful
        assert graph.change_state("/recorder", "activate")
        assert not graph.set_parameters("/recorder", bag=str(tmp_path / "other"))[0].successful
        graph.wait_for_nodes("/recorder")
        graph.wait_until(lambda: int(graph.fact("/recorder", "recorded", 0)) > 200, what="messages to be recorded")
        graph.wait_until(lambda: int(graph.fact("/recorder", "parameters_of", 0)) >= 3, what="the nodes' parameters")
        assert graph.change_state("/recorder", "deactivate")
    for number in range(3):
        with BagReader(tmp_path / f"bag{number}") as reader:
            total = sum(topic.count for topic in reader.topics.values())
            account = reader.custom_data
            assert account["recorded"] == str(total - snapshots(reader)) and account["lost"] == "0", account
            assert reader.topics["/output"].count > 50
        assert verify(tmp_path / f"bag{number}").different == 0


def snapshots(reader: BagReader) -> int:
    """Parameters that the recorder asked for itself: they are in the bag, but did not arrive on a topic."""
    return sum(len(row) > 1 for row in reader.columns("/parameter_events")["new_parameters"])


def test_a_bag_is_never_overwritten(graph: Any, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"))
    recorder.expected_status = 2
    graph.wait_until(lambda: recorder.process.poll() is not None, 60, "the recorder to refuse")
    lines = [line for line in recorder.log.splitlines() if "exists already" in line]
    assert recorder.process.returncode == 2 and len(lines) == 1


def test_a_vanished_folder_is_told_at_once_and_the_loop_goes_on(graph: Any, tmp_path: Path) -> None:
    graph.start("plant", case=CASE, lossless=True)
    graph.start("controller", case=CASE)
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"), lossless=True)
    graph.wait_for_nodes("/plant", "/controller", "/recorder")
    graph.start("scenario", case=CASE, episodes=["run"], plan__run=["0 setpoint 1", "25 end"])
    graph.wait_until(lambda: (tmp_path / "bag").is_dir() and int(graph.fact("/plant", "steps", 0)) > 0, 60, "steps")
    shutil.rmtree(tmp_path / "bag")
    graph.wait_for_log(recorder, "recording stopped")
    graph.wait_until(lambda: graph.fact("/recorder", "level") == 2, 20, "an error in the diagnostics")
    graph.wait_until(lambda: graph.fact("/plant", "state") == "finished", 120, "the loop to go on to its end")
    recorder.expected_status = 1


def test_a_plant_that_begins_after_its_recorder_has_given_up_does_not_wait(graph: Any, tmp_path: Path) -> None:
    graph.start("controller", case=CASE)
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"), lossless=True)
    recorder.expected_status = 1
    graph.wait_for_nodes("/controller", "/recorder")
    shutil.rmtree(tmp_path / "bag")
    graph.wait_for_log(recorder, "recording stopped")
    graph.start("plant", case=CASE, lossless=True)
    graph.start("scenario", case=CASE, episodes=["run"], plan__run=["0 setpoint 1", "25 end"])
    graph.wait_until(lambda: graph.fact("/plant", "state") == "finished", 120, "the loop to end")


def test_a_full_disk(graph: Any, tmp_path: Path) -> None:
    """A file system of 3 MiB, three chunks; what was written before it was full stays readable."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "none", disk], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("mounting a small file system needs root")
    try:
        graph.start("plant", case=CASE)
        graph.start("controller", case=CASE)
        recorder = graph.start("recorder", bag=str(disk / "bag"), compression="none")
        graph.wait_for_nodes("/plant", "/controller", "/recorder")
        graph.start("scenario", case=CASE, episodes=["run"], plan__run=["0 setpoint 1", "60 end"])
        graph.wait_for_log(recorder, "recording stopped", 60)
        assert "No space left" in recorder.log
        recorder.expected_status = 1
        recorder.stop()
        with BagReader(disk / "bag") as reader:
            assert len(reader.columns("/output")["log_time"]) > 100
    finally:
        for process in graph.processes:
            process.stop()
        subprocess.run(["umount", disk], check=True)


def test_a_killed_recorder_leaves_a_bag_that_can_be_verified(graph: Any, tmp_path: Path) -> None:
    graph.start("plant", case=CASE)
    graph.start("controller", case=CASE)
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"))
    graph.wait_for_nodes("/plant", "/controller", "/recorder")
    graph.start("scenario", case=CASE, episodes=["run"], plan__run=["0 setpoint 1", "25 end"])
    graph.wait_until(lambda: int(graph.fact("/recorder", "recorded", 0)) > 500, 60, "some recording")
    graph.wait_for_nodes("/recorder")
    recorder.send(signal.SIGKILL)
    account = verify(tmp_path / "bag")
    assert account.different == 0 and account.equal + sum(account.unverifiable.values()) > 0


def test_a_loop_that_waits_for_its_log_goes_on_with_the_next_recorder(graph: Any, tmp_path: Path) -> None:
    from rosgraph_msgs.msg import Clock

    graph.start("plant", case=CASE, lossless=True, reply_timeout=0.1)
    graph.start("controller", case=CASE)
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"), lossless=True)
    graph.start("scenario", case=CASE, episodes=["run"], plan__run=["0 setpoint 1", "3000 end"])
    clock = graph.collect("/clock", Clock)
    graph.wait_until(lambda: len(clock) > 3, 60.0, "steps")
    recorder.send(signal.SIGKILL)
    graph.wait_until(lambda: int(graph.fresh_fact("/plant", "held_up", 0)) > 3, what="the loop to wait")
    graph.catch_up()
    clock.clear()
    graph.start("recorder", bag=str(tmp_path / "next"), lossless=True)
    graph.wait_until(lambda: len(clock) > 3, 60.0, "steps")
