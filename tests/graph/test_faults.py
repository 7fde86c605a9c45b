"""Faults in a realtime loop of real processes. The bounds are those of docs/operation.md."""

from __future__ import annotations

import math
import os
import random
import signal
import time
from typing import Any

import numpy as np
import pytest
from test_operation import CONTROLLER, PLANT, Live

BOUND = 0.5  # of the setpoint: how far the output may go in any of these faults, but for the loss of the plant itself
JUMP = 0.25  # largest step of the effort between two samples while parameters change at random
CHANGES = int(os.environ.get("TDOF_PARAMETER_CHANGES", "120"))
MALFORMED = int(os.environ.get("TDOF_MALFORMED_MESSAGES", "300"))


@pytest.fixture(scope="module")
def live(shared_graph: Any) -> Live:
    plant = {"fallback": "hold", "effort_timeout": 0.2}
    loop = Live(shared_graph, "/live", plant, {"effort_min": -2.0, "effort_max": 3.0, "output_timeout": 0.2})
    loop.settle()
    return loop


def excursion(live: Live, first: int) -> float:
    outputs = [m.position[0] for m in live.outputs[first:] if m.header.frame_id != "malformed"]
    assert np.isfinite(outputs).all()
    return float(np.max(np.abs(np.array(outputs) - 1.0)))


def test_a_stopped_controller(live: Live) -> None:
    live.settle()
    first, jumps_from = len(live.outputs), len(live.efforts)
    with live.graph.expect_log(live.plant, "no control_effort for 0.2 s: holding the last"):
        live.controller.send(signal.SIGSTOP)
    with live.graph.expect_log(live.plant, "control_effort comes again"):
        live.controller.send(signal.SIGCONT)
    live.settle()
    assert excursion(live, first) < BOUND
    assert np.max(np.abs(np.diff([m.effort[0] for m in live.efforts[jumps_from:]]))) < JUMP


def test_a_killed_controller_that_is_started_again(live: Live) -> None:
    live.settle()
    first = len(live.outputs)
    with live.graph.expect_log(live.plant, "no control_effort"):
        live.controller.send(signal.SIGKILL)
    live.controller = live.graph.start("controller", namespace="/live", effort_min=-2.0, effort_max=3.0,
                                       output_timeout=0.2, **CONTROLLER)  # fmt: skip
    live.settle()
    assert excursion(live, first) < BOUND


def test_a_stopped_plant(live: Live) -> None:
    live.settle()
    missed = int(live.graph.fresh_fact(live.plant_name, "missed_ticks", 0))
    first, jumps_from = len(live.outputs), len(live.efforts)
    with live.graph.expect_log(live.controller, "no output for 0.2 s: the integral action waits"):
        live.plant.send(signal.SIGSTOP)
    with live.graph.expect_log(live.controller, "output comes again"):
        live.plant.send(signal.SIGCONT)
    live.settle()
    assert excursion(live, first) < BOUND
    assert np.max(np.abs(np.diff([m.effort[0] for m in live.efforts[jumps_from:]]))) < JUMP
    assert int(live.graph.fresh_fact(live.plant_name, "missed_ticks", 0)) >= missed + 10


def test_random_parameter_changes(live: Live) -> None:
    """Each is accepted or refused whole, and the effort does not jump."""
    live.settle()
    rng = random.Random(0)
    wild = [math.nan, math.inf, -1.0, "x", True, [1.0, 2.0, math.nan], 1e300]
    names = ["kp", "ki", "kd", "alpha", "beta", "sigma", "n", "type", "anti_windup", "dead_band", "filter_time"]
    start, accepted = len(live.efforts), 0
    for _ in range(CHANGES):
        changes: dict[str, Any] = {"kp": rng.uniform(1, 4), "ki": rng.uniform(1, 6), "kd": rng.uniform(0, 0.05),
                                   "alpha": rng.uniform(0, 1), "beta": rng.uniform(0, 1), "sigma": rng.uniform(0.5, 5),
                                   "type": rng.choice(["pid", "npid", "tdof_npid1", "tdof_npid2"])}  # fmt: skip
        spoilt = rng.random() < 0.4
        if spoilt:
            changes[rng.choice(["kp", "ki", "sigma", "n", "type", "dead_band"])] = rng.choice(wild[:4])
        before = live.graph.get_parameters(live.controller_name, *names)
        (result,) = live.graph.set_parameters(live.controller_name, atomically=True, **changes)
        after = dict(zip(names, live.graph.get_parameters(live.controller_name, *names), strict=True))
        if result.successful:
            accepted += 1
            assert all(after[name] == value for name, value in changes.items())
        else:
            assert result.reason
            assert list(after.values()) == before or all(
                type(a) is type(b) and (a == b or a != a) for a, b in zip(after.values(), before, strict=True)
            )
    efforts = [m.effort[0] for m in live.efforts[start:]]
    assert accepted > CHANGES / 4
    assert np.isfinite(efforts).all()
    assert np.max(np.abs(np.diff(efforts))) < JUMP
    live.graph.set_parameters(live.controller_name, atomically=True, **CONTROLLER | {"sample_period": 0.01})


