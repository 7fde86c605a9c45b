"""How well the realtime plant keeps its period, beside a bare rclpy timer on the same machine in the same run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.harness import Rate, Result, Verdict, main

QUESTION = "Period error of the realtime plant in a closed loop, beside a bare rclpy timer"
NAMESPACE = "/bench"
PERIODS = {"100 Hz": 0.01, "1 kHz": 0.001}  # s
TIMEOUT = 60.0  # s


def run(size: str) -> Result:
    """Both at once would share the processor; so one after the other, at each rate."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", "88")
    seconds = 20.0 if size == "full" else 3.0
    result = Result(QUESTION)
    for name, period in PERIODS.items():
        bare, ours = bare_timer(period, seconds), plant(period, seconds)
        for who, figures in (("bare timer", bare), ("plant", ours)):
            for percentile in ("p50", "p99"):
                value = figures[f"period_error_{percentile}"]
                result.rates.append(Rate(f"{who} at {name}, {percentile}", "us", value, value, value))
        for percentile in ("p50", "p99"):
            value = ours[f"output_to_effort_{percentile}"]
            result.rates.append(Rate(f"output to effort at {name}, {percentile}", "us", value, value, value))
        ratio = ours["period_error_p99"] / bare["period_error_p99"]
        result.verdicts.append(Verdict(f"{name}: p99 against the bare timer's", ratio, 1.5, at_most=True))
        result.notes.append(f"{name}: {ours['steps']:.0f} steps, {ours['missed_ticks']:.0f} missed")
    return result


def bare_timer(period: float, seconds: float) -> dict[str, float]:
    """Percentiles of the bare timer's period error, in us."""
    command = [sys.executable, "-m", "benchmarks.bare_timer", str(period), str(seconds)]
    p50, p99 = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    return {"period_error_p50": float(p50), "period_error_p99": float(p99)}


def plant(period: float, seconds: float) -> dict[str, float]:
    """The plant's own figures after so many seconds with a controller, in us."""
    from tdof_npid_ros.graph.conductor import Conductor
    from tdof_npid_ros.graph.processes import NodeProcesses

    names = ("period_error_p50", "period_error_p99", "output_to_effort_p50", "output_to_effort_p99")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bench.yaml"
        file.write_text(
            f"/**: {{ros__parameters: {{sample_period: {period}, mode: realtime}}}}\n"
            "/**/controller: {ros__parameters: {kp: 2.0, ki: 1.0, setpoint: 1.0}}\n"
        )
        with NodeProcesses(file, NAMESPACE) as nodes:
            for node in ("plant", "controller"):
                nodes.start(node)
            conductor = Conductor(NAMESPACE, nodes.check)
            try:
                conductor.wait(lambda: conductor.fact("plant", "output_to_effort_p50_us") != "", "the loop", TIMEOUT)
                end = time.monotonic() + seconds
                conductor.wait(lambda: time.monotonic() > end, "the run", seconds + TIMEOUT)
                figures = {name: float(conductor.fact("plant", f"{name}_us")) for name in names}
                counts = {name: float(conductor.fact("plant", name) or 0) for name in ("steps", "missed_ticks")}
                return figures | counts
            finally:
                conductor.close()


if __name__ == "__main__":
    main(run)
