"""Random parameters, requests and messages: no node ends, none says a number that is not finite, all go on answering.

In short here; at length, and with another seed, by the environment:

    export TDOF_FUZZ_SEED=1 TDOF_FUZZ_PARAMETERS=3000 TDOF_FUZZ_MESSAGES=20000 TDOF_FUZZ_FILES=500
    pytest tests/graph/test_fuzz.py
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.wire import SignalReader

SEED = int(os.environ.get("TDOF_FUZZ_SEED", "0"))
PARAMETERS = int(os.environ.get("TDOF_FUZZ_PARAMETERS", "60"))  # sets for each node
MESSAGES = int(os.environ.get("TDOF_FUZZ_MESSAGES", "60"))  # on each topic
FILES = int(os.environ.get("TDOF_FUZZ_FILES", "40"))
AT_ONCE = 20  # requests on their way
SIGNALS = ("output", "control_effort", "controller_state")  # what must stay finite
MEMORY_KB = 2_000_000  # that no node may exceed

NODES = ("plant", "controller", "scenario", "recorder", "tuner", "replay")
NUMBERS = (0, 1, -1, 7, 2**31, 2**63 - 1, -(2**63))
FLOATS = (0.0, -0.0, 0.5, -1.0, 1e-300, 1e300, math.inf, -math.inf, math.nan)
TEXTS = ("", "x", "pid", "effort", "\n", "\x1b[2J", "../../x", "os:system", "0 setpoint 1", "1 end", "é" * 50,
         "z" * 10_000)  # fmt: skip


pytestmark = pytest.mark.timeout(60 + PARAMETERS + MESSAGES // 4 + 2 * FILES)


def start(graph: Any, node: str, folder: Path, **more: Any) -> Any:
    arguments = {"recorder": ["-p", f"bag:={folder / 'bag'}"], "tuner": ["-p", "case:=p1-c0.5"]}.get(node, [])
    if node == "replay":
        arguments = ["-p", f"bag:={recorded_bag(folder)}", "-p", "rate:=0.001"]
    return graph.start(node, *arguments, **more)


def recorded_bag(folder: Path) -> Path:
    from mcap.writer import Writer

    from tdof_npid_ros.bag import schema

    path = folder / "replayed.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        kind = "std_msgs/msg/Float64"
        number = writer.register_schema(kind, "ros2msg", schema.definition(kind).encode())
        channel = writer.register_channel("/x", "cdr", number)
        for second in (1, 2, 3):
            writer.add_message(channel, second * 10**9, b"\0\1\0\0" + bytes(8), second * 10**9)
        writer.finish()
    return path


def random_value(rng: random.Random) -> Any:
    """A parameter's value on the wire: any type's number, any content in any field."""
    from rcl_interfaces.msg import ParameterValue

    return ParameterValue(
        type=rng.choice((rng.randrange(10), rng.randrange(256))),
        bool_value=rng.random() < 0.5,
        integer_value=rng.choice(NUMBERS),
        double_value=rng.choice(FLOATS),
        string_value=rng.choice(TEXTS),
        byte_array_value=[bytes([rng.randrange(256)]) for _ in range(rng.randrange(3))],
        bool_array_value=[rng.random() < 0.5 for _ in range(rng.randrange(3))],
        integer_array_value=[rng.choice(NUMBERS) for _ in range(rng.randrange(3))],
        double_array_value=[rng.choice(FLOATS) for _ in range(rng.choice((0, 1, 2, 1000)))],
        string_array_value=[rng.choice(TEXTS) for _ in range(rng.randrange(3))],
    )


@pytest.mark.parametrize("node", NODES)
def test_random_parameter_sets(graph: Any, node: str, tmp_path: Path) -> None:
    from rcl_interfaces.msg import Parameter
    from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically

    patient = {"loop_timeout": 86_400.0} if node == "tuner" else {}  # there is no loop, and the long form is long
    process = start(graph, node, tmp_path, **patient)
    graph.wait_for_nodes(f"/{node}")
    names = list(graph.call(f"/{node}/list_parameters", ListParameters, again=True).result.names)
    rng = random.Random(f"{SEED} {node}")
    kinds = {SetParameters: "set_parameters", SetParametersAtomically: "set_parameters_atomically"}
    for kind, name in kinds.items():  # until client and node have found each other, answers may be lost
        graph.call(f"/{node}/{name}", kind, again=True)
    clients = {kind: graph.client(f"/{node}/{name}") for kind, name in kinds.items()}
    answered = 0
    for _ in range(0, PARAMETERS, AT_ONCE):
        futures = []
        for _ in range(AT_ONCE):
            parameters = [
                Parameter(name=rng.choice((*names, rng.choice(TEXTS))), value=random_value(rng))
                for _ in range(rng.choice((1, 1, 2, 3)))
            ]
            kind = rng.choice(list(kinds))
            futures.append(clients[kind].call_async(kind.Request(parameters=parameters)))
        end = time.monotonic() + 10
        while not all(future.done() for future in futures) and time.monotonic() < end:
            graph.spin_once(0.01)  # an answer may be lost, where the two have not found each other yet
        answered += sum(future.done() for future in futures)
        assert process.process.poll() is None, process.log
    assert answered > PARAMETERS // 2
    assert graph.get_parameters(f"/{node}", "autostart") == [True]
    check([process])
    facts = graph.diagnostics[f"/{node}"]
    assert "nan" not in {str(value) for value in facts.values()}


def mutated(rng: random.Random, data: bytes) -> bytes:
    """A serialized message with some of it changed, cut, repeated or inserted."""
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(len(content)) if content else 0
        match rng.randrange(6):
            case 0 if content:
                content[at] ^= 1 << rng.randrange(8)
            case 1 if content:
                content[at] = rng.randrange(256)
            case 2:
                content = content[:at]
            case 3:  # a length, of a text or of an array
                place = at // 4 * 4
                content[place : place + 4] = rng.choice((0, 1, 255, 2**16, 2**31 - 1, 2**32 - 1)).to_bytes(4, "little")
            case 4:
                content[at:at] = rng.randbytes(rng.choice((1, 8, 100)))
            case 5:  # a number
                place = at // 8 * 8 + 4
                content[place : place + 8] = np.float64(rng.choice(FLOATS)).tobytes()
    return bytes(content) or b"\0"  # the middleware sends no empty one


def example(kind: Any, rng: random.Random) -> Any:
    """A message with something in it."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Header
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    header = Header(frame_id=rng.choice(("", "base", "0123456789ab/1")))
    header.stamp.sec, header.stamp.nanosec = rng.randrange(100), rng.randrange(10**9)
    if kind is JointState:
        values = [rng.uniform(-2, 2)]
        return JointState(header=header, name=["lane0"], position=values, velocity=values, effort=values)
    if kind is JointTrajectory:
        points = [JointTrajectoryPoint(positions=[float(i), 1.0]) for i in range(2)]
        points[1].time_from_start.sec = rng.choice((1, 100, 99_999))
        return JointTrajectory(header=header, joint_names=["setpoint", rng.choice(("plant.gain", "disturbance"))],
                               points=points)  # fmt: skip
    if kind is DiagnosticArray:
        values = [KeyValue(key=key, value=rng.choice(TEXTS)) for key in ("state", "episode", "plan")]
        return DiagnosticArray(header=header, status=[DiagnosticStatus(name="/plant", values=values)])
    return kind()


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_mutated_messages(graph: Any, mode: str, tmp_path: Path) -> None:
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.serialization import serialize_message
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState

    from tdof_npid_ros.interfaces import message_class

    nodes = ("recorder", "plant", "controller", "scenario", *(["tuner"] if mode == "lockstep" else []))
    options: dict[str, dict[str, Any]] = {
        "plant": {"mode": mode, "case": "p1-c0.5"},
        "controller": {"case": "p1-c0.5"},
        "scenario": {"mode": mode, "play": False}, "recorder": {"exclude": ["/rosout"]},
        "tuner": {"loop_timeout": 600.0, "answer_timeout": 600.0},
    }  # fmt: skip
    processes = [start(graph, node, tmp_path, **options.get(node, {})) for node in nodes]
    if mode == "lockstep":
        processes[-1].expected_status = None  # a tuner may give a disturbed loop up, and say so
    graph.wait_for_nodes(*(f"/{node}" for node in nodes))
    topics = {
        name: types[0]
        for name, types in graph.node.get_topic_names_and_types()
        if any(info.node_name in nodes for info in graph.node.get_subscriptions_info_by_topic(name))
    }
    assert {"/output", "/control_effort", "/setpoint", "/scenario_plan", "/diagnostics"} <= set(topics)
    for client in list(graph.node.subscriptions):  # a typed subscription of the test's own is no part of the test
        graph.node.destroy_subscription(client)
    rng = random.Random(f"{SEED} {mode}")
    qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for topic, type_name in topics.items():
        kind = message_class(type_name)
        heard: dict[str, list[bytes]] = {name: [] for name in SIGNALS if f"/{name}" != topic}
        listeners = [
            graph.node.create_subscription(JointState, name, messages.append, 100, raw=True)
            for name, messages in heard.items()
        ]
        publisher = graph.node.create_publisher(kind, topic, qos)
        graph.wait_until(publisher.get_subscription_count, 20, f"a subscriber of {topic}")
        sent = 0
        for i in range(MESSAGES):
            data = serialize_message(example(kind, rng))
            with contextlib.suppress(
                rclpy_implementation.RCLError
            ):  # a type of fixed size takes no more bytes than it has
                publisher.publish(mutated(rng, data)[: len(data) if kind is Clock else None])
                sent += 1
            graph.spin_once(0.0)
            if i % 50 == 0:
                check(processes)
            if i % 10 == 0:
                time.sleep(0.01)  # so that they are taken, not overwritten
        assert sent > MESSAGES / 2
        graph.node.destroy_publisher(publisher)
        for listener in listeners:
            graph.node.destroy_subscription(listener)
        for name, messages in heard.items():
            for data in messages:
                sample = SignalReader().read(bytes(data))
                values = np.concatenate([sample.position, sample.effort])
                assert np.isfinite(values).all(), (topic, name, values)
    check(processes)
    for node in nodes[:4]:
        assert graph.get_parameters(f"/{node}", "autostart") == [True]


