"""Hybrid genetic algorithm (HGA), ask/tell: the paper, section 3.3.2, after Jin & Jarso (2024).

The paper gives pseudo code and no formulas; the operators are our reading of it. Each generation

    x_i <- x_i + eta r w_i (x_best - x_i),   w_i = (f_i - f_best) / (f_worst - f_best),  r uniform in 0 .. 1

moves every individual towards (for eta r w > 1 beyond) the best, the worse the further; 0 < eta < 2 contracts.
Then Michalewicz's non-uniform mutation moves each coordinate, with probability `mutation_rate`, towards one of its
bounds by the fraction 1 - r^((1 - t/T)^shape): anywhere at first, hardly at all towards the last generation T.

That finds the valley of a good controller in a generation or two and then creeps along it. So by default the HGA
explores briefly and *polishes* (`quadratic.py`): of all points seen it keeps the best few, fits a quadratic to them,
and asks for the model's minimum and for samples about it, shaped like the cloud of kept points, and for one farther
on, beyond the best point as seen from the cloud's centre. When that has stalled, the round is over, and another begins
from a new random population, dense at the bounds, and polishes more patiently, until the budget is spent. A round whose
points agree already, but in a valley that lies higher than the best is given up. After a round that has found a better
best, the next one begins about it, near and far. Every candidate counts as an evaluation. `polish=0` is the paper's HGA
alone.

As long as no other round has ended as low as the best, its valley may go on, too narrow and bent for a quadratic: where
a round about the best has found a better one, or a round from anywhere has not, the next one is a *walk* (`walk.py`)
from the best, one for each best. Once another has ended as low, rounds look elsewhere: what lies about the ends of all
rounds before is not taken for good.

And a valley may rise and then fall lower, far along it, as those of two-degree-of-freedom loops do along alpha. So
then, too, or once six rounds are over, every other round stays in the half of one parameter's range in which the best
does not lie, each parameter in turn, the last first, and begins about the best in the others.

Half of each random population is drawn along the parameters' scales, half of it linearly: bounds that fit lie about
the gains, bounds that are decades wide do not.

A large polish asks for several minima of the model at once, within small and large distances of the best point.

What is not allowed never wins, but it is not thrown away: the best gains lie where a constraint just holds, and the
model must see both sides of that. So points are kept and fitted by their *merit*, f + penalty · violation · |f|. Where
a round ends at a point that is not allowed, the next one has a larger penalty. Until something allowed has been found,
the violation alone is the merit.

A run has *converged* when enough rounds are over and more than one that began anywhere has ended as low as the best.

A run is the same on every machine: NumPy's PCG64 drawn only for uniform numbers, elementwise arithmetic, decimal
powers, no BLAS and no math library.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Optimizer, Scores, SearchState
from tdof_npid_ros.tuning.quadratic import coefficients, model_step
from tdof_npid_ros.tuning.walk import Walk

MIN_EXPLORATION = 2
"""Generations of HGA before each polish, at least: the random population and its offspring."""

KEPT_PER_COEFFICIENT = (2.5, 3.5, 6.0)
"""Points kept for each coefficient of the quadratic: first round, second, all later. More is slower and surer."""

TRUST_RADIUS = 1.5
"""How far from the best point the model is believed, in standard deviations of the kept points."""

RADII, GROUP = (1.0, 2.0, 4.0, 0.5), 8
"""Of a large polish each group of so many candidates has its own radius, in TRUST_RADIUS: far steps along a valley."""

SAMPLE_SPREAD = 0.6
"""Standard deviation of the samples, in those of the kept points; well below 1, so that the cloud shrinks."""

ONWARD = 3.0
"""How far, at most, a sample goes on beyond the best point, in distances of that from the kept points' centre."""

KNOWN = 0.1
"""How far from where another round ended a round that looks elsewhere keeps away, in any parameter, of its range."""

OUT_OF_QUESTION = 1e6
"""The violation of a point there."""

PENALTY_CAP = 3.0
"""Merits above best + 3 (median - best) of the kept points count as that much: a penalty must not bend the model."""

PROGRESS, PATIENCE = 1e-4, 3.0
"""A polish has stalled when PATIENCE times the kept points were told without improving by PROGRESS, relatively."""

