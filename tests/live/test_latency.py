"""A step is seen on the page no later than 200 ms after it happened."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from browser import WATCH_EFFORT, chromium_page, seen_efforts
from live_program import CHROMIUM, Program, eventually, needs_chromium

pytestmark = [pytest.mark.timeout(240), pytest.mark.alone]
LATEST_S = 0.2
STEPS = 20  # of the effort, in a round
# A machine that is busy with something else may be late; a page that is late is so in every round, at most steps.
ROUNDS, MOST_LATE = 5, 2
PERIOD_S = 0.01


@needs_chromium
def test_a_step_is_shown_within_200_ms(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from scripted_loop import ScriptedLoop

    program = Program(tmp_path, "--join", "/fast")
    try:
        assert CHROMIUM
        domain = int(program.environment["ROS_DOMAIN_ID"])
        with ScriptedLoop("/fast", PERIOD_S, domain) as loop, chromium_page(CHROMIUM) as page:
            page.goto(program.url, timeout=60_000)
            page.wait_for_function("window.Bokeh && Bokeh.documents[0]?.is_idle", timeout=60_000)
            page.evaluate(WATCH_EFFORT)
            eventually(lambda: loop.hold(0.0, 0.1) or 0.0 in seen_efforts(page), "the loop is seen")
            late: list[list[float]] = []
            for number in range(ROUNDS):
                values = [1.0 + STEPS * number + k for k in range(STEPS)]
                for value in values:
                    loop.hold(value, 0.1)
                loop.hold(0.5, 1.0)  # for what is on its way
                seen = seen_efforts(page)
                late.append(sorted(seen.get(value, math.inf) - loop.published[value] for value in values))
                if late[-1][-1 - MOST_LATE] <= LATEST_S:
                    break
        told = [f"median {1000 * one[STEPS // 2]:.0f} ms, at most {1000 * one[-1]:.0f} ms" for one in late]
        print(*told, sep="\n")
        assert late[-1][-1 - MOST_LATE] <= LATEST_S, told
    finally:
        program.stop()
