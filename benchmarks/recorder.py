"""What recording costs a lockstep loop, and whether anything is lost at its full speed."""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.harness import Result, Verdict, main, ros_environment, summary

TITLE = "Recording a loop at full speed"
METHOD = (
    "A lockstep episode of Process 1 of 30,000 steps at full speed, after a short one, with and without the "
    "recorder, in "
    "turn, three times. `lossless`: the loop waits for its log. Every bag is then checked: messages lost by the "
    "recorder's own count and "
    "by the gaps in the stamps; every control effort recomputed from it (`tdof-npid verify`); outputs and efforts "
    "compared with the in-process simulation, bit for bit."
)
PEERS: tuple[str, ...] = ()
NOTES: tuple[str, ...] = ()

NAMESPACE = "/bench"
TIMEOUT = 600.0  # s
WARM_UP = 1_000  # steps of a first episode
VARIANTS: dict[str, dict[str, Any] | None] = {
    "unrecorded": None,
    "recorded": {},
    "recorded, lossless": {"lossless": True},
}


def run(size: str) -> Result:
    """The variants in turn, so that all see the same machine; each bag is verified, and compared with the loop here."""
    from tdof_npid_ros.analysis.report import analyze
    from tdof_npid_ros.analysis.verify import verify
    from tdof_npid_ros.bag.reader import BagReader

    ros_environment(88)
    rounds, steps = (3, 30_000) if size == "full" else (1, 2_000)
    result = Result()
    variants = VARIANTS if size == "full" else {name: VARIANTS[name] for name in ("unrecorded", "recorded, lossless")}
    speeds: dict[str, list[float]] = {name: [] for name in variants}
    lost, missing, unequal, off = 0, 0, 0, 0.0
    for round_ in range(rounds):
        for name, parameters in variants.items():
            with tempfile.TemporaryDirectory() as folder:
                speeds[name].append(run_loop(Path(folder), steps, parameters))
                if parameters is None:
                    continue
                bag = Path(folder) / "bag"
                with BagReader(bag) as reader:
                    lost += int(reader.custom_data["lost"])
                start = time.perf_counter()
                account = verify(bag)
                seconds = time.perf_counter() - start
                unequal += account.different + max(0, steps + 1 - account.equal)
                *_, report = analyze([bag]).episodes
                for deviation in (report.deviation.output, report.deviation.control_effort):
                    off = max(off, math.inf if deviation is None else deviation)  # None: it could not be compared
                missing += report.episode.missing
        result.notes.append(f"round {round_ + 1}: verify took {seconds:.2f} s for {steps + 1} steps")
    result.rates = [summary(name, "steps/s", values, ours=True) for name, values in speeds.items()]
    unrecorded = result.rates[0].median
    for name, values in zip(list(variants)[1:], result.rates[1:], strict=True):
        result.verdicts.append(Verdict(f"{name}, times unrecorded", values.median / unrecorded, 0.5))
    bags = (len(variants) - 1) * rounds
    result.verdicts += [
        Verdict(f"messages lost in {bags} recordings of {steps:,} steps", lost, 0, at_most=True),
        Verdict("outputs missing by the gaps in the stamps", missing, 0, at_most=True),
        Verdict("control efforts that differ when recomputed from the bag", unequal, 0, at_most=True),
        Verdict("largest deviation from the in-process simulation", off, 0, at_most=True),
    ]
    return result


def run_loop(folder: Path, steps: int, recording: dict[str, Any] | None, lanes: int = 1) -> float:
    """An episode of Process 1 through the nodes, after a short one; returns its steps per second, from the plant's
    report
    that the short one has ended to its report that this one has. The bag is `folder/bag`.

    Args:
        recording: the loop's parameters while it is recorded; None: it is not.
    """
    from tdof_npid_ros.case import load_case
    from tdof_npid_ros.graph.conductor import Conductor
    from tdof_npid_ros.graph.processes import NodeProcesses

    period = load_case("p1-c0.5").sample_period
    file = folder / "bench.yaml"
    file.write_text(
        f"/**: {{ros__parameters: {{sample_period: {period}, mode: lockstep}}}}\n"
        f"/**/plant: {{ros__parameters: {{lanes: {lanes}}}}}\n"
        f"/**/controller: {{ros__parameters: {{kp: {[9.4] * lanes}, ki: 9.4, kd: 2.1, alpha: 0.3, sigma: 1.0}}}}\n"
        "/**/scenario: {ros__parameters: {play: false, episodes: [warm_up, run], plan: {"
        f'warm_up: ["0 setpoint 1", "{WARM_UP * period} end"], run: ["0 setpoint 1", "{steps * period} end"]}}}}}}\n'
    )
    recorded = recording is not None
    with NodeProcesses(file, NAMESPACE) as nodes:
        if recording is not None:
            nodes.start("recorder", {"bag": folder / "bag", **recording})
        for node in ("plant", "controller", "scenario"):
            nodes.start(node, recording)
        conductor = Conductor(NAMESPACE, nodes.check)
        try:
            watched = {"output": 1 + recorded, "control_effort": 1 + recorded, "scenario_plan": 2 + recorded}
            conductor.wait_for_subscriptions(watched, TIMEOUT)
            conductor.play(TIMEOUT)
            conductor.wait(lambda: conductor.episodes_finished >= 1, "the first episode's end", TIMEOUT)
            start = time.monotonic()
            conductor.wait(lambda: conductor.episodes_finished >= 2, "the episode's end", TIMEOUT)
            return steps / (time.monotonic() - start)
        finally:
            conductor.close()


if __name__ == "__main__":
    main("recorder")
