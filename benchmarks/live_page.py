"""What the live page costs, and how soon it shows what happened."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from benchmarks.harness import (
    Result,
    Verdict,
    main,
    plural,
    processor_seconds,
    resident_mib,
    ros_environment,
    summary,
)
from benchmarks.realtime import running_loop
from tdof_npid_ros.graph.conductor import Conductor
from tests.browser import WATCH_EFFORT, chromium_page, seen_efforts
from tests.scripted_loop import ScriptedLoop

TITLE = "The live page"
METHOD = (
    "`tdof-npid live --join` of a loop, its page in a headless Chromium on the same two cores, which also draws it. "
    "*Step seen*: outputs with their efforts are published at 100 Hz, the effort stepping ten times a second; the time "
    "from the publishing of a step's first effort until the page's data hold it. *Ticks missed*: plant and controller "
    "in realtime at 100 Hz, by the plant's own count, in windows with nothing else running and with program, page and "
    "browser, in turn; the latter begin three seconds after the page's first picture."
)
PEERS = ("bokeh", "playwright")
NOTES = (
    "What bounds the ticks: a tick counts as missed when it is a whole period late, 10 ms here, and two cores serve "
    "plant, controller, program and a browser that draws without a graphics card. The program takes a tenth of one "
    "core, and the page rests between two pictures for three times as long as the browser took for one. While "
    "program and browser start, both cores are busy for seconds: whoever minds opens the page on another machine.",
)

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NAMESPACE, SCRIPTED = "/bench_page", "/bench_steps"
PERIOD = 0.01  # s
SETTLED = 3.0  # s from the page's first picture on, until ticks are counted
HELD = 0.1  # s that a step of the effort lasts
TIMEOUT = 90.0  # s


def run(size: str) -> Result:
    """First the steps, then the ticks."""
    if CHROMIUM is None:
        return Result(notes=["Not measured: there is no Chromium on this machine."])
    ros_environment(88)
    steps, rounds, window = (100, 3, 12.0) if size == "full" else (5, 1, 2.0)
    result = Result()
    seen = _steps_seen(steps)
    result.rates.append(summary("a step of the effort, until the page holds it", "ms", seen, ours=True))
    result.verdicts += [
        Verdict(f"a step seen in the browser, 95 % of {steps}, ms", _quantile(seen, 0.95), 200.0, at_most=True),
        Verdict("the same, the latest, ms", seen[-1], None),
    ]
    alone, opening, beside, processor, memory = 0, 0, 0, [], []
    with running_loop(NAMESPACE, PERIOD) as conductor:
        for _ in range(rounds):
            alone += _missed(conductor, window)
            before_it = _report(conductor)
            with _page(NAMESPACE) as (program, _):
                time.sleep(SETTLED)
                opening += _report(conductor) - before_it
                before, begin = processor_seconds(program.pid), time.monotonic()
                beside += _missed(conductor, window)
                processor.append(100.0 * (processor_seconds(program.pid) - before) / (time.monotonic() - begin))
                memory.append(resident_mib(program.pid))
    ticks = round(rounds * window / PERIOD)
    result.rates += [
        summary("tdof-npid live, of one processor", "%", processor, ours=True),
        summary("tdof-npid live, resident", "MiB", memory, ours=True),
    ]
    claim = f"ticks missed with the page, of {ticks:,}, more than without it"
    result.verdicts.append(Verdict(claim, max(0, beside - alone), 0, at_most=True))
    result.notes.append(
        f"Ticks missed of {ticks:,}: {alone} without the page, {beside} with it; {opening} more while program and "
        f"browser started, {plural(rounds, 'time')}."
    )
    return result


def _quantile(ordered: list[float], q: float) -> float:
    return ordered[min(len(ordered) - 1, round(q * len(ordered)))]


def _steps_seen(steps: int) -> list[float]:
    """Of each step, how long until the page held it, in ms, in order."""
    with ScriptedLoop(SCRIPTED, PERIOD) as loop, _page(SCRIPTED) as (_, page):
        page.evaluate(WATCH_EFFORT)
        end = time.monotonic() + TIMEOUT
        while not seen_efforts(page):
            if time.monotonic() > end:
                raise TimeoutError("the page does not show the loop")
            loop.hold(0.0, HELD)
        for step in range(steps):
            loop.hold(1.0 + step, HELD)
        loop.hold(0.5, 1.0)  # for what is on its way
        at = seen_efforts(page)
        return sorted(1000.0 * (at[1.0 + step] - loop.published[1.0 + step]) for step in range(steps))


def _missed(conductor: Conductor, seconds: float) -> int:
    """Ticks that the plant misses in so many seconds."""
    before = _report(conductor)
    time.sleep(seconds)  # an onlooker that spins would take its share of the processors
    return _report(conductor) - before


def _report(conductor: Conductor) -> int:
    """The ticks missed since the plant's start, by a report from now on."""
    told = {conductor.fact("plant", "time_s")}
    for _ in range(2):  # the first may have waited to be taken
        conductor.wait(lambda: conductor.fact("plant", "time_s") not in told, "the plant's report", TIMEOUT)
        told.add(conductor.fact("plant", "time_s"))
    return int(conductor.fact("plant", "missed_ticks") or 0)


@contextmanager
def _page(namespace: str) -> Iterator[tuple[subprocess.Popen[str], Any]]:
    """`tdof-npid live` of a loop, and its page in a browser, as Playwright has it."""
    assert CHROMIUM is not None
    command = [sys.executable, "-m", "tdof_npid_ros", "live", "--join", namespace, "--no-browser", "--json"]
    with subprocess.Popen(command, env=dict(os.environ), stdout=subprocess.PIPE, text=True) as program:
        try:
            assert program.stdout is not None
            url = str(json.loads(program.stdout.readline())["url"])
            with chromium_page(CHROMIUM) as page:
                page.goto(url, timeout=1000.0 * TIMEOUT)
                page.wait_for_function("window.Bokeh && Bokeh.documents[0]?.is_idle", timeout=1000.0 * TIMEOUT)
                yield program, page
        finally:
            program.send_signal(signal.SIGINT)


if __name__ == "__main__":
    main("live_page")
