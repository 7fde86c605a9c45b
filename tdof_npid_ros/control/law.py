"""The paper's control law, sampled: equations (1) to (8) on one screen.

The law is one compiled scalar function, `law`; `answer_lanes` applies it to an array of lanes. The in-process loop,
the controller node and `verify` all step through it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tdof_npid_ros.compiled import compiled, entry_point
from tdof_npid_ros.control.exponential import exp_minus
from tdof_npid_ros.control.gains import LIMITS_PER_LANE, PER_LANE, Gains

# Rows of the coefficient array (COEFFICIENTS, lanes) that the compiled law reads.
(KP, KI_H, KD_H, PHI, ALPHA, BETA, HALF_INVERSE_SIGMA2, TRACKING) = range(8)
COEFFICIENTS = 8


# Arguments of compiled functions come in plain tuples: to hand over a named one takes a microsecond.
Limits = tuple[float, float, float, float]  # of one lane: of the effort, min and max, and of the integral action


@compiled
def law(c: Any, limits: Limits, conditional: float, unwinding: Any, r: float, y: float, u_i: float, z: float) -> Any:
    """One sample of the TDOF-NPID law. Returns u, u_i and z for the next sample, u before its limits, ζ, u_p, u_d.

    Args: the coefficients of one lane (see `coefficients`), its limits (see `limits_of`), the anti-windup (see
    `conditional_integration`), unwinding (see `unwinding_of`), r setpoint, y output, u_i integral action, z derivative
    filter's state.
    """
    kp, ki_h, kd_h, phi, alpha, beta, q, tracking = c
    u_min, u_max, i_min, i_max = limits
    e = r - y
    zeta = exp_minus(e * e * q) * e  # (3), (4)
    if unwinding is not None and unwinding * (ki_h * e) * u_i < 0.0:  # beyond the paper: unwinding is not scaled down
        zeta = e
    u_p = kp * ((1.0 - alpha) * r - y)  # (7)
    e_d = (1.0 - beta) * r - y
    u_d = kd_h * (e_d - z)  # (1b), its mean over the coming sample
    raw = u_p + u_i + u_d
    u = min(max(raw, u_min), u_max)

    step = ki_h * zeta  # (2), (5b)
    if u != raw:  # anti-windup
        windup = conditional * (raw - u) * step > 0.0
        step = (0.0 if windup else step) + tracking * (u - raw)
    u_i = min(max(u_i + step, i_min), i_max)
    z = e_d + phi * (z - e_d)
    return u, u_i, z, raw, zeta, u_p, u_d


@compiled
def lane_coefficients(c: Any, j: Any, lanes: Any) -> Any:
    """The coefficients of lane j as a tuple, from the flat coefficient array."""
    return (c[j], c[lanes + j], c[2 * lanes + j], c[3 * lanes + j],
            c[4 * lanes + j], c[5 * lanes + j], c[6 * lanes + j], c[7 * lanes + j])  # fmt: skip


@entry_point
def answer_lanes(
    c: np.ndarray,
    limits: Limits,
    conditional: float,
    unwinding: float,
    low: np.ndarray,
    high: np.ndarray,
    r: np.ndarray,
    y: np.ndarray,
    state: np.ndarray,
    u: np.ndarray,
    terms: np.ndarray,
) -> None:
    """One sample of every lane.

    Args:
        c: coefficients, flat (COEFFICIENTS * lanes,); limits: see `limits_of`.
        conditional: see `conditional_integration`; unwinding: 1.0 or 0.0, see `unwinding_of`.
        low, high: limits of the effort at this sample, in place of those in `limits`, (lanes,).
        r, y: setpoint and output, (lanes,).
        state: integral action and derivative filter's state, (2, lanes); advanced in place.
        u: effort, (lanes,); written.
        terms: error, scaled error, proportional, integral, derivative and unlimited effort, (6, lanes); written.
    """
    lanes = y.shape[0]
    _, _, i_min, i_max = limits
    for j in range(lanes):
        u_i = state[0, j]
        u[j], state[0, j], state[1, j], raw, zeta, u_p, u_d = law(
            lane_coefficients(c, j, lanes),
            (low[j], high[j], i_min, i_max),
            conditional,
            unwinding,
            r[j],
            y[j],
            u_i,
            state[1, j],
        )
        terms[0, j] = r[j] - y[j]
        terms[1, j] = zeta
        terms[2, j] = u_p
        terms[3, j] = u_i
        terms[4, j] = u_d
        terms[5, j] = raw


@entry_point
def any_at_limit(u: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether the effort of a lane, (lanes,), is at its limits or beyond."""
    for j in range(u.shape[0]):  # noqa: SIM110  compiled
        if not low[j] < u[j] < high[j]:
            return True
    return False


