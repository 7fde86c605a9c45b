"""Faults in a realtime loop of real processes. The bounds are those of docs/operation.md."""

from __future__ import annotations

import math
import os
import random
import shutil
import signal
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_operation import CONTROLLER, PLANT, Live

from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.graph.runtime.node import as_float

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


@pytest.mark.parametrize("node", ["scenario", "recorder"])
def test_an_onlooker_stopped_killed_and_started_again(live: Live, node: str, tmp_path: Path) -> None:
    """The loop does not need scenario and recorder: with them stopped or gone, nothing moves."""
    graph = live.graph

    def start() -> Any:
        options = {"bag": str(tmp_path / "bag")} if node == "recorder" else {"play": False}
        return graph.start(node, namespace=live.namespace, **options)

    def bounded(action: Callable[[], None]) -> None:
        live.settle()
        first, efforts_from = len(live.outputs), len(live.efforts)
        action()
        live.settle()
        live.settle()
        assert excursion(live, first) < BOUND
        assert np.max(np.abs(np.diff([m.effort[0] for m in live.efforts[efforts_from:]]))) < JUMP

    name = f"{live.namespace}/{node}"
    process = start()
    graph.wait_for_nodes(name)
    bounded(lambda: process.send(signal.SIGSTOP))
    bounded(lambda: process.send(signal.SIGCONT))
    graph.wait_for_nodes(name)
    bounded(lambda: process.send(signal.SIGKILL))
    if node == "recorder":
        assert verify(tmp_path / "bag").different == 0
        (tmp_path / "bag").rename(tmp_path / "killed")
    process = start()
    graph.wait_for_nodes(name)
    process.stop()


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

    def junk() -> bytes:
        return b"\0\1\0\0" + rng.randbytes(rng.randint(0, 99))

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
    makers["/live/manual_effort"] = (JointState, signal_)
    not_read_here = ("/live/setpoint", "/live/disturbance", "/live/manual_effort")  # the others end this test's node
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
            if topic in not_read_here:
                publisher.publish(junk())
            live.graph.spin_once(0.0)
        live.graph.node.destroy_publisher(publisher)
    live.settle()
    assert excursion(live, first) < BOUND
    assert live.controller.log.count("scenario_plan refused") == 1  # each cause once


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_malformed_episodes_clocks_and_accounts_end_no_node(graph: Any, mode: str) -> None:
    """What scenario and plant hear of each other, forged."""
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import KeyValue
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Header

    from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS

    rng = random.Random(2)
    words = ["", "x", "-1", "9" * 5000, "nan", "finished", "\u0663", "1e9"]

    def episode() -> Any:
        labels = [*words, "-/a.1", f"{'0' * 12}/a.{'9' * 18}", f"{'0' * 12}/a.\u0663"]
        return KeyValue(key=rng.choice(labels), value=rng.choice(words))

    def time() -> Any:
        return Time(sec=rng.randint(-(2**31), 2**31 - 1), nanosec=rng.randint(0, 2**32 - 1))

    plan = ["0 setpoint 1", "0 plant.gain 1", "3000 end"]
    plant = graph.start("plant", mode=mode, lossless=True)
    controller = graph.start("controller")
    scenario = graph.start("scenario", mode=mode, episodes=["e"], plan__e=plan)
    graph.wait_for_nodes("/plant", "/controller", "/scenario")
    makers = {
        "/episode": (KeyValue, episode),
        "/clock": (Clock, lambda: Clock(clock=time())),
        "/recorded": (JointState, lambda: JointState(header=Header(stamp=time(), frame_id=rng.choice(words)))),
    }
    for topic, (kind, make) in makers.items():
        publisher = graph.node.create_publisher(kind, topic, LATCHED_QOS)
        for _ in range(MALFORMED):
            publisher.publish(make())
            graph.spin_once(0.0)
    graph.wait_for_nodes("/plant", "/controller", "/scenario")
    assert int(graph.fact("/scenario", "rejected", 0)) > 0
    assert all(process.process.poll() is None for process in (plant, controller, scenario))


def rejections(live: Live) -> int:
    nodes = (live.controller_name, live.plant_name)
    return sum(int(live.graph.fact(node, name, 0)) for node in nodes for name in ("rejected", "late"))


