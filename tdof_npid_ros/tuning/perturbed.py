"""Tuning for many plants at once: which plants, and what one number stands for all of them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.loop import Integrals
from tdof_npid_ros.robustness import RobustError
from tdof_npid_ros.robustness.spread import Spread, changes_of, samples
from tdof_npid_ros.robustness.sweep import is_linear
from tdof_npid_ros.stability.plant import linear_loop_plants
from tdof_npid_ros.stability.screen import Screens
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.judge import UNSTABLE, Judge

MOST_PLANTS = 100_000
MOST_SPREADS = 6  # whose corners are watched: 64
LEAST_LOOPS = 1024  # that are worth a chunk of their own


@dataclass(frozen=True)
class Perturbed:
    """Fixed plants near the model, for all of which the same gains are looked for.

    They are a Latin hypercube. Besides, with up to six spreads, the loop of a linear plant must be stable at their
    corners.

    Attributes:
        spreads: of the plant's parameters.
        plants: how many.
        by: what is minimised: `mean`, `worst`, or a quantile of the objective over the plants, as a fraction.
        seed: of the plants.

    Raises:
        TuningError: too many plants, or no such quantile.
    """

    spreads: tuple[Spread, ...]
    plants: int
    by: str | float = "mean"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 2 <= self.plants <= MOST_PLANTS:
            raise TuningError(f"{self.plants} plants to tune for: from 2 to {MOST_PLANTS:,}")
        if isinstance(self.by, str):
            if self.by not in ("mean", "worst"):
                raise TuningError(f"by {self.by!r}: take mean, worst, or a quantile as a fraction, 0.9")
        elif not 0.0 < self.by < 1.0:
            raise TuningError(f"a quantile of {self.by:g}: it must lie between 0 and 1")

    def changes(self, case: Case) -> list[dict[str, Any]]:
        """The plant's parameters that are changed in each."""
        try:
            values = samples(self.spreads, self.plants, "latin", self.seed)
        except RobustError as error:
            raise TuningError(str(error)) from error
        return [changes_of(case, self.spreads, row, index) for index, row in enumerate(values.tolist())]

    def corners(self, case: Case) -> list[dict[str, Any]]:
        """The plant's parameters at the corners of the spreads; none where there are too many."""
        if len(self.spreads) > MOST_SPREADS:
            return []
        ends = itertools.product(*((spread.low, spread.high) for spread in self.spreads))
        return [changes_of(case, self.spreads, corner, 0) for corner in ends]

    def together(self, values: Array) -> Array:
        """One number for each candidate, (n,), from the objective with each plant, (plants, n)."""
        if self.by == "mean":
            total: Array = np.cumsum(values, axis=0)[-1] / len(values)  # in the order of the plants
            return total
        if self.by == "worst":
            worst: Array = values.max(axis=0)
            return worst
        quantile: Array = np.quantile(values, float(self.by), axis=0, method="inverted_cdf")
        return quantile

    def description(self) -> dict[str, Any]:
        """What the outcome of a study depends on, flat and as JSON holds it."""
        return {
            "robust.plants": self.plants,
            "robust.by": self.by,
            "robust.seed": self.seed,
            **{f"robust.{one.name}": [one.low, one.high] for one in self.spreads},
        }


class PlantsJudge:
    """Scores candidates with many plants: allowed is what is allowed with every one, and stable at the corners.

    Args:
        judge: of the case's own plant; what it asks for is asked of each.
        linear: whether the case's plant has a linear model; else the plants are judged by their outputs.
    """

    def __init__(self, perturbed: Perturbed, case: Case, judge: Judge, linear: bool) -> None:
        self._perturbed, self._judge = perturbed, judge
        self._screens = self._corners = None
        if linear and is_linear(case):
            self._screens = Screens(linear_loop_plants(case, perturbed.changes(case)))
            corners = perturbed.corners(case)
            self._corners = Screens(linear_loop_plants(case, corners)) if corners else None

    def chunks(self, candidates: int, wanted: int) -> list[slice]:
        """The plants in about so many parts, fewer if these were small; no score depends on it."""
        plants = self._perturbed.plants
        parts = min(wanted, plants, -(-candidates * plants // LEAST_LOOPS))
        ends = np.linspace(0, plants, parts + 1).astype(int).tolist()
        return [slice(first, last) for first, last in itertools.pairwise(ends)]

    def __call__(
        self, gains: Gains, plants: slice, objective: Array, setpoint: Integrals, disturbance: Integrals
    ) -> Scores:
        """Of candidates with each of some plants, (n * plants,): first the first candidate with all of them.

        Args:
            gains: the candidates', n lanes.
            plants: which they are.
            objective: (10), (n * plants,).
            setpoint, disturbance: of the episodes, likewise.
        """
        margins = self._screens(gains, plants=plants) if self._screens else None
        ki = np.repeat(gains.per_lane("ki"), len(objective) // gains.lanes)
        return self._judge.scores(ki, margins, objective, setpoint, disturbance)

    def together(self, gains: Gains, parts: Sequence[Scores]) -> Scores:
        """The scores (n,) of candidates from those with the plants of each chunk."""
        objective = np.hstack([part.objective.reshape(gains.lanes, -1) for part in parts])
        violation = np.hstack([part.violation.reshape(gains.lanes, -1) for part in parts])
        value = self._perturbed.together(objective.T)
        if self._corners:
            stable = self._corners(gains, modes=False).stable.reshape(gains.lanes, -1)
            violation = np.hstack([violation, np.where(stable, 0.0, UNSTABLE)])
        # Beside the worst, how many there are: a search must see whether it gets nearer.
        return Scores(value, violation.max(axis=1) + np.mean(violation > 0.0, axis=1))
