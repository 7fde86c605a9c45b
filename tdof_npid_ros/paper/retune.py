"""Writes `tuned.csv` anew: every case and controller type, tuned by the HGA at the paper's σ. From a checkout:

python -m tdof_npid_ros.paper.retune
"""

from __future__ import annotations

import csv
import sys
from typing import Any

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, PER_LANE, ControllerType
from tdof_npid_ros.paper.tables import CASES, SIGMA
from tdof_npid_ros.paper.tuned import FILE
from tdof_npid_ros.tuning.study import tune_case

SEEDS = range(3)  # the best of their results


def tuned_row(case_name: str, controller: ControllerType) -> dict[str, Any]:
    """A row of `tuned.csv`."""
    case = load_case(case_name)
    if case.gains.sigma != SIGMA:
        raise ValueError(f"{case_name} has sigma {case.gains.sigma}: tuned.csv is for {SIGMA}")
    best = min((tune_case(case, controller, seed=seed) for seed in SEEDS), key=lambda result: result.objective)
    gains = {name: repr(getattr(best.gains, name)) for name in PER_LANE}
    return {"case": case_name, "controller": controller, **gains, "objective": repr(best.objective)}


def main() -> int:
    """Write the file at the end, so that an interrupted run changes nothing."""
    from tqdm import tqdm

    pairs = [(case, controller) for case in CASES for controller in CONTROLLER_TYPES]
    rows = [tuned_row(*pair) for pair in tqdm(pairs, unit=" row")]
    with FILE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
