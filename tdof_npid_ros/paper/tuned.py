"""Gains that our hybrid genetic algorithm found for the paper's cases."""

from __future__ import annotations

import csv
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from tdof_npid_ros.control.gains import ControllerType, Gains

FILE = Path(__file__).with_name("tuned.csv")


class Tuned(NamedTuple):
    """One row of `tuned.csv`."""

    gains: Gains
    objective: float


@lru_cache(maxsize=1)
def _rows() -> dict[tuple[str, str], Tuned]:
    with FILE.open(newline="", encoding="utf-8") as file:
        return {(row["case"], row["controller"]): _tuned(row) for row in csv.DictReader(file)}


def _tuned(row: dict[str, str]) -> Tuned:
    numbers = {name: float(row[name]) for name in ("kp", "ki", "kd", "alpha", "beta", "sigma")}
    return Tuned(Gains(type=row["controller"], **numbers), float(row["objective"]))  # type: ignore[arg-type]


def tuned(case: str, controller: ControllerType) -> Tuned | None:
    """The tuned gains of a case, if there are any."""
    return _rows().get((case, controller))
