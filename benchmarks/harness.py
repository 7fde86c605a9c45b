"""What every benchmark shares: repeats, what it found, the machine's description, JSON and the command line.

A benchmark is a module with

    TITLE      the section's heading
    METHOD     what is measured and how, and each peer's configuration: a paragraph
    PEERS      distributions whose versions the page names
    NOTES      what bounds a figure, or was tried where a goal is missed: written by hand, no run overwrites it
    run(size)  measures; size is `small` (CI: it still works) or `full`
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, cast

ROOT = Path(__file__).parent.parent


@dataclass(frozen=True)
class Rate:
    """A measured rate or time: the median of the repeats and their spread; `ours` colours it in the picture."""

    name: str
    unit: str
    median: float
    low: float
    high: float
    note: str = ""
    ours: bool = False


@dataclass(frozen=True)
class Verdict:
    """A claim: what was reached, mostly a ratio of two figures of the same run, and its goal.

    Attributes:
        goal: None where no goal is set: then it is only stated.
        at_most: whether the goal is an upper limit.
    """

    claim: str
    reached: float
    goal: float | None
    at_most: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the goal is reached; None where none is set."""
        if self.goal is None:
            return None
        return self.reached <= self.goal if self.at_most else self.reached >= self.goal

    @property
    def limit(self) -> str:
        """The goal with its sign."""
        return "–" if self.goal is None else f"{'≤' if self.at_most else '≥'} {self.goal:,g}"

    @property
    def word(self) -> str:
        """The verdict in a word."""
        return {None: "–", True: "met", False: "**missed**"}[self.met]


@dataclass(frozen=True)
class Table:
    """A table of the page."""

    title: str
    header: list[str]
    rows: list[list[str]]


@dataclass(frozen=True)
class Dots:
    """A picture: a row per problem, a dot per contestant, the first of them ours; the axis is logarithmic.

    Attributes:
        values: one list per contestant, one value per row.
    """

    axis: str
    rows: list[str]
    contestants: list[str]
    values: list[list[float]]


@dataclass(frozen=True)
class Curve:
    """A picture's line: seconds, or what `unit` says, against size, both axes logarithmic."""

    name: str
    size_unit: str
    sizes: list[float]
    seconds: list[float]
    unit: str = "s"


@dataclass
class Result:
    """What a benchmark found; `circumstances` says when, where and with which versions."""

    rates: list[Rate] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    dots: Dots | None = None
    curves: list[Curve] = field(default_factory=list)
    circumstances: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "verdicts": [{**asdict(verdict), "met": verdict.met} for verdict in self.verdicts]}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Result:
        """What `as_dict` gave."""
        verdicts = [{key: value for key, value in one.items() if key != "met"} for one in values["verdicts"]]
        return cls(
            [Rate(**one) for one in values["rates"]],
            [Verdict(**one) for one in verdicts],
            values["notes"],
            [Table(**one) for one in values["tables"]],
            Dots(**values["dots"]) if values["dots"] else None,
            [Curve(**one) for one in values["curves"]],
            values["circumstances"],
        )


def rate(
    name: str,
    unit: str,
    amount: float,
    function: Callable[[], Any],
    repeats: int,
    *,
    note: str = "",
    ours: bool = False,
) -> Rate:
    """`amount` divided by the wall time of a call: once to warm up, then `repeats` times."""
    function()
    return summary(name, unit, [amount / seconds(function) for _ in range(repeats)], note=note, ours=ours)


def seconds(function: Callable[[], Any]) -> float:
    """Wall time of a call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def summary(name: str, unit: str, values: Iterable[float], *, note: str = "", ours: bool = False) -> Rate:
    """Median and spread of measured values."""
    values = list(values)
    return Rate(name, unit, statistics.median(values), min(values), max(values), note, ours)


@contextmanager
def one_process_per_core() -> Iterator[ProcessPoolExecutor]:
    """A pool whose processes keep to one thread each, so that they do not fight for the cores."""
    before = dict(os.environ)
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # read by the processes when they start
    try:
        with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("spawn")) as pool:
            yield pool
    finally:
        os.environ.clear()
        os.environ.update(before)


def plural(count: int, noun: str) -> str:
    """A count and its noun."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def measure(module: Any, size: str) -> Result:
    """Run a benchmark and note the circumstances."""
    start = time.monotonic()
    result = cast(Result, module.run(size))
    result.circumstances = {
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d"),
        "seconds": round(time.monotonic() - start),
        "size": size,
        "machine": machine(),
        "versions": {name: _version(name) for name in module.PEERS},
    }
    return result


def machine() -> dict[str, Any]:
    """The machine that the figures are from."""
    cpu = next(
        (line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")),
        platform.processor(),
    )
    kernels = {name: os.environ[name] for name in ("OPENBLAS_CORETYPE",) if name in os.environ}
    return {
        "cpu": cpu,
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": _version("numpy"),
        "scipy": _version("scipy"),
        "numba": _version("numba"),
        "compiler": _compiler(),
        **kernels,
    }


def last_line(output: str) -> str:
    """What a program printed last: the middleware may have printed its own complaints before."""
    return output.strip().splitlines()[-1]


def resident_mib(pid: int) -> float:
    """Memory of a process that is in use, in MiB."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    return int(status.split("VmRSS:")[1].split()[0]) / 1024.0


def processor_seconds(pid: int) -> float:
    """Processor time that a process has had, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _compiler() -> str:
    try:
        return subprocess.run(["gcc", "--version"], capture_output=True, text=True).stdout.partition("\n")[0] or "none"
    except OSError:
        return "none"


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def ros_environment(domain: int) -> None:
    """Keep the nodes that are started from here to this machine and to themselves."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(domain))


def main(name: str) -> None:
    """Run one benchmark from the command line and print what it found."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}")
    parser.add_argument("--size", choices=["small", "full"], default="full")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    module = importlib.import_module(f"benchmarks.{name}")
    result = measure(module, arguments.size)
    print(json.dumps(result.as_dict()) if arguments.json else text(module.TITLE, result))
    sys.exit(0)


def text(title: str, result: Result) -> str:
    """For a terminal."""
    lines = [title]
    lines += [
        f"  {r.name:48} {r.median:14,.6g} {r.unit:12} ({r.low:,.4g} to {r.high:,.4g}) {r.note}" for r in result.rates
    ]
    for table in result.tables:
        lines += [f"  {table.title}", *(f"    {line}" for line in _aligned([table.header, *table.rows]))]
    for v in result.verdicts:
        word = {None: "      ", True: "met   ", False: "MISSED"}[v.met]
        lines.append(f"  {word} {v.claim}: {v.reached:,.3g} (goal {v.limit})")
    return "\n".join([*lines, *(f"  {note}" for note in result.notes)])


def _aligned(rows: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
