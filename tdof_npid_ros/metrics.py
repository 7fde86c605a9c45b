"""The paper's measures of a response (section 4), from sampled arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SETTLING_BAND = 0.05  # of the setpoint step
RECOVERY_BAND = 0.02  # of the setpoint step
CONFIRMED_SHARE = 0.05  # of the episode, at its end: a response is settled once it has stayed in its band this long


@dataclass(frozen=True)
class SetpointMetrics:
    """A response to a setpoint step; times from the step on. `None` where there is no such time, with the reason."""

    overshoot_percent: float
    settling_time_s: float | None
    iae: float
    reason: str | None = None


@dataclass(frozen=True)
class DisturbanceMetrics:
    """A response to a disturbance; times from its onset on. `None` where there is no such time, with the reason."""

    peak: float
    recovery_time_s: float | None
    iae: float
    reason: str | None = None


def integral_absolute_error(setpoint: np.ndarray, output: np.ndarray, sample_period: float) -> float:
    """IAE (9) by the trapezoidal rule; setpoint and output of shape (steps,), in the output's unit; result in
    unit·s."""
    error = np.abs(setpoint - output)
    error[0] *= 0.5
    error[-1] *= 0.5
    return float(np.cumsum(error)[-1] * sample_period)  # summed in the order of time, as the closed loop does


def setpoint_metrics(output: np.ndarray, before: float, after: float, sample_period: float) -> SetpointMetrics:
    """Metrics of the response `output` (steps,) to a setpoint step from `before` to `after` at its first sample.

    Raises:
        ValueError: there is no step.
    """
    size = after - before
    if size == 0:
        raise ValueError("the setpoint does not step: a setpoint response needs before != after")
    overshoot = max(0.0, float(np.max((output - after) / size)) * 100.0)
    settling, reason = _last_outside(np.abs(output - after) > SETTLING_BAND * abs(size), sample_period, "settle", "5")
    return SetpointMetrics(
        overshoot, settling, integral_absolute_error(np.full(output.shape, after), output, sample_period), reason
    )


def disturbance_metrics(
    output: np.ndarray, setpoint: float, sample_period: float, setpoint_step: float = 1.0
) -> DisturbanceMetrics:
    """Metrics of the response `output` (steps,) to a disturbance from its first sample on, the setpoint held."""
    deviation = np.abs(output - setpoint)
    band = RECOVERY_BAND * abs(setpoint_step)
    recovery, reason = _last_outside(deviation > band, sample_period, "recover", "2")
    if reason is None and recovery == 0.0:
        reason = f"the deviation never left the 2 % band (±{band:g})"
    iae = integral_absolute_error(np.full(output.shape, setpoint), output, sample_period)
    return DisturbanceMetrics(float(deviation.max()), recovery, iae, reason)


def _last_outside(outside: np.ndarray, period: float, verb: str, band: str) -> tuple[float | None, str | None]:
    """The time from which on the response stays inside its band."""
    last = np.flatnonzero(outside)
    if last.size == 0:
        return 0.0, None
    if last[-1] >= (1 - CONFIRMED_SHARE) * (outside.size - 1):
        return None, (
            f"does not {verb}: outside the {band} % band {last[-1] * period:g} s after the step, "
            f"too near the episode's end ({(outside.size - 1) * period:g} s)"
        )
    return float((last[-1] + 1) * period), None
