"""How fast a lockstep loop over DDS goes, beside a bare ping-pong of the same message."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from benchmarks.harness import Result, Verdict, main, summary
from benchmarks.ping_pong import EXECUTORS, round_trips_per_second

QUESTION = "Lockstep steps per second over DDS, plant and controller in two processes"
NAMESPACE = "/bench"
TIMEOUT = 300.0  # s


def run(size: str) -> Result:
    """Ping-pong and loop in turn, so that both see the same machine."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", "87")
    full = size == "full"
    rounds, steps, lane_counts = (3, 10_000, (1, 40, 200)) if full else (1, 500, (1, 4))
    result = Result(QUESTION)
    for lanes in lane_counts:
        trips: dict[str, list[float]] = {executor: [] for executor in EXECUTORS}
        loops: dict[bool, list[float]] = {False: [], True: []}
        for _ in range(rounds):
            for executor in EXECUTORS:
                trips[executor].append(round_trips_per_second(executor, lanes, steps))
            for recorded in loops:
                loops[recorded].append(steps_per_second(lanes, steps, recorded))
        many = f"{lanes} lane{'s' * (lanes > 1)}"
        best = summary(f"ping-pong, events executor, {many}", "1/s", trips["events"])
        loop = summary(f"lockstep loop, {many}", "steps/s", loops[False])
        taped = summary(f"lockstep loop, {many}, recorded", "steps/s", loops[True])
        result.rates += [best, summary(f"ping-pong, default executor, {many}", "1/s", trips["default"]), loop, taped]
        result.verdicts.append(Verdict(f"{many}: loop against the best ping-pong", loop.median / best.median, 0.75))
        result.verdicts.append(Verdict(f"{many}: recorded against not recorded", taped.median / loop.median, 0.5))
    return result


def steps_per_second(lanes: int, steps: int, recorded: bool) -> float:
    """One episode of Process 1 through the nodes, from the reset to its end."""
    from tdof_npid_ros.case import load_case
    from tdof_npid_ros.graph.conductor import Conductor
    from tdof_npid_ros.graph.processes import NodeProcesses

    case = load_case("p1-c0.5")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bench.yaml"
        file.write_text(
            f"/**: {{ros__parameters: {{sample_period: {case.sample_period}, mode: lockstep}}}}\n"
            f"/**/plant: {{ros__parameters: {{lanes: {lanes}}}}}\n"
            f"/**/controller: {{ros__parameters: {{kp: {[9.4] * lanes}, ki: 9.4, kd: 2.1, alpha: 0.3}}}}\n"
            "/**/scenario: {ros__parameters: {play: false, episodes: [run], plan: {run: "
            f'["0 setpoint 1", "{steps * case.sample_period} end"]}}}}}}\n'
        )
        with NodeProcesses(file, NAMESPACE) as nodes:
            if recorded:
                nodes.start("recorder", {"bag": Path(folder) / "bag"})
            for node in ("plant", "controller", "scenario"):
                nodes.start(node)
            conductor = Conductor(NAMESPACE, nodes.check)
            try:
                watched = {"output": 1 + recorded, "control_effort": 1 + recorded, "scenario_plan": 2 + recorded}
                conductor.wait_for_subscriptions(watched, TIMEOUT)
                start = time.monotonic()
                conductor.trigger("scenario/play")
                conductor.wait(lambda: conductor.fact("plant", "state") == "finished", "the episode's end", TIMEOUT)
                return steps / (time.monotonic() - start)
            finally:
                conductor.close()


if __name__ == "__main__":
    main(run)
