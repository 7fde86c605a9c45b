"""What every benchmark shares: repeats, the machine's description, verdicts, JSON and the command line.

A benchmark is a module with a `QUESTION` and a `run(size)`; size is `small` (CI: it still works) or `full`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Rate:
    """A measured rate or time: the median of the repeats and their spread."""

    name: str
    unit: str
    median: float
    low: float
    high: float
    note: str = ""


@dataclass(frozen=True)
class Verdict:
    """A claim: a ratio of two figures of the same run against its goal."""

    claim: str
    ratio: float
    goal: float
    at_most: bool = False

    @property
    def met(self) -> bool:
        """Whether the goal is reached."""
        return self.ratio <= self.goal if self.at_most else self.ratio >= self.goal


@dataclass
class Result:
    """What a benchmark found."""

    question: str
    rates: list[Rate] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        verdicts = [{**asdict(verdict), "met": verdict.met} for verdict in self.verdicts]
        return {**asdict(self), "verdicts": verdicts, "machine": machine()}


def rate(name: str, unit: str, amount: float, function: Callable[[], Any], repeats: int, note: str = "") -> Rate:
    """`amount` divided by the wall time of a call: once to warm up, then `repeats` times."""
    function()
    rates = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        rates.append(amount / (time.perf_counter() - start))
    return summary(name, unit, rates, note)


def summary(name: str, unit: str, values: list[float], note: str = "") -> Rate:
    """Median and spread of measured values."""
    return Rate(name, unit, statistics.median(values), min(values), max(values), note)


def machine() -> dict[str, Any]:
    """The machine that the figures are from."""
    cpu = next(
        (line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")),
        platform.processor(),
    )
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def main(run: Callable[[str], Result]) -> None:
    """Run one benchmark from the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", choices=["small", "full"], default="full")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = run(arguments.size)
    print(json.dumps(result.as_dict()) if arguments.json else text(result))
    sys.exit(0)


def text(result: Result) -> str:
    """For a terminal."""
    lines = [result.question]
    lines += [
        f"  {r.name:44} {r.median:14,.6g} {r.unit:10} ({r.low:,.4g} to {r.high:,.4g}) {r.note}" for r in result.rates
    ]
    for v in result.verdicts:
        sign = "<=" if v.at_most else ">="
        lines.append(f"  {'met   ' if v.met else 'MISSED'} {v.claim}: {v.ratio:.3g} (goal {sign} {v.goal:g})")
    return "\n".join([*lines, *(f"  {note}" for note in result.notes)])
