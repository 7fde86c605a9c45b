"""The paper's measures of a response (section 4), from sampled arrays.

With `turn` above 0, setpoint and output are angles: a difference is the shorter way round a circle of `turn`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

SETTLING_BAND = 0.05  # of the setpoint step
RECOVERY_BAND = 0.02  # of the setpoint step
CONFIRMED_FRACTION = 0.05  # of the response, at its end: it is settled once it has stayed in its band this long
NO_BAND = f"no setpoint step is known that the {100 * RECOVERY_BAND:g} % band would be a fraction of"


def in_units(value: float) -> str:
    """A metric that bears a unit, for people: four decimals, or four digits where the unit is too large or too small.

    >>> in_units(33.39061), in_units(2e-8), in_units(1.25e9), in_units(0.0)
    ('33.3906', '2e-08', '1.25e+09', '0.0000')
    """
    return f"{value:.4f}" if value == 0.0 or 1e-3 <= abs(value) < 1e6 else f"{value:.4g}"


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


@dataclass(frozen=True)
class EffortUse:
    """What one lane's control costs; None where there is no effort, or its limits are not known.

    Attributes:
        total_variation: sum of |u[k+1] - u[k]|.
        peak: largest |u|.
        saturated_share: fraction of the samples at a limit.
    """

    total_variation: float | None
    peak: float | None
    saturated_share: float | None


def effort_use(effort: np.ndarray, limits: tuple[float, float] | None) -> EffortUse:
    """What an effort of shape (samples,) costs.

    Args:
        limits: the tightest that act on it; None: not known.
    """
    if not effort.size:
        return EffortUse(None, None, None)
    at_limit = None if limits is None else float(np.mean((effort <= limits[0]) | (effort >= limits[1])))
    return EffortUse(float(np.abs(np.diff(effort)).sum()), float(np.abs(effort).max()), at_limit)


def difference(a: np.ndarray | float, b: np.ndarray | float, turn: float = 0.0) -> np.ndarray:
    """a - b, as angles within half a turn."""
    plain = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    return plain - turn * np.floor(plain / turn + 0.5) if turn > 0 else plain


def integral_absolute_error(setpoint: np.ndarray, output: np.ndarray, sample_period: float, turn: float = 0.0) -> float:
    """IAE (9) by the trapezoidal rule; setpoint and output of shape (steps,), in the output's unit; result in
    unit·s, 0 for a single sample."""
    error = np.abs(difference(setpoint, output, turn))
    if error.size < 2:
        return 0.0
    error[0] *= 0.5
    error[-1] *= 0.5
    return float(np.cumsum(error)[-1] * sample_period)  # summed in the order of time, as the closed loop does


def setpoint_metrics(
    output: np.ndarray, before: float, after: float, sample_period: float, turn: float = 0.0
) -> SetpointMetrics:
    """Metrics of the response `output` (steps,) to a setpoint step from `before` to `after` at its first sample.

    Raises:
        ValueError: there is no step.
    """
    size = float(difference(after, before, turn))
    if size == 0:
        raise ValueError("the setpoint does not step: a setpoint response needs before != after")
    beyond = _beyond_the_target(output, before, size, turn) if turn > 0 else (output - after) / size
    overshoot = max(0.0, float(np.max(beyond)) * 100.0)
    outside = np.abs(difference(output, after, turn)) > SETTLING_BAND * abs(size)
    settling, reason = _last_outside(outside, sample_period, "settle", "5")
    iae = integral_absolute_error(np.full(output.shape, after), output, sample_period, turn)
    return SetpointMetrics(overshoot, settling, iae, reason)


def disturbance_metrics(
    output: np.ndarray, setpoint: float, sample_period: float, setpoint_step: float | None = 1.0, turn: float = 0.0
) -> DisturbanceMetrics:
    """Metrics of the response `output` (steps,) to a disturbance from its first sample on, the setpoint held.

    Args:
        setpoint_step: what the recovery band is a fraction of; None: not known, so there is no recovery time.
    """
    deviation = np.abs(difference(output, setpoint, turn))
    iae = integral_absolute_error(np.full(output.shape, setpoint), output, sample_period, turn)
    if not setpoint_step:
        return DisturbanceMetrics(float(deviation.max()), None, iae, NO_BAND)
    band = RECOVERY_BAND * abs(setpoint_step)
    recovery, reason = _last_outside(deviation > band, sample_period, "recover", "2")
    if reason is None and recovery == 0.0:
        reason = f"the deviation never left the {100 * RECOVERY_BAND:g} % band (±{band:g})"
    return DisturbanceMetrics(float(deviation.max()), recovery, iae, reason)


def _beyond_the_target(output: np.ndarray, before: float, size: float, turn: float) -> np.ndarray:
    """How far an angle is beyond the setpoint, as a fraction of the step, along the way that it went.

    A loop may go the longer way round; then that is the way to measure.
    """
    steps = difference(output, np.concatenate([[before], output[:-1]]), turn)
    way = np.cumsum(steps)
    other = size - math.copysign(turn, size)
    there, round_ = (np.flatnonzero(way * np.sign(target) >= abs(target)) for target in (size, other))
    target = other if round_.size and (not there.size or round_[0] < there[0]) else size
    return (way - target) / target


def _last_outside(outside: np.ndarray, period: float, verb: str, band: str) -> tuple[float | None, str | None]:
    """The time from which on the response stays inside its band."""
    last = np.flatnonzero(outside)
    if last.size == 0:
        return 0.0, None
    if last[-1] >= (1 - CONFIRMED_FRACTION) * (outside.size - 1):
        return None, (
            f"does not {verb}: outside the {band} % band {last[-1] * period:g} s after the step, "
            f"too near the response's end ({(outside.size - 1) * period:g} s)"
        )
    return float((last[-1] + 1) * period), None