TERMS = ("error", "scaled_error", "proportional", "integral", "derivative", "unlimited_effort")


@entry_point
def _exp_minus(q: np.ndarray) -> np.ndarray:
    out = np.empty_like(q)
    for j in range(q.shape[0]):
        out[j] = exp_minus(q[j])
    return out


def exp_minus_of(q: float) -> float:
    """exp(-q), q >= 0, with the bits of the compiled law."""
    return float(_exp_minus(np.array([q]))[0])


def coefficients(gains: Gains, sample_period: float) -> np.ndarray:
    """What the compiled law reads for gains sampled every `sample_period` seconds, (COEFFICIENTS, lanes)."""
    lanes, h = gains.lanes, sample_period
    kp, ki, kd, alpha, beta, sigma = (gains.per_lane(name) for name in PER_LANE)
    c = np.zeros((COEFFICIENTS, lanes))
    c[KP] = kp
    c[KI_H] = h * ki
    # T_f = K_d/(K_p N); without derivative action it is 0 and the filter follows at once.
    with np.errstate(over="ignore"):  # a rate that is infinite is a filter that follows at once
        rate = h * np.divide(kp * gains.n, kd, out=np.full(lanes, np.inf), where=kd != 0)
    c[PHI] = _exp_minus(rate)
    c[KD_H] = kd / h * (1.0 - c[PHI])
    if gains.type in ("tdof_npid1", "tdof_npid2"):
        c[ALPHA] = alpha
    if gains.type == "tdof_npid2":
        c[BETA] = beta
    if gains.type != "pid":
        c[HALF_INVERSE_SIGMA2] = 1.0 / (2.0 * sigma * sigma)
    if gains.anti_windup == "back_calculation":
        with np.errstate(over="ignore"):
            c[TRACKING] = 1.0 - _exp_minus(h / tracking_time(gains))
    return c


def limits_of(gains: Gains, lane: int = 0) -> Limits:
    """The limits of one lane, as the compiled law reads them."""
    low, high = (float(gains.per_lane(name)[lane]) for name in LIMITS_PER_LANE)
    return low, high, gains.integral_min, gains.integral_max


def conditional_integration(gains: Gains) -> float:
    """1.0: while the effort is at a limit, the integral action makes no step that would wind it up; 0.0: it does.

    Back-calculation is in the coefficients, for it depends on the sample period.
    """
    return float(gains.anti_windup == "conditional")


def unwinding_of(gains: Gains) -> float | None:
    """1.0: the error is not scaled down where its integral makes the integral action smaller; None: it always is.

    None is left out when the law is compiled: the paper's law has the machine code that it would have without this.
    """
    return 1.0 if gains.full_unwinding else None


def settled(c: np.ndarray, gains: Gains, r: np.ndarray, y: np.ndarray, applied: np.ndarray) -> np.ndarray:
    """The law's state, (2, lanes): integral action and derivative filter, that rests at r and y with effort `applied`.

    Lanes without integral gain have no integral action: they could never leave it again.

    Args:
        c: coefficients, (COEFFICIENTS, lanes).
        r, y, applied: setpoint, output and effort at rest, (lanes,).
    """
    wanted = applied - c[KP] * ((1.0 - c[ALPHA]) * r - y)
    integral = np.where(c[KI_H] != 0, np.clip(wanted, gains.integral_min, gains.integral_max), 0.0)
    return np.stack([integral, (1.0 - c[BETA]) * r - y])


def tracking_time(gains: Gains) -> np.ndarray:
    """Back-calculation's tracking time in s, (lanes,): as given, or sqrt(kd/ki), or kp/ki without derivative action.

    The automatic choice is that of control_toolbox. Without integral action there is nothing to track: infinite.
    """
    kp, ki, kd = (gains.per_lane(name) for name in ("kp", "ki", "kd"))
    with np.errstate(divide="ignore", invalid="ignore"):
        automatic = np.where(kd != 0, np.sqrt(np.abs(kd / ki)), np.abs(kp / ki))
    time = gains.tracking_time or np.where(automatic == 0, np.finfo(float).tiny, automatic)
    return np.where(ki == 0, np.inf, time)
