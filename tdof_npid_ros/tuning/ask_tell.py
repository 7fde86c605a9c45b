"""What every optimiser here is to its caller: ask for candidates, tell their scores."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.space import Space

Array = NDArray[np.float64]

NOT_ALLOWED = 1e150
"""The least of `Scores.values` of a candidate that is not allowed: above all objectives."""


@dataclass(frozen=True)
class Scores:
    """What candidates are worth.

    Attributes:
        objective: (n,), the lower the better.
        violation: (n,), not below 0: how far each is from what is allowed. One with a violation never wins over one
            without, whatever its objective; of two with one, the lesser violation wins, then the lower objective.
    """

    objective: Array
    violation: Array

    @classmethod
    def allowed(cls, objective: ArrayLike) -> Scores:
        """Scores (n,) of candidates that are all allowed."""
        values = np.array(objective, dtype=np.float64)
        return cls(values, np.zeros_like(values))

    @property
    def values(self) -> Array:
        """(n,), one number each, in their order: allowed ones by objective; above them the others, by violation."""
        v, f = self.violation, self.objective
        return np.where(v > 0.0, NOT_ALLOWED * (1.0 + v + 1e-9 * f / (1.0 + np.abs(f))), f)

    @property
    def best(self) -> int:
        """Index of the winner."""
        return int(np.lexsort((self.objective, self.violation))[0])


@dataclass
class SearchState:
    """What of a run changes as it goes on; all of it is in the run's state.

    Attributes:
        candidates: [n, d] in 0 .. 1, which wait for their scores.
        evaluations: candidates told.
        generation: times told.
        best: [d] in 0 .. 1, the winner so far; None before the first scores.
        best_value, best_violation: its scores; infinite before.
    """

    candidates: Array
    evaluations: int = 0
    generation: int = 0
    best: Array | None = None
    best_value: float = math.inf
    best_violation: float = math.inf


class Optimizer(ABC):
    """Minimise a function of d bounded parameters within a budget of evaluations.

        while not optimizer.done:
            optimizer.tell(scores(optimizer.ask()))

    The optimiser never calls the objective, so one optimiser serves the compiled loop and the live one. Inside,
    parameters run from 0 to 1 along their scales; `ask` and `best_x` are in the caller's units.
    """

    _state: SearchState

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        budget: int,
        logarithmic: Sequence[bool] = (),
        starts: ArrayLike = (),
    ) -> None:
        """
        Args:
            lower, upper: [d], finite, lower < upper.
            budget: evaluations after which the run is done.
            logarithmic: [d], which parameters run along a logarithmic scale; by default none.
            starts: [k, d], points within the bounds that are among the first candidates.

        Raises:
            TuningError: bounds that are no such arrays, no budget, or a start out of bounds.
        """
        self.space = Space.of_bounds(lower, upper, logarithmic)
        self.starts = self.space.checked(starts)
        if budget < 1:
            raise TuningError(f"budget of {budget} evaluations: give at least one")
        self.budget = budget

    @property
    def lower(self) -> Array:
        """[d]"""
        return self.space.lower

    @property
    def upper(self) -> Array:
        """[d]"""
        return self.space.upper

    @property
    def evaluations(self) -> int:
        """Candidates told."""
        return self._state.evaluations

    @property
    def generation(self) -> int:
        """Times told."""
        return self._state.generation

    @property
    def best_value(self) -> float:
        """The objective of the best candidate; infinite before the first scores."""
        return self._state.best_value

    @property
    def best_violation(self) -> float:
        """0 as soon as one that is allowed has been found; infinite before the first scores."""
        return self._state.best_violation

    @property
    def dimension(self) -> int:
        """How many parameters: d."""
        return int(self.lower.size)

    @property
    def done(self) -> bool:
        """Whether nothing is left to ask: `ask` returns no candidate any more."""
        return len(self._state.candidates) == 0

    @property
    def converged(self) -> bool:
        """Whether nothing better is to be expected of the rest of the budget; only the HGA knows."""
        return False

    @property
    def best_x(self) -> Array:
        """[d], the best candidate so far. Raises TuningError before the first `tell`."""
        if self._state.best is None:
            raise TuningError("no best candidate yet: tell the scores of the first candidates")
        return self.space.at(self._state.best)

    def ask(self) -> Array:
        """Candidates [n, d] within the bounds; the same ones until their scores are told. n may vary."""
        return self.space.at(self._state.candidates)

    def tell(self, scores: Scores | ArrayLike) -> None:
        """Take the scores of the candidates asked, in their order; plain values [n] are of allowed ones.

        Raises:
            TuningError: not one finite score for each candidate; nothing has changed then.
        """
        told = scores if isinstance(scores, Scores) else Scores.allowed(scores)
        self._check(told)
        state, best = self._state, told.best
        value, violation = float(told.objective[best]), float(told.violation[best])
        if (violation, value) < (state.best_violation, state.best_value):
            state.best, state.best_value, state.best_violation = state.candidates[best].copy(), value, violation
        state.evaluations += told.objective.size
        state.generation += 1
        left = self.budget - state.evaluations
        state.candidates = self._next(told)[:left] if left > 0 else state.candidates[:0]

    def _check(self, told: Scores) -> None:
        count = len(self._state.candidates)
        if self.done:
            raise TuningError(f"the run is done after {self.evaluations} evaluations: nothing is left to tell")
        for values in (told.objective, told.violation):
            if values.shape != (count,):
                raise TuningError(f"{count} candidates were asked, but values of shape {values.shape} told")
            if not np.isfinite(values).all():
                index = int(np.argmin(np.isfinite(values)))
                raise TuningError(f"value {values[index]} of candidate {index}: give a failed one a finite penalty")

    @abstractmethod
    def _next(self, told: Scores) -> Array:
        """The candidates [n, d] in 0 .. 1 that follow those in the state, whose scores are `told`."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """All that the run is, as JSON can hold it exactly; `restore_optimizer` goes on from it bit for bit."""

    def _with_starts(self, points: Array) -> Array:
        """The points [n, d] in 0 .. 1, the first of them replaced by the starts."""
        if len(self.starts):
            starts = self.space.of(self.starts)[: len(points)]
            points[: len(starts)] = starts
        return points

    def _bounds_state(self) -> dict[str, Any]:
        return {
            "lower": self.lower.tolist(),
            "upper": self.upper.tolist(),
            "logarithmic": list(self.space.logarithmic),
            "starts": self.starts.tolist(),
        }
