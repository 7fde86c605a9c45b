"""The HGA keeps its bounds, is its seed's, resumes bit for bit and finds minima."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Scores
from tdof_npid_ros.tuning.hga import HGA

Array = NDArray[np.float64]
Objective = Callable[[Array], Array]


def sphere(x: Array) -> Array:
    return np.array((x * x).sum(axis=1))


def rosenbrock(x: Array) -> Array:
    return np.array((100.0 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1.0 - x[:, :-1]) ** 2).sum(axis=1))


def kinked_valley(x: Array) -> Array:
    """An IAE's looks: kinks, a narrow valley, unequal scales; 1 at its minimum."""
    scaled = x / np.array([10.0, 1.0, 3.0])
    across, along = np.abs(scaled[:, 0] - scaled[:, 1]), (scaled[:, 1] - 0.5) ** 2
    return np.array(1.0 + 20.0 * across + along + np.abs(scaled[:, 2] - 0.3))


def penalised_sphere(x: Array) -> Array:
    """Most of the box is unstable: a large finite penalty there, larger farther away."""
    return np.where(np.abs(x).max(axis=1) > 1.0, 1e6 * (1.0 + np.abs(x).max(axis=1)), 1.0 + sphere(x - 0.25))


def run(hga: HGA, objective: Objective, tells: int | None = None) -> list[Array]:
    """Tell `tells` times or to the end; all that was asked."""
    asked: list[Array] = []
    while not hga.done and (tells is None or len(asked) < tells):
        asked.append(hga.ask())
        hga.tell(objective(asked[-1]))
    return asked


def cube(dimension: int, **options: Any) -> HGA:
    options = {"seed": 1, **options}
    return HGA([-3.0] * dimension, [5.0] * dimension, **options)


@pytest.mark.parametrize("polish", [0, 1, 6, 40])
@pytest.mark.parametrize("objective", [sphere, penalised_sphere])
def test_every_candidate_is_within_the_bounds(polish: int, objective: Objective) -> None:
    lower, upper = np.array([-0.1, 0.0, 1e-9]), np.array([0.3, 1e6, 2e-9])
    hga = HGA(lower, upper, seed=3, generations=30, polish=polish)
    for candidates in run(hga, objective):
        assert candidates.dtype == np.float64
        assert (candidates >= lower).all()
        assert (candidates <= upper).all()


@pytest.mark.parametrize("polish", [0, 7])
def test_the_budget_is_spent_and_never_exceeded(polish: int) -> None:
    hga = cube(4, population=10, generations=23, polish=polish)
    asked = run(hga, rosenbrock)
    assert sum(len(candidates) for candidates in asked) == hga.evaluations == 230
    assert hga.generation == len(asked)
    assert len(hga.ask()) == 0


def test_the_same_seed_asks_the_same_and_another_seed_something_else() -> None:
    first, second, other = (run(cube(3, seed=seed, generations=20), rosenbrock) for seed in (5, 5, 6))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_asking_again_asks_the_same() -> None:
    hga = cube(2)
    assert np.array_equal(hga.ask(), hga.ask())


def test_what_the_caller_does_to_the_candidates_does_not_matter() -> None:
    hga, untouched = cube(2), cube(2)
    hga.ask()[:] = 0.0
    assert np.array_equal(hga.ask(), untouched.ask())


def test_the_best_never_gets_worse_and_is_the_best_told() -> None:
    hga = cube(5, generations=40)
    told: list[float] = []
    while not hga.done:
        values = rosenbrock(hga.ask())
        told.extend(values.tolist())
        hga.tell(values)
        assert hga.best_value == min(told)
        assert rosenbrock(hga.best_x[None])[0] == hga.best_value


@settings(max_examples=25, deadline=None)
@given(tells=st.integers(0, 60), polish=st.sampled_from([0, 6, 40]), seed=st.integers(0, 2**64))
def test_a_run_resumed_anywhere_ends_as_the_one_left_alone(tells: int, polish: int, seed: int) -> None:
    alone, killed = (cube(3, seed=seed, generations=30, polish=polish) for _ in range(2))
    run(killed, kinked_valley, tells)
    resumed = HGA.from_state(json.loads(json.dumps(killed.state(), allow_nan=False)))
    assert resumed.state() == killed.state()
    run(alone, kinked_valley)
    run(resumed, kinked_valley)
    assert resumed.state() == alone.state()


@pytest.mark.parametrize(
    ("objective", "dimension", "minimum", "tolerance"),
    [(sphere, 5, 0.0, 1e-9), (rosenbrock, 5, 0.0, 1e-9), (penalised_sphere, 3, 1.0, 1e-9)],
)
def test_it_finds_the_minimum(objective: Objective, dimension: int, minimum: float, tolerance: float) -> None:
    for seed in range(3):
        hga = cube(dimension, seed=seed)
        run(hga, objective)
        assert hga.best_value <= minimum + tolerance