def test_malformed_messages_on_every_topic(live: Live) -> None:
    from builtin_interfaces.msg import Time
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Header
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    rng = random.Random(1)
    bad = [math.nan, math.inf, -math.inf]

    def signal_() -> Any:
        values = rng.choice([[], [rng.choice(bad)], [0.0] * rng.randint(2, 50), [0.0, rng.choice(bad)]])
        header = Header(
            frame_id="malformed", stamp=Time(sec=rng.randint(-5, 2**31 - 1), nanosec=rng.randint(0, 2**32 - 1))
        )
        return JointState(header=header, name=["x" * rng.randint(0, 99)], position=values, effort=values)

    def plan() -> Any:
        points = [
            JointTrajectoryPoint(positions=[rng.choice(bad)] * rng.randint(0, 3)) for _ in range(rng.randint(0, 4))
        ]
        return JointTrajectory(joint_names=[rng.choice(["setpoint", "plant.x", "", "junk"])], points=points)

    live.settle()
    first = len(live.outputs)
    makers = {
        f"/live/{name}": (JointState, signal_) for name in ("output", "setpoint", "control_effort", "disturbance")
    }
    makers["/live/scenario_plan"] = (JointTrajectory, plan)
    for topic, (kind, make) in makers.items():
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publisher = live.graph.publisher(topic, kind, latched)
        refused = fresh_rejections(live)
        live.graph.publish_until(
            publisher, make(), lambda n=refused: rejections(live) > n, what=f"a rejection of {topic}"
        )
        for _ in range(MALFORMED):
            publisher.publish(make())
            live.graph.spin_once(0.0)
        live.graph.node.destroy_publisher(publisher)
    live.settle()
    assert excursion(live, first) < BOUND
    assert live.controller.log.count("scenario_plan refused") == 1  # each cause once


def rejections(live: Live) -> int:
    nodes = (live.controller_name, live.plant_name)
    return sum(int(live.graph.fact(node, name, 0)) for node in nodes for name in ("rejected", "late"))


def fresh_rejections(live: Live) -> int:
    live.graph.wait_for_nodes(live.controller_name, live.plant_name)
    return rejections(live)


def test_a_clock_that_is_set_back_or_forward(live: Live) -> None:
    """A robot stamps its joint states with the wall clock; the controller goes on over a step without a jump."""
    from sensor_msgs.msg import JointState

    graph = live.graph
    efforts = graph.collect("/robot/control_effort", JointState)
    graph.start("controller", namespace="/robot", **CONTROLLER)
    output = graph.publisher("/robot/output", JointState)
    now, y = 1e6, 0.5

    def answer(stamp: float) -> float:
        message = JointState(position=[y], effort=[0.3])
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
        answered = graph.publish_until(
            output,
            message,
            lambda: [m for m in efforts[-5:] if m.header.stamp == message.header.stamp],
            what="an answer",
        )
        return float(answered[0].effort[0])

    assert answer(now) == pytest.approx(0.3)  # it begins within a running loop, from the effort that the robot has
    steady = [answer(now + 0.01 * k) for k in range(1, 10)]
    back = [answer(now - 3600 + 0.01 * k) for k in range(10)]
    forward = [answer(now + 3600 + 0.01 * k) for k in range(10)]
    assert max(abs(np.diff([*steady, *back, *forward]))) < JUMP + 0.1


def test_a_killed_plant_that_is_started_again(live: Live) -> None:
    with live.graph.expect_log(live.controller, "no output for 0.2 s"):
        live.plant.send(signal.SIGKILL)
    live.plant = live.graph.start("plant", namespace="/live", fallback="hold", effort_timeout=0.2, **PLANT)
    began = time.monotonic()
    live.settle()
    assert time.monotonic() - began < 30
