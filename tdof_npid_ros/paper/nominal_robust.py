"""Gains tuned for the model beside gains tuned for 50 plants near it, for the report.

`perturbed.csv` holds what `python -m tdof_npid_ros.paper.perturbed` has printed for every linear row of the paper.
"""

from __future__ import annotations

import csv
from pathlib import Path

from tdof_npid_ros.paper.evaluation import CONTROLLER_TITLES, Rows
from tdof_npid_ros.paper.report import Cell, Table
from tdof_npid_ros.paper.tables import CASE_TITLES

FILE = Path(__file__).with_name("perturbed.csv")
NUMBERS = ("unstable_percent", "mean", "high")  # then with robust gains
NOTE = (
    "Both kinds of gains on the same 1,000 plants that neither has seen: gain and time constants ±20 %, dead time "
    "±30 %. Robust ones are tuned for the mean over 50 others. The mean objective is over the plants that are stable "
    "with both; where more than 5 % are unstable, there is no 95 %."
)


def nominal_beside_robust(rows: Rows) -> Table:
    """Those of the rows that are linear."""
    columns = ["process", "controller"]
    for gains in ("nominal", "robust"):
        columns += [f"{gains}: unstable (%)", f"{gains}: mean objective (s)", f"{gains}: 95 % (s)"]
    with FILE.open(newline="", encoding="utf-8") as file:
        lines = [_line(row) for row in csv.DictReader(file) if (row["case"], row["controller"]) in rows]
    return Table("plants-near", "Gains for the model and for plants near it", tuple(columns), tuple(lines), 1, NOTE)


def _line(row: dict[str, str]) -> tuple[Cell, ...]:
    texts = [row[f"{kind}{name}"] for kind in ("", "robust_") for name in NUMBERS]
    numbers = [float(text) if text else None for text in texts]
    return (CASE_TITLES[row["case"]], CONTROLLER_TITLES[row["controller"]], *numbers)
