"""The objective (10) of candidate gains: IAE = IAE_SP + w·IAE_DIS, whole populations at a time, on all cores.

`scores` takes integrals from anywhere: the live tuner gives it those that it measured over ROS 2 and gets the same bits
(tuned live = tuned offline).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tdof_npid_ros.case import EPISODES
from tdof_npid_ros.control.gains import Gains, gains_from_candidates
from tdof_npid_ros.loop import VECTOR, Integrals, joined
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.workers import Workers, available_cores

LARGEST_IAE = 1e30
"""unit·s: an IAE above it is compressed; such a loop is useless, and only its place in the order matters."""

CHUNKS_PER_CORE = 4
"""Of candidates with many plants: their loops and margins do not all take the same time."""

_DOUBLINGS = 1024.0  # of LARGEST_IAE within the range of a float: a compressed IAE stays below 2·LARGEST_IAE
_DIVERGED = 3.0  # penalty / LARGEST_IAE of a lane that diverged at once; it falls to 2 for one that nearly did not


def objective_values(setpoint: Integrals, disturbance: Integrals, weight: float) -> Array:
    """Equation (10) per lane, (lanes,): always finite, and the better the lower.

    In each episode a lane that diverged costs more than any that did not, and the more the earlier it diverged.

    Args:
        setpoint, disturbance: of the two episodes, (lanes,) each.
        weight: w.
    """
    return _cost(setpoint) + weight * _cost(disturbance)


def scores(problem: TuningProblem, candidates: Array, setpoint: Integrals, disturbance: Integrals) -> Scores:
    """The scores of candidates (n, len(problem.names)) with the case's plant, from the integrals of their episodes,
    (n,) each."""
    return _scores(problem, gains_from_candidates(problem.base, problem.names, candidates), setpoint, disturbance)


def _scores(problem: TuningProblem, gains: Gains, setpoint: Integrals, disturbance: Integrals) -> Scores:
    return problem.judge(gains, objective_values(setpoint, disturbance, problem.weight), setpoint, disturbance)


def _cost(integrals: Integrals) -> Array:
    fraction = integrals.finite_fraction
    finite = (fraction >= 1.0) & np.isfinite(integrals.iae)
    iae = np.where(finite, integrals.iae, 0.0)
    return np.where(finite, _compressed(iae), LARGEST_IAE * (_DIVERGED - fraction))


def _compressed(iae: Array) -> Array:
    """The IAE itself up to LARGEST_IAE, above it like a logarithm; drawn in straight lines, without the C library."""
    mantissa, exponent = np.frexp(np.maximum(iae / LARGEST_IAE, 1.0))
    doublings = (exponent - 1) + (2.0 * mantissa - 1.0)
    return np.where(iae > LARGEST_IAE, LARGEST_IAE * (1.0 + doublings / _DOUBLINGS), iae)


class Objective:
    """Scores a problem's candidates, in process.

    They do not depend on the number of threads: lanes are independent, and each is summed in the order of time.
    """

    def __init__(self, problem: TuningProblem, threads: int | None = None, where: Workers | None = None) -> None:
        """
        Args:
            threads: by default one per core.
            where: the loops with perturbed plants run; None: on those threads.
        """
        self._problem, self._where = problem, where
        self._threads = threads or available_cores()
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="objective")

    def __call__(self, candidates: Array) -> Scores:
        """Scores of candidates (n, len(problem.names)).

        Raises:
            GainsError: a candidate is not a valid set of gains.
        """
        if self._problem.perturbed:
            return self._scores_with_plants(candidates)
        blocks = self._blocks(candidates)
        whole = blocks[0] if len(blocks) == 1 else self._gains(candidates)  # to make them takes time
        return _scores(self._problem, whole, *self._integrals(blocks))

    def integrals(self, candidates: Array) -> tuple[Integrals, Integrals]:
        """Of the setpoint and the disturbance episode with the case's plant, (n,) each."""
        return self._integrals(self._blocks(candidates))

    def _gains(self, candidates: Array) -> Gains:
        return gains_from_candidates(self._problem.base, self._problem.names, candidates)

    def _blocks(self, candidates: Array) -> list[Gains]:
        return [self._gains(candidates[block]) for block in _blocks(len(candidates), self._threads)]

    def _integrals(self, blocks: list[Gains]) -> tuple[Integrals, Integrals]:
        case = self._problem.case
        running = [[self._pool.submit(case.integrals, name, gains) for gains in blocks] for name in EPISODES]
        setpoint, disturbance = (joined([block.result() for block in episode]) for episode in running)
        return setpoint, disturbance

    def _scores_with_plants(self, candidates: Array) -> Scores:
        problem = self._problem
        judge = problem.plants_judge  # made here, before threads ask for it
        cores = self._where.cores if self._where else self._threads
        chunks = [(candidates, plants) for plants in judge.chunks(len(candidates), CHUNKS_PER_CORE * cores)]
        if self._where:
            parts = self._where.map(scores_with_plants, problem, chunks)
        else:
            _ = problem.plants
            parts = list(self._pool.map(scores_with_plants, [problem] * len(chunks), chunks))
        return judge.together(self._gains(candidates), parts)


def scores_with_plants(problem: TuningProblem, chunk: tuple[Array, slice]) -> Scores:
    """Of candidates with each of some plants, (candidates * plants,): first the first candidate with all of them."""
    candidates, plants = chunk
    gains = gains_from_candidates(problem.base, problem.names, candidates)
    setpoint, disturbance = (
        problem.case.integrals(episode, gains, problem.plants[episode][plants].with_each_of(gains.lanes))
        for episode in EPISODES
    )
    objective = objective_values(setpoint, disturbance, problem.weight)
    return problem.plants_judge(gains, plants, objective, setpoint, disturbance)


def _blocks(lanes: int, threads: int) -> list[slice]:
    """Lanes in blocks of what the loop vectorises best, so that the episodes of each give every thread something."""
    count = -(-threads // len(EPISODES))
    size = max(2 * VECTOR, -(-lanes // (count * VECTOR)) * VECTOR)
    return [slice(first, min(first + size, lanes)) for first in range(0, lanes, size)]
