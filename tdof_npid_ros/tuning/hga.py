"""Hybrid genetic algorithm (HGA), ask/tell: the paper, section 3.3.2, after Jin & Jarso (2024).

The paper gives pseudo code and no formulas; the operators are our reading of it. Each generation

    x_i <- x_i + eta r w_i (x_best - x_i),   w_i = (f_i - f_best) / (f_worst - f_best),  r uniform in 0 .. 1

moves every individual towards (for eta r w > 1 beyond) the best, the worse the further; 0 < eta < 2 contracts.
Then Michalewicz's non-uniform mutation moves each coordinate, with probability `mutation_rate`, towards one of its
bounds by the fraction 1 - r^((1 - t/T)^shape): anywhere at first, hardly at all towards the last generation T.

That finds the valley of a good controller in a generation or two and then creeps along it. So by default the HGA
explores briefly and *polishes* (`quadratic.py`): of all points seen it keeps the best few, fits a quadratic to them,
and asks for the model's minimum and for samples about it, shaped like the cloud of kept points. When that has
stalled, it restarts from a new random population, dense at the bounds, and polishes more patiently, until the budget
is spent. Every candidate counts as an evaluation. `polish=0` is the paper's HGA alone.

A run is the same on every machine: NumPy's PCG64 drawn only for uniform numbers, elementwise arithmetic, decimal
powers, no BLAS and no math library.
"""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Optimizer
from tdof_npid_ros.tuning.quadratic import coefficients, model_step

MIN_EXPLORATION = 2
"""Generations of HGA before each polish, at least: the random population and its offspring."""

KEPT_PER_COEFFICIENT = (2.5, 3.5, 6.0)
"""Points kept for each coefficient of the quadratic: first round, second, all later. More is slower and surer."""

TRUST_RADIUS = 1.5
"""How far from the best point the model is believed, in standard deviations of the kept points."""

SAMPLE_SPREAD = 0.6
"""Standard deviation of the samples, in those of the kept points; well below 1, so that the cloud shrinks."""

PENALTY_CAP = 3.0
"""Values above best + 3 (median - best) of the kept points count as that much: a penalty must not bend the model."""

PROGRESS, PATIENCE = 1e-4, 3.0
"""A polish has stalled when PATIENCE times the kept points were told without improving by PROGRESS, relatively."""