PATIENCE_OF_WALK = 6.0
"""As PATIENCE, of a walk, which gets worse at first."""

LONGEST = 0.5
"""Of the budget, which a round that creeps may take, before another sees with more points; a walk may take longer."""

HIGHER = 4.0
"""A round is given up when its best point lies higher than the run's by so many times median - best of its points."""

PENALTY, STIFFER = 3.0, 4.0
"""Of the merit: at first, and by which factor it grows."""

TIE = 1e-3
"""How much the objective counts beside a violation, while nothing allowed has been found: less than this."""

ROUNDS_TO_CONVERGE, CONFIRMATIONS = 5, 2
"""Rounds that must be over, and those of them, begun anywhere, that must have ended as low as the best..."""

CONFIRMED = 1e-3
"""... within this, relatively, before the run counts as converged."""


@dataclass
class HGAState(SearchState):
    """What of a run of the HGA changes, beside its random numbers.

    Attributes:
        round: restarts so far.
        about_best: whether this round began about the best of those before.
        elsewhere: whether it keeps away from where rounds before it ended.
        half: the parameter, counted from 1, of whose range it stays in one half, `upper_half` says which; 0: of none.
        halves: how many rounds have done so.
        round_began_at: the best value when this round began.
        age: generations told in this round; `began_after`: evaluations before it.
        searching: whether nothing allowed has been found yet.
        points, objectives, violations: [m, d] in 0 .. 1, [m], [m]: the best points of this round, best merit first.
        goal: the merit below which this round counts as having made progress; `waited`: evaluations since.
        penalty: of the merit in this round.
        ends: the lowest allowed values of the rounds that began anywhere and are over; infinite where there is none.
        walk: of this round, if it is one.
        walked_from: the best value when the last walk was over.
        end_points: [k, d] in 0 .. 1, where those of them ended that ended at something allowed.
    """

    round: int = 0
    about_best: bool = False
    elsewhere: bool = False
    half: int = 0
    upper_half: bool = False
    halves: int = 0
    round_began_at: float = math.inf
    age: int = 0
    began_after: int = 0
    searching: bool = True
    points: Array = field(default_factory=lambda: np.empty((0, 0)))
    objectives: Array = field(default_factory=lambda: np.empty(0))
    violations: Array = field(default_factory=lambda: np.empty(0))
    goal: float = math.inf
    waited: int = 0
    penalty: float = PENALTY
    ends: Array = field(default_factory=lambda: np.empty(0))
    end_points: Array = field(default_factory=lambda: np.empty((0, 0)))
    walk: Walk | None = None
    walked_from: float = math.inf


_COUNTS = ("evaluations", "generation", "round", "age", "began_after", "waited", "half", "halves")
_NUMBERS = ("best_value", "best_violation", "round_began_at", "goal", "penalty", "walked_from")
_FLAGS = ("about_best", "elsewhere", "searching", "upper_half")