HOSTILE = (
    "[" * 5000, "&a [*a]", "9" * 310, ".nan", "-.inf", "1e308", "'1e308 end'", "!!python/object/apply:os.system [x]",
    "[1, [2, [3]]]", "{a: {b: 1}}", "''", "~", "true", "'\\0'", '"\\u0000\\ud800"', "z" * 100_000, "os:abort",
    "2026-02-30", "[" + "1.0, " * 60 + "1.0]", "0x" + "f" * 40, "-1", "1.0e-300", "1.0e+300", "0",
    "['0 setpoint ramp 1 over 99999', '99999 end']", "['0 plant.gain 1', '0 plant.x 1', '9 end']",
)  # fmt: skip


def hostile_file(rng: random.Random, good: str) -> bytes:
    """A parameter file with something in it that no one would write."""
    lines = good.splitlines()
    at = rng.randrange(len(lines))
    indent = len(lines[at]) - len(lines[at].lstrip())
    key = lines[at].strip().partition(":")[0]
    value = rng.choice(HOSTILE)
    match rng.randrange(4):
        case 0:
            lines[at] = f"{' ' * indent}{key}: {value}"
        case 1:
            lines.insert(at, f"{' ' * indent}{rng.choice(('sample_period', 'model', 'kp', 'x'))}: {value}")
        case 2:
            content = bytearray(good.encode())
            for _ in range(rng.choice((1, 5, 50))):
                content[rng.randrange(len(content))] = rng.randrange(256)
            return bytes(content)
        case 3:
            lines = lines[:at]
    return "\n".join(lines).encode()


