"""How fast a lockstep loop over DDS goes, beside a bare ping-pong of the same message."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.harness import Rate, Result, Verdict, main, plural, ros_environment, summary
from benchmarks.ping_pong import EXECUTORS, round_trips_per_second
from benchmarks.recorder import run_loop

TITLE = "Lockstep over DDS"
METHOD = (
    "Steps per second of one episode of Process 1 with plant and controller as two processes, after a "
    "short one (the ping-pong, too, is timed once the two have met), by the plant's reports; recorded: with the recorder "
    "as a third, writing every topic. Beside it two bare rclpy processes that send the same message, as long as the loop's, to and fro, one at a time: the limit of any such loop. They "
    "run with rclpy's default executor and with its events executor, and the faster counts. In turn, round by round."
)
PEERS = ("ros-jazzy-rclpy",)
NOTES = (
    "What bounds it: most of a round trip is DDS and the waking of the other process, the same in both. Of a step's 144 us "
    "(median, one lane) the ping-pong takes 123; each node computes 7 us before it publishes, and colder caches "
    "do the rest. Answers are published before all bookkeeping. Tried without a measurable "
    "gain: shared memory (the nodes use UDP, for its safe restarts; the ping-pong has both), no piggybacked heartbeats, "
    "`spin_until_future_complete` in place of `spin_once`. "
    "A second message on its way would hide the latency, but a loop has only one.",
)


def run(size: str) -> Result:
    """Ping-pong and loop in turn, so that both see the same machine."""
    ros_environment(87)
    full = size == "full"
    rounds, steps, lane_counts = (5, 12_000, (1, 40, 200)) if full else (1, 500, (4,))
    result = Result()
    for lanes in lane_counts:
        trips: dict[str, list[float]] = {executor: [] for executor in EXECUTORS}
        loops: dict[bool, list[float]] = {False: [], True: []}
        for _ in range(rounds):
            for executor in EXECUTORS:
                trips[executor].append(round_trips_per_second(executor, lanes, steps))
            for recorded in loops:
                loops[recorded].append(steps_per_second(lanes, steps, recorded))
        many = plural(lanes, "lane")
        pings = ping_rates(trips, lanes)
        loop = summary(f"loop, {many}", "steps/s", loops[False], ours=True)
        taped = summary(f"loop, {many}, recorded", "steps/s", loops[True], ours=True)
        result.rates += [*pings, loop, taped]
        best = max(rate.median for rate in pings)
        result.verdicts.append(Verdict(f"{many}: loop, times the best ping-pong", loop.median / best, 0.75))
        result.verdicts.append(Verdict(f"{many}: recorded loop, times the best ping-pong", taped.median / best, None))
        result.verdicts.append(Verdict(f"{many}: recorded, times not recorded", taped.median / loop.median, 0.5))
    return result


def ping_rates(trips: dict[str, list[float]], lanes: int) -> list[Rate]:
    """The ping-pong's rates, by executor."""
    return [summary(f"ping-pong, {name} executor, {plural(lanes, 'lane')}", "steps/s", trips[name]) for name in trips]


def steps_per_second(lanes: int, steps: int, recorded: bool) -> float:
    """One episode of Process 1 through the nodes, from the command to its end."""
    with tempfile.TemporaryDirectory() as folder:
        return run_loop(Path(folder), steps, {} if recorded else None, lanes)


if __name__ == "__main__":
    main("lockstep")
