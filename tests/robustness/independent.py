"""A loop of a first- to third-order plant by SciPy and plain NumPy: none of the project's numerics, for comparison."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm
from scipy.signal import cont2discrete

from tdof_npid_ros.control.gains import Gains


def discretised(numerator: list[float], denominator: list[float], dead_time: float, h: float):  # type: ignore[no-untyped-def]
    """Phi, B of the older and of the newer input, C, and the whole samples of the dead time."""
    from scipy.signal import tf2ss

    a, b, c, _ = tf2ss(numerator, denominator)
    delay = int(np.floor(dead_time / h + 1e-9))
    late = max(0.0, dead_time - delay * h)
    late = 0.0 if late < 1e-9 * h else late
    phi, whole, *_ = cont2discrete((a, b, c, np.zeros((1, 1))), h)
    new = cont2discrete((a, b, c, np.zeros((1, 1))), h - late)[1]
    old = expm(a * (h - late)) @ cont2discrete((a, b, c, np.zeros((1, 1))), late)[1] if late else 0.0 * whole
    return phi, old[:, 0], new[:, 0], c[0], delay


def law_constants(gains: Gains, h: float):  # type: ignore[no-untyped-def]
    kp, ki, kd, alpha, beta, sigma = (float(getattr(gains, n)) for n in ("kp", "ki", "kd", "alpha", "beta", "sigma"))
    phi = np.exp(-h * kp * gains.n / kd) if kd else 0.0
    return kp, ki * h, kd / h * (1.0 - phi) if kd else 0.0, phi, alpha, beta, sigma


def simulated(plant, gains: Gains, h: float, r: float, d: float, steps: int) -> np.ndarray:  # type: ignore[no-untyped-def]
    """The output, (steps + 1,)."""
    phi_p, old, new, c, delay = plant
    kp, ki_h, kd_h, phi, alpha, beta, sigma = law_constants(gains, h)
    x, u_i, z, sent, outputs = np.zeros(len(c)), 0.0, 0.0, [0.0] * (delay + 1), []
    for _ in range(steps + 1):
        y = float(c @ x)
        outputs.append(y)
        e, e_d = r - y, (1.0 - beta) * r - y
        u = kp * ((1.0 - alpha) * r - y) + u_i + kd_h * (e_d - z)
        u_i += ki_h * np.exp(-e * e / (2.0 * sigma**2)) * e
        z = e_d + phi * (z - e_d)
        sent.append(u + d)
        x = phi_p @ x + old * sent[-2 - delay] + new * sent[-1 - delay]
    return np.array(outputs)


def is_unstable(plant, gains: Gains, h: float) -> bool:  # type: ignore[no-untyped-def]
    """By the eigenvalues of the whole loop near the setpoint: plant, integral action, filter, efforts on their way."""
    phi_p, old, new, c, delay = plant
    kp, ki_h, kd_h, phi, *_ = law_constants(gains, h)
    n = len(c)
    size = n + 2 + delay + 1  # x, u_i, z, and the inputs of the last delay + 1 samples, newest first
    m = np.zeros((size, size))
    effort = np.zeros(size)
    effort[:n], effort[n], effort[n + 1] = -(kp + kd_h) * c, 1.0, -kd_h
    m[:n, :n] = phi_p
    m[:n, n + 2 + delay] += old
    if delay:
        m[:n, n + 1 + delay] += new
    else:
        m[:n] += np.outer(new, effort)
    m[n, :n], m[n, n] = -ki_h * c, 1.0
    m[n + 1, :n], m[n + 1, n + 1] = -(1.0 - phi) * c, phi
    m[n + 2] = effort
    for i in range(delay):
        m[n + 3 + i, n + 2 + i] = 1.0
    return bool(np.abs(np.linalg.eigvals(m)).max() >= 1.0)


def setpoint_metrics(y: np.ndarray, h: float) -> tuple[float, float, float]:
    """Overshoot in per cent, settling time and IAE of a unit step."""
    outside = np.flatnonzero(np.abs(y - 1.0) > 0.05)
    settled = 0.0 if not outside.size else (outside[-1] + 1) * h
    if outside.size and outside[-1] >= 0.95 * (len(y) - 1):
        settled = np.inf
    return max(0.0, 100.0 * (y.max() - 1.0)), settled, float(np.trapezoid(np.abs(1.0 - y), dx=h))


def disturbance_metrics(y: np.ndarray, h: float) -> tuple[float, float, float]:
    """Peak, recovery time and IAE, after a setpoint step of 1."""
    outside = np.flatnonzero(np.abs(y) > 0.02)
    recovered = 0.0 if not outside.size else (outside[-1] + 1) * h
    if outside.size and outside[-1] >= 0.95 * (len(y) - 1):
        recovered = np.inf
    return float(np.abs(y).max()), recovered, float(np.trapezoid(np.abs(y), dx=h))