# A program that reads files as `tdof-npid check` does, within bounds of memory, and tells of each what came of it.
READER = """
import contextlib, io, json, resource, sys, time, traceback
from tdof_npid_ros.cli import main
resource.setrlimit(resource.RLIMIT_DATA, (4 << 30, 4 << 30))
for name in sys.argv[1:]:
    out, err, began = io.StringIO(), io.StringIO(), time.monotonic()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(["check", name])
        except BaseException:
            status = traceback.format_exc()
    print(json.dumps([name, status, out.getvalue(), err.getvalue(), time.monotonic() - began]), flush=True)
"""


def test_hostile_parameter_files(tmp_path: Path) -> None:
    """Each is read, or refused in one line; nothing of it is run."""
    rng = random.Random(f"{SEED} files")
    good = (Path(__file__).parents[2] / "config" / "p1-c0.5.yaml").read_text()
    (tmp_path / "evil.py").write_text("raise SystemExit('executed')")
    for i in range(FILES):
        (tmp_path / f"{i}.yaml").write_bytes(hostile_file(rng, good))
    files = [str(tmp_path / f"{i}.yaml") for i in range(FILES)]
    done = subprocess.run([sys.executable, "-c", READER, *files], capture_output=True, text=True, cwd=tmp_path)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(told) == FILES, done.stderr[-3000:]
    for name, status, out, err, elapsed in told:
        case = (Path(name).read_bytes()[:3000], status, err[-3000:])
        assert status in (0, 1, 2), case
        assert "Traceback" not in err and len(err) < 20_000 and elapsed < 60, case
        if status == 2:
            assert err.splitlines()[-1].startswith("tdof-npid check: "), case
        assert "nan" not in out, case


def check(processes: list[Any]) -> None:
    """All run, quietly and within bounds of memory."""
    for process in processes:
        ended = process.process.poll()
        assert ended is None or (process.expected_status is None and ended >= 0), process.log[-3000:]
        assert "Traceback" not in process.log, process.log[-3000:]
        status = Path(f"/proc/{process.process.pid}/status")
        lines = status.read_text().splitlines() if status.exists() else []
        for resident in (line.split()[1] for line in lines if line.startswith("VmRSS")):
            assert int(resident) < MEMORY_KB, (process.node, resident)
