"""Ten minutes at 200 Hz: is an answer missed, does memory grow?"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Result, Verdict, main, resident_mib, ros_environment, summary

TITLE = "Soak: ten minutes at 200 Hz"
METHOD = (
    "Plant, controller and recorder as three processes in realtime mode at 200 Hz for ten minutes, normal scheduling. "
    "Missed: outputs after the first minute, by the bag, that no control effort answers. Memory: each process's "
    "resident set every second; its growth is the largest after the first minute less that at the minute."
)
PEERS: tuple[str, ...] = ()
NOTES: tuple[str, ...] = ()

NAMESPACE = "/soak"
NODES = ("recorder", "plant", "controller")
PERIOD = 0.005  # s
SECONDS, WARM_UP = 600.0, 60.0
LAST = 1.0  # s before the end: answers may still be on their way
TIMEOUT = 60.0  # s
LARGEST_GROWTH = 1.0  # MiB


def run(size: str) -> Result:
    """One run, measured from outside and by its bag."""
    ros_environment(89)
    seconds, warm_up = (SECONDS, WARM_UP) if size == "full" else (4.0, 2.0)
    with tempfile.TemporaryDirectory() as folder:
        memory, missed_ticks = _watched(Path(folder), seconds)
        outputs, unanswered = _answers(Path(folder) / "bag", warm_up)
    result = Result()
    minute = round(warm_up)
    result.verdicts.append(Verdict(f"outputs without an answer, of {outputs:,}", unanswered, 0, at_most=True))
    for node in NODES:
        before, after = memory[node][minute], memory[node][minute:]
        result.rates.append(summary(f"{node} after {warm_up:g} s", "MiB", [before], ours=True))
        result.rates.append(summary(f"{node} from then on", "MiB", after, ours=True))
        growth = max(after) - before
        result.verdicts.append(
            Verdict(f"growth of the {node} after {warm_up:g} s, MiB", growth, LARGEST_GROWTH, at_most=True)
        )
    result.notes.append(f"{missed_ticks:,.0f} ticks of the plant's timer missed in {seconds:g} s")
    return result


def _watched(folder: Path, seconds: float) -> tuple[dict[str, list[float]], float]:
    """Run the loop; memory of each node in MiB every second, and the ticks that the plant missed."""
    from tdof_npid_ros.graph.conductor import Conductor
    from tdof_npid_ros.graph.processes import NodeProcesses

    file = folder / "soak.yaml"
    file.write_text(
        f"/**: {{ros__parameters: {{sample_period: {PERIOD}, mode: realtime}}}}\n"
        "/**/controller: {ros__parameters: {kp: 2.0, ki: 1.0, sigma: 1.0, setpoint: 1.0}}\n"
        f"/**/recorder: {{ros__parameters: {{bag: {folder / 'bag'}}}}}\n"
    )
    memory: dict[str, list[float]] = {node: [] for node in NODES}
    with NodeProcesses(file, NAMESPACE) as nodes:
        for node in NODES:
            nodes.start(node)
        conductor = Conductor(NAMESPACE, nodes.check)
        try:
            conductor.wait(lambda: conductor.fact("plant", "output_to_effort_p50_us") != "", "the loop", TIMEOUT)
            pids, start = nodes.pids, time.monotonic()
            for second in range(round(seconds) + 1):
                for node in NODES:
                    memory[node].append(resident_mib(pids[node]))
                due = start + second + 1.0
                conductor.wait(lambda due=due: time.monotonic() > due, "the next second", TIMEOUT)  # type: ignore[misc]
            return memory, float(conductor.fact("plant", "missed_ticks") or 0)
        finally:
            conductor.close()


def _answers(bag: Path, warm_up: float) -> tuple[int, int]:
    """Outputs in the bag from the warm-up to shortly before the end, and how many of them no effort answers."""
    from tdof_npid_ros.bag.reader import BagReader

    with BagReader(bag) as reader:
        outputs, answers = (
            np.asarray(reader.columns(f"{NAMESPACE}/{topic}", ["header.stamp"])["header.stamp"])
            for topic in ("output", "control_effort")
        )
    first, last = outputs[0] + round(warm_up * 1e9), outputs[-1] - round(LAST * 1e9)
    asked = outputs[(outputs >= first) & (outputs <= last)]
    return len(asked), int(np.sum(~np.isin(asked, answers)))


if __name__ == "__main__":
    main("soak")
