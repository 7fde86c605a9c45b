"""How surely the HGA finds the optimum on plants that people ask about in forums."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.harness import Result, Table, Verdict, main, one_process_per_core, summary
from benchmarks.tuning import WITHIN
from tdof_npid_ros.case import Case, make_case
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, ControllerType
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

TITLE = "The HGA on plants from forums"
METHOD = (
    "Plants of the kinds that people ask about (heaters with their limits, carts, tanks, unstable ones, zeros on the "
    "wrong side), each with all four types of controller, from twenty seeds, 4,000 evaluations each. The best known "
    "value of a row is the least that any of its runs finds, one of SciPy's differential evolution with 12,000 "
    "evaluations among them, and of the rows whose type is contained in this one."
)
PEERS = ("scipy",)
NOTES: tuple[str, ...] = ()

SEEDS = range(20)
POPULATION, GENERATIONS = 40, 100
DE_POPULATION, DE_GENERATIONS = 80, 150
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
    names, seeds, generations = (list(LOOPS), SEEDS, GENERATIONS) if full else (list(LOOPS)[2:3], SEEDS[:1], 3)
    rows: list[Row] = [(name, controller) for name in names for controller in CONTROLLER_TYPES]
    work = [(row, "hga", seed, POPULATION, generations) for row in rows for seed in seeds]
    work += [(row, "de", 0, DE_POPULATION, DE_GENERATIONS if full else 2) for row in rows]
    with one_process_per_core() as pool:
        found = list(pool.map(_least_so_far, work, chunksize=4))
    best: dict[Row, float] = {}
    for (row, *_), values in zip(work, found, strict=True):
        best[row] = min(float(values[-1]), best.get(row, np.inf))
    known = {(name, its): min(best[name, one] for one in (its, *CONTAINED.get(its, ()))) for name, its in rows}
    cells: dict[Row, list[float]] = {row: [] for row in rows}
    for (row, algorithm, *_), values in zip(work, found, strict=True):
        if algorithm == "hga":
            reached = np.flatnonzero(values <= known[row] * WITHIN)
            cells[row].append(float(reached[0]) + 1.0 if reached.size else np.inf)
    return _result(names, rows, cells, POPULATION * generations)


def _least_so_far(work: tuple[Row, str, int, int, int]) -> np.ndarray:
    """The least value of the first candidate, of the first two, …"""
    (name, controller), algorithm, seed, population, generations = work
    case = case_of(name)
    problem = TuningProblem(
        case, controller, (), case.weight, algorithm, seed, population=population, generations=generations
    )
    study, objective = Study(problem), Objective(problem, threads=1)
    values: list[np.ndarray] = []
    while not study.done:
        scores = objective(study.ask())
        values.append(scores.values)
        study.tell(scores)
    return np.minimum.accumulate(np.concatenate(values))


def _result(names: list[str], rows: list[Row], cells: dict[Row, list[float]], budget: int) -> Result:
    shares = {row: float(np.mean(np.isfinite(cell))) for row, cell in cells.items()}
    least = min(rows, key=lambda row: shares[row])
    result = Result()
    claim = (
        f"share of the HGA's runs within 0.1 % of the best known, {len(names)} plants, {len(CONTROLLER_TYPES)} types"
    )
    result.verdicts += [
        Verdict(claim, float(np.mean(list(shares.values()))), 0.99),
        Verdict(f"the same on its weakest ({', '.join(least)})", shares[least], None),
    ]
    for controller in CONTROLLER_TYPES:
        counts = [min(one, budget) for row in rows if row[1] == controller for one in cells[row]]
        result.rates.append(summary(f"{controller}, all plants", "evaluations", counts, ours=True))
    table = [[name, *(_cell(cells[name, controller], budget) for controller in CONTROLLER_TYPES)] for name in names]
    title = (
        "Evaluations until within 0.1 % of the best known, median (worst) of the seeds, and the share that gets there"
    )
    result.tables.append(Table(title, ["plant", *CONTROLLER_TYPES], table))
    return result


def _cell(evaluations: list[float], budget: int) -> str:
    median, worst = (
        f"{one:.0f}" if np.isfinite(one) else f">{budget}" for one in (np.median(evaluations), max(evaluations))
    )
    reached = float(np.mean(np.isfinite(evaluations)))
    return f"{median} ({worst})" + ("" if reached == 1.0 else f", {reached:.0%}")


if __name__ == "__main__":
    main("forum")