def fresh_rejections(live: Live) -> int:
    live.graph.wait_for_nodes(live.controller_name, live.plant_name)
    return rejections(live)


NODES = ("plant", "controller", "scenario", "recorder", "tuner")


@pytest.mark.parametrize("node", NODES)
def test_random_parameters_of_every_node_are_accepted_or_refused_whole(graph: Any, node: str, tmp_path: Path) -> None:
    from rcl_interfaces.srv import ListParameters

    arguments = {"recorder": ["-p", f"bag:={tmp_path / 'bag'}"], "tuner": ["-p", "case:=p1-c0.5"]}.get(node, [])
    process = graph.start(node, *arguments)
    name = f"/{node}"
    graph.wait_for_nodes(name)
    names = list(graph.call(f"{name}/list_parameters", ListParameters, again=True).result.names)
    rng = random.Random(node)
    wild = [None, True, 0, -7, 2**62, 0.5, -1.0, 1e300, math.nan, -math.inf, "", "x", [b"x", b"y"], [], [True], [0, 1],
    [1.0],
            [math.nan], ["0 setpoint 1", "1 end"], ["a", ""]]  # fmt: skip
    for _ in range(CHANGES):
        changes = {one: rng.choice(wild) for one in rng.sample(names, rng.choice([1, 1, 2, 3]))}
        before = graph.get_parameters(name, *names)
        (result,) = graph.set_parameters(name, atomically=True, **changes)
        after = graph.get_parameters(name, *names)
        for one, was, now in zip(names, before, after, strict=True):
            expected = changes[one] if result.successful and one in changes else was
            is_float = isinstance(was[0] if isinstance(was, list) and was else was, float)
            expected = as_float(expected) if is_float else expected  # 3 is taken as 3.0
            assert same(now, expected), (changes, one, was, now, process.log)
        assert result.successful or result.reason


def same(one: Any, other: Any) -> bool:
    """Whether two parameters are equal, nan included."""
    return repr(list(one) if hasattr(one, "__len__") and not isinstance(one, str) else one) == repr(
        list(other) if hasattr(other, "__len__") and not isinstance(other, str) else other
    )


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


@pytest.mark.parametrize("step", [3600, -3600])
def test_a_wall_clock_that_is_set_moves_nothing(graph: Any, tmp_path: Path, step: int) -> None:
    """The nodes' wall clock is set by an hour while the loop runs; they live by the steady clock."""
    compiler, library, offset = shutil.which("cc"), tmp_path / "wall_clock.so", tmp_path / "offset"
    if compiler is None:
        pytest.skip("a C compiler is needed to give the nodes another wall clock")
    source = Path(__file__).with_name("wall_clock.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    offset.write_bytes(struct.pack("=q", 0))
    graph.environment |= {"LD_PRELOAD": str(library), "WALL_CLOCK_OFFSET": str(offset)}
    live = Live(graph, "/clock", {"fallback": "hold"}, {})
    live.settle()
    live.settle()
    names = (live.plant_name, live.controller_name)
    silences = [graph.fresh_fact(name, "silences", 0) for name in names]
    first, jumps_from, set_ns = len(live.outputs), len(live.efforts), time.time_ns()
    with offset.open("r+b") as stream:
        stream.write(struct.pack("=q", step))
    for name in names:  # until their reports bear the other time
        graph.wait_until(lambda n=name: abs(graph.fact(n, "stamp_ns") - set_ns - step * 10**9) < 60 * 10**9, 30)
    live.settle()
    live.settle()
    assert excursion(live, first) < 0.05
    assert np.max(np.abs(np.diff([m.effort[0] for m in live.efforts[jumps_from:]]))) < 0.05
    assert [graph.fact(name, "silences", 0) for name in names] == silences
    assert graph.set_parameters(live.controller_name, kp=3.0)[0].successful


def test_a_killed_plant_that_is_started_again(live: Live) -> None:
    with live.graph.expect_log(live.controller, "no output for 0.2 s"):
        live.plant.send(signal.SIGKILL)
    live.plant = live.graph.start("plant", namespace="/live", fallback="hold", effort_timeout=0.2, **PLANT)
    began = time.monotonic()
    live.settle()
    assert time.monotonic() - began < 30
