"""How slowly a nonlinear integral action brings a large error down, and how fast a ramp it can follow."""

from __future__ import annotations

import math

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.stability.plant import loop_plant

INTEGRAL_PEAK = math.exp(-0.5)  # the largest value of exp(-e²/2σ²) e, in σ: at |e| = σ
ACCURATE_FROM = 3.0  # σ: from there on the creep time is right to some 4 %


def creep_time(before: float, after: float, sigma: float, tau: float, re_g_zero: float) -> float:
    """How long the error takes to creep from one value to a smaller one, in s.

    τ {½ [Ei(e₀²/2σ²) - Ei(e₁²/2σ²)] + |Re G(0)| ln[ψ(e₁)/ψ(e₀)]}: within some 4 % from 3 σ on.

    Args:
        before, after: the errors' absolute values, `before` the larger one, above 0; in y, as sigma.
        tau: 1/(K_i Q(1)), in s: how fast a small error dies out that only the integral action brings down.
        re_g_zero: Re G for ω → 0.

    Returns:
        Infinite where it is beyond the range of floats.

    Example:
        >>> round(creep_time(5.0, 1.0, 1.0, 1.0, -0.5) / 1000)  # 5 σ take 12,000 τ
        12
    """
    from scipy.special import expi

    x, y = (0.5 * (e / sigma) ** 2 for e in (before, after))
    scaled = math.log(after / before) - y + x  # of ψ(e₁)/ψ(e₀), as a logarithm
    return float(tau * (0.5 * (expi(x) - expi(y)) + abs(re_g_zero) * scaled))


def time_to_expect(case: Case, gains: Gains, lane: int, error: float) -> float | None:
    """How long an error takes until the integral action alone has brought it down to sigma, in s, within some 15 %.

    None where that is beyond the range of floats, or where the plant is not linear.

    Args:
        error: of the lane, in y.
    """
    if not isinstance(case.plant, TransferFunction):
        return None
    kp, ki, sigma = (float(gains.per_lane(name)[lane]) for name in ("kp", "ki", "sigma"))
    tau = abs((1.0 / loop_plant(case).gain + kp) / ki)
    time = creep_time(abs(error), sigma, sigma, tau, 0.0)
    return time if math.isfinite(time) else None


def fastest_disturbance_ramp(ki: float, sigma: float) -> float:
    """The fastest ramp of the disturbance that the integral action can follow, in u/s."""
    return INTEGRAL_PEAK * abs(ki) * sigma


def fastest_setpoint_ramp(ki: float, sigma: float, kp: float, alpha: float, gain: float) -> float:
    """The fastest ramp of the setpoint that the integral action can follow, in y/s; infinite if it need not move.

    Args:
        gain: the plant's K; infinite for an integrating plant.
    """
    needed = abs(1.0 / gain + alpha * kp)
    return INTEGRAL_PEAK * abs(ki) * sigma / needed if needed else math.inf


def error_left(setpoint_step: float, kp: float, alpha: float, gain: float) -> float:
    """What the PD loop leaves of a step of the setpoint for the integral action to bring down, in y: absolute value.

    (1 + α K K_p)/(1 + K K_p) of the step.
    """
    return abs((1.0 / gain + alpha * kp) / (1.0 / gain + kp) * setpoint_step)
