"""What every optimiser here is to its caller: ask for candidates, tell their values."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdof_npid_ros.tuning import TuningError

Array = NDArray[np.float64]


class Optimizer(ABC):
    """Minimise a function of d bounded parameters within a budget of evaluations.

        while not optimizer.done:
            optimizer.tell(objective(optimizer.ask()))

    The optimiser never calls the objective, so one optimiser serves the compiled loop and the live one. Inside,
    parameters run from 0 to 1; `ask` and `best_x` are in the caller's units.
    """

    def __init__(self, lower: ArrayLike, upper: ArrayLike, budget: int) -> None:
        """
        Args:
            lower, upper: [d], finite, lower < upper.
            budget: evaluations after which the run is done.

        Raises:
            TuningError: bounds that are no such arrays, or no budget.
        """
        self.lower, self.upper = _bounds(lower, upper)
        if budget < 1:
            raise TuningError(f"budget of {budget} evaluations: give at least one")
        self.budget = budget
        self.evaluations = 0
        self.generation = 0
        """Times told."""
        self.best_value = float("inf")
        self._best_unit: Array | None = None
        self._unit: Array = np.empty((0, self.dimension))
        """[n, d] in 0 .. 1: the candidates that wait for their values."""

    @property
    def dimension(self) -> int:
        """How many parameters: d."""
        return int(self.lower.size)

    @property
    def done(self) -> bool:
        """Whether nothing is left to ask: `ask` returns no candidate any more."""
        return len(self._unit) == 0

    @property
    def best_x(self) -> Array:
        """[d], the best candidate so far. Raises TuningError before the first `tell`."""
        if self._best_unit is None:
            raise TuningError("no best candidate yet: tell the values of the first candidates")
        return self._in_bounds(self._best_unit)

    def ask(self) -> Array:
        """Candidates [n, d] within the bounds; the same ones until their values are told. n may vary."""
        return self._in_bounds(self._unit)

    def tell(self, values: ArrayLike) -> None:
        """Take the values [n] of the candidates asked, in their order.

        Raises:
            TuningError: not one finite value for each candidate; nothing has changed then.
        """
        told = np.array(values, dtype=np.float64)
        if self.done:
            raise TuningError(f"the run is done after {self.evaluations} evaluations: nothing is left to tell")
        if told.shape != (len(self._unit),):
            raise TuningError(f"{len(self._unit)} candidates were asked, but values of shape {told.shape} told")
        if not np.isfinite(told).all():
            index = int(np.argmin(np.isfinite(told)))
            raise TuningError(f"value {told[index]} of candidate {index}: give a failed one a large finite penalty")
        best = int(np.argmin(told))
        if told[best] < self.best_value:
            self.best_value, self._best_unit = float(told[best]), self._unit[best].copy()
        self.evaluations += told.size
        self.generation += 1
        left = self.budget - self.evaluations
        self._unit = self._next(told)[:left] if left > 0 else self._unit[:0]

    @abstractmethod
    def _next(self, told: Array) -> Array:
        """The candidates [n, d] in 0 .. 1 that follow `self._unit`, whose values are `told` [n]."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """All that the run is, as JSON can hold it exactly; `restore_optimizer` goes on from it bit for bit."""

    def _in_bounds(self, unit: Array) -> Array:
        return np.clip(self.lower + unit * (self.upper - self.lower), self.lower, self.upper)


def _bounds(lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
    try:
        low, high = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    except (TypeError, ValueError):
        raise TuningError(f"bounds {lower!r}, {upper!r}: give two lists of numbers") from None
    if low.ndim != 1 or low.shape != high.shape or low.size == 0:
        raise TuningError(f"bounds of shapes {low.shape} and {high.shape}: give one lower and upper a parameter")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise TuningError(f"bounds {low.tolist()} to {high.tolist()}: each lower must be finite and below its upper")
    return low, high
