"""Metrics say what the paper's section 4 says, and never make up a time."""

import numpy as np
import pytest

from tdof_npid_ros.metrics import NO_BAND, disturbance_metrics, integral_absolute_error, setpoint_metrics

H = 0.01
T = np.arange(0, 20 + H / 2, H)


def test_a_second_order_response_has_its_textbook_metrics() -> None:
    damping, frequency = 0.4, 2.0
    damped = frequency * np.sqrt(1 - damping**2)
    y = 1 - np.exp(-damping * frequency * T) * (
        np.cos(damped * T) + damping / np.sqrt(1 - damping**2) * np.sin(damped * T)
    )
    metrics = setpoint_metrics(y, 0.0, 1.0, H)
    assert metrics.overshoot_percent == pytest.approx(
        100 * np.exp(-np.pi * damping / np.sqrt(1 - damping**2)), abs=0.01
    )
    last_outside = T[np.abs(y - 1) > 0.05][-1]
    assert metrics.settling_time_s == pytest.approx(last_outside + H)


def test_the_integral_is_the_trapezoidal_rule() -> None:
    y = np.exp(-T)
    assert integral_absolute_error(np.zeros_like(y), y, H) == pytest.approx(np.trapezoid(y, T), rel=1e-13)


def test_a_step_down_is_measured_like_a_step_up() -> None:
    y = 1 - np.exp(-T) * np.cos(3 * T)
    up, down = setpoint_metrics(y, 0.0, 1.0, H), setpoint_metrics(5 - 2 * y, 5.0, 3.0, H)
    assert down.overshoot_percent == pytest.approx(up.overshoot_percent)
    assert down.settling_time_s == up.settling_time_s


@pytest.mark.parametrize("y", [np.sin(3 * T), np.zeros_like(T), 1 + 0.06 * np.sin(10 * T)])
def test_a_response_that_never_settles_has_no_settling_time_but_a_reason(y: np.ndarray) -> None:
    metrics = setpoint_metrics(y, 0.0, 1.0, H)
    assert metrics.settling_time_s is None
    assert metrics.reason and "does not settle" in metrics.reason


def test_a_deviation_that_never_recovers_has_no_recovery_time_but_a_reason() -> None:
    metrics = disturbance_metrics(np.full(T.shape, 0.5), 0.0, H)
    assert (metrics.peak, metrics.recovery_time_s) == (0.5, None)
    assert metrics.reason and "does not recover" in metrics.reason


def test_recovery_counts_from_the_onset_to_the_last_exit_of_the_band() -> None:
    metrics = disturbance_metrics(0.3 * np.exp(-T), 0.0, H)
    assert metrics.recovery_time_s == pytest.approx(np.log(0.3 / 0.02), abs=2 * H)
    small = disturbance_metrics(0.01 * np.exp(-T), 0.0, H)
    assert small.recovery_time_s == 0.0
    assert small.reason and "never left" in small.reason


def test_one_sample_has_no_area() -> None:
    assert integral_absolute_error(np.array([1.0]), np.array([0.0]), H) == 0.0


def test_without_a_known_step_there_is_no_band_to_recover_to() -> None:
    for unknown in (None, 0.0):
        metrics = disturbance_metrics(0.3 * np.exp(-T), 0.0, H, unknown)
        assert (metrics.peak, metrics.recovery_time_s, metrics.reason) == (0.3, None, NO_BAND)


def test_an_angle_is_measured_the_way_that_it_goes() -> None:
    y = 1 - np.exp(-T) * np.cos(3 * T)
    plain = setpoint_metrics(y, 0.0, 1.0, H)
    for before, after, way in ((3.0, -3.0, 2 * np.pi - 6), (-3.0, 3.0, 6 - 2 * np.pi), (0.5, 1.0, 0.5)):
        angle = (before + way * y + np.pi) % (2 * np.pi) - np.pi
        turned = setpoint_metrics(angle, before, after, H, 2 * np.pi)
        assert turned.overshoot_percent == pytest.approx(plain.overshoot_percent)
        assert turned.settling_time_s == plain.settling_time_s
        assert turned.iae == pytest.approx(abs(way) * plain.iae)


def test_a_loop_that_takes_the_longer_way_round_does_not_overshoot_by_it() -> None:
    """A step of 3.1 rad that begins with a little kick backwards, and goes on that way."""
    y = (-(2 * np.pi - 3.1) * (1 - np.exp(-T)) + np.pi) % (2 * np.pi) - np.pi
    metrics = setpoint_metrics(y, 0.0, 3.1, H, 2 * np.pi)
    assert metrics.overshoot_percent < 0.01 and metrics.settling_time_s is not None


def test_a_disturbed_angle_deviates_by_the_shorter_way() -> None:
    y = (3.0 + 0.5 * T * np.exp(-T) + np.pi) % (2 * np.pi) - np.pi
    metrics = disturbance_metrics(y, 3.0, H, 1.0, 2 * np.pi)
    assert metrics.peak == pytest.approx(0.5 / np.e, rel=1e-3) and metrics.recovery_time_s is not None
