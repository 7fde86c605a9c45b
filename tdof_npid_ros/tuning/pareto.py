"""The trade-off between tracking and rejection (the paper's Figure 6): NSGA-II on (IAE_SP, IAE_DIS).

The loop is a case's, or the paper's: K e^(-Ls) / (1 + Ts) with K = 1, T = 1 s and a chosen ratio L/T; σ = 1, N = 10.
NSGA-II is pymoo's; a generation is one call of the compiled loop.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, PER_LANE, ControllerType, Gains
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.objective import Objective, objective_values, scores
from tdof_npid_ros.tuning.problem import TuningProblem, candidate_of
from tdof_npid_ros.tuning.space import Space
from tdof_npid_ros.tuning.study import Study

RATIOS = (0.1, 0.5, 1.0)  # L/T of Figure 6
POPULATION = 96  # whole blocks of the compiled loop
GENERATIONS = 200
LARGEST_POPULATION = 2000  # NSGA-II compares each point with each other one

POORER: dict[ControllerType, ControllerType] = {"tdof_npid1": "npid", "tdof_npid2": "tdof_npid1"}
"""The type that a type contains: with alpha, or beta, of 0."""

LEAST_FOR_ENDS = 25
"""Generations of the HGA for each end of a front, at least."""

PYMOO_NSGA2 = "pymoo.algorithms.moo.nsga2"

TIME_CONSTANT = 1.0  # s, T
SAMPLES_PER_DEAD_TIME = 100
SETTLED_AFTER = 8.0  # s beyond 14 dead times: the episode's length
DEAD_TIMES = 14.0

Loop = float | Case
"""What a front belongs to: a ratio L/T of Figure 6, or a case."""

Costs = Callable[[Array], tuple[Array, Array]]
"""Of candidates [n, d] both measures [n, 2], and the violations [n]."""


@dataclass(frozen=True)
class Front:
    """A Pareto front: no point is beaten by another one in both measures.

    Attributes:
        case: the loop that it belongs to.
        ratio: L/T; None: of a case that is not the paper's.
        gains: of each point, by increasing IAE_SP.
        iae: IAE_SP and IAE_DIS, (points, 2), in s.
    """

    case: Case
    controller: ControllerType
    ratio: float | None
    gains: tuple[Gains, ...]
    iae: Array

    @property
    def title(self) -> str:
        """Of which loop it is."""
        return self.case.name if self.ratio is None else f"L/T = {self.ratio:g}"

    def best(self, weight: float = 1.0) -> int:
        """Index of the point with the lowest objective (10)."""
        return int(np.argmin(self.iae @ np.array([1.0, weight])))

    def rows(self) -> list[dict[str, Any]]:
        """One mapping per point: where it lies and its gains."""
        return [
            {
                "case": self.case.name,
                "ratio": self.ratio,
                "controller": self.controller,
                "index": i,
                "iae_setpoint": float(iae[0]),
                "iae_disturbance": float(iae[1]),
                **{name: getattr(gains, name) for name in PER_LANE},
            }
            for i, (gains, iae) in enumerate(zip(self.gains, self.iae, strict=True))
        ]

    def parameters(self, index: int) -> dict[str, dict[str, Any]]:
        """The parameters by node of the loop with the gains of one point, for a ROS parameter file.

        Raises:
            TuningError: there is no such point.
        """
        if not 0 <= index < len(self.gains):
            raise TuningError(f"no point {index} on the front of {self.controller}: it has 0 to {len(self.gains) - 1}")
        gains, period = self.gains[index], self.case.sample_period
        if self.ratio is None:
            return self.case.parameters(gains)
        return {
            "plant": {"model": self.case.model, **self.case.plant_values, "sample_period": period, "mode": "lockstep"},
            "controller": {
                "type": gains.type,
                **{name: getattr(gains, name) for name in PER_LANE},
                "n": gains.n,
                "sample_period": period,
            },
            "scenario": {
                "episodes": list(self.case.episodes),
                **{f"plan.{name}": list(lines) for name, lines in self.case.episodes.items()},
            },
            "tuner": {f"bounds.{name}": list(bounds) for name, bounds in self.case.bounds.items()},
        }


def foptd_case(ratio: float) -> Case:
    """The loop of Figure 6 for a ratio L/T, with bounds of the search that grow with the loop's ultimate gain.

    Raises:
        TuningError: the ratio is not a number above 0, or so small that the loop would take too many samples.
    """
    if not 0.01 <= ratio <= 100.0:
        raise TuningError(f"ratio L/T is {ratio:g}: it must be from 0.01 to 100")
    dead_time = ratio * TIME_CONSTANT
    end = math.ceil(SETTLED_AFTER + DEAD_TIMES * dead_time)
    kp = 1.0 + 2.0 / ratio  # a proportional loop becomes unstable near π/2 · T/L
    return Case(
        name=f"foptd-{ratio:g}",
        sample_period_ns=round(dead_time / SAMPLES_PER_DEAD_TIME * 1e9),
        model="first_order",
        plant_values={"gain": 1.0, "time_constant": TIME_CONSTANT, "dead_time": dead_time},
        effort_limits=(-math.inf, math.inf),
        gains=Gains(n=10.0, sigma=1.0),
        episodes={"setpoint": ("0 setpoint 1", f"{end} end"), "disturbance": ("0 disturbance 1", f"{end} end")},
        bounds={
            "kp": (0.01, kp),
            "ki": (0.0, kp / dead_time),
            "kd": (0.0, kp * dead_time),
            "alpha": (0.0, 1.0),
            "beta": (0.0, 1.0),
        },
    )


def pareto_front(
    loop: Loop,
    controller: ControllerType,
    *,
    seed: int = 0,
    population: int = POPULATION,
    generations: int = GENERATIONS,
    constraints: Constraints | None = None,
    poorer: Front | None = None,
    threads: int | None = None,
) -> Front:
    """The front that NSGA-II finds; the same one for the same arguments.

    It begins with the ends of the front, which the HGA finds, with the points of a poorer controller's front, and with
    random points; and no point of the front is worse than those.

    Args:
        loop: a ratio L/T, or a case, of whose tuner's parameters bounds, freed gains and margins hold here, too.
        seed: not negative.
        constraints: margins that each point must have, None: the case's; see `Judge` for what else it must be.
        poorer: the front of the type in `POORER`, which this type contains; found here if it is not given.
        threads: by default one per core; the front does not depend on it.

    Raises:
        TuningError: an argument out of its range, no point that is allowed, or pymoo is not installed.
    """
    if seed < 0 or population < 4 or generations < 1:
        raise TuningError(f"seed {seed}, population {population}, generations {generations}: at least 0, 4 and 1")
    check_installed()
    case = case_of(loop)
    constraints = constraints or Constraints.of_search(case.search)
    if poorer is None and controller in POORER:
        poorer = pareto_front(
            loop,
            POORER[controller],
            seed=seed,
            population=population,
            generations=generations,
            constraints=constraints,
            threads=threads,
        )
    asked = TuningProblem.of_case(case, controller, seed=seed, generations=max(LEAST_FOR_ENDS, generations))
    problem = replace(asked, constraints=constraints)
    objective, space = Objective(problem, threads), problem.space

    def costs(candidates: Array) -> tuple[Array, Array]:
        setpoint, disturbance = objective.integrals(candidates)
        pairs = ((setpoint, disturbance), (disturbance, setpoint))
        measures = np.column_stack([objective_values(*pair, weight=0.0) for pair in pairs])
        return measures, scores(problem, candidates, setpoint, disturbance).violation

    known = [candidate_of(problem, gains)[0] for gains in (*_ends(problem, costs), *(poorer.gains if poorer else ()))]
    starts = np.reshape(known, (-1, len(problem.names)))
    found = space.at(_nsga2(costs, space, space.of(starts), seed, population, generations))
    candidates = np.unique(np.concatenate([starts, found]), axis=0)
    iae, violation = costs(candidates) if len(candidates) else (np.empty((0, 2)), np.empty(0))
    candidates, iae = candidates[violation == 0.0], iae[violation == 0.0]
    if not len(candidates):
        raise TuningError(f"{case.name}: no {controller} was found that is allowed: ask for less, or search longer")
    best = ~np.any(np.all(iae[None] <= iae[:, None], axis=2) & np.any(iae[None] < iae[:, None], axis=2), axis=1)
    _, first = np.unique(iae[best], axis=0, return_index=True)
    candidates, iae = candidates[best][first], iae[best][first]
    return Front(case, controller, _ratio(loop), tuple(problem.gains(one) for one in candidates), iae)


def case_of(loop: Loop) -> Case:
    """The loop as a case."""
    return loop if isinstance(loop, Case) else foptd_case(loop)


def _ratio(loop: Loop) -> float | None:
    return None if isinstance(loop, Case) else loop


class FrontSearch(NamedTuple):
    """How fronts are found: see `pareto_front`."""

    seed: int = 0
    generations: int = GENERATIONS
    constraints: Constraints | None = None
    threads: int | None = None


class FrontChain(NamedTuple):
    """Fronts of one loop that are found one after the other, each from the one before."""

    loop: Loop
    controllers: tuple[ControllerType, ...]


def chains_of(loops: Sequence[Loop], controllers: Sequence[ControllerType]) -> list[FrontChain]:
    """The fronts of each loop and controller type, in chains that are independent of each other; the longest first."""
    nested = {*POORER, *POORER.values()}
    kinds = [
        tuple(one for one in CONTROLLER_TYPES if one in controllers and (one in nested) == wanted)
        for wanted in (True, False)
    ]
    return [FrontChain(loop, kind) for kind in kinds if kind for loop in loops]


def chain_points(search: FrontSearch, chain: FrontChain) -> list[dict[str, Array]]:
    """A chunk of work: of each front of a chain, `gains` (points, len(PER_LANE)) and `iae` (points, 2)."""
    fronts: list[Front] = []
    for controller in chain.controllers:
        poorer = next((front for front in fronts if front.controller == POORER.get(controller)), None)
        fronts.append(pareto_front(chain.loop, controller, poorer=poorer, **search._asdict()))
    return [
        {"gains": np.array([[getattr(gains, name) for name in PER_LANE] for gains in front.gains]), "iae": front.iae}
        for front in fronts
    ]


def fronts_of(
    chains: Sequence[FrontChain], points: Sequence[list[dict[str, Array]]]
) -> dict[tuple[float | None, str], Front]:
    """The fronts of chains from what `chain_points` gave, by ratio (None: a case's) and controller type."""
    fronts: dict[tuple[float | None, str], Front] = {}
    for chain, found in zip(chains, points, strict=True):
        case, ratio = case_of(chain.loop), _ratio(chain.loop)
        for controller, one in zip(chain.controllers, found, strict=True):
            lanes = [dict(zip(PER_LANE, row, strict=True)) for row in one["gains"].tolist()]
            gains = tuple(case.gains.with_values(type=controller, **lane) for lane in lanes)
            fronts[ratio, controller] = Front(case, controller, ratio, gains, one["iae"])
    return fronts


def _ends(problem: TuningProblem, costs: Costs) -> list[Gains]:
    """The gains with the least IAE_SP, and with the least IAE_DIS, that the HGA finds among what the front may hold."""
    ends = []
    for measure in range(2):
        study = Study(problem)

        def evaluated(candidates: Array, measure: int = measure) -> Scores:
            measures, violation = costs(candidates)
            return Scores(measures[:, measure], violation)

        study.run(evaluated)
        if study.feasible:
            ends.append(study.result.gains)
    return ends


def _nsga2(
    costs: Costs,
    space: Space,
    starts: Array,
    seed: int,
    population: int,
    generations: int,
) -> Array:
    """The points [n, d] in 0 .. 1 that NSGA-II ends with.

    Args:
        starts: [k, d] in 0 .. 1; half the population at most begins there.
    """
    nsga2, problems, optimize = (
        importlib.import_module(name) for name in (PYMOO_NSGA2, "pymoo.core.problem", "pymoo.optimize")
    )
    dimension = space.lower.size

    class Tradeoff(problems.Problem):  # type: ignore[misc, name-defined]
        def _evaluate(self, x: Array, out: dict[str, Array], *_: Any, **__: Any) -> None:
            out["F"], violation = costs(space.at(x))
            out["G"] = violation[:, None]

    first = np.random.default_rng(seed).random((population, dimension))
    if len(starts):
        chosen = starts[np.linspace(0, len(starts) - 1, min(population // 2, len(starts))).astype(int)]
        first[: len(chosen)] = chosen
    found = optimize.minimize(
        Tradeoff(n_var=dimension, n_obj=2, n_ieq_constr=1, xl=np.zeros(dimension), xu=np.ones(dimension)),
        nsga2.NSGA2(pop_size=population, sampling=first),
        ("n_gen", generations),
        seed=seed,
    )
    return np.empty((0, dimension)) if found.X is None else np.reshape(found.X, (-1, dimension))


def dominated_fraction(front: Front, other: Front) -> float:
    """Share of the points of `front` that some point of `other` beats in both measures."""
    beats = np.all(other.iae[None, :, :] < front.iae[:, None, :], axis=2)
    return float(np.mean(np.any(beats, axis=1)))


def check_installed() -> None:
    """Raise TuningError, with the remedy, if pymoo is not installed."""
    try:
        importlib.import_module(PYMOO_NSGA2)
    except ImportError:
        raise TuningError("NSGA-II needs pymoo: pip install pymoo") from None