def test_it_finds_the_end_of_a_kinked_valley() -> None:
    for seed in range(5):
        hga = HGA([0.0, 0.0, 0.0], [30.0, 3.0, 9.0], seed=seed)
        run(hga, kinked_valley)
        assert hga.best_value <= 1.001


def bent_border(x: Array) -> Scores:
    """Allowed is what lies within 0.01 of a bent line, steep on both sides; the best is at one end of it."""
    off = np.abs(x[:, 1:] - 0.5 * x[:, :1] ** 2).max(axis=1)
    return Scores(1.0 + (x[:, 0] - 2.0) ** 2 + 20.0 * off, np.maximum(off - 0.01, 0.0))


def test_it_walks_to_the_end_of_what_a_narrow_border_allows() -> None:
    for seed in range(3):
        hga = HGA([-3.0] * 3, [3.0] * 3, seed=seed)
        while not hga.done:
            hga.tell(bent_border(hga.ask()))
        assert hga.best_violation == 0.0
        assert hga.best_value <= 1.001


@pytest.mark.parametrize("kind", ["walk", "elsewhere"])
def test_a_run_resumed_amid_a_walk_or_elsewhere_ends_as_the_one_left_alone(kind: str) -> None:
    def told(hga: HGA) -> Scores:
        return bent_border(hga.ask()) if kind == "walk" else Scores.allowed(1.0 + sphere(hga.ask()))

    alone = HGA([-3.0] * 3, [3.0] * 3, seed=2)
    while not alone.state()[kind]:
        alone.tell(told(alone))
    for _ in range(7):
        alone.tell(told(alone))
    assert alone.state()[kind]
    resumed = HGA.from_state(json.loads(json.dumps(alone.state(), allow_nan=False)))
    for _ in range(300):
        alone.tell(told(alone))
        resumed.tell(told(resumed))
    assert resumed.state() == alone.state()


def test_once_a_valley_is_sure_rounds_look_elsewhere() -> None:
    hga = cube(3)
    while not hga.state()["elsewhere"]:
        hga.tell(1.0 + sphere(hga.ask()))
    ends = np.array(hga.state()["end_points"])
    run(hga, lambda x: 1.0 + sphere(x), 30)
    kept = np.array(hga.state()["points"])[:10]
    assert hga.state()["elsewhere"]
    assert (np.abs(kept[:, None] - ends[None]).max(axis=2) >= 0.1).all()


def test_without_the_polish_it_is_the_papers_algorithm() -> None:
    hga = cube(3, polish=0, generations=60)
    asked = run(hga, sphere)
    assert [len(candidates) for candidates in asked] == [40] * 60
    assert hga.best_value < 1e-3


def test_reproduction_moves_only_along_the_line_to_the_best() -> None:
    hga = cube(3, polish=0, mutation_rate=0.0)
    before = hga.ask()
    values = sphere(before)
    hga.tell(values)
    best = before[np.argmin(values)]
    moved, way = hga.ask() - before, best - before
    inside = ((hga.ask() > hga.lower) & (hga.ask() < hga.upper)).all(axis=1)
    share = (moved * way).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-300)
    np.testing.assert_allclose(moved[inside], (share[:, None] * way)[inside], atol=1e-12)
    weight = (values - values.min()) / (values.max() - values.min())
    assert (share <= hga.eta * weight + 1e-12).all()
    assert (hga.ask()[np.argmin(values)] == best).all()


def test_a_flat_objective_does_no_harm() -> None:
    hga = cube(4, generations=30)
    run(hga, lambda x: np.full(len(x), 7.0))
    assert hga.best_value == 7.0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_value_that_is_not_finite_is_refused_and_nothing_changes(bad: float) -> None:
    hga = cube(2)
    before = hga.state()
    values = sphere(hga.ask())
    values[3] = bad
    with pytest.raises(TuningError, match="candidate 3"):
        hga.tell(values)
    assert hga.state() == before


@pytest.mark.parametrize("shape", [(39,), (41,), (40, 1), ()])
def test_another_number_of_values_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(TuningError, match="40 candidates"):
        cube(2).tell(np.zeros(shape))


def test_telling_after_the_end_is_refused() -> None:
    hga = cube(2, generations=1)
    run(hga, sphere)
    with pytest.raises(TuningError, match="done"):
        hga.tell([])


def test_there_is_no_best_before_the_first_values() -> None:
    with pytest.raises(TuningError, match="no best"):
        _ = cube(2).best_x


@pytest.mark.parametrize(
    ("lower", "upper"),
    [([1.0], [0.0]), ([0.0], [0.0]), ([0.0, 0.0], [1.0]), ([], []), ([0.0], [float("inf")]), ("a", "b")],
)
def test_bounds_that_enclose_nothing_are_refused(lower: list[float], upper: list[float]) -> None:
    with pytest.raises(TuningError, match="bounds"):
        HGA(lower, upper, seed=1)


