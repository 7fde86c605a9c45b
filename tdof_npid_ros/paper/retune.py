"""Writes `tuned.csv` and `robust.csv` anew, by the HGA at the paper's σ. From a checkout:

python -m tdof_npid_ros.paper.retune

`tuned.csv`: every case and controller type, the best of two runs. `robust.csv`: every row of the paper with M_s held to
each of `LEVELS`, the best of two runs of half the length; where the gains of a type that is contained are better,
TDOF-NPID2 takes those. All begin cold. A quarter of an hour on one core.
"""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, PER_LANE, ControllerType
from tdof_npid_ros.paper import robust
from tdof_npid_ros.paper.evaluation import GENERATIONS
from tdof_npid_ros.paper.tables import CASES, ROWS, SIGMA
from tdof_npid_ros.paper.tuned import FILE
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.pareto import POORER
from tdof_npid_ros.tuning.study import tune_case

SEEDS = (0, 1)
ROBUST_GENERATIONS = GENERATIONS // 2
AS_GOOD = 1.001  # of the least objective: then the first run's gains are taken


class Job(NamedTuple):
    """What to tune, with which largest M_s, from which seeds; the first of the best counts."""

    case: str
    controller: ControllerType
    ms: float | None
    seeds: tuple[int, ...]
    generations: int


def tuned_row(job: Job) -> dict[str, Any] | None:
    """A row of either file; None if nothing is allowed."""
    case = load_case(job.case)
    if case.gains.sigma != SIGMA:
        raise ValueError(f"{job.case} has sigma {case.gains.sigma}: the tables are for {SIGMA}")
    constraints = Constraints(ms=job.ms)
    results = [
        tune_case(case, job.controller, seed=seed, generations=job.generations, constraints=constraints)
        for seed in job.seeds
    ]
    allowed = [result for result in results if result.feasible]
    if not allowed:
        return None
    least = min(result.objective for result in allowed)
    best = next(result for result in allowed if result.objective <= AS_GOOD * least)
    level = {} if job.ms is None else {"ms": repr(job.ms)}
    gains = {name: repr(getattr(best.gains, name)) for name in PER_LANE}
    return {"case": job.case, "controller": job.controller, **level, **gains, "objective": repr(best.objective)}


def main() -> int:
    """Write the files at the end, so that an interrupted run changes nothing."""
    from tqdm import tqdm

    free = [Job(case, controller, None, SEEDS, GENERATIONS) for case in CASES for controller in CONTROLLER_TYPES]
    held = [Job(row.case, row.controller, level, SEEDS, ROBUST_GENERATIONS) for level in robust.LEVELS for row in ROWS]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("spawn")) as pool:
        rows = list(tqdm(pool.map(tuned_row, free + held), total=len(free) + len(held), unit=" row", disable=None))
    _write(FILE, rows[: len(free)])
    _write(robust.FILE, _nested([row for row in rows[len(free) :] if row is not None]))
    return 0


def _nested(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, those of TDOF-NPID2 with the gains of TDOF-NPID1 (beta is 0) where these are better."""
    of = {(row["case"], row["controller"], row["ms"]): row for row in rows}
    nested = []
    for row in rows:
        poorer = of.get((row["case"], POORER.get(row["controller"]), row["ms"]), row)
        better = float(poorer["objective"]) < float(row["objective"])
        nested.append({**poorer, "controller": row["controller"]} if better else row)
    return nested


def _write(path: Path, rows: Sequence[dict[str, Any] | None]) -> None:
    found = [row for row in rows if row is not None]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, found[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(found)


if __name__ == "__main__":
    sys.exit(main())
