"""How long a whole tuning run takes."""

from __future__ import annotations

from benchmarks.harness import Dots, Result, Table, Verdict, main, seconds, summary
from tdof_npid_ros.case import load_case
from tdof_npid_ros.paper.evaluation import GENERATIONS
from tdof_npid_ros.paper.tables import ROWS
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import POPULATION, TuningProblem
from tdof_npid_ros.tuning.study import Study
from tdof_npid_ros.workers import available_cores

TITLE = "Time of a tuning run"
METHOD = (
    "What `tdof-npid tune` does between its progress bar's first and last sign: a `Study` of 8,000 evaluations run "
    "with an `Objective` on all cores, the loop compiled before. Each of the paper's 21 rows, by the HGA and, beside "
    "it, by the libraries' optimisers that the program offers: `cmaes` (the `cma` package) and `de` (SciPy)."
)
PEERS = ("cma", "scipy")
NOTES = (
    "What bounds the ratio: the HGA's polish asks for six candidates at a time, which costs more calls and fewer "
    "evaluations to the target than DE's whole generations; a block of 16 lanes takes nearly as long as one of 64. "
    "On the linear rows some 40 % of a run is the loop, 20 % the HGA's own arithmetic, the rest the checks of each "
    "candidate and its margins. On the circuit, of which an episode has 30,000 steps, the evaluations prevail.",
)

LIMIT = 4.0
ALGORITHMS = {"hga": "HGA", "cmaes": "cma", "de": "SciPy DE"}


def run(size: str) -> Result:
    """One run of each optimiser on each row, in turn."""
    full = size == "full"
    rows = [(row.case, row.controller) for row in (ROWS if full else ROWS[:1])]
    generations = GENERATIONS if full else 10
    times: dict[str, list[float]] = {algorithm: [] for algorithm in ALGORITHMS}
    for case_name, controller in rows:
        case = load_case(case_name)
        problems = {
            a: TuningProblem(case, controller, (), case.weight, a, 1, POPULATION, generations) for a in ALGORITHMS
        }
        for algorithm, problem in problems.items():
            objective = Objective(problem)
            objective(Study(problem).ask())  # compiles
            study = Study(problem)
            times[algorithm].append(seconds(lambda study=study, objective=objective: study.run(objective)))  # type: ignore[misc]
    result = Result()
    for algorithm, name in ALGORITHMS.items():
        result.rates.append(summary(f"{name}, all rows", "s", times[algorithm], ours=algorithm == "hga"))
    labels = [" ".join(row) for row in rows]
    ratio = sum(times["hga"]) / sum(times["de"])
    claim = f"time of the HGA's runs on {available_cores()} cores, times that of SciPy DE's with as many evaluations"
    result.verdicts.append(Verdict(claim, ratio, LIMIT, at_most=True))
    cells = [[f"{times[a][i]:.2f}" for a in ALGORITHMS] for i in range(len(rows))]
    result.tables.append(
        Table("Wall time of 8,000 evaluations, in s", ["row", *ALGORITHMS.values()],
              [[label, *cell] for label, cell in zip(labels, cells, strict=True)])
    )  # fmt: skip
    result.dots = Dots("wall time of 8,000 evaluations, s", labels, list(ALGORITHMS.values()), list(times.values()))
    return result


if __name__ == "__main__":
    main("tuning_time")