@pytest.mark.parametrize(
    "option",
    [
        {"seed": -1},
        {"population": 1},
        {"population": 4.5},
        {"generations": 0},
        {"polish": -1},
        {"eta": 0.0},
        {"eta": 2.0},
        {"mutation_rate": 1.5},
        {"shape": float("nan")},
    ],
)
def test_options_out_of_range_are_refused(option: dict[str, float]) -> None:
    with pytest.raises(TuningError, match=next(iter(option))):
        cube(2, **option)


def half_forbidden(x: Array) -> Scores:
    """A bowl whose lowest point is not allowed: the best that is lies where the first parameter is 1."""
    return Scores(1.0 + sphere(x + 0.5), np.maximum(1.0 - x[:, 0], 0.0))


def test_what_is_not_allowed_never_wins_and_the_best_is_found_where_the_constraint_holds() -> None:
    for seed in range(3):
        hga = cube(3, seed=seed)
        told: list[tuple[float, float]] = []
        while not hga.done:
            scores = half_forbidden(hga.ask())
            told += zip(scores.violation.tolist(), scores.objective.tolist(), strict=True)
            hga.tell(scores)
            assert (hga.best_violation, hga.best_value) == min(told)
        assert hga.best_violation == 0.0
        assert hga.best_value <= 1.0005 * (1.0 + 1.5**2)


def test_of_points_that_are_all_forbidden_the_nearest_to_what_is_allowed_is_the_best() -> None:
    hga = cube(2)
    while not hga.done:
        hga.tell(Scores(1.0 + sphere(hga.ask()), 1.0 + np.abs(hga.ask() - 2.0).max(axis=1)))
    assert hga.best_violation == pytest.approx(1.0, abs=0.01)
    assert not hga.converged


def test_the_starts_are_among_the_first_candidates() -> None:
    starts = [[1.0, 2.0, -1.0], [0.0, 0.0, 0.0]]
    hga, without = cube(3, starts=starts), cube(3)
    np.testing.assert_allclose(hga.ask()[:2], starts, atol=1e-12)
    assert np.array_equal(hga.ask()[2:], without.ask()[2:])


def test_a_run_that_has_converged_says_so_and_finds_hardly_better_in_the_rest_of_its_budget() -> None:
    for seed in range(3):
        hga = HGA([0.0, 0.0, 0.0], [30.0, 3.0, 9.0], seed=seed)
        assert not hga.converged
        while not hga.converged:
            hga.tell(kinked_valley(hga.ask()))
        assert hga.evaluations < 0.8 * hga.budget
        found = hga.best_value
        run(hga, kinked_valley)
        assert hga.best_value >= found / 1.001


def test_bounds_that_fit_and_bounds_that_are_decades_wide_are_both_met_by_the_first_population() -> None:
    """Half of it lies along the logarithmic scales, in which a linear population has no point below 1 here."""
    first = HGA([1e-3] * 2, [1e3] * 2, seed=1, logarithmic=[True, True]).ask()
    assert 5 <= np.count_nonzero((first > 100.0).all(axis=1)) <= 25
    assert 2 <= np.count_nonzero((first < 1.0).all(axis=1)) <= 15


def test_a_round_that_has_found_better_is_followed_by_one_about_the_best() -> None:
    hga = cube(2, generations=100)
    while hga.state()["round"] == 0:
        hga.tell(1.0 + sphere(hga.ask() - 0.3))
    near = np.abs(hga.ask() - 0.3).max(axis=1)
    assert hga.state()["about_best"]
    assert np.count_nonzero(near < 0.1) > 10
    assert np.count_nonzero(near > 1.0) > 3


DAMAGE = {
    "lower": [5.0, 5.0],
    "evaluations": -1,
    "generation": "two",
    "candidates": [[0.5, 1.5]],
    "points": [[0.5]],
    "objectives": [1.0, float("nan")],
    "searching": 3,
    "about_best": None,
    "elsewhere": 0,
    "end_points": [[0.5, 1.5]],
    "walk": [0.01, 0.5],
    "walked_from": "low",
    "round_began_at": "low",
    "violations": [0.0],
    "penalty": "much",
    "best": [0.5],
    "best_value": None,
    "random": {"bit_generator": "PCG64"},
    "eta": None,
}


@pytest.mark.parametrize("key", DAMAGE)
@pytest.mark.parametrize("missing", [True, False])
def test_a_damaged_state_is_refused(key: str, missing: bool) -> None:
    hga = cube(2)
    run(hga, sphere, 5)
    state = hga.state()
    if missing:
        del state[key]
    else:
        state[key] = DAMAGE[key]
    with pytest.raises(TuningError, match="damaged"):
        HGA.from_state(state)
