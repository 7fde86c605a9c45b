"""Gains tuned for the model beside gains tuned for 50 plants near it, on plants that neither has seen. From a checkout:

python -m tdof_npid_ros.paper.perturbed

It prints the table of docs/robustness.md: every linear row of the paper, some ten minutes on one core.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import NamedTuple

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.gains import PER_LANE, ControllerType
from tdof_npid_ros.metrics import in_units
from tdof_npid_ros.paper.evaluation import CONTROLLER_TITLES
from tdof_npid_ros.paper.tables import CASE_TITLES, ROWS
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.robustness.result import RobustResult, sweep_plants
from tdof_npid_ros.robustness.spread import spreads_of
from tdof_npid_ros.robustness.sweep import is_linear
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.perturbed import Perturbed
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study
from tdof_npid_ros.workers import Workers, workers

SPREADS = {"gain": "20 %", "time_constant": "20 %", "zero_time_constant": "20 %", "dead_time": "30 %"}
PLANTS = 50  # tuned for
UNSEEN = 1_000
GENERATIONS = 30  # from the nominal gains on
SEEDS = (0, 1)  # of the search; the better on the plants tuned for counts


class Compared(NamedTuple):
    """A row of the paper: what both kinds of gains achieve on the same unseen plants."""

    case: str
    controller: ControllerType
    nominal: RobustResult
    robust: RobustResult

    @property
    def is_better(self) -> bool:
        """Whether the robust gains are: fewer unstable plants, or as many and a lower mean."""
        counts = int(self.nominal.unstable.sum()), int(self.robust.unstable.sum())
        return counts[1] < counts[0] or (counts[1] == counts[0] and self.means[1] < self.means[0])

    @property
    def means(self) -> tuple[float, float]:
        """The mean objective over the plants that are stable with both, nominal gains first."""
        both = ~(self.nominal.unstable | self.robust.unstable)
        return tuple(float(one.metrics["objective"][both].mean()) for one in (self.nominal, self.robust))  # type: ignore[return-value]


def compared(here: Workers, case_name: str, controller: ControllerType) -> Compared | None:
    """A row; None if nothing within the bounds of the search is stable with every plant."""
    case = load_case(case_name)
    its = [f"{name} {amount}" for name, amount in SPREADS.items() if case.plant_values.get(name)]
    spreads = spreads_of(case, its)
    row = tuned(case_name, controller)
    assert row is not None
    nominal = case.gains.with_values(type=controller, **{name: getattr(row.gains, name) for name in PER_LANE})
    studies = []
    for seed in SEEDS:
        problem = TuningProblem(
            replace(case, gains=nominal), controller, generations=GENERATIONS, warm=True, seed=seed,
            perturbed=Perturbed(spreads, PLANTS),
        )  # fmt: skip
        studies.append(Study(problem))
        studies[-1].run(Objective(problem))
    allowed = [study for study in studies if study.feasible]
    if not allowed:
        return None
    both = (nominal, min(allowed, key=lambda study: study.best_value).result.gains)
    return Compared(
        case_name, controller, *(sweep_plants(here, case, gains, spreads, count=UNSEEN, seed=1) for gains in both)
    )


def line(row: Compared) -> str:
    """A row of the table, in Markdown."""
    cells = [CASE_TITLES[row.case], CONTROLLER_TITLES[row.controller]]
    for one, mean in zip((row.nominal, row.robust), row.means, strict=True):
        high = one.quantile("objective", 0.95)
        cells += [f"{100 * one.unstable_fraction:.2f}", in_units(mean), in_units(high) if math.isfinite(high) else "-"]
    return " | ".join(["", *cells, "yes" if row.is_better else "no", ""]).strip()


def main() -> int:
    """Print the table."""
    print("| process | controller | unstable (%) | mean | 95 % | robust: unstable (%) | mean | 95 % | better |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    with workers() as here:
        for published in ROWS:
            if is_linear(load_case(published.case)):
                row = compared(here, published.case, published.controller)
                nothing = f"| {CASE_TITLES[published.case]} | {CONTROLLER_TITLES[published.controller]} | none found |"
                print(nothing if row is None else line(row), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
