"""How fast the live loop tunes: what lanes gain, what lockstep costs, and a whole HGA run over DDS."""

from __future__ import annotations

import re
import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.harness import Rate, Result, Table, Verdict, main, ros_environment, summary
from benchmarks.lockstep import ping_rates, steps_per_second
from benchmarks.ping_pong import EXECUTORS, round_trips_per_second
from tdof_npid_ros.case import load_case
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

TITLE = "Tuning through the live loop"
METHOD = (
    "With many lanes one episode evaluates a whole population: *lane-steps* are steps times lanes. Loops and bare "
    "ping-pong as in the section on lockstep, in turn. Then a quarter of an HGA run of 40 candidates x 60 generations "
    "on Process 1, by the tuner node through ROS 2 alone, from the moment it has found the loop to its last "
    "generation; with one loop on this machine. How much of the 60 generations ten seeds need until they have "
    "converged is counted offline, where a run visits the same candidates; the best known is `tuned.csv`'s."
)
PEERS = ("ros-jazzy-rclpy",)
NOTES = (
    "What bounds stopping by itself: a search counts as converged after five rounds, of which two that began anywhere "
    "agree. With 40 candidates at a time a round takes 8 to 31 generations, so in 60 there are three or four. "
    "The ten seeds are within 0.1 % after 8 to 18 generations (median 10), and their first round is over after 14 to "
    "17, or after 6, where it is given up: to stop at a quarter of the budget, 15, is to believe the first round, "
    "which lay 2.9 and 4.4 % too high from two seeds. That two agree takes 53 to 56 generations.",
    "A whole run is 120 episodes of 5,001 outputs in lockstep, one after the other: the loop's steps per second "
    "bound it. "
    "The tuner empties the outputs in batches, every 5 ms. Signals are read and written as bytes; with messages a "
    "whole run took 121 s on fast cores, with bytes 80.",
)

NAMESPACE = "/bench_tuning"
CASE = "p1-c0.5"
LANES = 40
TIMEOUT = 900.0  # s
BUDGET, WITHIN = 0.25, 1e-3  # of the whole, and of the best known


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
    quarter = max(1, round(BUDGET * generations))
    live = tuning_time(quarter)
    result.rates.append(Rate(f"HGA {LANES} x {quarter} on {CASE}", "s", live, live, live, ours=True))
    _state_convergence(result, range(10 if full else 1), generations)
    return result


def _state_convergence(result: Result, seeds: range, generations: int) -> None:
    """How much of the whole budget each seed needs until it stops by itself, and how good it is then.

    It is counted offline, where a run visits the same candidates; live, a generation takes the time of two episodes.
    """
    case = load_case(CASE)
    known = tuned(CASE, case.gains.type)
    if known is None:
        raise RuntimeError(f"no tuned gains for {case.gains.type} on {CASE}")
    fractions, excesses = [], []
    for seed in seeds:
        study = Study(
            TuningProblem(
                case, case.gains.type, (), case.weight, seed=seed, population=LANES, generations=generations,
                polish=LANES, warm=True, until_converged=True,
            )
        )  # fmt: skip
        study.run(Objective(study.problem))
        fractions.append(study.generation / generations)
        excesses.append(study.best_value / known.objective - 1.0)
    good = [fraction <= BUDGET and excess <= WITHIN for fraction, excess in zip(fractions, excesses, strict=True)]
    rows = [[str(seed), f"{f:.2f}", f"{100.0 * e:.3g}"] for seed, f, e in zip(seeds, fractions, excesses, strict=True)]
    header = ["seed", "of the generations", "above the best known, %"]
    result.tables.append(Table("Runs that end when they have converged, each with its whole budget as 1", header, rows))
    result.verdicts += [
        Verdict(f"share of seeds within 0.1 % of the best known after {BUDGET:g} of the budget, stopped by itself",
                sum(good) / len(good), 0.9),
        Verdict("median of the budget's fraction until it stops by itself", statistics.median(fractions), None),
    ]  # fmt: skip


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
        parameters = {
            "case": CASE, "generations": generations, "until_converged": False, "loops": [loop], "result": result,
            "stay": True,
        }  # fmt: skip
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
