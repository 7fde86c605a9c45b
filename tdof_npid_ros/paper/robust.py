"""The price of robustness: what the best objective becomes when the loop must have margins.

`robust.csv` holds, for every row of the paper and each of `LEVELS`, the gains that our HGA finds with M_s held to that;
`python -m tdof_npid_ros.paper.retune` writes it.
"""

from __future__ import annotations

import csv
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from tdof_npid_ros.control.gains import PER_LANE, Gains, controller_type
from tdof_npid_ros.paper.evaluation import CONTROLLER_TITLES, Rows, paper_case
from tdof_npid_ros.paper.report import Cell, Table
from tdof_npid_ros.paper.tables import CASE_TITLES
from tdof_npid_ros.stability.margins import margins

FILE = Path(__file__).with_name("robust.csv")
LEVELS = (2.0, 1.7, 1.4)  # largest M_s


class Robust(NamedTuple):
    """A row of `robust.csv`."""

    gains: Gains
    objective: float


@lru_cache(maxsize=1)
def robust() -> dict[tuple[str, str, float], Robust]:
    """By case, controller and largest M_s; a level that nothing within the bounds of the search meets is missing."""
    with FILE.open(newline="", encoding="utf-8") as file:
        return {
            (row["case"], row["controller"], float(row["ms"])): Robust(_gains(row), float(row["objective"]))
            for row in csv.DictReader(file)
        }


def price_of_robustness(rows: Rows) -> Table:
    """Each row free, and at each level of M_s."""
    lines: list[tuple[Cell, ...]] = []
    for (case, controller), row in rows.items():
        free = row.tuned.number("objective")
        cells: list[Cell] = [free, margins(paper_case(case), row.tuned.gains).m_s]
        for level in LEVELS:
            found = robust().get((case, controller, level))
            cells += [None, None] if found is None else [found.objective, 100.0 * (found.objective / free - 1.0)]
        lines.append((CASE_TITLES[case], CONTROLLER_TITLES[controller], *cells))
    columns = ["process", "controller", "objective, free (s)", "its M_s"]
    for level in LEVELS:
        columns += [f"objective, M_s ≤ {level:g} (s)", f"Δ M_s ≤ {level:g} (%)"]
    note = (
        "All tuned by our HGA, the best of two runs of 4,000 evaluations each; TDOF-NPID2 has the gains of TDOF-NPID1 "
        "where these "
        "are better. Δ: against the free objective. M_s: largest magnitude of the sensitivity of the linearised loop "
        "(the circuit's is linearised at the setpoint 1)."
    )
    return Table("robustness", "The price of robustness", tuple(columns), tuple(lines), 1, note)


def _gains(row: dict[str, str]) -> Gains:
    return Gains(type=controller_type(row["controller"])).with_values(**{name: float(row[name]) for name in PER_LANE})
