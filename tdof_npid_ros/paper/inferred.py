"""The paper's simulation as its printed numbers suggest that it was, and a check that they were not chosen to fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.case import EPISODES, Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.paper.evaluation import paper_case, published_gains
from tdof_npid_ros.paper.tables import Published

PERIOD_NS = 10_000_000
LIMIT = 15.0  # of the Sprott circuit's effort
DISTURBANCE = 5.0  # of the Sprott circuit
PROCESS3_SIGMA = 2.0
OPTIMAL = 0.1  # %: gains whose objective is no further above the nearest optimum count as optimal
LEAST_GAIN = 0.01  # where the search starts when a printed gain is nearly 0
FIRST_STEP = 0.05  # of the search: the relative change of one gain
EVALUATIONS = 500  # of the search


class Variant(NamedTuple):
    """A way to read the paper: a plant and gains."""

    label: str
    case: Case
    gains: Gains


def as_stated(row: Published) -> Variant:
    """The row as the paper's text has it."""
    return Variant("as the paper states it", paper_case(row.case), published_gains(row))


def inferred(row: Published, limit: float = LIMIT) -> Variant:
    """The row in the paper's simulation as its numbers suggest that it was.

    Sampled every 10 ms, the derivative filter's state advanced before it is used, u_d = K_d/T_f (e_d - z⁺), T_f as
    printed. With e_d - z⁺ = φ (e_d - z), that is our law with K_d x/(eˣ - 1), x = h/T_f, and N so that T_f stays.
    """
    case, gains = paper_case(row.case), published_gains(row)
    fraction = derivative_fraction(row)
    gains = gains.with_values(kd=fraction * row.kd, n=fraction * gains.n)
    case = replace(case, sample_period_ns=PERIOD_NS)
    if row.case == "sprott":
        case = with_disturbance(case, DISTURBANCE)
        gains = gains.with_values(effort_min=-limit, effort_max=limit, anti_windup="none")
    if row.case.startswith("p3") and row.controller != "pid":
        gains = gains.with_values(sigma=PROCESS3_SIGMA)
    return Variant("the paper's simulation, inferred", case, gains)


def derivative_fraction(row: Published) -> float:
    """What is left of the derivative action in the inferred simulation: x/(eˣ - 1), x = h/T_f."""
    lag = PERIOD_NS / 1e9 * row.kp * published_gains(row).n / row.kd
    return lag / math.expm1(lag)


def with_disturbance(case: Case, size: float) -> Case:
    """The case with another size of the disturbance."""
    end = case.plans["disturbance"].end_ns / 1e9
    return replace(case, episodes={**case.episodes, "disturbance": (f"0 disturbance {size:g}", f"{end:g} end")})


class Optimality(NamedTuple):
    """How far the printed gains are from the nearest optimum of a reading.

    Attributes:
        excess_percent: their objective, above the optimum's.
        factors: the optimum's gains over the printed ones, by name.
    """

    excess_percent: float
    factors: dict[str, float]


def optimality(row: Published, reading: Callable[[Published], Variant]) -> Optimality:
    """Search the optimum (10) near the printed gains, with every gain counted as the reading counts it."""
    from scipy.optimize import minimize

    names = [name for name in ("kp", "ki", "kd", "alpha", "beta") if getattr(row, name) > 0.0]
    start = np.array([max(getattr(row, name), LEAST_GAIN) for name in names])

    def objective(variant: Variant) -> float:
        return sum(float(variant.case.integrals(episode, variant.gains).iae[0]) for episode in EPISODES)

    def at(logarithms: np.ndarray) -> float:
        gains = dict(zip(names, (start * np.exp(logarithms)).tolist(), strict=True))
        return objective(reading(row._replace(**gains)))

    simplex = np.vstack([np.zeros(len(names)), FIRST_STEP * np.eye(len(names))])
    options: Any = {"maxfev": EVALUATIONS, "xatol": 1e-3, "fatol": 1e-6, "initial_simplex": simplex}
    best = minimize(at, simplex[0], method="Nelder-Mead", options=options)
    return Optimality(
        100.0 * (objective(reading(row)) / float(best.fun) - 1.0),
        dict(zip(names, np.exp(best.x).tolist(), strict=True)),
    )
