"""The HGA and, to check it against, two well-kept libraries' optimisers, all in ask/tell form.

`Cmaes` is the `cma` library's CMA-ES with restarts of doubled population (IPOP), `DifferentialEvolution` is SciPy's.
Neither library can write its state but by pickle, which must not be read from a file that others could have made. So
their state is the scores told: a restored run asks and is told them again. That is exact on one machine; across
machines it is not, for both use the machine's BLAS or math library. The HGA's state is exact everywhere.
"""

from __future__ import annotations

import math
import queue
import threading
import warnings
import weakref
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Optimizer, Scores, SearchState
from tdof_npid_ros.tuning.hga import HGA

INITIAL_STEP = 0.3
"""CMA-ES's first standard deviation, as a fraction of the bounds' distance: what the library advises."""


def make_optimizer(
    algorithm: str,
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    seed: int,
    population: int = 40,
    generations: int = 200,
    polish: int = 6,
    logarithmic: Sequence[bool] = (),
    starts: ArrayLike = (),
) -> Optimizer:
    """An optimiser that ends after population * generations evaluations.

    Args:
        algorithm: one of `ALGORITHMS`. `cmaes` takes the library's own population; for it only the budget counts.
        lower, upper: [d], bounds of the parameters.
        seed: not negative.
        polish: of the HGA; the others have none.
        logarithmic, starts: see `Optimizer`.

    Raises:
        TuningError: unknown algorithm, or an argument out of its range.
    """
    kind = _kind(algorithm)
    options = {"polish": polish} if kind is HGA else {}
    return kind(
        lower,
        upper,
        seed=seed,
        population=population,
        generations=generations,
        logarithmic=logarithmic,
        starts=starts,
        **options,
    )


def restore_optimizer(state: dict[str, Any]) -> Optimizer:
    """The run that `Optimizer.state` was taken of; it goes on as if it had never stopped.

    Raises:
        TuningError: not a state, of an unknown algorithm, or damaged.
    """
    if not isinstance(state, dict) or "algorithm" not in state:
        raise TuningError("state of the optimiser is damaged, start anew: no algorithm in it")
    return _kind(state["algorithm"]).from_state(state)


