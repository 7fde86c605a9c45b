"""From the page: gains searched for, looked at, applied; a loop and a lane chosen; a loop joined and left as it was."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from browser import chromium_page
from live_program import CHROMIUM, Program, eventually, model, needs_chromium, opened

from tdof_npid_ros.case import load_case

pytestmark = [pytest.mark.timeout(480), pytest.mark.alone]
TWO_LANES = """
/**: {ros__parameters: {sample_period: 0.01, mode: realtime}}
plant: {ros__parameters: {model: first_order, gain: 2.0, time_constant: 0.5, lanes: 2}}
controller: {ros__parameters: {type: pid, kp: [2.0, 1.0], ki: 2.0, sigma: 1.0}}
"""


@needs_chromium
def test_gains_are_tuned_looked_at_and_only_then_applied(tmp_path: Path) -> None:
    published = load_case("p1-c0.5").gains.kp
    program = Program(tmp_path, "p1-c0.5")
    try:
        assert CHROMIUM
        with chromium_page(CHROMIUM) as page:
            opened(page, program.url)
            page.get_by_role("button", name="tune", exact=True).click()
            eventually(lambda: "evaluations" in str(model(page, "tuning", "w.text")), "progress is told")
            told = lambda: str(model(page, "tuning", "w.text"))  # noqa: E731
            while not model(page, "proposal", "w.visible"):  # behind all else on this machine: as long as it goes on
                before = told()
                eventually(lambda before=before: told() != before or model(page, "proposal", "w.visible"), told)
            assert program.tdof_npid("get", "kp")["kp"] == published
            texts = str(model(page, "proposal", "w.children.map(c => c.text ?? '').join()"))
            for fact in ("overshoot", "M_<wbr>s", "delay margin", "now", "tuned", "kp"):
                assert fact in texts, fact
            names = set(model(page, "proposal", "w.children.flatMap(c => (c.renderers ?? []).map(r => r.name))"))
            assert {"now", "tuned"} <= names
            page.get_by_role("button", name="apply", exact=True).click()
            eventually(lambda: program.tdof_npid("get", "kp")["kp"] != published, "the gains are applied")
            assert not model(page, "proposal", "w.visible")
            page.get_by_role("button", name="undo", exact=True).click()
            eventually(lambda: program.tdof_npid("get", "kp")["kp"] == published, "undo restores them all")
    finally:
        program.stop()


@needs_chromium
def test_one_of_several_loops_and_lanes_is_chosen_and_a_joined_loop_outlives_the_page(tmp_path: Path) -> None:
    (tmp_path / "two.yaml").write_text(TWO_LANES)
    host = Program(tmp_path, "two.yaml")
    guest = Program(tmp_path, "--join", "/nobody", "/live", beside=host)
    try:
        assert CHROMIUM
        with chromium_page(CHROMIUM) as page:
            page.goto(guest.url, timeout=60_000)
            page.wait_for_function("window.Bokeh && Bokeh.documents[0]?.is_idle", timeout=60_000)
            assert model(page, "loop", "w.options") == ["/nobody", "/live"]
            model(page, "loop", "w.value = '/live'")
            shown = lambda: [model(page, name, "w.value") for name in ("loop", "lane", "kp_field", "type")]  # noqa: E731
            eventually(lambda: model(page, "lane", "w.visible") and shown()[2] == 2.0, shown)
            assert model(page, "kd", "w.pretty ? w.pretty(w.value) : w.value <= w.start")  # 0 has its place below
            model(page, "lane", "w.value = '1'")
            eventually(lambda: model(page, "kp_field", "w.value") == 1.0, "lane 1's kp")
            model(page, "alone", "w.active = true")
            model(page, "kp_field", "w.value = 3")  # a whole number among others
            eventually(lambda: host.tdof_npid("get", "kp")["kp"] == [2.0, 3.0], "that lane's kp")
            model(page, "kp_field", "w.value = 0.7")
            page.get_by_role("button", name="tune", exact=True).click()
            eventually(lambda: "no parameter file is known" in str(model(page, "tuning", "w.text")), "what is missing")
            model(page, "lane", "w.value = '0'")
            eventually(lambda: shown()[2] == 2.0, shown)
        guest.stop(signal.SIGKILL)
        assert len(host.nodes()) == 3
        assert host.tdof_npid("get", "kp")["kp"] == [2.0, 0.7]  # that lane's alone; and the loop answers
    finally:
        guest.stop()
        host.stop()
