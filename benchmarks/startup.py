"""How long things take to start."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.harness import ROOT, Result, Verdict, last_line, main, seconds, summary

TITLE = "Start-up"
METHOD = (
    "Whole processes, from their start to their exit, in turn: `tdof-npid --help`; `tdof-npid simulate p1-c0.5` for "
    "the first time after installation (an empty folder for compiled code) and when it has run before; `tdof-npid "
    "analyze` of the sample bag. `import numba` is what any program with compiled code pays; it is ready for its first "
    "function when it has filled its registries, too. For a node: from its start until it has answered the first "
    "`output` that it was sent over DDS, discovery included; beside it a bare rclpy node that answers the same message."
)
PEERS = ("numba", "ros-jazzy-rclpy")
NOTES = (
    "What bounds simulate and analyze: before the first compiled function runs, kept on disk or not, Numba fills its "
    "registries, which costs more than its import; *ready for its first function* is that, without any of ours. "
    "In processor time, medians of four on a busy machine: import 0.44 s, ready 1.02 s (0.75 s where it could not "
    "import SciPy's linear algebra), simulate 1.20 s, analyze 1.38 s. So as long as Numba runs, 1.6 is out of reach.",
)

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


REGISTRIES = "from numba.core.registry import cpu_target as c; c.typing_context.refresh(); c.target_context.refresh()"
WHOLE = {
    "import numba": [sys.executable, "-c", "import numba"],
    "numba, ready for its first function": [sys.executable, "-c", REGISTRIES],
    "import tdof_npid_ros": [sys.executable, "-c", "import tdof_npid_ros"],
    "tdof-npid --help": [PROGRAM, "--help"],
    "second simulate": [PROGRAM, "simulate", "p1-c0.5", "--json"],
    "analyze of the sample bag": [PROGRAM, "analyze", "bags/sample", "--json"],
}
GOALS = {"second simulate": 1.6, "import tdof_npid_ros": 0.3, "analyze of the sample bag": 3.0}
CONTROLLER = [sys.executable, "-m", "tdof_npid_ros.graph", "controller"]


def run(size: str) -> Result:
    """Each several times; what is compared, in turn."""
    repeats, firsts = (7, 1) if size == "full" else (1, 0)
    simulate = [PROGRAM, "simulate", "p1-c0.5", "--json"]
    first: list[float] = []
    for _ in range(firsts):
        with tempfile.TemporaryDirectory() as cache:
            compiled = {"NUMBA_CACHE_DIR": cache}
            first.append(seconds(lambda compiled=compiled: _call(simulate, compiled)))  # type: ignore[misc]
    whole = _in_turn(WHOLE, repeats)
    bare, controller = [], []
    for _ in range(repeats):
        bare.append(_first_answer([sys.executable, "-c", BARE_NODE]))
        controller.append(_first_answer([*CONTROLLER, "--ros-args", "-p", "sigma:=1.0"]))
    fresh = [summary("first simulate, compilation included", "s", first, ours=True)] if first else []
    bare_node = summary("a bare rclpy node until its first answer", "s", bare)
    node = summary("the controller node until its first answer", "s", controller, ours=True)
    rates = {name: summary(name, "s", times, ours="numba" not in name) for name, times in whole.items()}
    numba = rates["import numba"].median
    result = Result([*rates.values(), *fresh, bare_node, node])
    result.verdicts += [
        Verdict("tdof-npid --help, s", rates["tdof-npid --help"].median, 0.2, at_most=True),
        *(Verdict("first simulate, compilation included, s", one.median, None) for one in fresh),
        *(
            Verdict(f"{name}, times import numba", rates[name].median / numba, goal, at_most=True)
            for name, goal in GOALS.items()
        ),
        Verdict(
            "node until its first answer, s more than a bare one", node.median - bare_node.median, 1.0, at_most=True
        ),
    ]
    return result


def _environment(extra: dict[str, str] | None = None) -> dict[str, str]:
    environment = {**os.environ, **(extra or {}), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "86"}
    # The second: else each start would compile our modules anew, and those of the other packages not.
    for name in ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "PYTHONDONTWRITEBYTECODE"):
        environment.pop(name, None)
    return environment


def _call(command: list[str], extra: dict[str, str] | None = None) -> str:
    done = subprocess.run(command, env=_environment(extra), check=True, capture_output=True, text=True, cwd=ROOT)
    return done.stdout


def _in_turn(commands: dict[str, list[str]], repeats: int) -> dict[str, list[float]]:
    """Times of whole processes by name."""
    for command in commands.values():
        _call(command)  # warms the disk's cache, and keeps what it compiles
    times: dict[str, list[float]] = {name: [] for name in commands}
    for _ in range(repeats):
        for name, command in commands.items():
            times[name].append(seconds(lambda command=command: _call(command)))  # type: ignore[misc]
    return times


def _first_answer(command: list[str]) -> float:
    return float(last_line(_call([sys.executable, "-m", "benchmarks.first_answer", *command])))


if __name__ == "__main__":
    main("startup")
