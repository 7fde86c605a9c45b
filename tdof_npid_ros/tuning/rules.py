"""First gains by published rules, from a process model: somewhere to start from, before anything is tuned.

The rules speak of the ideal form u = k_c [e + 1/t_i ∫e + t_d de/dt]; the law's gains are kp = k_c, ki = k_c/t_i,
kd = k_c t_d. A negative process gain gives negative gains (reverse action).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tdof_npid_ros.tuning import TuningError

SIMC = "SIMC (Skogestad 2003, J. Process Control 13)"
IMC = "IMC (Rivera, Morari and Skogestad 1986, Ind. Eng. Chem. Process Des. Dev. 25)"
DE_PAOR = "De Paor and O'Malley (1989, Int. J. Control 49)"

FASTEST = 0.05  # of the largest time constant: the closed loop is not made faster, however short the dead time is
FASTEST_IN_SAMPLES = 5.0  # nor than so many sample periods
LONGEST_DEAD_TIME = 0.7  # of an unstable time constant; beyond it a PI controller has next to no margin


@dataclass(frozen=True)
class RuleGains:
    """Gains of the law's linear part.

    Attributes:
        rule: the name of the rule, with its source.
        kp, ki, kd: in effort/output, effort/(output s), effort s/output.
        closed_loop_time: the time constant that the closed loop is designed for, s; None where the rule has none.
    """

    rule: str
    kp: float
    ki: float
    kd: float
    closed_loop_time: float | None


def simc(
    gain: float,
    time_constants: Sequence[float],
    dead_time: float,
    *,
    zero: float = 0.0,
    integrating: bool = False,
    sample_period: float = 0.0,
    closed_loop_time: float | None = None,
) -> RuleGains:
    """Gains for gain · (zero s + 1)/Π(T s + 1) · exp(-dead_time s), with a further 1/s if it is integrating.

    Lags beyond the second go half to the second and half or whole to the dead time (the half rule). A zero with inverse
    response (zero < 0) goes to the dead time, another shortens the nearest lag. The closed loop's time constant is the
    dead time, as Skogestad advises for fast control, but no less than a twentieth of the largest lag and five samples.

    Args:
        gain: of the process, output/effort; of an integrating one output/(effort s).
        time_constants: s, each not negative, in any order.
        dead_time: s.
        zero: s.
        integrating: whether the process has a factor 1/s.
        sample_period: s; half of it counts as dead time.
        closed_loop_time: s, instead of the rule's choice.

    Raises:
        TuningError: a number out of its range, or nothing that a time constant of the closed loop could follow from.
    """
    _check(gain, (*time_constants, dead_time, sample_period))
    lags, gain = _without_zero(sorted(time_constants, reverse=True), zero, gain)
    delay = dead_time + max(-zero, 0.0) + 0.5 * sample_period
    first = math.inf if integrating else lags.pop(0) if lags else 0.0
    second = lags.pop(0) if lags else 0.0
    if lags:  # the half rule
        second, delay = second + lags[0] / 2.0, delay + lags[0] / 2.0 + sum(lags[1:])
    slowest = second if integrating else first
    wanted = closed_loop_time or max(delay, FASTEST * slowest, FASTEST_IN_SAMPLES * sample_period)
    horizon = wanted + delay
    if horizon <= 0.0:
        raise TuningError("a process without dead time or lag has no time for its closed loop: give closed_loop_time")
    if first == 0.0:  # a dead time alone: an integral controller
        return RuleGains(SIMC, 0.0, 1.0 / (gain * horizon), 0.0, wanted)
    series_gain = (1.0 if integrating else first) / (gain * horizon)
    integral_time = min(first, 4.0 * horizon)
    ideal = 1.0 + second / integral_time  # from the rule's series form to the ideal one
    return RuleGains(SIMC, series_gain * ideal, series_gain / integral_time, series_gain * second, wanted)


def imc_oscillating(
    gain: float,
    period: float,
    damping: float,
    dead_time: float,
    *,
    zero: float = 0.0,
    sample_period: float = 0.0,
    closed_loop_time: float | None = None,
) -> RuleGains:
    """Gains for gain · (zero s + 1)/(period² s² + 2 damping period s + 1) · exp(-dead_time s), damping below 1.

    Args:
        gain: of the process, output/effort.
        period: the inverse of the natural frequency, s (not 2π times it).
        damping: the damping ratio, above 0.
        dead_time, sample_period: s.
        zero: s; of either sign it counts as dead time: one with inverse response (zero < 0) delays, another makes the
            loop livelier than the rule expects.
        closed_loop_time: s, instead of the rule's choice.

    Raises:
        TuningError: a number out of its range.
    """
    _check(gain, (period, damping, dead_time, sample_period))
    if not period > 0 or not damping > 0:
        raise TuningError(f"period is {period} and damping {damping}: both must be above 0")
    delay = dead_time + abs(zero) + 0.5 * sample_period
    wanted = closed_loop_time or max(delay, 0.5 * period, FASTEST_IN_SAMPLES * sample_period)
    scale = 1.0 / (gain * (wanted + delay))
    return RuleGains(IMC, 2.0 * damping * period * scale, scale, period**2 * scale, wanted)


def unstable_first_order(
    gain: float, time_constant: float, dead_time: float, *, sample_period: float = 0.0
) -> RuleGains:
    """PI gains for gain/(time_constant s - 1) · exp(-dead_time s).

    Raises:
        TuningError: a number out of its range, or a dead time for which a PI controller has no margin left.
    """
    _check(gain, (time_constant, dead_time, sample_period))
    ratio = (dead_time + 0.5 * sample_period) / time_constant if time_constant > 0 else math.inf
    if ratio > LONGEST_DEAD_TIME:
        raise TuningError(
            f"dead time and half a sample are {ratio:.2g} of the unstable time constant {time_constant:g} s: beyond "
            f"{LONGEST_DEAD_TIME:g} a PI controller has next to no margin; shorten the dead time or the sample period"
        )
    ratio = max(ratio, 0.01)
    root, slope = math.sqrt((1.0 - ratio) * ratio), math.sqrt((1.0 - ratio) / ratio)
    kp = (math.cos(root) + slope * math.sin(root)) / gain
    phase = math.atan(slope) - root
    integral_time = time_constant / (slope * math.tan(0.75 * phase))
    return RuleGains(DE_PAOR, kp, kp / integral_time, 0.0, None)


def _without_zero(lags: list[float], zero: float, gain: float) -> tuple[list[float], float]:
    """Cancel a zero above 0 against the nearest larger lag, else the largest one (Skogestad's rules T1 and T3)."""
    if zero <= 0.0 or not lags:
        return lags, gain
    larger = [lag for lag in lags if lag >= zero]
    nearest = min(larger) if larger else lags[0]
    lags.remove(nearest)
    if not larger:
        return lags, gain * zero / nearest
    return sorted([*lags, nearest - zero], reverse=True), gain


def _check(gain: float, not_negative: Sequence[float]) -> None:
    if not math.isfinite(gain) or gain == 0.0:
        raise TuningError(f"gain is {gain}: it must be finite and not 0")
    for value in not_negative:
        if not 0.0 <= value < math.inf:
            raise TuningError(f"{value} s: times and damping must be finite and not negative")
