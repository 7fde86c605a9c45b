"""`replay` publishes a bag again, and compares a live controller's efforts with the recorded ones."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "analysis"))
from loop_bags import LoopBag

from tdof_npid_ros.case import load_case

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
    replay = graph.start("replay", namespace="/left", bag=str(bag), rate=0.01, start=0.02, clock=True)
    began = time.monotonic()
    graph.wait_until(lambda: len(outputs) > 2 and clock, 60, "outputs and clock")
    assert outputs[0].header.stamp.nanosec >= 0.4e9 and time.monotonic() > began
    replay.stop()


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


def test_a_missing_bag_is_refused_in_one_line(graph: Any, tmp_path: Path) -> None:
    replay = graph.start("replay", bag=str(tmp_path / "none"))
    wait_for_end(graph, replay, 2)
    assert "none" in replay.log
