"""How long things take to start."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.harness import ROOT, Rate, Result, Verdict, last_line, main, seconds, summary

TITLE = "Start-up"
METHOD = (
    "Whole processes, from their start to their exit: `tdof-npid --help`, and `tdof-npid simulate p1-c0.5` for the "
    "first "
    "time after installation (an empty folder for compiled code) and for the second. For a node: from its start until "
    "it "
    "has answered the first `output` that it was sent over DDS, discovery included; beside it a bare rclpy node that "
    "answers the same message. `import numba` is what any program with compiled code pays."
)
PEERS = ("numba", "ros-jazzy-rclpy")
NOTES: tuple[str, ...] = ()

PROGRAM = str(Path(sys.executable).with_name("tdof-npid"))
BARE_NODE = """
import rclpy
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node('bare')
publisher = node.create_publisher(JointState, 'control_effort', 10)
node.create_subscription(JointState, 'output', publisher.publish, 10)
try:
    rclpy.spin(node)
except rclpy.executors.ExternalShutdownException:
    pass
"""


CONTROLLER = [sys.executable, "-m", "tdof_npid_ros.graph", "controller"]


def run(size: str) -> Result:
    """Each several times; what is compared, in turn."""
    repeats, firsts = (7, 3) if size == "full" else (1, 1)
    simulate = [PROGRAM, "simulate", "p1-c0.5", "--json"]
    help_ = _whole("tdof-npid --help", [PROGRAM, "--help"], repeats, ours=True)
    numba = _whole("import numba", [sys.executable, "-c", "import numba"], repeats)
    first: list[float] = []
    for _ in range(firsts):
        with tempfile.TemporaryDirectory() as cache:
            compiled = {"NUMBA_CACHE_DIR": cache}
            first.append(seconds(lambda compiled=compiled: _call(simulate, compiled)))  # type: ignore[misc]
            if len(first) == firsts:
                second = _whole("second simulate", simulate, repeats, compiled, ours=True)
    bare, controller = [], []
    for _ in range(repeats):
        bare.append(_first_answer([sys.executable, "-c", BARE_NODE]))
        controller.append(_first_answer([*CONTROLLER, "--ros-args", "-p", "sigma:=1.0"]))
    fresh = summary("first simulate, compilation included", "s", first, ours=True)
    bare_node = summary("a bare rclpy node until its first answer", "s", bare)
    node = summary("the controller node until its first answer", "s", controller, ours=True)
    result = Result([help_, numba, fresh, second, bare_node, node])
    result.verdicts += [
        Verdict("tdof-npid --help, s", help_.median, 0.2, at_most=True),
        Verdict("first simulate, compilation included, s", fresh.median, None),
        Verdict("second simulate, s", second.median, 1.5, at_most=True),
        Verdict(
            "node until its first answer, s more than a bare one", node.median - bare_node.median, 1.0, at_most=True
        ),
    ]
    return result


def _environment(extra: dict[str, str] | None = None) -> dict[str, str]:
    environment = {**os.environ, **(extra or {}), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "86"}
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    return environment


def _call(command: list[str], extra: dict[str, str] | None = None) -> str:
    done = subprocess.run(command, env=_environment(extra), check=True, capture_output=True, text=True, cwd=ROOT)
    return done.stdout


def _whole(
    name: str, command: list[str], repeats: int, extra: dict[str, str] | None = None, ours: bool = False
) -> Rate:
    if repeats > 1:
        _call(command, extra)  # warms the disk's cache
    return summary(name, "s", [seconds(lambda: _call(command, extra)) for _ in range(repeats)], ours=ours)


def _first_answer(command: list[str]) -> float:
    return float(last_line(_call([sys.executable, "-m", "benchmarks.first_answer", *command])))


if __name__ == "__main__":
    main("startup")
