"""Tuning for many plants at once: each candidate's score is that of every plant alone, put together."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.case import Case, make_case
from tdof_npid_ros.checkpoint import CheckpointError
from tdof_npid_ros.cli import main, tune
from tdof_npid_ros.parameter_file import write_parameters
from tdof_npid_ros.robustness.spread import spreads_of
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.judge import UNSTABLE, Constraints
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.perturbed import Perturbed
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

SPREADS = ["gain 20 %", "dead_time 50 %"]


def short_case(**plant: Any) -> Case:
    return make_case(
        {"model": "first_order", "time_constant": 1.0, "dead_time": 0.2} | plant,
        {"type": "pid", "kp": 2.0, "ki": 2.0, "kd": 0.2},
        {"setpoint": ["0 setpoint 1", "8 end"], "disturbance": ["0 disturbance 1", "8 end"]},
        sample_period=0.02,
        tuner={"bounds.kp": [0.1, 10.0], "bounds.ki": [0.1, 10.0], "bounds.kd": [0.0, 1.0]},
    )


def problem(by: str | float = "mean", plants: int = 6, **more: Any) -> TuningProblem:
    case = short_case()
    perturbed = Perturbed(spreads_of(case, SPREADS), plants, by)
    return TuningProblem(case, "pid", population=8, generations=4, perturbed=perturbed, **more)


@pytest.mark.parametrize("by", ["mean", "worst", 0.5])
def test_a_score_is_put_together_from_those_of_each_plant_alone(by: str | float) -> None:
    together = problem(by)
    assert together.perturbed is not None
    candidates = np.random.default_rng(0).uniform([0.5, 0.5, 0.0], [3.0, 3.0, 0.3], (5, 3))
    cases = [
        dataclasses.replace(together.case, plant_values={**together.case.plant_values, **changed})
        for changed in together.perturbed.changes(together.case)
    ]
    alone = [Objective(dataclasses.replace(together, case=case, perturbed=None))(candidates) for case in cases]
    values = np.stack([scores.objective for scores in alone])
    found = Objective(together, threads=2)(candidates)
    put_together = {"mean": np.mean, "worst": np.max}.get(str(by), np.median)(values, axis=0)  # type: ignore[operator]
    if by == 0.5:
        put_together = np.sort(values, axis=0)[2]  # of six, the third
    np.testing.assert_allclose(found.objective, put_together, rtol=1e-14)
    allowed = np.max([scores.violation for scores in alone], axis=0) == 0.0
    assert np.all(allowed[found.violation == 0.0])
    np.testing.assert_array_equal(found.objective, Objective(together, threads=1)(candidates).objective)


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
def test_scores_do_not_depend_on_how_the_work_is_cut(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    which = problem(plants=7, constraints=Constraints(ms=2.0))
    candidates = np.random.default_rng(1).uniform([0.5, 0.5, 0.0], [6.0, 3.0, 0.3], (5, 3))
    whole = Objective(which, threads=1)(candidates)
    monkeypatch.setattr("tdof_npid_ros.tuning.perturbed.LEAST_LOOPS", 1)
    chunks = which.plants_judge.chunks(len(candidates), 4 * threads)
    assert [i for chunk in chunks for i in range(7)[chunk]] == list(range(7)) and len(chunks) == min(4 * threads, 7)
    cut = Objective(which, threads=threads)(candidates)
    assert cut.objective.tobytes() == whole.objective.tobytes()
    assert cut.violation.tobytes() == whole.violation.tobytes()


def test_what_is_unstable_at_a_corner_of_the_spreads_is_not_allowed() -> None:
    case = short_case()
    spreads = spreads_of(case, ["gain 60 %", "dead_time 60 %"])
    lively = np.array([[6.2, 2.0, 0.0]])  # stable with the model, and with plants in the middle
    few = TuningProblem(case, "pid", perturbed=Perturbed(spreads, 2))
    assert TuningProblem(case, "pid").judge is not None
    assert Objective(TuningProblem(case, "pid"))(lively).violation[0] < UNSTABLE
    assert Objective(few)(lively).violation[0] >= UNSTABLE


def test_margins_are_asked_of_every_plant() -> None:
    candidates = np.array([[2.0, 2.0, 0.0]])
    free = Objective(problem())(candidates)
    held = Objective(problem(constraints=Constraints(ms=1.6)))(candidates)
    assert free.violation[0] < held.violation[0] < UNSTABLE


def test_stopped_and_resumed_it_ends_as_one_left_alone(tmp_path: Path) -> None:
    alone = Study(problem())
    alone.run(Objective(alone.problem))
    first = Study(problem(), tmp_path / "run.json")
    first.run(Objective(first.problem), lambda study: study.generation < 2)
    assert not first.done
    resumed = Study(problem(), tmp_path / "run.json", resume=True)
    resumed.run(Objective(resumed.problem))
    assert resumed.result == alone.result
    with pytest.raises(CheckpointError, match=r"another problem: robust\.plants"):
        Study(problem(plants=7), tmp_path / "run.json", resume=True)


def test_without_perturbed_plants_a_problem_is_described_as_before() -> None:
    assert not [key for key in dataclasses.replace(problem(), perturbed=None).description() if "robust" in key]


@pytest.mark.parametrize(("plants", "by"), [(1, "mean"), (50, "most"), (50, 1.0), (10**7, "mean")])
def test_plants_that_cannot_be_are_refused(plants: int, by: str | float) -> None:
    with pytest.raises(TuningError):
        Perturbed(spreads_of(short_case(), SPREADS), plants, by)


def test_the_program_tells_both_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tune, "UNSEEN", 100)
    write_parameters(tmp_path / "case.yaml", short_case().parameters())
    words = ["tune", str(tmp_path / "case.yaml"), "--controller", "pid", "--generations", "4", "--population", "8"]
    robust = ["--robust", "6", "--spread", "gain 20 %", "--spread", "dead_time 50 %", "--robust-by", "worst"]
    assert main([*words, *robust, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["robust"]
    assert report["plants"] == 6 and report["by"] == "worst" and report["unseen"]["samples"] == 100
    assert 0.8 * report["objective"] < report["unseen_objective"] < 2.0 * report["objective"]
    assert main([*words, *robust]) == 0
    assert "over 100 others" in capsys.readouterr().out
    assert main([*words, "--spread", "gain 20 %"]) == 2
    assert "--robust N" in capsys.readouterr().err