class HGA(Optimizer):
    """The hybrid genetic algorithm; the module's text says what it does."""

    _state: HGAState

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
        logarithmic: Sequence[bool] = (),
        starts: ArrayLike = (),
    ) -> None:
        """
        Args:
            lower, upper: [d], bounds of the parameters.
            seed: not negative; the run depends on nothing else but these arguments and the scores told.
            population: individuals, at least 2.
            generations: the run ends after population * generations evaluations.
            eta: reproduction parameter, between 0 and 2.
            mutation_rate: probability that a coordinate mutates.
            shape: how fast the mutation's reach shrinks, positive.
            polish: candidates in each step of the polish; few need the fewest evaluations, `population` the fewest
                generations (for a live loop with that many lanes). 0: no polish and no restarts.
            logarithmic, starts: see `Optimizer`; the starts are in the first population.

        Raises:
            TuningError: an argument out of its range.
        """
        _check(seed=seed, population=population, generations=generations, polish=polish)
        if not (0.0 < eta < 2.0 and 0.0 <= mutation_rate <= 1.0 and 0.0 < shape < float("inf")):
            raise TuningError(
                f"eta {eta}, mutation_rate {mutation_rate}, shape {shape}: must be in (0, 2), in [0, 1], positive"
            )
        super().__init__(lower, upper, population * generations, logarithmic, starts)
        self.seed, self.population, self.generations, self.polish = seed, population, generations, polish
        self.eta, self.mutation_rate, self.shape = eta, mutation_rate, shape
        self._random = np.random.Generator(np.random.PCG64(seed))
        uniform = self._random.random((population, self.dimension))
        self._state = HGAState(self._with_starts(self._half_linear(uniform)), end_points=np.empty((0, self.dimension)))
        self._forget()

    @property
    def converged(self) -> bool:
        """Whether `ROUNDS_TO_CONVERGE` rounds are over, and `CONFIRMATIONS` begun anywhere ended as low as the best."""
        return self._confirmed and self._state.round >= ROUNDS_TO_CONVERGE

    @property
    def _confirmed(self) -> bool:
        """Whether `CONFIRMATIONS` rounds begun anywhere ended as low as the best."""
        as_low = self._state.ends <= self.best_value + CONFIRMED * abs(self.best_value)
        return self.best_violation == 0.0 and int(np.count_nonzero(as_low)) >= CONFIRMATIONS

    def _new_round(self) -> Array:
        """End the round, forget all but the global best, and draw the next one's population.

        About the best if the round has found it, at all distances, or in the other half of one parameter's range.
        Otherwise, if it is no walk, anywhere, densely at the bounds: a valley that lies along one is often narrow, and
        a uniform population misses it.
        """
        state = self._state
        if state.violations[0] > 0.0:
            state.penalty *= STIFFER
        was_about_best = state.about_best
        if not was_about_best and not state.half:
            self._note_end()
        confirmed = self._confirmed
        allowed = state.best_violation == 0.0
        better = allowed and state.best_value < state.round_began_at - PROGRESS * abs(state.best_value)
        if state.walk:
            state.walked_from = state.best_value
        walks = allowed and better == was_about_best and not confirmed and state.best_value < state.walked_from
        state.about_best = better or walks
        self._choose_half(allowed and not state.about_best and (confirmed or state.round >= ROUNDS_TO_CONVERGE))
        state.elsewhere = confirmed and not state.about_best and not state.half
        state.round_began_at = state.best_value
        state.round += 1
        self._forget()
        state.walk = Walk.begun_at(state.best) if walks and state.best is not None else None
        if state.walk:
            return state.walk.samples(self._random, self.polish)
        uniform: Array = self._random.random((self.population, self.dimension))
        if (state.about_best or state.half) and state.best is not None:
            reach = self._random.random((self.population, 1))
            about: Array = np.clip(state.best + reach * reach * reach * (2.0 * uniform - 1.0), 0.0, 1.0)
            if state.half:
                about[:, state.half - 1] = 0.5 * (uniform[:, state.half - 1] + state.upper_half)
            return about
        return self._half_linear(uniform * uniform * (3.0 - 2.0 * uniform))

    def _choose_half(self, may: bool) -> None:
        """Let the next round stay in the half in which the best does not lie, if it may and this one has not."""
        state = self._state
        if not may or state.half or state.best is None:
            state.half = 0
            return
        state.half = self.dimension - state.halves % self.dimension
        state.upper_half = bool(state.best[state.half - 1] < 0.5)
        state.halves += 1

    def _note_end(self) -> None:
        """Where the round, begun anywhere, has ended, and how low."""
        state = self._state
        allowed = np.flatnonzero(state.violations == 0.0)
        lowest = math.inf
        if allowed.size:
            end = allowed[np.argmin(state.objectives[allowed])]
            lowest = float(state.objectives[end])
            state.end_points = np.concatenate([state.end_points, state.points[end : end + 1]])
        state.ends = np.append(state.ends, lowest)

    def _away(self, told: Scores) -> Scores:
        """The scores as this round takes them: what lies where it keeps away from is not allowed."""
        state = self._state
        if state.half:
            out = (state.candidates[:, state.half - 1] < 0.5) == state.upper_half
        elif state.elsewhere:
            out = np.abs(state.candidates[:, None] - state.end_points[None]).max(axis=2).min(axis=1) < KNOWN
        else:
            return told
        return Scores(told.objective, told.violation + np.where(out, OUT_OF_QUESTION, 0.0))

    def _half_linear(self, points: Array) -> Array:
        """The points [n, d] in 0 .. 1, every other one of them along linear scales."""
        linear = self.lower + points[1::2] * (self.upper - self.lower)
        points[1::2] = self.space.of(linear)
        return points

    def _forget(self) -> None:
        state = self._state
        state.age = state.waited = 0
        state.began_after = state.evaluations
        state.points = np.empty((0, self.dimension))
        state.objectives, state.violations = np.empty(0), np.empty(0)
        state.goal = math.inf

    @property
    def _kept(self) -> int:
        """How many of the best points of this round the polish keeps."""
        fraction = KEPT_PER_COEFFICIENT[min(self._state.round, len(KEPT_PER_COEFFICIENT) - 1)]
        return int(fraction * coefficients(self.dimension))

    @property
    def _exploration(self) -> int:
        """Generations of HGA in this round: T of the mutation."""
        if self.polish == 0:
            return self.generations
        return max(MIN_EXPLORATION, -(-self._kept // self.population))

    def _next(self, told: Scores) -> Array:
        state = self._state
        state.age += 1
        if state.searching and state.best_violation == 0.0:
            state.searching, state.goal, state.waited = False, math.inf, 0
        told = self._away(told)
        if self.polish:
            self._keep_best(told)
        if state.walk:
            state.walk = state.walk.moved(state.candidates[np.lexsort((told.objective, told.violation))])
        elif state.age < self._exploration:
            return self._mutated(self._reproduced(told))
        if self._stalled(told.objective.size):
            return self._new_round()
        return state.walk.samples(self._random, self.polish) if state.walk else self._polished()

    def _merits(self, objective: Array, violation: Array) -> Array:
        """What points are kept and fitted by, [m]."""
        if self._state.walk:
            return Scores(objective, violation).values
        if self._state.searching:
            return violation + TIE * objective / (1.0 + np.abs(objective))
        return objective + self._state.penalty * violation * np.abs(objective)

    def _reproduced(self, told: Scores) -> Array:
        merits = self._merits(told.objective, told.violation)
        allowed = merits[told.violation == 0.0]
        values = np.minimum(merits, max(allowed.max(), merits.min())) if allowed.size else merits
        best, worst = values.min(), values.max()
        weight = (values - best) / (worst - best) if worst > best else np.zeros_like(values)
        step = self.eta * self._random.random(values.size) * weight
        x = self._state.candidates
        moved: Array = np.clip(x + step[:, None] * (x[np.argmin(values)] - x), 0.0, 1.0)
        return moved

    def _mutated(self, x: Array) -> Array:
        mutates = self._random.random(x.shape) < self.mutation_rate
        bound = np.where(self._random.random(x.shape) < 0.5, 0.0, 1.0)
        fraction = self._random.random(x.shape)
        power = Decimal(1.0 - self._state.age / self._exploration) ** Decimal(self.shape)
        for i, j in np.argwhere(mutates):
            reach = 1.0 - float(Decimal(float(fraction[i, j])) ** power)
            x[i, j] += reach * (bound[i, j] - x[i, j])
        return x

    def _keep_best(self, told: Scores) -> None:
        state = self._state
        objectives = np.append(state.objectives, told.objective)
        violations = np.append(state.violations, told.violation)
        best = np.argsort(self._merits(objectives, violations), kind="stable")[: self._kept]
        state.points = np.concatenate([state.points, state.candidates])[best]
        state.objectives, state.violations = objectives[best], violations[best]

    def _stalled(self, told: int) -> bool:
        state = self._state
        best = float(self._merits(state.objectives[:1], state.violations[:1])[0])
        if best < state.goal:
            state.goal, state.waited = best - PROGRESS * abs(best), 0
        else:
            state.waited += told
        if state.walk:
            return state.waited > PATIENCE_OF_WALK * self._kept
        too_long = state.evaluations - state.began_after > LONGEST * self.budget
        return too_long or state.waited > PATIENCE * self._kept or self._is_higher()

    def _is_higher(self) -> bool:
        """Whether the round's points are in a valley that lies higher than the best of the run."""
        state = self._state
        if state.searching or len(state.points) < self._kept:
            return False
        merits = self._merits(state.objectives, state.violations)
        return bool(merits[0] - HIGHER * (merits[merits.size // 2] - merits[0]) > state.best_value)

    def _polished(self) -> Array:
        points, merits = self._state.points, self._merits(self._state.objectives, self._state.violations)
        best, median = merits[0], merits[merits.size // 2]
        values = np.minimum(merits, best + PENALTY_CAP * (median - best))
        # Uniform with variance 1: a normal draw's rare tails would go through the C library.
        deviation = (2.0 * self._random.random((self.polish, self.dimension)) - 1.0) * np.sqrt(3.0)
        groups = np.array_split(deviation, max(1, self.polish // GROUP))
        return np.concatenate([self._sampled(points, values, group, i) for i, group in enumerate(groups)])

    def _sampled(self, points: Array, values: Array, deviation: Array, group: int) -> Array:
        """The model's minimum within the group's radius and samples about it and about the best point."""
        centre, cloud = model_step(points, values, RADII[group % len(RADII)] * TRUST_RADIUS)
        deviation[0] = 0.0
        onward = ONWARD * self._random.random() * (points[0] - points.sum(axis=0) / len(points))
        about = np.where(np.arange(len(deviation))[:, None] % 2 == 0, centre, points[0])
        spread = (cloud[None, :, :] * deviation[:, None, :]).sum(axis=2)
        samples = about + SAMPLE_SPREAD * spread
        if len(samples) > 1:
            samples[-1] = points[0] + onward
        clipped: Array = np.clip(samples, 0.0, 1.0)
        return clipped

    def state(self) -> dict[str, Any]:
        """All that the run is, as JSON can hold it exactly; `from_state` goes on from it bit for bit."""
        changing = {one.name: _encoded(getattr(self._state, one.name)) for one in fields(HGAState)}
        return {
            "algorithm": "hga",
            **self._bounds_state(),
            **{name: getattr(self, name) for name in _ARGUMENTS},
            **changing,
            "random": self._random.bit_generator.state,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> HGA:
        """The run that `state` was taken of.

        Raises:
            TuningError: the state is not one of an HGA, or damaged.
        """
        try:
            hga = cls(**{name: state[name] for name in ("lower", "upper", "logarithmic", "starts", *_ARGUMENTS)})
            hga._state = _decoded(state, hga.dimension)
            left = hga.budget - hga.evaluations
            if (left > 0) != (len(hga._state.candidates) > 0) or len(hga._state.candidates) > max(left, 0):
                raise ValueError("candidates")
            hga._random.bit_generator.state = state["random"]
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise TuningError(f"state of the HGA is damaged, start anew: {error!r}") from None
        return hga


_ARGUMENTS = ("seed", "population", "generations", "eta", "mutation_rate", "shape", "polish")


def _encoded(value: Any) -> Any:
    """A part of the state as JSON holds it: infinity, which JSON does not know, is None."""
    if isinstance(value, Walk):
        value = value.numbers()
    if isinstance(value, np.ndarray):
        return [_encoded(one) for one in value.tolist()] if value.ndim == 1 else value.tolist()
    return None if value == math.inf else value


def _decoded(state: dict[str, Any], dimension: int) -> HGAState:
    """The part of a state that changes; raises ValueError or TypeError where it cannot be."""
    _check(**{name: state[name] for name in _COUNTS})
    numbers = {name: math.inf if state[name] is None else float(_finite([state[name]])[0]) for name in _NUMBERS}
    best = None if state["best"] is None else _unit([state["best"]], dimension)[0]
    points = _unit(state["points"], dimension)
    objectives, violations = _finite(state["objectives"]), _finite(state["violations"])
    if not len(points) == len(objectives) == len(violations) or any(
        not isinstance(state[name], bool) for name in _FLAGS
    ):
        raise ValueError("points, objectives and violations")
    if state["half"] > dimension:
        raise ValueError("half")
    if (best is None) != (state["generation"] == 0) or (best is None) != (numbers["best_value"] == math.inf):
        raise ValueError("best")
    return HGAState(
        candidates=_unit(state["candidates"], dimension),
        best=best,
        points=points,
        end_points=_unit(state["end_points"], dimension),
        walk=Walk.of_numbers(_finite(state["walk"] or []), dimension),
        **{name: state[name] for name in _FLAGS},
        ends=np.append(np.empty(0), [math.inf if one is None else float(_finite([one])[0]) for one in state["ends"]]),
        objectives=objectives,
        violations=violations,
        **{name: state[name] for name in _COUNTS},
        **numbers,  # type: ignore[arg-type]
    )


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
