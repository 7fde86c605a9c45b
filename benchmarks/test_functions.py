"""The HGA on standard test functions, beside SciPy's and pymoo's optimisers at equal evaluations."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.harness import Dots, Result, Table, main, one_process_per_core
from benchmarks.tuning import BUDGET, Counted, Optimise, TargetReachedError, ask_tell, pymoo
from tdof_npid_ros.tuning.ask_tell import Scores

TITLE = "The HGA on standard test functions"
METHOD = (
    "Sphere, Rosenbrock, Rastrigin, Ackley and Griewank in five dimensions; every optimiser has 8,000 evaluations and "
    "ten seeds, and what counts is the lowest value found (the minimum is 0). The bounds lie unevenly about the "
    "minimum, "
    "so that none gains from looking in the middle. The HGA runs with its polish, as `tdof-npid tune` does, and "
    "without, "
    "as the paper has it. SciPy's `differential_evolution` (popsize 8) ends with its own polish; `dual_annealing` is "
    "as it "
    "comes, with its local search; both within the 8,000. pymoo: GA and DE with 40 individuals, PSO with 25, CMA-ES "
    "with 9 restarts. No goal is set: this is to say where the HGA wins and loses."
)
PEERS = ("scipy", "pymoo", "cma")
NOTES: tuple[str, ...] = ()

DIMENSION = 5
SEEDS = range(200, 210)
SMALLEST = 1e-12  # below it a value counts as 0
OURS = "HGA"
Function = Callable[[np.ndarray], np.ndarray]  # (n, d) to (n,)


def sphere(x: np.ndarray) -> np.ndarray:
    """One bowl."""
    return np.asarray((x * x).sum(axis=1))


def rosenbrock(x: np.ndarray) -> np.ndarray:
    """A long bent valley."""
    return np.asarray((100.0 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1.0 - x[:, :-1]) ** 2).sum(axis=1))


def rastrigin(x: np.ndarray) -> np.ndarray:
    """A bowl with a regular grid of deep dents."""
    return np.asarray((x * x - 10.0 * np.cos(2.0 * np.pi * x) + 10.0).sum(axis=1))


def ackley(x: np.ndarray) -> np.ndarray:
    """A nearly flat, dented plain with a hole."""
    distance = np.sqrt((x * x).mean(axis=1))
    return np.asarray(-20.0 * np.exp(-0.2 * distance) - np.exp(np.cos(2.0 * np.pi * x).mean(axis=1)) + 20.0 + np.e)


def griewank(x: np.ndarray) -> np.ndarray:
    """A wide bowl with many shallow dents."""
    product = np.cos(x / np.sqrt(np.arange(1, x.shape[1] + 1))).prod(axis=1)
    return np.asarray((x * x).sum(axis=1) / 4000.0 - product + 1.0)


FUNCTIONS: dict[str, tuple[Function, float, float]] = {  # and the bounds of every coordinate
    "sphere": (sphere, -3.1, 5.0),
    "Rosenbrock": (rosenbrock, -5.0, 10.0),
    "Rastrigin": (rastrigin, -3.1, 5.12),
    "Ackley": (ackley, -19.0, 32.0),
    "Griewank": (griewank, -370.0, 600.0),
}


def _scipy_polished(objective: Counted, lower: np.ndarray, upper: np.ndarray, seed: int) -> None:
    from scipy.optimize import Bounds, differential_evolution

    # Its polish takes some hundred evaluations; the generations get the rest.
    generations = (objective.budget - 400) // (8 * len(lower)) - 1

    def evaluate(x: Any) -> Any:  # a generation (d, n), or in the polish one point (d,)
        return objective(x.T) if x.ndim == 2 else float(objective(x)[0])

    differential_evolution(
        evaluate, Bounds(lower, upper), rng=seed, vectorized=True, updating="deferred", popsize=8,
        maxiter=max(1, generations), polish=True,
    )  # fmt: skip


def _dual_annealing(objective: Counted, lower: np.ndarray, upper: np.ndarray, seed: int) -> None:
    from scipy.optimize import Bounds, dual_annealing

    def evaluate(x: Any) -> Any:
        return float(objective(x)[0])

    budget = objective.budget
    dual_annealing(evaluate, Bounds(lower, upper), rng=seed, maxiter=budget, maxfun=budget)


OPTIMISERS: dict[str, Optimise] = {
    OURS: ask_tell("hga"),
    "HGA, no polish": ask_tell("hga", polish=0),
    "SciPy DE": _scipy_polished,
    "SciPy dual annealing": _dual_annealing,
    "pymoo GA": pymoo("GA"),
    "pymoo DE": pymoo("DE"),
    "pymoo PSO": pymoo("PSO"),
    "pymoo CMA-ES": pymoo("CMA-ES"),
}


def run(size: str) -> Result:
    """Every optimiser on every function with every seed, spread over the cores."""
    full = size == "full"
    functions = list(FUNCTIONS) if full else ["sphere", "Rastrigin"]
    seeds, budget = (SEEDS, BUDGET) if full else (SEEDS[:1], 800)
    work = [(name, function, seed, budget) for function in functions for name in OPTIMISERS for seed in seeds]
    with one_process_per_core() as pool:
        lowest = list(pool.map(_lowest, work, chunksize=4))
    values: dict[tuple[str, str], list[float]] = {}
    for (name, function, _, _), value in zip(work, lowest, strict=True):
        values.setdefault((name, function), []).append(value)
    return _stated(values, functions)


class _Lowest:
    """A function that remembers its lowest value."""

    def __init__(self, function: Function) -> None:
        self.function, self.value = function, np.inf

    def __call__(self, x: np.ndarray) -> np.ndarray:
        values = self.function(x)
        self.value = min(self.value, float(values.min()))
        return values


def _lowest(work: tuple[str, str, int, int]) -> float:
    name, function_name, seed, budget = work
    warnings.simplefilter("ignore")
    function, lower, upper = FUNCTIONS[function_name]
    lowest = _Lowest(function)
    objective = Counted(lambda x: Scores.allowed(lowest(x)), -np.inf, budget)
    with contextlib.suppress(TargetReachedError):
        OPTIMISERS[name](objective, np.full(DIMENSION, lower), np.full(DIMENSION, upper), seed)
    return lowest.value


def _stated(values: dict[tuple[str, str], list[float]], functions: list[str]) -> Result:
    median = {key: max(SMALLEST, float(np.median(found))) for key, found in values.items()}
    worst = {key: max(SMALLEST, max(found)) for key, found in values.items()}
    rows = []
    for function in functions:
        best = min(median[name, function] for name in OPTIMISERS)
        cells = [f"{_shown(median[name, function])} ({_shown(worst[name, function])})" for name in OPTIMISERS]
        won = [median[name, function] == best for name in OPTIMISERS]
        rows.append([function, *(f"**{cell}**" if bold else cell for cell, bold in zip(cells, won, strict=True))])
    title = "Lowest value found in 8,000 evaluations, median (worst) of the seeds; the lowest median in bold"
    result = Result(tables=[Table(title, ["function", *OPTIMISERS], rows)])
    for function in functions:
        ahead = [n for n in OPTIMISERS if n != OURS and median[n, function] < median[OURS, function]]
        surer = [n for n in OPTIMISERS if n != OURS and worst[n, function] < worst[OURS, function]]
        verdict = f"loses to {_listed(ahead)}" if ahead else "is not beaten"
        result.notes.append(f"{function}: by the median the HGA {verdict}; by its worst seed it "
                            f"{f'loses to {_listed(surer)}' if surer else 'is not beaten'}")  # fmt: skip
    result.dots = Dots("lowest value found in 8,000 evaluations, median of the seeds (1e-12: that or less)", functions,
                       list(OPTIMISERS), [[median[n, f] for f in functions] for n in OPTIMISERS])  # fmt: skip
    return result


def _shown(value: float) -> str:
    return "0" if value <= SMALLEST else f"{value:.2g}"


def _listed(names: list[str]) -> str:
    return ", ".join(names[:-1]) + f" and {names[-1]}" if len(names) > 1 else names[0]


if __name__ == "__main__":
    main("test_functions")
