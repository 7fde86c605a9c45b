"""A tuning problem: the case, what of its controller is free, and how the search is done."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from tdof_npid_ros.case import EPISODES, Bounds, Case
from tdof_npid_ros.control.gains import TUNED, ControllerType, Gains, GainsError
from tdof_npid_ros.parameter import ParameterError
from tdof_npid_ros.parameters import TUNER, WEIGHT
from tdof_npid_ros.plants.catalog import model_parameters
from tdof_npid_ros.plants.per_lane import LanePlants
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.plant import loop_plant, operating_point
from tdof_npid_ros.stability.screen import Screen
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array
from tdof_npid_ros.tuning.judge import DIVERGED, LARGEST_TAIL, UNSTABLE, Constraints, Judge
from tdof_npid_ros.tuning.perturbed import Perturbed, PlantsJudge
from tdof_npid_ros.tuning.space import Space

POPULATION, GENERATIONS = 40, 500
"""By default: Jin & Jarso's (2024) population, for 20,000 evaluations; 8,000 miss some narrow valleys."""

LARGEST_BUDGET = 10**12
"""Evaluations: more than a year of them."""

LOGARITHMIC = ("kp", "ki", "kd", "sigma")
"""Gains of which it matters by which factor they change; alpha and beta are weights between 0 and 1."""

AT_BOUND = 1e-3
"""Of a bound: nearer than that, gains are at it."""

POLISH = 6
"""By default: candidates in each step of the HGA's polish, for the fewest evaluations."""


