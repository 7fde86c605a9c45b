"""The latest step of the setpoint, and gains to go back to: what the page shows, without a page."""

from __future__ import annotations

import numpy as np
import pytest

from tdof_npid_ros.live.gain_history import GainHistory
from tdof_npid_ros.live.step import MOST, Steps

PERIOD = 0.01


def fed(
    steps: Steps, setpoint: float, seconds: float, start: float = 0.0, level: float = 0.0, episode: int = 0
) -> None:
    """An output that follows a step from `level`, which has stood, with a time constant of 0.2 s."""
    if steps.latest is None:
        steps.take(start - PERIOD, episode, level, level)
    for t in np.arange(0.0, seconds, PERIOD):
        steps.take(start + t, episode, setpoint, level + (setpoint - level) * (1.0 - np.exp(-t / 0.2)))


def test_a_step_is_measured_from_the_setpoint_before() -> None:
    steps = Steps()
    fed(steps, 1.0, 3.0)
    fed(steps, 3.0, 3.0, start=3.0, level=1.0)
    assert steps.latest is not None and (steps.latest.before, steps.latest.after) == (1.0, 3.0)
    assert steps.previous is not None and steps.previous.after == 1.0
    measured = steps.latest.metrics(PERIOD)
    assert measured is not None
    assert measured.overshoot_percent == pytest.approx(0.0, abs=0.1)
    assert measured.settling_time_s == pytest.approx(0.6, abs=0.02)
    assert measured.iae == pytest.approx(0.4, abs=0.01)


def test_a_new_episode_steps_from_its_output() -> None:
    steps = Steps()
    fed(steps, 1.0, 1.0)
    fed(steps, 1.0, 1.0, start=1.0, level=0.5, episode=1)
    assert steps.latest is not None and steps.latest.before == 0.5


def test_a_loop_that_is_joined_on_its_way_shows_no_step_that_was_not_seen() -> None:
    steps = Steps()
    for k in range(100):
        steps.take(k * PERIOD, 0, 2.0, 1.5)
    assert steps.latest is None


def test_a_setpoint_that_stays_is_no_step() -> None:
    steps = Steps()
    for k in range(100):
        steps.take(k * PERIOD, 0, 2.0, 2.0)
    assert steps.latest is None


def test_a_long_step_stays_small() -> None:
    steps = Steps()
    fed(steps, 1.0, 3 * MOST * PERIOD)
    assert steps.latest is not None and len(steps.latest.time) < MOST
    assert steps.latest.time[-1] == pytest.approx(3 * MOST * PERIOD, rel=0.01)
    measured = steps.latest.metrics(PERIOD * steps.stride)
    assert measured is not None and measured.settling_time_s == pytest.approx(0.6, abs=0.1)


def test_gains_are_undone_and_redone_and_a_new_one_forgets_what_was_undone() -> None:
    history = GainHistory({"kp": 1.0})
    history.note({"kp": 2.0})
    history.note({"kp": 2.0})
    history.note({"kp": 3.0})
    assert [history.undo(), history.undo(), history.undo()] == [{"kp": 2.0}, {"kp": 1.0}, None]
    history.note({"kp": 9.0})
    assert history.redo() is None and history.undo() == {"kp": 1.0}
