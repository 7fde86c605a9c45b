"""How long things take to start."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.harness import Rate, Result, Verdict, main, summary

QUESTION = "Start-up: the program, a node, the first and the second simulation"
BARE_NODE = (
    "import rclpy; rclpy.init(); node = rclpy.create_node('bare');"
    "print('up', flush=True); node.destroy_node(); rclpy.shutdown()"
)


def run(size: str) -> Result:
    """Whole processes, from start to exit or to the first sign of life."""
    repeats = 7 if size == "full" else 1
    result = Result(QUESTION)
    program = [sys.executable, "-m", "tdof_npid_ros"]
    simulate = [*program, "simulate", "p1-c0.5", "--json"]
    help_ = _seconds("tdof-npid --help", [*program, "--help"], repeats)
    numba = _seconds("import numba", [sys.executable, "-c", "import numba"], repeats)
    with tempfile.TemporaryDirectory() as cache:
        first = _seconds("first simulate, compilation included", simulate, 1, {"NUMBA_CACHE_DIR": cache})
        second = _seconds("second simulate", simulate, repeats, {"NUMBA_CACHE_DIR": cache})
    bare = _until_output("a bare rclpy node", [sys.executable, "-c", BARE_NODE], repeats)
    node = _until_output("the controller node until it is active", _controller(), repeats)
    result.rates += [help_, numba, first, second, bare, node]
    result.verdicts += [
        Verdict("seconds of tdof-npid --help", help_.median, 0.2, at_most=True),
        Verdict("seconds of the second simulate", second.median, 1.5, at_most=True),
        Verdict("seconds of a node beyond a bare one", node.median - bare.median, 1.0, at_most=True),
    ]
    return result


def _controller() -> list[str]:
    return [sys.executable, "-m", "benchmarks.first_sign", "controller"]


def _environment(extra: dict[str, str] | None = None) -> dict[str, str]:
    environment = {**os.environ, **(extra or {}), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "86"}
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    return environment


def _seconds(name: str, command: list[str], repeats: int, extra: dict[str, str] | None = None) -> Rate:
    values = []
    for _ in range(repeats):
        start = time.perf_counter()
        subprocess.run(command, env=_environment(extra), check=True, capture_output=True, cwd=_root())
        values.append(time.perf_counter() - start)
    return summary(name, "s", values)


def _until_output(name: str, command: list[str], repeats: int) -> Rate:
    values = []
    for _ in range(repeats):
        start = time.perf_counter()
        with subprocess.Popen(command, env=_environment(), stdout=subprocess.PIPE, text=True, cwd=_root()) as process:
            assert process.stdout is not None
            process.stdout.readline()
            values.append(time.perf_counter() - start)
            process.stdout.read()
    return summary(name, "s", values)


def _root() -> Path:
    return Path(__file__).parent.parent


if __name__ == "__main__":
    main(run)
