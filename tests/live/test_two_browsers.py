"""Two browsers for a long time: memory stays flat, and the loop misses no more than beside a page that stands still.

Runs only where TDOF_PAGE_SECONDS says for how long: 600 is what the page is made for.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from browser import chromium_page
from live_program import CHROMIUM, Program, needs_chromium

from tdof_npid_ros.graph.observer import KEPT
from tdof_npid_ros.parameter_file import find_parameter_file

SECONDS = float(os.environ.get("TDOF_PAGE_SECONDS", "0"))
PERIOD = 0.01  # s of the loop
WARM_UP = 0.4 * SECONDS  # s after which memory must stay where it is, if by then all is kept that is kept for browsers
GROWTH_KIB = 4096
pytestmark = [
    pytest.mark.timeout(3 * SECONDS + 600),
    pytest.mark.skipif(not SECONDS, reason="a long form: TDOF_PAGE_SECONDS=600"),
]
LISTEN = """
import sys, time
from tdof_npid_ros.graph.observer import LoopObserver
observer, count, first, last = LoopObserver("/live"), 0, None, 0
seen, end = observer.count, time.monotonic() + float(sys.argv[1])
while time.monotonic() < end:
    time.sleep(0.2)
    rows, seen = observer.rows_since(seen)
    count += len(rows)
    if rows:
        first, last = first or rows[0].stamp_ns, rows[-1].stamp_ns
observer.close()
print(round((last - first) / float(sys.argv[2])) + 1 - count)
"""


def missed(program: Program, seconds: float) -> int:
    """Answers that the loop did not give within a time: ticks that were missed, and outputs without an answer."""
    command = [sys.executable, "-c", LISTEN, str(seconds), str(PERIOD * 1e9)]
    done = subprocess.run(command, env=program.environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def resident_kib(program: Program) -> int:
    status = Path(f"/proc/{program.process.pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])


@needs_chromium
def test_two_browsers_cost_neither_memory_nor_answers(tmp_path: Path) -> None:
    given = yaml.safe_load(find_parameter_file("p1-c0.5").read_text())
    given["/**"]["ros__parameters"]["sample_period"] = PERIOD
    case, still = tmp_path / "slow.yaml", tmp_path / "still.html"
    case.write_text(yaml.safe_dump(given))
    simulate = [sys.executable, "-m", "tdof_npid_ros", "simulate", "p1-c0.5", "--html", str(still)]
    assert subprocess.run(simulate, capture_output=True).returncode == 0
    assert CHROMIUM
    program = Program(tmp_path, str(case))
    try:
        time.sleep(10.0)
        counts = {}
        for name, url in (("still", f"file://{still}"), ("live", program.url)):
            with chromium_page(CHROMIUM) as page:
                for one in (page, page.context.new_page()):
                    one.goto(url, timeout=120_000)
                if name == "still":
                    counts[name] = missed(program, SECONDS)
                    continue
                early = missed(program, WARM_UP)
                before = resident_kib(program)
                counts[name] = early + missed(program, SECONDS - WARM_UP)
                grown = resident_kib(program) - before
        print(f"missed of {SECONDS / PERIOD:.0f}: {counts}; memory grew by {grown} KiB after {WARM_UP:.0f} s")
        assert grown < GROWTH_KIB or WARM_UP < KEPT * PERIOD
        assert counts["live"] <= counts["still"] + 3.0 * math.sqrt(counts["still"] + 1.0), counts
    finally:
        program.stop()
