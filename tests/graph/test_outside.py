"""Nothing from outside is run, and no request ends a node."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

NODES = ("plant", "controller", "scenario", "recorder", "tuner")
TYPE_TAGS = range(256)
# A process that publishes std_msgs/Empty under other names: what a peer announces is up to the peer.
PEER = """
import ctypes, sys, time
import rclpy
from std_msgs.msg import Empty, String

library = ctypes.CDLL("libstd_msgs__rosidl_typesupport_fastrtps_c.so")
rclpy.init()
node = rclpy.create_node("peer")
kept = []
for number, (kind, space, name) in enumerate(((Empty, b"evil::msg", b"X"), (String, b"::msg", b"X"))):
    symbol = f"rosidl_typesupport_fastrtps_c__get_message_type_support_handle__std_msgs__msg__{kind.__name__}"
    handle = getattr(library, symbol)
    handle.restype = ctypes.POINTER(ctypes.c_void_p)
    names = ctypes.cast(handle()[1], ctypes.POINTER(ctypes.c_char_p))
    names[0], names[1] = space, name
    kept.append((names, space, name, node.create_publisher(kind, f"strange{number}", 10)))
print(node.get_topic_names_and_types(), flush=True)
time.sleep(300)
"""


def evil_package(folder: Path) -> Path:
    """A package `evil` that tells when it is imported; where it tells."""
    (folder / "evil").mkdir()
    executed = folder / "executed"
    for name in ("__init__", "msg", "plants"):
        (folder / "evil" / f"{name}.py").write_text(f"open({str(executed)!r}, 'w')\nclass X: pass\n")
    return executed


def test_the_recorder_imports_nothing_for_a_type_that_a_peer_announces(graph: Any, tmp_path: Path) -> None:
    executed = evil_package(tmp_path)
    recorder = graph.start("recorder", cwd=tmp_path, bag=str(tmp_path / "bag"))
    graph.wait_for_nodes("/recorder")
    peer = subprocess.Popen([sys.executable, "-c", PEER], env=graph.environment, stdout=subprocess.PIPE, text=True)
    try:
        assert peer.stdout is not None
        announced = peer.stdout.readline()
        assert "evil/msg/X" in announced and "'/msg/X'" in announced
        graph.wait_for_log(recorder, "/strange0 is not recorded: the message type evil/msg/X is not installed")
        graph.wait_for_log(recorder, "/strange1 is not recorded: '/msg/X' is no message type")
    finally:
        peer.send_signal(signal.SIGKILL)
        peer.wait()
    graph.wait_for_nodes("/recorder")
    assert not executed.exists()


def test_replay_and_analysis_import_nothing_for_a_type_in_a_bag(graph: Any, tmp_path: Path) -> None:
    executed = evil_package(tmp_path)
    bag = tmp_path / "evil.mcap"
    with bag.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for name in ("evil/msg/X", "/msg/X", "evil.plants/msg/X", "../evil/msg/X"):
            schema = writer.register_schema(name, "ros2msg", b"float64 x")
            channel = writer.register_channel(f"/topic{schema}", "cdr", schema)
            writer.add_message(channel, 1_000_000_000, b"\0\1\0\0" + bytes(8), 1_000_000_000)
        writer.finish()
    replay = graph.start("replay", cwd=tmp_path, bag=str(bag))
    graph.wait_for_log(replay, "the message type evil/msg/X is not installed")
    for command in ("analyze", "verify"):
        done = subprocess.run(
            [sys.executable, "-m", "tdof_npid_ros", command, str(bag)],
            env=graph.environment, cwd=tmp_path, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert not executed.exists()


@pytest.mark.parametrize("count", [2**16, 2**24, 2**27, 2**32 - 1])
def test_a_few_bytes_that_announce_many_messages_take_no_memory(graph: Any, count: int) -> None:
    """The middleware would make room for all of them before it finds that they are not there."""
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from trajectory_msgs.msg import JointTrajectory

    nodes = {"plant": graph.start("plant", mode="lockstep"), "controller": graph.start("controller")}
    graph.wait_for_nodes(*(f"/{node}" for node in nodes))
    header = b"\0\1\0\0" + bytes(8) + (1).to_bytes(4, "little") + bytes(4)
    plan = header + bytes(4) + count.to_bytes(4, "little") + bytes(48)
    qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = graph.node.create_publisher(JointTrajectory, "/scenario_plan", qos)
    for process in nodes.values():
        graph.publish_until(publisher, plan, lambda log=process: "unreadable scenario_plan refused" in log.log)
    for node, process in nodes.items():
        status = Path(f"/proc/{process.process.pid}/status").read_text()
        (peak,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
        assert int(peak) < 1_000_000, (node, peak)  # kB


# The middleware makes a request of a million bytes that are 0, and may take no more than 100 MB more.
UNPACK = """
import resource
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import deserialize_message
used_kb = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmData"))
resource.setrlimit(resource.RLIMIT_DATA, (used_kb * 1024 + 100_000_000, -1))
count = 1_000_000
try:
    deserialize_message(bytes((0, 1, 0, 0)) + count.to_bytes(4, "little") + bytes(count), SetParameters.Request)