@dataclass(frozen=True)
class TuningProblem:
    """All that the outcome of a study depends on.

    Attributes:
        case: the loop, with its search bounds.
        controller: the type that is tuned.
        extra: what is free beyond the gains that the paper tunes for the type: `sigma`, or nothing.
        weight: w of the objective (10).
        algorithm: `hga`, `de` or `cmaes`.
        seed: of the optimiser's random numbers.
        population, generations: their product is the budget of evaluations.
        polish: candidates in each step of the HGA's polish.
        constraints: margins that the loop must have.
        warm: whether the case's own gains are among the first candidates.
        until_converged: whether the search ends when it has converged, before its budget is spent.
        perturbed: plants near the case's, for all of which the gains are tuned at once; None: for the case's alone.

    Raises:
        TuningError: the case lacks an episode or bounds, its bounds allow gains that no controller takes, or margins
            are asked for that are not known here.
    """

    case: Case
    controller: ControllerType
    extra: tuple[str, ...] = ()
    weight: float = WEIGHT.default
    algorithm: str = TUNER["algorithm"].default
    seed: int = TUNER["seed"].default
    population: int = POPULATION
    generations: int = GENERATIONS
    polish: int = POLISH
    constraints: Constraints = field(default_factory=Constraints)
    warm: bool = False
    until_converged: bool = False
    perturbed: Perturbed | None = None

    def __post_init__(self) -> None:
        try:
            WEIGHT.checked(self.weight)
        except ParameterError as error:
            raise TuningError(str(error)) from None
        for name in ("population", "polish"):  # the optimiser checks the rest
            if getattr(self, name) > (most := TUNER[name].within.high):
                raise TuningError(f"{name} is {getattr(self, name):g}: it must be {most:.0f} or less")
        if self.population * self.generations > LARGEST_BUDGET:
            raise TuningError(f"population times generations must be {LARGEST_BUDGET:g} evaluations or less")
        if self.extra not in ((), ("sigma",)) or (self.extra and self.controller == "pid"):
            raise TuningError(f"{', '.join(self.extra)} cannot be freed for {self.controller}: only sigma, not for pid")
        missing = [episode for episode in EPISODES if episode not in self.case.episodes]
        if missing:
            raise TuningError(f"{self.case.name} has no episode {missing[0]!r}: tuning runs {' and '.join(EPISODES)}")
        missing = [name for name in self.names if name not in self.case.bounds]
        if missing:
            raise TuningError(f"{self.case.name} has no bounds.{missing[0]}: give [lower, upper] to its tuner")
        self._check_bounds()
        if self.constraints.given and self.screen is None:
            asked = ", ".join(self.constraints.given)
            raise TuningError(f"{self.without_margins}: no margins are known here, tune without {asked}")

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: the rest follows from them where it is needed."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @classmethod
    def of_case(cls, case: Case, controller: ControllerType, **search: Any) -> TuningProblem:
        """The problem as the case's file asks its tuner: with its weight, what it frees and the margins it wants.

        Args:
            search: attributes of how the search is done.

        Raises:
            TuningError: as for the class.
        """
        free = case.search.get("free") if controller != "pid" else None
        constraints = Constraints.of_search(case.search)
        return cls(case, controller, (free,) if free else (), case.weight, constraints=constraints, **search)

    def _check_bounds(self) -> None:
        bounds = dict(zip(self.names, self.bounds, strict=True))
        kp, ki, kd = (bounds[name] for name in ("kp", "ki", "kd"))
        direct = kp[0] > 0 and ki[0] >= 0 and kd[0] >= 0
        reverse = kp[1] < 0 and ki[1] <= 0 and kd[1] <= 0
        if not (direct or reverse):
            raise TuningError(
                f"{self.case.name}: bounds kp {list(kp)}, ki {list(ki)}, kd {list(kd)} hold gains that no controller "
                "takes: kp must stay above 0 and ki, kd must not fall below it (reverse action: the other way round)"
            )
        if "sigma" in bounds and bounds["sigma"][0] <= 0:
            raise TuningError(f"{self.case.name}: bounds sigma {list(bounds['sigma'])}: it must stay above 0")
        for corner in zip(*self.bounds, strict=True):
            try:
                self.gains(np.array(corner))
            except GainsError as error:
                raise TuningError(
                    f"{self.case.name}: its bounds hold gains that no controller takes: {error}"
                ) from None

    @property
    def names(self) -> tuple[str, ...]:
        """The free gains, in the order of a candidate's columns."""
        return (*TUNED[self.controller], *self.extra)

    @property
    def bounds(self) -> tuple[Bounds, ...]:
        """Lower and upper bound of each free gain."""
        return tuple(self.case.bounds[name] for name in self.names)

    @cached_property
    def base(self) -> Gains:
        """The controller with what is not free; alpha and beta are 0 where the type has none."""
        unused = {name: 0.0 for name in ("alpha", "beta") if name not in TUNED[self.controller]}
        return self.case.gains.with_values(type=self.controller, **unused)

    @property
    def logarithmic(self) -> tuple[bool, ...]:
        """Which of the free gains are searched along a logarithmic scale."""
        return tuple(name in LOGARITHMIC for name in self.names)

    @property
    def starts(self) -> Array:
        """The candidates that the search begins with beside random ones, (k, len(names))."""
        if not self.warm:
            return np.empty((0, len(self.names)))
        start: Array = np.clip(candidate_of(self, self.case.gains), *np.array(self.bounds).T)
        return start

    @property
    def space(self) -> Space:
        """What is searched: the free gains between their bounds, along their scales."""
        lower, upper = zip(*self.bounds, strict=True)
        return Space.of_bounds(lower, upper, self.logarithmic)

    @property
    def screen(self) -> Screen | None:
        """Of the margins of the linear loop; None if there is none, for which `without_margins` gives the reason."""
        return self._screening[0]

    @property
    def without_margins(self) -> str:
        """Why no margins are known here; empty if they are."""
        return self._screening[1]

    @cached_property
    def _screening(self) -> tuple[Screen | None, str]:
        try:
            return Screen(loop_plant(self.case)), ""
        except StabilityError as error:
            return None, str(error)

    @cached_property
    def judge(self) -> Judge:
        """Of which candidates may win."""
        setpoint, disturbance = (
            0.0 if episode in self.restless else self.case.signals[episode].steps * self.case.sample_period
            for episode in EPISODES
        )
        return Judge(self.screen, self.constraints, (setpoint, disturbance), self.weight, self._noise_bound)

    @property
    def _noise_bound(self) -> float:
        """The largest of the case's plant and of those near it."""
        changes = self.perturbed.changes(self.case) if self.perturbed else []
        return max([self.case.noise_bound, *map(self.case.noise_bound_at, changes)])

    @cached_property
    def plants_judge(self) -> PlantsJudge:
        """Of which candidates may win with all perturbed plants."""
        assert self.perturbed is not None
        return PlantsJudge(self.perturbed, self.case, self.judge, linear=self.screen is not None)

    @cached_property
    def plants(self) -> dict[str, LanePlants]:
        """The perturbed plants, by episode; none if there are no such."""
        changes = self.perturbed.changes(self.case) if self.perturbed else []
        return {episode: self.case.lane_plants(episode, changes) for episode in EPISODES if changes}

    @cached_property
    def restless(self) -> dict[str, str]:
        """The episodes in which no loop comes to rest, because that takes an effort beyond the limits: the reason."""
        case, reasons = self.case, {}
        low, high = (float(case.gains.per_lane(name)[0]) for name in ("effort_min", "effort_max"))
        low, high = max(low, case.effort_limits[0]), min(high, case.effort_limits[1])
        for episode in EPISODES:
            signals = case.signals[episode]
            r, d = float(signals.setpoint[-1]), float(signals.disturbance[-1])
            plant = {**case.plant_values, **signals.segments[-1].plant}  # as this episode leaves it
            its_end = replace(case, plant_values=plant, episodes={})
            try:
                effort = operating_point(its_end, self.base.with_values(kp=1.0, ki=1.0, kd=0.0), r, d).effort
            except StabilityError:
                continue
            if effort is not None and not low <= effort <= high:
                reasons[episode] = (
                    f"episode {episode}: to rest at {r:g} under the disturbance {d:g} takes an effort of {effort:.4g}, "
                    f"beyond the limits {low:g} .. {high:g}"
                )
        return reasons

    def shortfall(self, gains: Gains, violation: float) -> str:
        """Why nothing was allowed, from the gains that came nearest and their violation."""
        within = f"{self.case.name}: within the bounds of the search"
        if self.perturbed:
            within += f", for all {self.perturbed.plants} plants and the corners of their spreads,"
        if violation >= DIVERGED:
            return f"{within} every {self.controller} that was tried diverges"
        if violation >= UNSTABLE:
            return f"{within} no {self.controller} was found whose loop is stable"
        missed = self.constraints.missed(self.screen(gains)) if self.screen else []
        if missed:
            return f"{within} no {self.controller} was found with {'; '.join(missed)}; allow more, or widen the bounds"
        return (
            f"{within} no {self.controller} was found whose error has come to rest by the end of the episodes "
            f"(what may follow must be below {LARGEST_TAIL:.1%} of the objective); give them more time, or ki a range"
        )

    def at_bounds(self, gains: Gains) -> dict[str, str]:
        """The free gains that lie at a bound of the search: `lower` or `upper` by name."""
        ends = {}
        for name, (low, high) in zip(self.names, self.bounds, strict=True):
            value, near = float(gains.per_lane(name)[0]), AT_BOUND * max(abs(low), abs(high))
            if min(value - low, high - value) <= near:
                ends[name] = "lower" if value - low <= near else "upper"
        return ends

    def gains(self, candidate: Array) -> Gains:
        """The gains of one candidate, (len(names),)."""
        return self.base.with_values(**dict(zip(self.names, candidate.tolist(), strict=True)))

    def description(self) -> dict[str, Any]:
        """The problem, flat and as JSON holds it: two problems are the same if their descriptions are."""
        case = self.case
        plant = {name: case.plant_values.get(name, value) for name, value in model_parameters(case.model).items()}
        fixed = {name: value for name, value in self.base.as_dict().items() if name not in (*self.names, "type")}
        return {
            "model": case.model,
            **{f"plant.{name}": value for name, value in plant.items()},
            "plant.effort_limits": str(case.effort_limits),  # may be infinite, which JSON does not know
            "sample_period_ns": case.sample_period_ns,
            **{f"plan.{episode}": case.plans[episode].digest for episode in EPISODES},
            "controller": self.controller,
            **{f"controller.{name}": str(value) for name, value in fixed.items()},
            **{f"bounds.{name}": list(bounds) for name, bounds in zip(self.names, self.bounds, strict=True)},
            "weight": self.weight,
            "algorithm": self.algorithm,
            "seed": self.seed,
            "population": self.population,
            "generations": self.generations,
            "polish": self.polish,
            **{f"constraint.{name}": value for name, value in self.constraints.given.items()},
            "starts": self.starts.tolist(),
            "until_converged": self.until_converged,
            **(self.perturbed.description() if self.perturbed else {}),
        }


def candidate_of(problem: TuningProblem, gains: Gains) -> Array:
    """Gains as the one candidate (1, len(problem.names)) of a generation."""
    return np.array([[float(gains.per_lane(name)[0]) for name in problem.names]])
