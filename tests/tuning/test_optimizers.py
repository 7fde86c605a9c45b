"""HGA, CMA-ES and differential evolution look the same to their caller, and resume exactly."""

import gc
import json
import threading

import numpy as np
import pytest
from numpy.typing import NDArray

from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Optimizer
from tdof_npid_ros.tuning.optimizers import ALGORITHMS, make_optimizer, restore_optimizer

Array = NDArray[np.float64]
LOWER, UPPER = np.array([-1.0, 0.0, 10.0]), np.array([3.0, 1e-3, 1e4])
each_algorithm = pytest.mark.parametrize("algorithm", ALGORITHMS)


def bowl(x: Array) -> Array:
    return np.array(1.0 + (((x - LOWER) / (UPPER - LOWER) - 0.3) ** 2).sum(axis=1))


def make(algorithm: str, seed: int = 1, generations: int = 50) -> Optimizer:
    return make_optimizer(algorithm, LOWER, UPPER, seed=seed, population=20, generations=generations)


def run(optimizer: Optimizer, tells: int | None = None) -> list[Array]:
    asked: list[Array] = []
    while not optimizer.done and (tells is None or len(asked) < tells):
        asked.append(optimizer.ask())
        optimizer.tell(bowl(asked[-1]))
    return asked


def same(first: list[Array], second: list[Array]) -> bool:
    return len(first) == len(second) and all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@each_algorithm
def test_it_finds_the_minimum_within_bounds_and_budget(algorithm: str) -> None:
    optimizer = make(algorithm)
    candidates = np.concatenate(run(optimizer))
    assert ((candidates >= LOWER) & (candidates <= UPPER)).all()
    assert len(candidates) == optimizer.evaluations <= optimizer.budget == 1000
    assert optimizer.best_value < 1.001
    assert bowl(optimizer.best_x[None])[0] == optimizer.best_value == bowl(candidates).min()


@each_algorithm
def test_the_seed_decides_whatever_else_draws_random_numbers(algorithm: str) -> None:
    first = run(make(algorithm, seed=2))
    np.random.seed(0)
    assert same(first, run(make(algorithm, seed=2)))
    assert not same(first, run(make(algorithm, seed=3)))


@each_algorithm
@pytest.mark.parametrize("tells", [0, 1, 17, 10**6])
def test_a_resumed_run_ends_as_the_one_left_alone(algorithm: str, tells: int) -> None:
    alone, killed = make(algorithm), make(algorithm)
    asked = run(alone)
    before = run(killed, tells)
    resumed = restore_optimizer(json.loads(json.dumps(killed.state(), allow_nan=False)))
    assert same(asked, before + run(resumed))
    assert resumed.state() == alone.state()
    assert resumed.best_value == alone.best_value


@each_algorithm
def test_a_value_that_is_not_finite_is_refused_and_nothing_changes(algorithm: str) -> None:
    optimizer, untouched = make(algorithm), make(algorithm)
    with pytest.raises(TuningError, match="candidate 0"):
        optimizer.tell(np.full(len(optimizer.ask()), np.nan))
    assert same(run(optimizer), run(untouched))


@each_algorithm
def test_a_damaged_state_is_refused(algorithm: str) -> None:
    state = make(algorithm).state()
    for damaged in ({**state, "lower": None}, {**state, "seed": 0.5}, {"algorithm": algorithm}):
        with pytest.raises(TuningError, match="damaged"):
            restore_optimizer(damaged)


@pytest.mark.parametrize("algorithm", ["cmaes", "de"])
def test_values_of_another_run_are_refused(algorithm: str) -> None:
    state = make(algorithm).state()
    with pytest.raises(TuningError, match="damaged"):
        restore_optimizer({**state, "told": [[1.0]]})


def test_an_unknown_algorithm_is_refused_with_the_known_ones() -> None:
    with pytest.raises(TuningError, match="hga, cmaes, de"):
        make("annealing")
    with pytest.raises(TuningError, match="unknown"):
        restore_optimizer({"algorithm": "annealing"})
    with pytest.raises(TuningError, match="damaged"):
        restore_optimizer({})


def test_a_differential_evolution_that_nobody_holds_leaves_no_thread() -> None:
    optimizer = make("de")
    run(optimizer, 3)
    before = [thread for thread in threading.enumerate() if thread.name == "differential_evolution"]
    assert before
    del optimizer
    gc.collect()
    for thread in before:
        thread.join(timeout=5.0)
    assert not any(thread.is_alive() for thread in before)
