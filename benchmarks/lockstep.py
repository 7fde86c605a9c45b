"""How fast a lockstep loop over DDS goes, beside a bare ping-pong of the same message."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.harness import Rate, Result, Verdict, main, plural, ros_environment, summary
from benchmarks.ping_pong import EXECUTORS, UNREAD, round_trips_per_second
from benchmarks.recorder import run_loop

TITLE = "Lockstep over DDS"
METHOD = (
    "Steps per second of one episode of Process 1 with plant and controller as two processes, after a "
    "short one (the ping-pong, too, is timed once the two have met), by the plant's reports; recorded: with the "
    "recorder "
    "as a third, writing every topic. Beside it two bare rclpy processes that send the same message, as long as the "
    "loop's, "
    "to and fro, one at a time. They run with rclpy's default executor and with its events executor, and the faster "
    "counts. "
    "*Unread*: they hand on the bytes "
    "of the message without reading them, the limit of any loop over rclpy. In turn, round by round."
)
PEERS = ("ros-jazzy-rclpy",)
NOTES = (
    "The loop reads and writes JointStates as bytes: rclpy's message takes longer to build and to take apart than a "
    "step of "
    "plant and controller. The nodes' Fast DDS profile has no timer's thread wake at every message "
    "(nackSupressionDuration of "
    "5 ms, 8 % more steps/s). Answers are published before all bookkeeping.",
    "What bounds it: DDS and the waking of the other process, as the unread ping-pong shows; plant and controller "
    "take the rest, in Python, which weighs the more the slower a core is: against the unread ping-pong 0.72, 0.73 and "
    "0.68 on a processor with AVX-512, 0.51 to 0.63 on one without. Of 390 us a step there the two nodes take "
    "170. Recorded, a third process wants its share of the two cores. Tried without a measurable gain: shared memory "
    "(the nodes use UDP, for its safe restarts; the ping-pong has both), no piggybacked heartbeats, "
    "`spin_until_future_complete` in place of `spin_once`. "
    "A second message on its way would hide the latency, but a loop has only one.",
)

RECORDED = {1: 0.75, 4: 0.5, 40: 0.6, 200: 0.6}  # goals, by lanes


def run(size: str) -> Result:
    """Ping-pong and loop in turn, so that both see the same machine."""
    ros_environment(87)
    full = size == "full"
    rounds, steps, lane_counts = (3, 6_000, (1, 40, 200)) if full else (1, 500, (4,))
    result = Result()
    for lanes in lane_counts:
        trips: dict[str, list[float]] = {executor: [] for executor in EXECUTORS}
        unread: list[float] = []
        loops: dict[bool, list[float]] = {False: [], True: []}
        for _ in range(rounds):
            for executor in EXECUTORS:
                trips[executor].append(round_trips_per_second(executor, lanes, steps))
            unread.append(round_trips_per_second(UNREAD, lanes, steps))
            for recorded in loops:
                loops[recorded].append(steps_per_second(lanes, steps, recorded))
        many = plural(lanes, "lane")
        pings = ping_rates(trips, lanes)
        loop = summary(f"loop, {many}", "steps/s", loops[False], ours=True)
        taped = summary(f"loop, {many}, recorded", "steps/s", loops[True], ours=True)
        limit = summary(f"ping-pong, unread, {many}", "steps/s", unread)
        result.rates += [limit, *pings, loop, taped]
        best = max(rate.median for rate in pings)
        result.verdicts.append(Verdict(f"{many}: loop, times the best ping-pong", loop.median / best, 0.75))
        result.verdicts.append(Verdict(f"{many}: loop, times the unread ping-pong", loop.median / limit.median, 0.85))
        result.verdicts.append(Verdict(f"{many}: recorded loop, times the best ping-pong", taped.median / best, None))
        result.verdicts.append(
            Verdict(f"{many}: recorded, times not recorded", taped.median / loop.median, RECORDED[lanes])
        )
    return result


def ping_rates(trips: dict[str, list[float]], lanes: int) -> list[Rate]:
    """The ping-pong's rates, by executor."""
    return [summary(f"ping-pong, {name} executor, {plural(lanes, 'lane')}", "steps/s", trips[name]) for name in trips]


def steps_per_second(lanes: int, steps: int, recorded: bool) -> float:
    """One episode of Process 1 through the nodes, between the plant's reports that it has begun and ended."""
    with tempfile.TemporaryDirectory() as folder:
        return run_loop(Path(folder), steps, {} if recorded else None, lanes)


if __name__ == "__main__":
    main("lockstep")
