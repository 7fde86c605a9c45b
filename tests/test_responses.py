"""What counts as a step, and which one is the largest."""

import numpy as np
import pytest

from tdof_npid_ros.responses import Lane, largest_move, responses
from tdof_npid_ros.scenario import parse_plan

PERIOD_NS = 10_000_000
N = 1001
TIME = np.arange(N) * 0.01


def lane(setpoint: np.ndarray, output: np.ndarray, disturbance: np.ndarray | None = None, **facts: object) -> Lane:
    none = np.zeros(len(setpoint)) if disturbance is None else disturbance
    return Lane(0.01, TIME[: len(setpoint)], setpoint, none, output, **facts)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("lines", "start", "size"),
    [
        (["0 setpoint 1", "10 end"], 0.0, 1.0),
        (["0 setpoint 1.5", "10 end"], 1.0, 0.5),
        (["0 setpoint 60", "2 setpoint 70", "3 setpoint 50", "10 end"], 60.0, 20.0),
        (["0 setpoint ramp 2 over 5", "10 end"], 0.0, 2.0),
        (["1 setpoint sine 0.5 period 2 for 4", "10 end"], 0.0, 0.5),
        (["0 disturbance 1", "10 end"], 0.0, 0.0),
    ],
)
def test_the_largest_step_of_a_plan(lines, start, size) -> None:
    setpoint = parse_plan(lines, PERIOD_NS).sampled(PERIOD_NS).setpoint
    assert largest_move(setpoint, start) == pytest.approx(size, rel=1e-3)


def test_the_largest_step_of_angles_is_the_shorter_way() -> None:
    assert largest_move(np.array([3.0, 3.0, -3.0]), 3.0, 2 * np.pi) == pytest.approx(2 * np.pi - 6)


def test_a_disturbance_while_the_setpoint_stands_is_a_disturbance() -> None:
    disturbance = np.where(TIME >= 5, 1.0, 0.0)
    (response,) = responses(lane(np.full(N, 60.0), np.full(N, 60.0), disturbance, largest_step=1.0))
    assert (response.kind, response.start_s) == ("disturbance", 5.0)
    at_once = responses(lane(np.full(N, 60.0), np.full(N, 60.0), np.ones(N), largest_step=1.0))
    assert [r.kind for r in at_once] == ["disturbance"]


def test_a_first_setpoint_is_a_step_from_the_output() -> None:
    y = 1.5 - 0.5 * np.exp(-TIME)
    (response,) = responses(lane(np.full(N, 1.5), y))
    assert response.kind == "setpoint" and response.metrics is not None
    assert response.metrics.iae == pytest.approx(0.5, rel=0.01)


def test_a_disturbance_s_sine_is_a_path() -> None:
    disturbance = np.where(TIME >= 2, np.sin(TIME - 2), 0.0)
    (response,) = responses(lane(np.zeros(N), np.zeros(N), disturbance))
    assert response.kind == "tracking"


def test_more_steps_than_a_table_shows_are_a_path() -> None:
    square = np.sign(np.sin(2 * np.pi * TIME * 2 + 0.1))
    assert [r.kind for r in responses(lane(square, square))] == ["tracking"]


def test_two_steps_close_together_are_two() -> None:
    setpoint = np.where(TIME >= 2.03, 3.0, np.where(TIME >= 2, 1.0, 0.0))
    first, second = responses(lane(setpoint, np.zeros(N)))
    assert (first.start_s, first.end_s, second.start_s) == pytest.approx((2.0, 2.03, 2.03))
    seen = responses(lane(setpoint, np.zeros(N), seen_late=True))[0].end_s
    assert seen == pytest.approx(2.02)


def test_a_change_at_the_last_sample_has_no_response() -> None:
    setpoint = np.zeros(N)
    setpoint[-1] = 1.0
    assert [r.kind for r in responses(lane(setpoint, np.zeros(N)))] == ["tracking"]


def test_noise_on_the_first_output_is_no_step_of_the_setpoint() -> None:
    noisy = 0.02 * np.random.default_rng(1).standard_normal(N)
    (response,) = responses(lane(np.zeros(N), noisy, np.ones(N), largest_step=1.0, begins=0.0))
    assert response.kind == "disturbance"
    (response,) = responses(lane(np.ones(N), 1.0 - np.exp(-TIME) + 10.0 * noisy, begins=0.0))
    assert response.kind == "setpoint"


def test_a_path_s_error_ends_before_the_step_that_follows() -> None:
    setpoint = np.clip(TIME, 0.0, 1.0) + np.where(TIME >= 5.0, 2.0, 0.0)
    tracking, step = responses(lane(setpoint, np.clip(TIME, 0.0, 1.0)))
    assert (tracking.kind, step.kind) == ("tracking", "setpoint")
    assert tracking.iae == pytest.approx(0.0, abs=1e-12)
