"""Whether the best known values, which the HGA is held to, are as good as ten times the evaluations find."""

from __future__ import annotations

from benchmarks.harness import Dots, Result, Table, Verdict, main, one_process_per_core
from benchmarks.tuning import Row, free_at_published, published_rows
from tdof_npid_ros.case import load_case
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

TITLE = "The best known values beside 80,000 evaluations of differential evolution"
METHOD = (
    "The HGA is held to the values in `tdof_npid_ros/paper/tuned.csv`, which it found itself: the best of three runs of "
    "8,000 evaluations on each row. Here SciPy's `differential_evolution` (`tdof-npid tune --algorithm de`, 80 "
    "individuals, 1,000 generations) has ten times as many on each of the 18 linear rows, and beside it one HGA run of "
    "8,000 with another seed. On the four NPID rows of Process 3 both are run with sigma free too. An excess is how far "
    "a value lies above the other's, in per cent; below 0 it is the better one. Two runs side by side, one a core."
)
PEERS = ("scipy",)
NOTES: tuple[str, ...] = ()

SEED = 7
POPULATION, GENERATIONS = 80, 1000  # of differential evolution
WITHIN_PERCENT = 0.1


def run(size: str) -> Result:
    """Both optimisers on every linear row, sigma as in the paper and, where it is asked for, free."""
    full = size == "full"
    rows = published_rows() if full else published_rows()[:1]
    problems = [(row, ()) for row in rows] + [(row, free_at_published(row)) for row in rows if free_at_published(row)]
    tenth = 1 if full else 100
    work = [(row, extra, "de", POPULATION, GENERATIONS // tenth) for row, extra in problems]
    work += [(row, extra, "hga", 40, max(2, 200 // tenth)) for row, extra in problems]
    with one_process_per_core() as pool:
        values = list(pool.map(_value, work))
    de, hga = values[: len(problems)], values[len(problems) :]
    known = [None if extra else tuned(*row) for row, extra in problems]  # type: ignore[arg-type]
    labels = [" ".join(row) + (", sigma free" if extra else "") for row, extra in problems]
    excess = [100.0 * (one.objective / other - 1.0) for one, other in zip(known, de, strict=True) if one is not None]
    hga_excess = [100.0 * (one / other - 1.0) for one, other in zip(hga, de, strict=True)]
    result = Result()
    result.verdicts += [
        Verdict("largest excess of a best known value over DE's of 80,000 evaluations, in per cent", max(excess),
                WITHIN_PERCENT, at_most=True),
        Verdict("largest excess of an HGA run of 8,000 evaluations over it, in per cent", max(hga_excess),
                WITHIN_PERCENT, at_most=True),
    ]  # fmt: skip
    table = [
        [label, "" if one is None else f"{one.objective:.7g}", f"{h:.7g}", f"{d:.7g}", f"{e:+.4f}"]
        for label, one, h, d, e in zip(labels, known, hga, de, hga_excess, strict=True)
    ]
    header = ["row", "best known", "HGA, 8,000", "SciPy DE, 80,000", "the HGA's excess, %"]
    result.tables.append(Table("Objective (the integral of the absolute error), the lower the better", header, table))
    result.dots = Dots("objective", labels, ["HGA, 8,000", "SciPy DE, 80,000"], [hga, de])
    return result


def _value(work: tuple[Row, tuple[str, ...], str, int, int]) -> float:
    (case_name, controller), extra, algorithm, population, generations = work
    case = load_case(case_name)
    problem = TuningProblem(case, controller, extra, case.weight, algorithm, SEED, population, generations)  # type: ignore[arg-type]
    study = Study(problem)
    study.run(Objective(problem, threads=1))
    return study.result.objective


if __name__ == "__main__":
    main("best_known")
