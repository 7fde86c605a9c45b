"""How fast a lockstep loop over DDS goes, beside a bare ping-pong of the same message."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from benchmarks.harness import Result, Verdict, main, summary
from benchmarks.ping_pong import EXECUTORS, round_trips_per_second
from benchmarks.recorder import run_loop

QUESTION = "Lockstep steps per second over DDS, plant and controller in two processes"


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
    with tempfile.TemporaryDirectory() as folder:
        return run_loop(Path(folder), steps, {} if recorded else None, lanes)


if __name__ == "__main__":
    main(run)
