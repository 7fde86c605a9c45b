"""`tdof-npid identify`: from a bag to a parameter file that the other commands take."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli import main

SAMPLE = Path(__file__).parents[2] / "bags" / "sample"


def test_the_sample_bag_tells_the_paper_s_first_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, plot = tmp_path / "plant.yaml", tmp_path / "plant.png"
    assert main(["identify", str(SAMPLE), "--out", str(out), "--plot", str(plot), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["structure"] == "first_order"
    for name, true in (("gain", 1.0), ("time_constant", 5.0), ("dead_time", 0.5)):
        told = report["parameters"][name]
        assert told["value"] == pytest.approx(true, rel=1e-3)
        assert told["low"] <= told["value"] <= told["high"]
    assert report["fit_percent"] > 99.9
    assert plot.stat().st_size > 10_000
    case = load_case(out)
    assert case.sample_period == 0.005
    assert case.plant.dead_time == pytest.approx(0.5, rel=1e-3)  # type: ignore[attr-defined]
    assert set(case.bounds) >= {"kp", "ki", "kd", "alpha", "beta", "sigma"}
    assert main(["simulate", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["margins"]["m_s"] < 2.0


def test_one_episode_alone_is_enough(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(SAMPLE), "--episode", "1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["parameters"]["dead_time"]["value"] == pytest.approx(0.5, rel=1e-3)


def test_mistakes_are_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, told in (
        (["--episode", "nonsense"], "no episode 'nonsense'"),
        (["--structure", "nonsense"], "no structure 'nonsense'"),
        (["--out", str(tmp_path / "x.txt")], "ends with .yaml"),
    ):
        assert main(["identify", str(SAMPLE), *arguments]) == 2
        error = capsys.readouterr().err
        assert told in error and error.count("\n") == 1
    present = tmp_path / "there.yaml"
    present.write_text("kept")
    assert main(["identify", str(SAMPLE), "--out", str(present)]) == 2
    assert present.read_text() == "kept"
