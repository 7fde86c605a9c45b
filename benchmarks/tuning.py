"""How many evaluations an optimiser needs on the paper's rows, and how surely it gets there."""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import Result, Verdict, main, summary
from tdof_npid_ros.case import load_case
from tdof_npid_ros.paper.tables import ROWS
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.optimizers import make_optimizer
from tdof_npid_ros.tuning.problem import TuningProblem

QUESTION = "Evaluations until within 0.1 % of the best known objective, all 21 rows of the paper"
BUDGET = 8000  # evaluations
OPTUNA_BUDGET = 300  # its samplers take tens of milliseconds for each candidate
WITHIN = 1.001
Evaluate = Callable[[np.ndarray], np.ndarray]


class TargetReachedError(Exception):
    """The target was reached."""


class Run(NamedTuple):
    """One run: evaluations until the target (None if it was not reached) and wall time in s."""

    optimiser: str
    row: str
    evaluations: int | None
    seconds: float


class Counted:
    """An objective that counts, and ends the run when the target is reached or the budget spent."""

    def __init__(self, evaluate: Evaluate, target: float, budget: int) -> None:
        self.evaluate, self.target, self.budget = evaluate, target, budget
        self.evaluations, self.reached = 0, None

    def __call__(self, candidates: np.ndarray) -> np.ndarray:
        """Values of the candidates, unless the run is over."""
        values = self.evaluate(np.atleast_2d(candidates))
        hits = np.flatnonzero(values <= self.target)
        if hits.size:
            self.reached = self.evaluations + int(hits[0]) + 1
        self.evaluations += len(values)
        if self.reached is not None or self.evaluations >= self.budget:
            raise TargetReachedError
        return values


