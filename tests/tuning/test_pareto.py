"""Pareto fronts: non-dominated, within bounds, their seed's; a point becomes a loop that runs."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, TUNED, ControllerType
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.pareto import POORER, Front, dominated_fraction, foptd_case, pareto_front
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

RATIO = 0.5
SHORT = ["pareto", "--ratio", "0.5", "--generations", "3"]


@pytest.fixture(scope="module")
def fronts() -> dict[str, Front]:
    return {kind: pareto_front(RATIO, kind, population=64, generations=60) for kind in CONTROLLER_TYPES}


def test_no_point_of_a_front_beats_another(fronts: dict[str, Front]) -> None:
    for front in fronts.values():
        assert len(front.gains) > 10
        assert dominated_fraction(front, front) == 0.0
        assert (np.diff(front.iae[:, 0]) >= 0).all()
        assert (np.diff(front.iae[:, 1]) <= 0).all()


def test_points_lie_within_the_bounds(fronts: dict[str, Front]) -> None:
    for front in fronts.values():
        for name in TUNED[front.controller]:
            low, high = front.case.bounds[name]
            assert all(low <= getattr(gains, name) <= high for gains in front.gains)


def test_a_point_is_what_its_gains_give(fronts: dict[str, Front]) -> None:
    front = fronts["tdof_npid2"]
    index = front.best()
    setpoint, disturbance = (front.case.integrals(name, front.gains[index]).iae[0] for name in front.case.episodes)
    assert (setpoint, disturbance) == tuple(front.iae[index])


def test_the_paper_s_order_of_the_controllers(fronts: dict[str, Front]) -> None:
    pid = fronts["pid"]
    for kind in CONTROLLER_TYPES[1:]:
        assert dominated_fraction(pid, fronts[kind]) > 0.9
        assert dominated_fraction(fronts[kind], pid) < 0.1
    least = {kind: front.iae.sum(axis=1).min() for kind, front in fronts.items()}
    assert least["tdof_npid2"] < least["npid"] < least["pid"]
    assert least["tdof_npid2"] == pytest.approx(least["tdof_npid1"], rel=0.02)


@pytest.mark.parametrize("kind", sorted(POORER))
def test_a_controller_is_nowhere_behind_the_one_that_it_contains(kind: ControllerType) -> None:
    """Not at the ends, either: each point of the poorer front has one of the richer that is as good in both measures.

    NSGA-II gets hardly any generations here, so that it cannot be its doing.
    """
    poorer = pareto_front(0.1, POORER[kind], population=16, generations=2)
    richer = pareto_front(0.1, kind, population=16, generations=2, poorer=poorer)
    assert all((richer.iae <= point).all(axis=1).any() for point in poorer.iae)
    assert (richer.iae.min(axis=0) <= poorer.iae.min(axis=0)).all()


@pytest.mark.parametrize("seed", [0, 3])
def test_the_least_iae_of_a_setpoint_lies_far_along_a_valley_beyond_a_rise(seed: int) -> None:
    problem = TuningProblem(foptd_case(0.1), "tdof_npid1", weight=0.0, seed=seed, generations=200)
    study = Study(problem)
    study.run(Objective(problem))
    assert study.best_value <= 0.1399 and study.result.gains.alpha > 0.7


def test_a_weight_moves_the_best_point(fronts: dict[str, Front]) -> None:
    front = fronts["pid"]
    assert front.best(0.0) == 0
    assert front.best(0.0) < front.best(1.0) < front.best(1000.0)


def test_the_seed_decides_the_front() -> None:
    first, again, other = (pareto_front(RATIO, "pid", seed=seed, population=16, generations=3) for seed in (1, 1, 2))
    assert first.iae.tobytes() == again.iae.tobytes()
    assert first.gains == again.gains
    assert first.iae.tobytes() != other.iae.tobytes()


def test_a_point_written_as_a_parameter_file_runs_as_on_the_front(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "loop.yaml"
    written = [*SHORT, "--controller", "tdof_npid1", "--write", str(file), "--index", "0", "--json"]
    assert main(written) == 0
    point = json.loads(capsys.readouterr().out)["points"][0]
    case = load_case(file)
    assert case.gains.type == "tdof_npid1"
    assert case.integrals("setpoint", case.gains).iae[0] == point["iae_setpoint"]
    assert case.integrals("disturbance", case.gains).iae[0] == point["iae_disturbance"]
    assert main(written) == 2  # not overwritten
    assert "exists" in capsys.readouterr().err


def test_the_fronts_are_written_as_data_and_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SHORT, "--controller", "pid", "npid", "--out", str(tmp_path / "out")]) == 0
    with (tmp_path / "out/fronts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["controller"] for row in rows} == {"pid", "npid"}
    assert len(json.loads((tmp_path / "out/fronts.json").read_text())) == len(rows)
    assert (tmp_path / "out/fronts.png").read_bytes()[:4] == b"\x89PNG"
    assert "npid" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--ratio", "0"], "ratio"),
        (["--ratio", "nan"], "ratio"),
        (["p1-c0.5", "--ratio", "0.5"], "--ratio"),
        (["--ratio", "0.5", "--controller", "pd"], "no controller type"),
        (["--ratio", "0.5", "--controller", "pid", "--seed", "-1"], "seed"),
        (["--ratio", "0.5", "--write", "loop.yaml"], "one front"),
        (["--ratio", "0.5", "--controller", "pid", "--write", "no/folder/loop.yaml"], "cannot be written"),
        (["--ratio", "0.5", "--controller", "pid", "--generations", "0"], "generations"),
        (["--ratio", "0.5", "--controller", "pid", "--index", "-1", "--write", "loop.yaml"], "index"),
        (["--ratio", "0.5", "--controller", "pid", "--weight", "nan", "--write", "loop.yaml"], "weight"),
        (["--ratio", "0.5", "--controller", "pid", "--weight", "-1", "--write", "loop.yaml"], "weight"),
        (["--ratio", "0.5", "--controller", "pid", "--index", "1"], "--write"),
        (
            ["--ratio", "0.5", "--controller", "pid", "--generations", "1", "--write", "loop.yaml", "--index", "999"],
            "no point",
        ),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str],
    reason: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["pareto", *arguments]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert "tdof-npid pareto: " in last
    assert reason in last
    assert not list(tmp_path.iterdir())


def test_any_case_has_its_fronts_and_a_point_of_one_is_a_file_for_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, point, folder = (str(tmp_path / name) for name in ("heater.yaml", "point.yaml", "fronts"))
    facts = "--gain -0.8 --time-constant 18 --dead-time 2 --effort -100 100 --at 20 --step -4 --unit K"
    assert main(["new", file, *facts.split()]) == 0
    capsys.readouterr()
    asked = ["pareto", file, "--controller", "tdof_npid2", "--generations", "3", "--out", folder, "--write", point]
    assert main([*asked, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["points"]
    assert {(row["case"], row["ratio"]) for row in rows} == {("heater", None)} and all(row["kp"] < 0 for row in rows)
    best = min(rows, key=lambda row: row["iae_setpoint"] + row["iae_disturbance"])
    assert main(["simulate", point, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["setpoint"]["iae"] == best["iae_setpoint"] and told["margins"]["m_s"] <= 2.0 + 1e-6
    assert (tmp_path / "fronts/fronts.png").stat().st_size > 10_000


def test_the_output_of_somebody_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert main([*SHORT, "--controller", "pid", "--out", str(tmp_path)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_without_pymoo_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymoo.algorithms.moo.nsga2", None)
    with pytest.raises(TuningError, match="pip install"):
        pareto_front(RATIO, "pid")


@pytest.mark.parametrize("subcommand", ["pareto", "reproduce"])
def test_without_pymoo_nothing_is_begun(
    subcommand: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pymoo.algorithms.moo.nsga2", None)
    assert main([subcommand, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_loop_of_a_ratio_has_its_dead_time() -> None:
    case = foptd_case(0.1)
    assert case.plant_values["dead_time"] == pytest.approx(0.1)
    assert case.sample_period == pytest.approx(0.001)
