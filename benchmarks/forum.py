"""How surely the HGA finds the optimum on plants that people ask about in forums."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.harness import Result, Table, Verdict, main, one_process_per_core, summary
from benchmarks.tuning import WITHIN
from tdof_npid_ros.case import Case, make_case
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, ControllerType
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import GENERATIONS, POPULATION, TuningProblem
from tdof_npid_ros.tuning.study import Study

TITLE = "The HGA on plants from forums"
METHOD = (
    "Plants of the kinds that people ask about (heaters with their limits, carts, tanks, unstable ones, zeros on the "
    "wrong side), each with all four types of controller, from twenty seeds with the evaluations that `tdof-npid tune` "
    "has by default (20,000). The best known value of a row is the least that SciPy's differential evolution finds "
    "with 200,000 evaluations (80 individuals), that the first seed finds with all of its own, and that is known of "
    "the rows whose type is contained in this one. A later seed ends as soon as it is within 0.1 % of it; should it "
    "find better than known, then the others are held to that."
)
PEERS = ("scipy",)
NOTES: tuple[str, ...] = ()

SEEDS = range(20)
DE_POPULATION, DE_GENERATIONS = 80, 2500
CONTAINED: dict[str, tuple[ControllerType, ...]] = {"tdof_npid1": ("npid",), "tdof_npid2": ("npid", "tdof_npid1")}
Row = tuple[str, ControllerType]
LEAST = 1e-4  # lower bounds, as fractions of the upper ones


class Loop(NamedTuple):
    """A plant and what is asked of it.

    Attributes:
        step, load: of the setpoint and of the disturbance.
        period, end: s.
        most: upper bounds of K_p, K_i and K_d.
    """

    numerator: list[float]
    denominator: list[float]
    dead_time: float
    step: float
    load: float
    period: float
    end: float
    most: tuple[float, float, float]
    limits: tuple[float, float] | None = None


LOOPS = {
    "dead time twenty lags": Loop([1.0], [0.1, 1.0], 2.0, 1.0, 1.0, 0.02, 60.0, (50.0, 50.0, 50.0)),
    "cart without friction": Loop([1.0], [1.0, 0.0, 0.0], 0.0, 1.0, 1.0, 0.01, 20.0, (50.0, 50.0, 50.0)),
    "heater, 0 to 255": Loop([0.5], [180.0, 1.0], 12.0, 60.0, 10.0, 1.0, 3600.0, (100.0, 2.0, 500.0), (0.0, 255.0)),
    "tank level, dead time": Loop([1.0], [1.0, 0.0], 0.5, 1.0, 1.0, 0.02, 40.0, (50.0, 50.0, 50.0)),
    "kiln": Loop([2.0], [3600.0, 1.0], 120.0, 800.0, 20.0, 10.0, 36000.0, (200.0, 1.0, 5000.0)),
    "unstable, dead time": Loop([1.0], [1.0, -1.0], 0.2, 1.0, 1.0, 0.01, 30.0, (50.0, 50.0, 50.0)),
    "motor speed": Loop([2.0], [5e-4, 0.06, 1.0], 0.002, 100.0, 10.0, 1e-3, 2.0, (50.0, 500.0, 5.0)),
    "servo position": Loop([1.0], [0.05, 1.0, 0.0], 0.01, 1.0, 1.0, 2e-3, 5.0, (200.0, 500.0, 20.0)),
    "weakly damped": Loop([1.0], [1.0, 0.2, 1.0], 0.1, 1.0, 1.0, 0.02, 60.0, (50.0, 50.0, 50.0)),
    "boiler drum, wrong way first": Loop([-0.5, 1.0], [2.0, 1.0, 0.0], 0.0, 1.0, 0.2, 0.02, 60.0, (20.0, 5.0, 20.0)),
    "two tanks, dead time": Loop([1.5], [600.0, 50.0, 1.0], 5.0, 10.0, 2.0, 0.5, 1000.0, (50.0, 5.0, 500.0)),
    "four lags": Loop([1.0], [1.0, 4.0, 6.0, 4.0, 1.0], 0.0, 1.0, 1.0, 0.02, 60.0, (50.0, 50.0, 50.0)),
    "flow, fast": Loop([0.8], [0.2, 1.0], 0.1, 5.0, 1.0, 0.01, 10.0, (50.0, 100.0, 10.0)),
}


def case_of(name: str) -> Case:
    """The loop as a case."""
    loop = LOOPS[name]
    limits = {} if loop.limits is None else {"effort_min": loop.limits[0], "effort_max": loop.limits[1]}
    plant = {
        "model": "transfer_function", "numerator": loop.numerator, "denominator": loop.denominator,
        "dead_time": loop.dead_time, **limits,
    }  # fmt: skip
    plans = {
        "setpoint": [f"0 setpoint {loop.step}", f"{loop.end} end"],
        "disturbance": [f"0 disturbance {loop.load}", f"{loop.end} end"],
    }
    tuner = {f"bounds.{gain}": [LEAST * most, most] for gain, most in zip(("kp", "ki", "kd"), loop.most, strict=True)}
    tuner |= {"bounds.alpha": [0.0, 1.0], "bounds.beta": [0.0, 1.0]}
    return make_case(plant, {"type": "pid", **limits}, plans, sample_period=loop.period, tuner=tuner, name=name)


def run(size: str) -> Result:
    """Every loop, type and seed, spread over the cores."""
    full = size == "full"
    names, seeds, generations = (list(LOOPS), SEEDS, GENERATIONS) if full else (list(LOOPS)[2:3], SEEDS[:2], 3)
    rows: list[Row] = [(name, controller) for name in names for controller in CONTROLLER_TYPES]
    first = [Work(row, "hga", seeds[0], POPULATION, generations) for row in rows]
    peer = [Work(row, "de", 0, DE_POPULATION, DE_GENERATIONS if full else 2) for row in rows]
    with one_process_per_core() as pool:
        whole = dict(zip(first + peer, pool.map(_least_so_far, first + peer), strict=True))
        known = _known(whole)
        later = [Work(row, "hga", seed, POPULATION, generations, known[row]) for row in rows for seed in seeds[1:]]
        found = whole | dict(zip(later, pool.map(_least_so_far, later), strict=True))
    known = _known(found)
    cells: dict[Row, list[float]] = {row: [] for row in rows}
    for work in first + later:
        reached = np.flatnonzero(found[work] <= known[work.row] * WITHIN)
        cells[work.row].append(float(reached[0]) + 1.0 if reached.size else np.inf)
    by_peer = {work.row: float(found[work][-1]) for work in peer}
    return _result(names, rows, cells, known, by_peer, POPULATION * generations)


class Work(NamedTuple):
    """One search; `enough`: a value from within 0.1 % of which it may end."""

    row: Row
    algorithm: str
    seed: int
    population: int
    generations: int
    enough: float = -np.inf


def _known(found: dict[Work, np.ndarray]) -> dict[Row, float]:
    """The least value of each row that any search has found, in it or in one whose type is contained in its."""
    best: dict[Row, float] = {}
    for work, values in found.items():
        best[work.row] = min(float(values[-1]), best.get(work.row, np.inf))
    return {(name, its): min(best[name, one] for one in (its, *CONTAINED.get(its, ()))) for name, its in best}


def _least_so_far(work: Work) -> np.ndarray:
    """The least value of the first candidate, of the first two, …"""
    name, controller = work.row
    case = case_of(name)
    problem = TuningProblem(
        case, controller, (), case.weight, work.algorithm, work.seed, work.population, work.generations
    )
    study, objective = Study(problem), Objective(problem, threads=1)
    values: list[np.ndarray] = []
    while not study.done and not (study.feasible and study.best_value <= work.enough * WITHIN):
        scores = objective(study.ask())
        values.append(scores.values)
        study.tell(scores)
    return np.minimum.accumulate(np.concatenate(values))


def _result(
    names: list[str],
    rows: list[Row],
    cells: dict[Row, list[float]],
    known: dict[Row, float],
    by_peer: dict[Row, float],
    budget: int,
) -> Result:
    shares = {row: float(np.mean(np.isfinite(cell))) for row, cell in cells.items()}
    least = min(rows, key=lambda row: shares[row])
    near = [by_peer[row] <= known[row] * WITHIN for row in rows]
    result = Result()
    claim = (
        f"share of the HGA's runs within 0.1 % of the best known, {len(names)} plants, {len(CONTROLLER_TYPES)} types"
    )
    result.verdicts += [
        Verdict(claim, float(np.mean(list(shares.values()))), 0.99),
        Verdict(f"the same on its weakest ({', '.join(least)})", shares[least], None),
        Verdict("the same of one run of DE with ten times the evaluations", float(np.mean(near)), None),
    ]
    for controller in CONTROLLER_TYPES:
        counts = [min(one, budget) for row in rows if row[1] == controller for one in cells[row]]
        result.rates.append(summary(f"{controller}, all plants", "evaluations", counts, ours=True))
    table = [[name, *(_cell(cells[name, controller], budget) for controller in CONTROLLER_TYPES)] for name in names]
    title = (
        "Evaluations until within 0.1 % of the best known, median (worst) of the seeds, and the share that gets there"
    )
    header = ["plant", *CONTROLLER_TYPES]
    result.tables.append(Table(title, header, table))
    table = [[name, *(f"{known[name, controller]:.6g}" for controller in CONTROLLER_TYPES)] for name in names]
    result.tables.append(Table("Best known objective", header, table))
    return result


def _cell(evaluations: list[float], budget: int) -> str:
    median, worst = (
        f"{one:.0f}" if np.isfinite(one) else f">{budget}" for one in (np.median(evaluations), max(evaluations))
    )
    reached = float(np.mean(np.isfinite(evaluations)))
    return f"{median} ({worst})" + ("" if reached == 1.0 else f", {reached:.0%}")


if __name__ == "__main__":
    main("forum")