except RuntimeError:
    print("dropped")
"""


def test_a_request_that_needs_more_memory_than_a_node_may_take_is_dropped(graph: Any) -> None:
    controller = graph.start("controller")
    graph.wait_for_nodes("/controller")
    limit, _ = resource.prlimit(controller.process.pid, resource.RLIMIT_DATA)
    assert limit == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    done = subprocess.run([sys.executable, "-c", UNPACK], capture_output=True, text=True, timeout=60)
    assert "dropped" in done.stdout, done.stderr


@pytest.mark.parametrize("node", NODES)
def test_no_type_of_a_parameter_ends_a_node(graph: Any, node: str, tmp_path: Path) -> None:
    """Over each service that sets parameters, and over the rest of those that rclpy makes."""
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import (
        DescribeParameters,
        GetParameters,
        GetParameterTypes,
        ListParameters,
        SetParameters,
        SetParametersAtomically,
    )

    arguments = {"recorder": ["-p", f"bag:={tmp_path / 'bag'}"], "tuner": ["-p", "case:=p1-c0.5"]}.get(node, [])
    process = graph.start(node, *arguments)
    graph.wait_for_nodes(f"/{node}")
    strange = [Parameter(name="autostart", value=ParameterValue(type=tag)) for tag in TYPE_TAGS]
    good = Parameter(name="use_sim_time", value=ParameterValue(type=1, bool_value=False))
    request = SetParameters.Request(parameters=[*strange, good])
    results = graph.call(f"/{node}/set_parameters", SetParameters, request, again=True).results
    assert [result.successful for result in results] == [False] * len(strange) + [True]
    assert all(result.reason for result in results[:-1])
    for tag in (0, 10, 99, 255):
        request = SetParametersAtomically.Request(parameters=[good, strange[tag]])
        result = graph.call(f"/{node}/set_parameters_atomically", SetParametersAtomically, request, again=True).result
        assert not result.successful and result.reason
    names = ["", "x" * 10_000, "autostart", "\n", "a.b..c"]
    for name, kind, request in (
        ("get_parameters", GetParameters, GetParameters.Request(names=names)),
        ("get_parameter_types", GetParameterTypes, GetParameterTypes.Request(names=names)),
        ("describe_parameters", DescribeParameters, DescribeParameters.Request(names=names)),
        ("list_parameters", ListParameters, ListParameters.Request(prefixes=names, depth=2**64 - 1)),
    ):
        graph.call(f"/{node}/{name}", kind, request, again=True)
    for number in (0, 9, 99, 255):
        request = ChangeState.Request(transition=Transition(id=number, label="x"))
        assert not graph.call(f"/{node}/change_state", ChangeState, request).success
    graph.wait_for_nodes(f"/{node}")
    assert "Traceback" not in process.log