class _Replayed(Optimizer):
    """A library's optimiser, whose state is the scores that it was told.

    It knows no violations, so it is told `Scores.values`.
    """

    algorithm: str

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int,
        population: int,
        generations: int,
        logarithmic: Sequence[bool] = (),
        starts: ArrayLike = (),
    ) -> None:
        least = {"seed": (seed, 0), "population": (population, 5), "generations": (generations, 1)}
        for name, (count, minimum) in least.items():
            if isinstance(count, bool) or not isinstance(count, int) or count < minimum:
                raise TuningError(f"{name} {count!r}: must be a whole number, at least {minimum}")
        super().__init__(lower, upper, population * generations, logarithmic, starts)
        self.seed, self.population, self.generations = seed, population, generations
        self._told: list[tuple[list[float], list[float]]] = []
        self._random = np.random.default_rng(seed)
        self._state = SearchState(self._first())

    def tell(self, scores: Scores | ArrayLike) -> None:
        told = scores if isinstance(scores, Scores) else Scores.allowed(scores)
        super().tell(told)
        self._told.append((told.objective.tolist(), told.violation.tolist()))

    @abstractmethod
    def _first(self) -> Array:
        """The first candidates [n, d] in 0 .. 1."""

    def state(self) -> dict[str, Any]:
        return {
            "algorithm": self.algorithm,
            **self._bounds_state(),
            "seed": self.seed,
            "population": self.population,
            "generations": self.generations,
            "evaluations": self.evaluations,
            "told": [[list(values) for values in told] for told in self._told],
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> _Replayed:
        """The run that `state` was taken of. Raises TuningError where the state is damaged."""
        try:
            names = ("lower", "upper", "seed", "population", "generations", "logarithmic", "starts")
            optimizer = cls(**{name: state[name] for name in names})
            for objective, violation in state["told"]:
                optimizer.tell(Scores(np.array(objective), np.array(violation)))
        except (KeyError, TypeError, ValueError) as error:
            raise TuningError(f"state of {cls.algorithm} is damaged, start anew: {error!r}") from None
        return optimizer


class Cmaes(_Replayed):
    """CMA-ES of the `cma` library; each restart begins at a random point with twice the population."""

    algorithm = "cmaes"

    def _first(self) -> Array:
        self._restarts = -1
        return self._restarted()

    def _restarted(self) -> Array:
        try:
            import cma
        except ImportError:
            raise TuningError("cmaes needs cma: pip install cma") from None

        self._restarts += 1
        options = {
            "bounds": [0.0, 1.0],
            "popsize": (4 + int(3.0 * math.log(self.dimension))) * 2**self._restarts,
            "randn": lambda *shape: self._random.standard_normal(shape),
            "seed": math.nan,  # the library must leave NumPy's global generator alone
            "verbose": -9,
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            first = self._random.random((1, self.dimension))
            first = self._with_starts(first) if self._restarts == 0 else first
            self._strategy = cma.CMAEvolutionStrategy(first[0], INITIAL_STEP, options)
        return self._asked()

    def _asked(self) -> Array:
        self._points = self._strategy.ask()
        return np.clip(np.array(self._points, dtype=np.float64), 0.0, 1.0)

    def _next(self, told: Scores) -> Array:
        self._strategy.tell(self._points, told.values.tolist())
        return self._restarted() if self._strategy.stop() else self._asked()


class DifferentialEvolution(_Replayed):
    """SciPy's `differential_evolution`, a generation at a time, without its polish.

    SciPy calls its objective, so it runs in a thread of its own, which waits in that call for the values told. The
    thread knows the queues alone, so that an optimiser nobody holds any more is collected, which ends the thread.
    """

    algorithm = "de"

    def _first(self) -> Array:
        self._asked: queue.SimpleQueue[Array | None] = queue.SimpleQueue()
        self._values: queue.SimpleQueue[Array | None] = queue.SimpleQueue()
        weakref.finalize(self, self._values.put, None)
        initial = self._with_starts(self._random.random((self.population, self.dimension)))
        arguments = (initial, self._random, self.generations, self._asked, self._values)
        threading.Thread(target=_evolve, args=arguments, name="differential_evolution", daemon=True).start()
        return self._candidates()

    def _candidates(self) -> Array:
        candidates = self._asked.get()
        return np.empty((0, self.dimension)) if candidates is None else candidates

    def _next(self, told: Scores) -> Array:
        self._values.put(told.values)
        return self._candidates()


class _AbandonedError(Exception):
    """Ends SciPy's thread when its optimiser is gone."""


def _evolve(
    initial: Array,
    random: np.random.Generator,
    generations: int,
    asked: queue.SimpleQueue[Array | None],
    told: queue.SimpleQueue[Array | None],
) -> None:
    """SciPy's side: candidates [n, d] go out, values [n] come in; None is the end of either."""
    from scipy.optimize import Bounds, differential_evolution

    def evaluate(points: Array) -> Array:
        asked.put(np.ascontiguousarray(points.T))
        values = told.get()
        if values is None:
            raise _AbandonedError
        return values

    dimension = initial.shape[1]
    try:
        differential_evolution(
            evaluate,  # type: ignore[arg-type]  # the stubs know no vectorized objective
            Bounds(np.zeros(dimension), np.ones(dimension)),
            init=initial,
            maxiter=generations,
            tol=0.0,
            rng=random,
            polish=False,
            updating="deferred",
            vectorized=True,
        )
    except _AbandonedError:
        pass
    finally:
        asked.put(None)


ALGORITHMS: dict[str, type[HGA | Cmaes | DifferentialEvolution]] = {
    "hga": HGA,
    "cmaes": Cmaes,
    "de": DifferentialEvolution,
}


def _kind(algorithm: object) -> type[HGA | Cmaes | DifferentialEvolution]:
    if not isinstance(algorithm, str) or algorithm not in ALGORITHMS:
        raise TuningError(f"algorithm {algorithm!r} is unknown: choose one of {', '.join(ALGORITHMS)}")
    return ALGORITHMS[algorithm]
