"""How fast the live loop tunes: what lanes gain, what lockstep costs, and a whole HGA run over DDS."""

from __future__ import annotations

import re
import tempfile
import time
from pathlib import Path

from benchmarks.harness import Rate, Result, Verdict, main, ros_environment, summary
from benchmarks.lockstep import ping_rates, steps_per_second
from benchmarks.ping_pong import EXECUTORS, round_trips_per_second

TITLE = "Tuning through the live loop"
METHOD = (
    "With many lanes one episode evaluates a whole population: *lane-steps* are steps times lanes. Loops and bare "
    "ping-pong as in the section on lockstep, in turn. Then a whole HGA run of 40 candidates x 60 generations on "
    "Process 1 by the tuner node through ROS 2 alone, from the moment it has found the loop to the last generation; "
    "with one loop on this machine."
)
PEERS = ("ros-jazzy-rclpy",)
NOTES = (
    "The whole run is 120 episodes of 5,001 outputs in lockstep, one after the other: the loop's steps per second "
    "bound it. "
    "The tuner empties the outputs in batches, every 5 ms. Signals are read and written as bytes; with messages the "
    "run took "
    "121 s.",
)

NAMESPACE = "/bench_tuning"
CASE = "p1-c0.5"
LANES = 40
TIMEOUT = 900.0  # s
RUN_LIMIT = 120.0  # s


def run(size: str) -> Result:
    """Loops and ping-pong in turn, so that they see the same machine; then the run."""
    ros_environment(88)
    full = size == "full"
    rounds, steps, generations = (3, 5_000, 60) if full else (1, 500, 1)
    one: list[float] = []
    many: list[float] = []
    trips: dict[str, list[float]] = {executor: [] for executor in (EXECUTORS if full else EXECUTORS[:1])}
    for _ in range(rounds):
        one.append(steps_per_second(1, steps, recorded=False))
        many.append(steps_per_second(LANES, steps, recorded=False))
        for executor in trips:
            trips[executor].append(round_trips_per_second(executor, LANES, steps))
    single = summary("loop, 1 lane", "lane-steps/s", one, ours=True)
    lane_steps = summary(f"loop, {LANES} lanes", "lane-steps/s", [LANES * rate for rate in many], ours=True)
    pings = ping_rates(trips, LANES)
    result = Result([single, lane_steps, *pings])
    best = max(rate.median for rate in pings)
    result.verdicts += [
        Verdict(f"lane-steps/s with {LANES} lanes, times one lane", lane_steps.median / single.median, 20.0),
        Verdict(f"lockstep with {LANES} lanes, times the best ping-pong", lane_steps.median / LANES / best, 0.5),
    ]
    seconds = tuning_time(generations)
    name = f"HGA {LANES} x {generations} on {CASE}"
    result.rates.append(Rate(name, "s", seconds, seconds, seconds, ours=True))
    result.verdicts.append(Verdict(f"{name}, s", seconds, RUN_LIMIT, at_most=True))
    return result


def tuning_time(generations: int) -> float:
    """Wall time of the generations of one run of the tuner node, on one loop of this machine."""
    from tdof_npid_ros.graph.processes import NodeProcesses
    from tdof_npid_ros.parameter_file import find_parameter_file

    loop, file = f"{NAMESPACE}_loop", find_parameter_file(CASE)
    with (
        tempfile.TemporaryDirectory() as folder,
        NodeProcesses(file, loop) as pair,
        NodeProcesses(file, NAMESPACE) as tuner,
    ):
        for node in ("plant", "controller"):
            pair.start(node)
        result = Path(folder) / "tuned.yaml"
        parameters = {"case": CASE, "generations": generations, "loops": [loop], "result": result, "stay": True}
        tuner.start("tuner", parameters)
        end = time.monotonic() + TIMEOUT
        while not result.exists():
            if time.monotonic() > end:
                raise TimeoutError(f"not tuned within {TIMEOUT:g} s: {tuner.log('tuner').read_text()}")
            pair.check()
            tuner.check()
            time.sleep(0.1)
        log = tuner.log("tuner").read_text()
    begin = re.search(r"\[(\d+\.\d+)\] \[[^]]*\]: loop .* is used", log)
    last = re.findall(r"\[(\d+\.\d+)\] \[[^]]*\]: generation", log)[-1]
    assert begin is not None
    return float(last) - float(begin.group(1))


if __name__ == "__main__":
    main("live_tuning")
