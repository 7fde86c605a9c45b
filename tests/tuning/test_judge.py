"""Which candidates may win: stable loops that come to rest and have the margins asked for, in this order."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.gains import ControllerType, gains_from_candidates
from tdof_npid_ros.loop import Integrals
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.judge import DIVERGED, LARGEST_TAIL, UNSTABLE, Constraints, Judge, tail
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem, candidate_of

# The best of a search that knew the first 60 s only: the loop's spectral radius is 1.00035.
UNSTABLE_IN_THE_END = [0.8366819494762695, 0.617872515857525, 0.580581397359785, 0.21422968553700478, 0.31947527218414]


def scored(case: str, kind: ControllerType, candidate: list[float], **options: Any) -> Scores:
    return Objective(TuningProblem(load_case(case), kind, **options))(np.array([candidate]))


def test_a_loop_that_is_unstable_only_after_the_episode_is_not_allowed() -> None:
    scores = scored("p3-c2", "tdof_npid2", UNSTABLE_IN_THE_END)
    assert scores.objective[0] < 9.6
    assert scores.violation[0] == UNSTABLE


def test_an_error_that_never_comes_to_rest_is_not_allowed() -> None:
    without_integral_action = scored("sprott", "pid", [1500.0, 0.0, 202.98])
    assert without_integral_action.objective[0] < 0.44
    assert without_integral_action.violation[0] > 1.0
    hardly_any = scored("sprott", "pid", [1500.0, 1e-100, 202.98])
    assert hardly_any.violation[0] > 1.0
    assert scored("sprott", "pid", [1150.0, 1500.0, 115.8]).violation[0] == 0.0


@pytest.mark.parametrize("case", ["p1-c4", "p3-c1"])
def test_what_comes_after_an_allowed_episode_is_below_its_bound(case: str) -> None:
    problem = TuningProblem(load_case(case), "tdof_npid2")
    later = {name: (lines[0], "600 end") for name, lines in problem.case.episodes.items()}
    longer = TuningProblem(replace(problem.case, episodes=later), "tdof_npid2")
    some = candidate_of(problem, problem.case.gains) * np.random.default_rng(1).uniform(0.3, 1.6, (60, 5))
    scores = Objective(problem)(some)
    allowed = scores.violation == 0.0
    assert 10 < np.count_nonzero(allowed) < 50
    more = Objective(longer)(some[allowed]).objective
    assert (more <= scores.objective[allowed] * (1.0 + LARGEST_TAIL)).all()


def rest(early: float, late: float, error: float, iae: float = 1.0) -> Integrals:
    return Integrals(*(np.array([value]) for value in (iae, 1.0, early, late, error)))


def test_without_a_model_the_outputs_alone_tell_how_the_error_decays() -> None:
    gains = load_case("p3-c1").gains
    assert tail(rest(0.2, 0.1, 0.2), 10.0, gains.per_lane("ki"), None)[0] == pytest.approx(0.1)  # 0.1, 0.05, 0.025, …
    assert tail(rest(0.1, 0.1, 0.02), 10.0, gains.per_lane("ki"), None)[0] == pytest.approx(9 * 10.0 * 0.02)  # it stays
    assert tail(rest(0.0, 0.0, 0.0), 10.0, gains.per_lane("ki"), None)[0] == 0.0


def test_the_worse_a_candidate_fails_the_later_it_comes() -> None:
    gains = gains_from_candidates(load_case("p3-c1").gains, ["kp"], np.ones((4, 1)))
    episode = Integrals(
        iae=np.ones(4),
        finite_fraction=np.array([1.0, 1.0, 0.9, 0.1]),
        early_rest_iae=np.array([0.2, 0.2, 0.2, 0.2]),
        late_rest_iae=np.array([1e-9, 0.2, 0.2, 0.2]),
        rest_error=np.array([1e-9, 0.1, 0.1, 0.1]),
    )
    scores = Judge(None, Constraints(), (10.0, 10.0), 1.0)(gains, np.ones(4), episode, episode)
    assert scores.violation[0] == 0.0
    assert (np.diff(scores.violation) > 0).all()
    assert scores.violation[2] > DIVERGED
    assert (np.diff(scores.values) > 0).all()
    assert scores.best == 0


def test_signals_that_move_to_the_end_are_not_asked_whether_they_rest() -> None:
    case = load_case("p3-c1")
    moving = replace(case, episodes={**case.episodes, "setpoint": ("0 setpoint sine 1 period 5 for 60", "60 end")})
    assert moving.signals["setpoint"].rest is None
    candidate = np.array([[1.2, 0.5, 1.0]])
    assert Objective(TuningProblem(moving, "pid"))(candidate).violation[0] == 0.0


def test_an_episode_in_which_the_limits_let_no_loop_rest_is_not_asked_whether_it_rests() -> None:
    case = load_case("p3-c1")
    heating_only = replace(case, effort_limits=(0.0, 5.0))
    problem = TuningProblem(heating_only, "pid")
    assert list(problem.restless) == ["disturbance"]
    assert "takes an effort of -1, beyond the limits 0 .. 5" in problem.restless["disturbance"]
    assert Objective(problem)(np.array([[1.2, 0.5, 1.0]])).violation[0] == 0.0
    assert TuningProblem(case, "pid").restless == {}


BOUNDS: dict[str, tuple[float, float]] = {
    "ms": (1.4, 3.0), "mt": (1.05, 3.0), "gain_margin": (1.5, 8.0), "phase_margin": (20.0, 80.0),
    "delay_margin": (0.01, 3.0),
}  # fmt: skip


@pytest.mark.parametrize("name", BOUNDS)
def test_a_margin_is_missed_exactly_by_loops_that_have_less(name: str) -> None:
    problem = TuningProblem(load_case("p1-c4"), "pid")
    some = np.array([[0.3 + 0.02 * i, 0.1 + 0.003 * i, 0.5] for i in range(60)])
    assert problem.screen is not None
    margins = problem.screen(gains_from_candidates(problem.base, problem.names, some))
    values: dict[str, Array] = {
        "ms": margins.m_s, "mt": margins.m_t, "phase_margin": np.degrees(margins.phase_margin),
        "gain_margin": margins.gain_margin, "delay_margin": margins.delay_margin,
    }  # fmt: skip
    stable = margins.stable
    limit = float(np.median(values[name][stable]))
    constraints = Constraints(**{name: limit})
    has_it = values[name] <= limit if name in ("ms", "mt") else values[name] >= limit
    excess = constraints.excess(margins)
    assert 0 < np.count_nonzero(has_it[stable]) < np.count_nonzero(stable)
    assert ((excess == 0.0) == has_it)[stable].all()
    lane = int(np.flatnonzero(stable & ~has_it)[0])
    chosen = problem.screen(problem.gains(some[lane]))
    assert name.replace("_", " ") in constraints.missed(chosen)[0]


@pytest.mark.parametrize(
    ("constraints", "told"),
    [
        ({"ms": 1.0}, "ms is 1: it must be above 1"),
        ({"mt": float("nan")}, "mt is nan"),
        ({"gain_margin": 0.5}, "gain_margin is 0.5"),
        ({"phase_margin": 180.0}, "below 180"),
        ({"delay_margin": -1.0}, "above 0 s"),
    ],
)
def test_margins_that_no_loop_has_are_refused(constraints: dict[str, float], told: str) -> None:
    with pytest.raises(TuningError, match=told):
        Constraints(**constraints)
