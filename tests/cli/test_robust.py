"""`tdof-npid robust`: one line for what is wrong, one object for scripts, files that simulate takes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tdof_npid_ros.cli import main
from tdof_npid_ros.robustness.sweep import METRICS

WORDS = ["robust", "p1-c0.5", "--spread", "gain 20 %", "--spread", "dead_time 30 %"]


def test_one_run_writes_all_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, plot, page = tmp_path / "worst", tmp_path / "fan.png", tmp_path / "page.html"
    written = ["--out", str(out), "--plot", str(plot), "--html", str(page)]
    assert main([*WORDS, "--samples", "60", "--json", *written]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["samples"] == 60 and report["unstable"]["count"] == 0
    assert report["quantiles"].keys() == METRICS.keys()
    assert report["quantiles"]["objective"]["0.05"] < report["mean"]["objective"]
    assert plot.read_bytes().startswith(b"\x89PNG") and "The worst plants" in page.read_text("utf-8")
    assert main(["simulate", str(out / "worst-1.yaml"), "--json"]) == 0
    simulated = json.loads(capsys.readouterr().out)
    assert simulated["objective"] == report["worst"][0]["objective"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--spread", "gain 10 %"], "gain has two spreads"),
        (["--samples", "0"], "0 samples"),
        (["--resume"], "--resume needs --checkpoint"),
        (["--out", "/proc/none"], "cannot be made"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(more: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*WORDS, *more]) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1