def _ask_tell(algorithm: str) -> Callable[[Counted, np.ndarray, np.ndarray, int], None]:
    def run(objective: Counted, lower: np.ndarray, upper: np.ndarray, seed: int) -> None:
        optimiser = make_optimizer(algorithm, lower, upper, seed=seed, population=40, generations=BUDGET // 40)
        while not optimiser.done:
            optimiser.tell(objective(optimiser.ask()))

    return run


def _scipy_de(objective: Counted, lower: np.ndarray, upper: np.ndarray, seed: int) -> None:
    from scipy.optimize import differential_evolution

    differential_evolution(
        lambda x: objective(x.T), list(zip(lower, upper, strict=True)), rng=seed, vectorized=True, updating="deferred",
        popsize=8, maxiter=10_000, tol=0.0, atol=0.0, polish=False,
    )  # fmt: skip


def _pymoo(name: str) -> Callable[[Counted, np.ndarray, np.ndarray, int], None]:
    def run(objective: Counted, lower: np.ndarray, upper: np.ndarray, seed: int) -> None:
        from pymoo.algorithms.soo.nonconvex.cmaes import CMAES
        from pymoo.algorithms.soo.nonconvex.de import DE
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.algorithms.soo.nonconvex.pso import PSO
        from pymoo.core.problem import Problem
        from pymoo.optimize import minimize

        class Rows(Problem):  # type: ignore[misc]
            def __init__(self) -> None:
                super().__init__(n_var=len(lower), n_obj=1, xl=lower, xu=upper)

            def _evaluate(self, x: np.ndarray, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
                out["F"] = objective(x)[:, None]

        best = {
            "GA": lambda: GA(pop_size=40), "DE": lambda: DE(pop_size=40), "PSO": lambda: PSO(pop_size=25),
            "CMA-ES": lambda: CMAES(restarts=9, parallelize=True),
        }[name]()  # fmt: skip
        minimize(Rows(), best, ("n_eval", BUDGET), seed=seed, verbose=False)

    return run


def _optuna(name: str) -> Callable[[Counted, np.ndarray, np.ndarray, int], None]:
    def run(objective: Counted, lower: np.ndarray, upper: np.ndarray, seed: int) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        sampler = {"TPE": optuna.samplers.TPESampler, "CMA-ES": optuna.samplers.CmaEsSampler}[name](seed=seed)
        study = optuna.create_study(sampler=sampler)

        def value(trial: Any) -> float:
            x = [trial.suggest_float(str(i), a, b) for i, (a, b) in enumerate(zip(lower, upper, strict=True))]
            return float(objective(np.array([x]))[0])

        study.optimize(value, n_trials=objective.budget)

    return run


OPTIMISERS: dict[str, tuple[Callable[[Counted, np.ndarray, np.ndarray, int], None], int]] = {
    "HGA": (_ask_tell("hga"), BUDGET),
    "cma (IPOP restarts)": (_ask_tell("cmaes"), BUDGET),
    "SciPy DE": (_scipy_de, BUDGET),
    "pymoo GA": (_pymoo("GA"), BUDGET),
    "pymoo DE": (_pymoo("DE"), BUDGET),
    "pymoo PSO": (_pymoo("PSO"), BUDGET),
    "pymoo CMA-ES": (_pymoo("CMA-ES"), BUDGET),
    "Optuna TPE": (_optuna("TPE"), OPTUNA_BUDGET),
    "Optuna CMA-ES": (_optuna("CMA-ES"), OPTUNA_BUDGET),
}


def run(size: str) -> Result:
    """Every optimiser on every row with many seeds, spread over the cores."""
    full = size == "full"
    seeds = 20 if full else 1
    rows = [(row.case, row.controller) for row in (ROWS if full else ROWS[:1])]
    names = list(OPTIMISERS) if full else list(OPTIMISERS)[:3]
    work = [
        (name, case, controller, seed)
        for case, controller in rows
        for name in names
        for seed in range(100, 100 + (5 if "Optuna" in name and full else seeds))  # Optuna: fewer seeds, for time
    ]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        runs = list(pool.map(_one, work, chunksize=4))
    return _result(runs, rows, names)


def _one(work: tuple[str, str, str, int]) -> Run:
    name, case_name, controller, seed = work
    warnings.simplefilter("ignore")
    optimise, budget = OPTIMISERS[name]
    case = load_case(case_name)
    problem = TuningProblem(case, controller, weight=case.weight, seed=seed)  # type: ignore[arg-type]
    known = tuned(case_name, controller)  # type: ignore[arg-type]
    if known is None:
        raise RuntimeError(f"no tuned gains for {controller} on {case_name}")
    objective = Counted(Objective(problem, threads=1), known.objective * WITHIN, budget)
    lower, upper = np.array(problem.bounds).T
    start = time.perf_counter()
    with contextlib.suppress(TargetReachedError):
        optimise(objective, lower, upper, seed)
    return Run(name, f"{case_name} {controller}", objective.reached, time.perf_counter() - start)


def _result(runs: list[Run], rows: list[tuple[str, str]], names: list[str]) -> Result:
    result = Result(QUESTION)
    medians: dict[tuple[str, str], float] = {}
    for name in names:
        mine = [run for run in runs if run.optimiser == name]
        counts = [run.evaluations if run.evaluations is not None else BUDGET for run in mine]
        reached = sum(run.evaluations is not None for run in mine)
        note = f"reached in {reached} of {len(mine)} runs, {np.median([run.seconds for run in mine]):.2f} s a run"
        result.rates.append(summary(name, "evaluations", [float(c) for c in counts], note))
        for case, controller in rows:
            row = f"{case} {controller}"
            own = [BUDGET if r.evaluations is None else r.evaluations for r in mine if r.row == row]
            medians[name, row] = float(np.median(own))
    hga = [run for run in runs if run.optimiser == "HGA"]
    labels = [f"{case} {controller}" for case, controller in rows]
    fewest = [row for row in labels if medians["HGA", row] <= min(medians[name, row] for name in names)]
    shares = [np.mean([run.evaluations is not None for run in hga if run.row == row]) for row in labels]
    result.verdicts += [
        Verdict("share of the HGA's runs that reach the target", float(np.mean(shares)), 0.95),
        Verdict("share of rows on which the HGA needs the fewest evaluations (median)", len(fewest) / len(rows), 0.5),
    ]
    worst = min(zip(shares, labels, strict=True))
    result.notes.append(f"the HGA's weakest row: {worst[1]}, reached in {100 * worst[0]:.0f} % of the seeds")
    result.notes += [f"{row}: " + ", ".join(f"{name} {medians[name, row]:.0f}" for name in names) for row in labels]
    return result


if __name__ == "__main__":
    main(run)
