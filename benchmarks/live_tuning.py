"""How fast the live loop tunes: what lanes gain, what lockstep costs, and a whole HGA run over DDS."""

from __future__ import annotations

import os
import re
import tempfile
import time
from pathlib import Path

from benchmarks.harness import Rate, Result, Verdict, main, summary
from benchmarks.lockstep import steps_per_second
from benchmarks.ping_pong import round_trips_per_second

QUESTION = "Tuning through the live loop: lanes, lockstep, and a 40 x 60 HGA run on Process 1"
NAMESPACE = "/bench_tuning"
CASE = "p1-c0.5"
LANES = 40
TIMEOUT = 900.0  # s
RUN_LIMIT = 120.0  # s


def run(size: str) -> Result:
    """Loops and ping-pong in turn, so that they see the same machine; then the run."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", "88")
    rounds, steps, generations = (3, 10_000, 60) if size == "full" else (1, 500, 1)
    one, many, trips = [], [], []
    for _ in range(rounds):
        one.append(steps_per_second(1, steps, recorded=False))
        many.append(steps_per_second(LANES, steps, recorded=False))
        trips.append(round_trips_per_second("events", LANES, steps))
    lane_steps = summary(f"{LANES} lanes", "lane-steps/s", [LANES * rate for rate in many])
    single = summary("1 lane", "lane-steps/s", one)
    ping = summary(f"ping-pong, {LANES} lanes", "1/s", trips)
    result = Result(QUESTION, rates=[single, lane_steps, ping])
    result.verdicts += [
        Verdict(f"lane-steps/s with {LANES} lanes against one", lane_steps.median / single.median, 20.0),
        Verdict(f"lockstep with {LANES} lanes against ping-pong", lane_steps.median / LANES / ping.median, 0.5),
    ]
    for loops in (1, 2):
        seconds = tuning_time(loops, generations)
        name = f"HGA {LANES} x {generations}, {CASE}, {loops} loop{'s' * (loops > 1)}"
        result.rates.append(Rate(name, "s", seconds, seconds, seconds))
        if size == "full":
            result.verdicts.append(Verdict(f"{name}, in s", seconds, RUN_LIMIT, at_most=True))
    return result


def tuning_time(loops: int, generations: int) -> float:
    """Wall time of the generations of one run of the tuner node, on so many loops of this machine."""
    from tdof_npid_ros.case import find_parameter_file
    from tdof_npid_ros.graph.processes import NodeProcesses

    names = [f"{NAMESPACE}_{i}" for i in range(loops)]
    file = find_parameter_file(CASE)
    pairs = [NodeProcesses(file, name) for name in names]
    with tempfile.TemporaryDirectory() as folder, NodeProcesses(file, NAMESPACE) as tuner:
        try:
            for pair in pairs:
                for node in ("plant", "controller"):
                    pair.start(node)
            result = Path(folder) / "tuned.yaml"
            tuner.start(
                "tuner", {"case": CASE, "generations": generations, "loops": names, "result": result, "stay": True}
            )
            end = time.monotonic() + TIMEOUT
            while not result.exists():
                if time.monotonic() > end:
                    raise TimeoutError(f"not tuned within {TIMEOUT:g} s: {tuner.log('tuner').read_text()}")
                for nodes in (*pairs, tuner):
                    nodes.check()
                time.sleep(0.1)
        finally:
            for pair in pairs:
                pair.stop()
        log = tuner.log("tuner").read_text()
    begin = re.search(r"\[(\d+\.\d+)\] \[[^]]*\]: loop .* is used", log)
    last = re.findall(r"\[(\d+\.\d+)\] \[[^]]*\]: generation", log)[-1]
    assert begin is not None
    return float(last) - float(begin.group(1))


if __name__ == "__main__":
    main(run)
