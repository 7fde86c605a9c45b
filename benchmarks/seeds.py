"""How surely the HGA reaches the published optima, and the best that is known, from one seed to the next."""

from __future__ import annotations

import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from benchmarks.harness import Rate, Result, Verdict, main
from tdof_npid_ros.case import load_case
from tdof_npid_ros.paper.tables import ROWS, Published
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

QUESTION = "The HGA from ten seeds, against the published objective and SciPy's DE with ten times the evaluations"
BUDGET = 8000  # evaluations, the HGA's; those of its polish included
MORE = 10  # times as many at most for SciPy's DE, which ends when its population has become one point
SEEDS = range(10)
DE_POPULATION = 50
WITHIN = 1.001
ENOUGH = 0.9  # of the seeds


class Row(NamedTuple):
    """A linear row of the paper, with the gains of the paper alone or with σ free as well."""

    case: str
    controller: str
    extra: tuple[str, ...]
    printed: float

    @property
    def label(self) -> str:
        """For the table."""
        return f"{self.case} {self.controller}{', sigma free' if self.extra else ''}"


class Run(NamedTuple):
    """One optimiser's run on a row."""

    row: Row
    optimiser: str
    objective: float
    evaluations: int
    seconds: float


def linear_rows() -> list[Row]:
    """The 18 rows of Processes 1 to 3, and the NPID rows of Process 3 once more with σ free."""
    linear = [row for row in ROWS if row.case != "sprott"]
    return [_row(row, ()) for row in linear] + [_row(row, ("sigma",)) for row in linear if _sigma_in_doubt(row)]


def _row(row: Published, extra: tuple[str, ...]) -> Row:
    return Row(row.case, row.controller, extra, row.objective)


def _sigma_in_doubt(row: Published | Row) -> bool:
    return row.case.startswith("p3") and row.controller != "pid"


def run(size: str) -> Result:
    """Ten seeds of the HGA and one run of DE on every row, spread over the cores."""
    rows = linear_rows() if size == "full" else linear_rows()[:1]
    seeds = SEEDS if size == "full" else range(2)
    work = [(row, "DE", 0) for row in rows] + [(row, "HGA", seed) for row in rows for seed in seeds]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        runs = list(pool.map(_one, work))
    return _result(rows, runs)


def _one(work: tuple[Row, str, int]) -> Run:
    row, optimiser, seed = work
    case = load_case(row.case)
    problem = TuningProblem(case, row.controller, row.extra, case.weight, seed=seed)  # type: ignore[arg-type]
    objective = Objective(problem, threads=1)
    objective(np.array(problem.bounds).T)  # compiled before the clock starts
    start = time.perf_counter()
    value, evaluations = (_hga if optimiser == "HGA" else _de)(problem, objective)
    return Run(row, optimiser, value, evaluations, time.perf_counter() - start)


def _hga(problem: TuningProblem, objective: Objective) -> tuple[float, int]:
    study = Study(problem)
    study.run(objective)
    if study.evaluations > BUDGET:
        raise RuntimeError(f"the HGA took {study.evaluations} evaluations, more than {BUDGET}")
    return study.best_value, study.evaluations


def _de(problem: TuningProblem, objective: Objective) -> tuple[float, int]:
    from scipy.optimize import differential_evolution

    dimensions, evaluations = len(problem.names), 0
    popsize = -(-DE_POPULATION // dimensions)  # SciPy multiplies it by the dimensions

    def value(x: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        evaluations += x.shape[1]
        return objective(x.T)

    found = differential_evolution(
        value, problem.bounds, rng=problem.seed, vectorized=True, updating="deferred", popsize=popsize,
        maxiter=MORE * BUDGET // (popsize * dimensions) - 1, tol=0.0, atol=0.0, polish=False,
    )  # fmt: skip
    return float(found.fun), evaluations


def _result(rows: list[Row], runs: list[Run]) -> Result:
    result = Result(QUESTION)
    at_or_below, near = {}, {}
    for row in rows:
        found = [one.objective for one in runs if one.row == row and one.optimiser == "HGA"]
        (de,) = [one for one in runs if one.row == row and one.optimiser == "DE"]
        at_or_below[row] = float(np.mean(np.array(found) <= row.printed))
        near[row] = float(np.mean(np.array(found) <= de.objective * WITHIN))
        note = (
            f"printed {row.printed:.4f}: at or below in {at_or_below[row]:.0%}; "
            f"DE {de.objective:.6g} ({de.evaluations} evaluations): within 0.1 % in {near[row]:.0%}"
        )
        result.rates.append(Rate(f"HGA, {row.label}", "s", float(np.median(found)), min(found), max(found), note))
    # Where σ is in doubt (docs/reproduction.md), the printed objective is a target with σ free only.
    targets = [row for row in rows if row.extra or not _sigma_in_doubt(row)]
    seconds = [one.seconds for one in runs if one.optimiser == "HGA"]
    result.verdicts += [
        Verdict("least share of seeds at or below the printed objective", min(at_or_below[r] for r in targets), ENOUGH),
        Verdict("least share of seeds within 0.1 % of DE's best", min(near.values()), ENOUGH),
    ]
    result.notes.append(f"a run of the HGA takes {np.median(seconds):.2f} s on one core, {max(seconds):.2f} s at most")
    return result


if __name__ == "__main__":
    main(run)
