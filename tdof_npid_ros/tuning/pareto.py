"""The trade-off between tracking and rejection (the paper's Figure 6): NSGA-II on (IAE_SP, IAE_DIS).

The plant is K e^(-Ls) / (1 + Ts) with K = 1, T = 1 s and a chosen ratio L/T; σ = 1, N = 10. NSGA-II is pymoo's; a
generation is one call of the compiled loop.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import PER_LANE, ControllerType, Gains
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array
from tdof_npid_ros.tuning.objective import Objective, objective_values
from tdof_npid_ros.tuning.problem import TuningProblem

RATIOS = (0.1, 0.5, 1.0)  # L/T of Figure 6
POPULATION = 96  # whole blocks of the compiled loop
GENERATIONS = 200
LARGEST_POPULATION = 2000  # NSGA-II compares each point with each other one

PYMOO_NSGA2 = "pymoo.algorithms.moo.nsga2"

TIME_CONSTANT = 1.0  # s, T
SAMPLES_PER_DEAD_TIME = 100
SETTLED_AFTER = 8.0  # s beyond 14 dead times: the episode's length
DEAD_TIMES = 14.0


@dataclass(frozen=True)
class Front:
    """A Pareto front: no point is beaten by another one in both measures.

    Attributes:
        case: the loop that it belongs to.
        ratio: L/T.
        gains: of each point, by increasing IAE_SP.
        iae: IAE_SP and IAE_DIS, (points, 2), in s.
    """

    case: Case
    controller: ControllerType
    ratio: float
    gains: tuple[Gains, ...]
    iae: Array

    def best(self, weight: float = 1.0) -> int:
        """Index of the point with the lowest objective (10)."""
        return int(np.argmin(self.iae @ np.array([1.0, weight])))

    def rows(self) -> list[dict[str, Any]]:
        """One mapping per point: where it lies and its gains."""
        return [
            {
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
    ratio: float,
    controller: ControllerType,
    *,
    seed: int = 0,
    population: int = POPULATION,
    generations: int = GENERATIONS,
    after_generation: Callable[[], object] = lambda: None,
) -> Front:
    """The front that NSGA-II finds; the same one for the same arguments.

    Args:
        ratio: L/T.
        seed: not negative.
        after_generation: called after each generation, for a progress bar.

    Raises:
        TuningError: an argument out of its range, or pymoo is not installed.
    """
    if seed < 0 or population < 4 or generations < 1:
        raise TuningError(f"seed {seed}, population {population}, generations {generations}: at least 0, 4 and 1")
    if population > LARGEST_POPULATION:
        raise TuningError(f"population is {population}: NSGA-II takes {LARGEST_POPULATION} or less")
    check_installed()
    nsga2, problems, optimize, callback = (
        importlib.import_module(name)
        for name in (PYMOO_NSGA2, "pymoo.core.problem", "pymoo.optimize", "pymoo.core.callback")
    )
    case = foptd_case(ratio)
    problem = TuningProblem(case, controller)
    objective = Objective(problem)

    class Tradeoff(problems.Problem):  # type: ignore[misc, name-defined]
        def _evaluate(self, x: Array, out: dict[str, Array], *_: Any, **__: Any) -> None:
            setpoint, disturbance = objective.integrals(x)
            costs = [objective_values(*pair, weight=0.0) for pair in ((setpoint, disturbance), (disturbance, setpoint))]
            out["F"] = np.column_stack(costs)

    class Progress(callback.Callback):  # type: ignore[misc, name-defined]
        def notify(self, _: Any) -> None:
            after_generation()

    lower, upper = (np.array(bound) for bound in zip(*problem.bounds, strict=True))
    found = optimize.minimize(
        Tradeoff(n_var=len(lower), n_obj=2, xl=lower, xu=upper),
        nsga2.NSGA2(pop_size=population),
        ("n_gen", generations),
        seed=seed,
        callback=Progress(),
    )
    order = np.lexsort(found.F.T[::-1])
    gains = tuple(problem.gains(candidate) for candidate in found.X[order])
    return Front(case, controller, ratio, gains, np.asarray(found.F[order], dtype=np.float64))


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
