"""Every row of the paper's tables in our loop: at the published gains, and at those that our HGA finds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import PER_LANE, ControllerType, Gains
from tdof_npid_ros.paper.tables import Published
from tdof_npid_ros.tuning.study import tune_case

CONTROLLER_TITLES = {"pid": "PID", "npid": "NPID", "tdof_npid1": "TDOF-NPID1", "tdof_npid2": "TDOF-NPID2"}
METRICS = {
    "overshoot_percent": "M_p (%)",
    "settling_time_s": "t_s (s)",
    "iae_setpoint": "IAE_SP (s)",
    "peak": "M_peak",
    "recovery_time_s": "t_rcy (s)",
    "iae_disturbance": "IAE_DIS (s)",
    "objective": "IAE_SP + IAE_DIS (s)",
}
GENERATIONS = 200  # of 40 candidates: a search of a row, 8,000 evaluations
SIGMA_FREE_CASES = ("p3-c1", "p3-c2")  # their published NPID rows are out of reach with σ = 1


@dataclass(frozen=True)
class Measured:
    """Gains and what they achieve in our loop; `values` by the names of `METRICS`, None for a time that is not."""

    gains: Gains
    values: dict[str, float | None]

    def number(self, metric: str) -> float:
        """A metric that always is."""
        value = self.values[metric]
        assert value is not None, metric
        return value


@dataclass(frozen=True)
class Row:
    """One row of the paper.

    Attributes:
        published: as printed.
        at_published: our loop with the printed gains.
        tuned: our loop with the best gains of our HGA.
        objectives: what the HGA reached with each seed, seed 0 first.
        sigma_free: the best with σ tuned too, where that is done.
    """

    published: Published
    at_published: Measured
    tuned: Measured
    objectives: tuple[float, ...]
    sigma_free: Measured | None


Rows = dict[tuple[str, str], Row]


@cache
def paper_case(name: str) -> Case:
    """A case of the paper, loaded once."""
    return load_case(name)


def published_gains(published: Published) -> Gains:
    """The printed gains with the case's limits and anti-windup."""
    printed = published.gains
    values = {name: getattr(printed, name) for name in PER_LANE}
    return paper_case(published.case).gains.with_values(type=published.controller, **values)


def measure(case: Case, gains: Gains) -> Measured:
    """The metrics of the case's setpoint and disturbance episodes."""
    setpoint, disturbance = case.setpoint_response(gains), case.disturbance_response(gains)
    return Measured(
        gains,
        {
            "overshoot_percent": setpoint.overshoot_percent,
            "settling_time_s": setpoint.settling_time_s,
            "iae_setpoint": setpoint.iae,
            "peak": disturbance.peak,
            "recovery_time_s": disturbance.recovery_time_s,
            "iae_disturbance": disturbance.iae,
            "objective": setpoint.iae + case.weight * disturbance.iae,
        },
    )


class RowSearch(NamedTuple):
    """One run of the HGA for a row: its case and type, the seed, and whether sigma is tuned too."""

    case: str
    controller: ControllerType
    seed: int
    sigma_free: bool = False


def searches_of(published: Published, seeds: int) -> list[RowSearch]:
    """What is to be run for a row with seeds 0 … seeds - 1."""
    free = published.case in SIGMA_FREE_CASES and published.controller != "pid"
    return [
        RowSearch(published.case, published.controller, seed, sigma_free)
        for sigma_free in ([False, True] if free else [False])
        for seed in range(seeds)
    ]


def optimum(search: RowSearch, generations: int, threads: int | None = None) -> dict[str, float]:
    """The gains that one run finds, and their `objective`."""
    extra = ("sigma",) if search.sigma_free else ()
    case = paper_case(search.case)
    found = tune_case(case, search.controller, seed=search.seed, extra=extra, generations=generations, threads=threads)
    return {**{name: getattr(found.gains, name) for name in PER_LANE}, "objective": found.objective}


def evaluated_row(published: Published, optima: dict[RowSearch, dict[str, float]]) -> Row:
    """One row: measured at the printed gains, and at the best that its searches found."""
    case = paper_case(published.case)
    own = {one: found for one, found in optima.items() if one[:2] == (published.case, published.controller)}
    tuned, free = ([found for one, found in own.items() if one.sigma_free == kind] for kind in (False, True))
    return Row(
        published,
        measure(case, published_gains(published)),
        _best(published, tuned),
        tuple(found["objective"] for found in tuned),
        _best(published, free) if free else None,
    )


def _best(published: Published, optima: list[dict[str, float]]) -> Measured:
    best = min(optima, key=lambda found: found["objective"])
    case = paper_case(published.case)
    values = {name: best[name] for name in PER_LANE}
    return measure(case, case.gains.with_values(type=published.controller, **values))


def deviation_percent(ours: float | None, published: float | None) -> float | None:
    """How far ours is from the published value, in per cent of it; None where there is no such number."""
    return None if ours is None or not published else 100.0 * (ours / published - 1.0)