class HGA(Optimizer):
    """The hybrid genetic algorithm; the module's text says what it does."""

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int,
        population: int = 40,
        generations: int = 200,
        eta: float = 1.8,
        mutation_rate: float = 0.04,
        shape: float = 6.0,
        polish: int = 6,
    ) -> None:
        """
        Args:
            lower, upper: [d], bounds of the parameters.
            seed: not negative; the run depends on nothing else but these arguments and the values told.
            population: individuals, at least 2.
            generations: the run ends after population * generations evaluations.
            eta: reproduction parameter, between 0 and 2.
            mutation_rate: probability that a coordinate mutates.
            shape: how fast the mutation's reach shrinks, positive.
            polish: candidates in each step of the polish; few need the fewest evaluations, `population` the fewest
                generations (for a live loop with that many lanes). 0: no polish and no restarts.

        Raises:
            TuningError: an argument out of its range.
        """
        _check(seed=seed, population=population, generations=generations, polish=polish)
        if not (0.0 < eta < 2.0 and 0.0 <= mutation_rate <= 1.0 and 0.0 < shape < float("inf")):
            raise TuningError(
                f"eta {eta}, mutation_rate {mutation_rate}, shape {shape}: must be in (0, 2), in [0, 1], positive"
            )
        super().__init__(lower, upper, population * generations)
        self.seed, self.population, self.generations, self.polish = seed, population, generations, polish
        self.eta, self.mutation_rate, self.shape = eta, mutation_rate, shape
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._round = -1
        self._unit = self._new_round()

    def _new_round(self) -> Array:
        """Forget all but the global best and draw a random population, after the first round densely at the bounds.

        A valley that lies along a bound is often narrow, and a uniform population misses it.
        """
        self._round += 1
        self._age = 0
        self._points = np.empty((0, self.dimension))
        self._values = np.empty(0)
        self._goal = float("inf")
        self._waited = 0
        uniform = self._random.random((self.population, self.dimension))
        return uniform if self._round == 0 else uniform * uniform * (3.0 - 2.0 * uniform)

    @property
    def _kept(self) -> int:
        """How many of the best points of this round the polish keeps."""
        fraction = KEPT_PER_COEFFICIENT[min(self._round, len(KEPT_PER_COEFFICIENT) - 1)]
        return int(fraction * coefficients(self.dimension))

    @property
    def _exploration(self) -> int:
        """Generations of HGA in this round: T of the mutation."""
        if self.polish == 0:
            return self.generations
        return max(MIN_EXPLORATION, -(-self._kept // self.population))

    def _next(self, told: Array) -> Array:
        self._age += 1
        if self.polish:
            self._keep_best(told)
        if self._age < self._exploration:
            return self._mutated(self._reproduced(told))
        if self._stalled(told.size):
            return self._new_round()
        return self._polished()

    def _reproduced(self, told: Array) -> Array:
        best, worst = told.min(), told.max()
        weight = (told - best) / (worst - best) if worst > best else np.zeros_like(told)
        step = self.eta * self._random.random(told.size) * weight
        x = self._unit
        moved: Array = np.clip(x + step[:, None] * (x[np.argmin(told)] - x), 0.0, 1.0)
        return moved

    def _mutated(self, x: Array) -> Array:
        mutates = self._random.random(x.shape) < self.mutation_rate
        bound = np.where(self._random.random(x.shape) < 0.5, 0.0, 1.0)
        fraction = self._random.random(x.shape)
        power = Decimal(1.0 - self._age / self._exploration) ** Decimal(self.shape)
        for i, j in np.argwhere(mutates):
            reach = 1.0 - float(Decimal(float(fraction[i, j])) ** power)
            x[i, j] += reach * (bound[i, j] - x[i, j])
        return x

    def _keep_best(self, told: Array) -> None:
        values = np.append(self._values, told)
        best = np.argsort(values, kind="stable")[: self._kept]
        self._points, self._values = np.concatenate([self._points, self._unit])[best], values[best]

    def _stalled(self, told: int) -> bool:
        best = float(self._values[0])
        if best < self._goal:
            self._goal, self._waited = best - PROGRESS * abs(best), 0
        else:
            self._waited += told
        return self._waited > PATIENCE * self._kept

    def _polished(self) -> Array:
        best, median = self._values[0], self._values[self._values.size // 2]
        values = np.minimum(self._values, best + PENALTY_CAP * (median - best))
        centre, cloud = model_step(self._points, values, TRUST_RADIUS)
        # Uniform with variance 1: a normal draw's rare tails would go through the C library.
        deviation = (2.0 * self._random.random((self.polish, self.dimension)) - 1.0) * np.sqrt(3.0)
        deviation[0] = 0.0
        about = np.where(np.arange(self.polish)[:, None] % 2 == 0, centre, self._points[0])
        spread = (cloud[None, :, :] * deviation[:, None, :]).sum(axis=2)
        samples: Array = np.clip(about + SAMPLE_SPREAD * spread, 0.0, 1.0)
        return samples

    def state(self) -> dict[str, Any]:
        """All that the run is, as JSON can hold it exactly; `from_state` goes on from it bit for bit."""
        return {
            "algorithm": "hga",
            "lower": self.lower.tolist(),
            "upper": self.upper.tolist(),
            "seed": self.seed,
            "population": self.population,
            "generations": self.generations,
            "eta": self.eta,
            "mutation_rate": self.mutation_rate,
            "shape": self.shape,
            "polish": self.polish,
            "evaluations": self.evaluations,
            "generation": self.generation,
            "best_value": None if self._best_unit is None else self.best_value,
            "best": None if self._best_unit is None else self._best_unit.tolist(),
            "candidates": self._unit.tolist(),
            "round": self._round,
            "age": self._age,
            "points": self._points.tolist(),
            "values": self._values.tolist(),
            "goal": None if self._goal == float("inf") else self._goal,
            "waited": self._waited,
            "random": self._random.bit_generator.state,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> HGA:
        """The run that `state` was taken of.

        Raises:
            TuningError: the state is not one of an HGA, or damaged.
        """
        try:
            return cls._from_state(state)
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise TuningError(f"state of the HGA is damaged, start anew: {error!r}") from None

    @classmethod
    def _from_state(cls, state: dict[str, Any]) -> HGA:
        arguments = ("seed", "population", "generations", "eta", "mutation_rate", "shape", "polish")
        hga = cls(state["lower"], state["upper"], **{name: state[name] for name in arguments})
        counts = ("evaluations", "generation", "round", "age", "waited")
        _check(**{name: state[name] for name in counts})
        hga.evaluations, hga.generation, hga._round, hga._age, hga._waited = (state[name] for name in counts)
        if state["best"] is not None:
            hga._best_unit = _unit([state["best"]], hga.dimension)[0]
            hga.best_value = float(_finite([state["best_value"]])[0])
        elif hga.generation > 0:
            raise ValueError("no best")
        if state["goal"] is not None:
            hga._goal = float(_finite([state["goal"]])[0])
        hga._unit = _unit(state["candidates"], hga.dimension)
        hga._points, hga._values = _unit(state["points"], hga.dimension), _finite(state["values"])
        if len(hga._points) != len(hga._values) or (hga._values[1:] < hga._values[:-1]).any():
            raise ValueError("points and values")
        if (hga.evaluations < hga.budget) != (len(hga._unit) > 0) or hga.evaluations + len(hga._unit) > hga.budget:
            raise ValueError("candidates")
        hga._random.bit_generator.state = state["random"]
        return hga


def _check(**counts: int) -> None:
    """Refuse what is no whole number in its range."""
    least = {"population": 2, "generations": 1}
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < least.get(name, 0):
            raise TuningError(f"{name} {count!r}: must be a whole number, at least {least.get(name, 0)}")


def _finite(values: list[float]) -> Array:
    array = np.array(values, dtype=np.float64)
    if array.ndim != 1 or not np.isfinite(array).all():
        raise ValueError("not a list of finite numbers")
    return array


def _unit(points: list[list[float]], dimension: int) -> Array:
    array = np.array(points, dtype=np.float64).reshape(len(points), dimension)
    if not ((array >= 0.0) & (array <= 1.0)).all():
        raise ValueError("a point outside the bounds")
    return array
