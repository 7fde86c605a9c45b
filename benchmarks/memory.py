"""Memory of each node beside a bare rclpy node."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.harness import Result, Verdict, main, resident_mib, ros_environment, summary
from benchmarks.startup import BARE_NODE

TITLE = "Memory of the nodes"
METHOD = (
    "Resident sets of plant, controller, scenario and recorder as four processes, after a lockstep episode of Process "
    "1 that is recorded, and of a bare rclpy node with one publisher and one subscription of the same message, which "
    "hears the loop's outputs meanwhile. A ratio is that of medians."
)
PEERS = ("ros-jazzy-rclpy", "numba")
NOTES = (
    "What bounds plant and controller: their step is compiled by Numba. A Python process that has imported Numba and "
    "made it ready for the first function, without any function of ours, holds 159 MiB (numpy 26, `import numba` 94; "
    "its registries the rest, with 16 for SciPy's linear algebra), and rclpy with DDS takes 55 more. Of a controller's "
    "233 MiB on a machine with AVX-512, 152 are files, LLVM's library above all, which all processes of a machine "
    "share. Scenario and "
    "recorder do without Numba: with it they took 2.1 times the bare node.",
)

NAMESPACE = "/bench_memory"
TIMEOUT = 120.0  # s
SETTLED = 1.0  # s after the episode
GOALS = {"scenario": 1.5, "recorder": 1.5, "plant": 2.4, "controller": 2.4}


def run(size: str) -> Result:
    """The same loop several times."""
    ros_environment(88)
    rounds, steps = (3, 5_000) if size == "full" else (1, 200)
    measured: dict[str, list[float]] = {"bare": [], **{node: [] for node in GOALS}}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            for node, memory in _memory(Path(folder), steps).items():
                measured[node].append(memory)
    bare = summary("a bare rclpy node", "MiB", measured["bare"])
    result = Result([bare])
    for node, goal in GOALS.items():
        rate = summary(node, "MiB", measured[node], ours=True)
        result.rates.append(rate)
        result.verdicts.append(
            Verdict(f"memory of the {node}, times a bare rclpy node", rate.median / bare.median, goal, at_most=True)
        )
    return result


def _memory(folder: Path, steps: int) -> dict[str, float]:
    from tdof_npid_ros.case import load_case
    from tdof_npid_ros.graph.conductor import Conductor
    from tdof_npid_ros.graph.processes import NodeProcesses

    period = load_case("p1-c0.5").sample_period
    file = folder / "bench.yaml"
    file.write_text(
        f"/**: {{ros__parameters: {{sample_period: {period}, mode: lockstep}}}}\n"
        "/**/controller: {ros__parameters: {kp: 9.4, ki: 9.4, kd: 2.1, alpha: 0.3, sigma: 1.0}}\n"
        f"/**/recorder: {{ros__parameters: {{bag: {folder / 'bag'}}}}}\n"
        "/**/scenario: {ros__parameters: {play: false, episodes: [run], plan: "
        f'{{run: ["0 setpoint 1", "{steps * period} end"]}}}}}}\n'
    )
    bare_node = [sys.executable, "-c", BARE_NODE.replace("'control_effort'", "'bare'"), "--ros-args"]
    with (
        NodeProcesses(file, NAMESPACE) as nodes,
        subprocess.Popen([*bare_node, "-r", f"__ns:={NAMESPACE}"], stderr=subprocess.DEVNULL) as bare,
    ):
        try:
            for node in ("recorder", "plant", "controller", "scenario"):
                nodes.start(node)
            conductor = Conductor(NAMESPACE, nodes.check)
            try:
                conductor.wait_for_subscriptions({"output": 3, "control_effort": 2, "scenario_plan": 3}, TIMEOUT)
                conductor.play(TIMEOUT)
                conductor.wait(lambda: conductor.episodes_finished >= 1, "the episode's end", TIMEOUT)
                time.sleep(SETTLED)
                return {"bare": resident_mib(bare.pid), **{node: resident_mib(pid) for node, pid in nodes.pids.items()}}
            finally:
                conductor.close()
        finally:
            bare.terminate()


if __name__ == "__main__":
    main("memory")
