"""The price of robustness: what the objective becomes when the loop must keep away from instability."""

from __future__ import annotations

from dataclasses import replace

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study, TuningResult

FRACTION, MOST = 4, 50
"""Of a search's generations, one in so many is spent on the price, and so many at the most."""

LEAST = 500
"""Evaluations: what fewer of them find says nothing about the price."""


def price_of_ms(problem: TuningProblem, gains: Gains, ms: float) -> TuningResult | None:
    """What a short search finds, from these gains, with M_s held to `ms`: at most so much is the price.

    None if it finds nothing allowed, or would be too short.

    Args:
        problem: the one that the gains were found for, with a linear model.
        gains: of the problem's controller.
    """
    generations = min(problem.generations // FRACTION, MOST)
    if generations * problem.population < LEAST:
        return None
    held = replace(
        problem,
        case=replace(problem.case, gains=gains),
        generations=generations,
        constraints=replace(problem.constraints, ms=ms),
        warm=True,
        until_converged=True,
    )
    study = Study(held)
    study.run(Objective(held))
    return study.result if study.feasible else None
