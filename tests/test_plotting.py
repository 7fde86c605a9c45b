"""Pictures: colours that all can tell apart, ranges that show the response, what is cut off is told."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path

import numpy as np
import pytest

from tdof_npid_ros.cli import main
from tdof_npid_ros.plotting import PALETTE, Curve, Panel, PlottingError, draw_responses, effort_range, shown_until

GROUNDS = ("#ffffff", "#16181c")  # of pages, light and dark


def luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.03928 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return float(np.dot((0.2126, 0.7152, 0.0722), linear))


@pytest.mark.parametrize(("colour", "ground"), itertools.product(PALETTE, GROUNDS))
def test_each_colour_has_a_contrast_of_3_to_1_on_light_and_dark(colour: str, ground: str) -> None:
    dark, light = sorted((luminance(colour), luminance(ground)))
    assert (light + 0.05) / (dark + 0.05) >= 3.0


TIME = np.linspace(0.0, 100.0, 10_001)


def panel(output: np.ndarray, effort: np.ndarray) -> Panel:
    return Panel("step", [Curve("PID", TIME, output, effort, np.ones_like(TIME))])


def test_a_flat_tail_is_not_shown() -> None:
    rise = 1.0 - np.exp(-TIME)
    assert 5.0 < shown_until(panel(rise, rise)) < 7.0


def test_a_response_that_never_rests_is_shown_whole() -> None:
    assert shown_until(panel(np.sin(TIME), np.sin(TIME))) == 100.0


def test_a_kick_does_not_flatten_the_effort() -> None:
    effort = np.exp(-TIME)
    effort[:20] = 200.0
    low, high, cut = effort_range(panel(effort, effort), 10.0)
    assert cut and high < 3.0 and low > -1.0
    assert effort_range(panel(effort, np.exp(-TIME)), 10.0)[1:] == pytest.approx((1.06, False), abs=0.01)


def test_short_responses_between_long_rests_are_no_kicks() -> None:
    effort = 1e-3 * np.sin(TIME)
    effort[:5], effort[500:505] = 20.0, -20.0
    low, high, cut = effort_range(panel(effort, effort), 10.0)
    assert not cut and low < -20.0 and high > 20.0


def test_nothing_known_of_the_effort_is_no_error(tmp_path: Path) -> None:
    draw_responses([panel(TIME, np.full_like(TIME, np.nan))], tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_picture_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PlottingError, match="cannot be written"):
        draw_responses([panel(TIME, TIME)], tmp_path / "a.unknown")


def test_simulate_draws_and_tabulates_each_episode(tmp_path: Path) -> None:
    picture, table, page = (tmp_path / f"a.{kind}" for kind in ("png", "csv", "html"))
    assert main(["simulate", "p3-c1", "--plot", str(picture), "--csv", str(table), "--html", str(page), "--json"]) == 0
    assert "TDOF-NPID2" in page.read_text()
    rows = list(csv.DictReader(table.open()))
    assert {row["episode"] for row in rows} == {"setpoint", "disturbance"}
    assert float(rows[-1]["time"]) > 0.0 and picture.stat().st_size > 10_000
