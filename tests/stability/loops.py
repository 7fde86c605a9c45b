"""Random linear loops, and what is true of them by the plainest computation: matrices and dense grids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import KD_H, KI_H, KP, PHI, coefficients
from tdof_npid_ros.plants.kernels import SampledLinear
from tdof_npid_ros.plants.linear import TransferFunction


class Loop(NamedTuple):
    """A plant, its gains and the sample period in s."""

    plant: TransferFunction
    gains: Gains
    period: float

    @property
    def sampled(self) -> SampledLinear:
        return self.plant.sampled(round(self.period * 1e9))


def random_loop(rng: np.random.Generator) -> Loop:
    """Stable, integrating, unstable, resonant and non-minimum phase plants, reverse acting ones among them."""
    period = float(rng.choice([0.001, 0.005, 0.01, 0.1]))
    scale = period * 10 ** rng.uniform(0.7, 2.5)  # s
    kind = rng.integers(7)
    t = scale * 10 ** rng.uniform(-0.5, 0.5, 3)
    gain = float(rng.choice([-1.0, 1.0]) * 10 ** rng.uniform(-1, 1))
    numerator, denominator = [gain], [t[0], 1.0]
    if kind == 1:
        denominator = np.polymul([t[0], 1.0], [t[1], 1.0])
    elif kind == 2:
        numerator = [-gain * t[2], gain]
        denominator = np.polymul(np.polymul([t[0], 1.0], [t[1], 1.0]), [t[2], 1.0])
    elif kind == 3:
        denominator = [t[0], 1.0, 0.0]
    elif kind == 4:
        denominator = [t[0], -1.0]
    elif kind == 5:
        denominator = [t[0] ** 2, 2 * t[0] * 10 ** rng.uniform(-3, 0), 1.0]
    elif kind == 6:
        numerator, denominator = [gain], [1.0 / 1.0, 0.0]
    delay = 0.0 if rng.random() < 0.3 else scale * 10 ** rng.uniform(-2, 0.3)
    if rng.random() < 0.3:
        delay = round(delay / period) * period
    plant = TransferFunction(tuple(map(float, numerator)), tuple(map(float, denominator)), delay)
    sign = np.sign(gain)
    kp = sign * 10 ** rng.uniform(-1.5, 1.0) / abs(gain)
    if kind in (3, 6):
        kp /= scale
    ki = 0.0 if rng.random() < 0.1 else kp / (scale * 10 ** rng.uniform(-0.7, 1.5))
    kd = 0.0 if rng.random() < 0.25 else kp * scale * 10 ** rng.uniform(-2, 0.0)
    if rng.random() < 0.05 and ki:
        kp = kd = 0.0
    return Loop(plant, Gains("pid", kp, ki, kd, n=float(10 ** rng.uniform(0.3, 1.7))), period)


def closed_loop_matrix(loop: Loop) -> np.ndarray:
    """The matrix of one step of the loop at rest, whole: plant, efforts on their way, filter and integral action."""
    plant = loop.sampled
    c = coefficients(loop.gains, loop.period)[:, 0]
    order, slots = len(plant.phi), plant.delay + 1
    size = order + slots + 2
    u_i, z = order + slots, order + slots + 1
    effort = np.zeros(size)  # as a row: u = effort · state, with e = -y
    effort[0] = -c[KP] - c[KD_H]
    effort[u_i], effort[z] = 1.0, -c[KD_H]
    matrix = np.zeros((size, size))
    matrix[:order, :order] = plant.phi
    # Slot i holds v[k-1-i]; v[k] is the effort now.
    old, new = order + plant.delay, order + plant.delay - 1
    matrix[:order, old] += plant.gamma_old
    if plant.delay:
        matrix[:order, new] += plant.gamma_new
    else:
        matrix[:order] += np.outer(plant.gamma_new, effort)
    matrix[order] = effort
    for i in range(1, slots):
        matrix[order + i, order + i - 1] = 1.0
    matrix[u_i, u_i], matrix[u_i, 0] = 1.0, -c[KI_H]
    matrix[z, z], matrix[z, 0] = c[PHI], -(1.0 - c[PHI])
    keep = np.ones(size, dtype=bool)
    keep[u_i] = loop.gains.ki != 0  # without integral gain it never moves
    keep[z] = loop.gains.kd != 0
    return matrix[np.ix_(keep, keep)]


def spectral_radius(loop: Loop) -> float:
    return float(np.max(np.abs(np.linalg.eigvals(closed_loop_matrix(loop)))))


def open_loop(loop: Loop, omega: np.ndarray) -> np.ndarray:
    """L(e^jω), ω in rad per sample."""
    response, pd, integral = responses(loop, omega)
    return np.asarray(response * (pd + integral))


def re_g(loop: Loop, omega: np.ndarray) -> np.ndarray:
    """Re G(e^jω), as the integral action sees the rest of the loop, ω in rad per sample."""
    response, pd, integral = responses(loop, omega)
    return np.asarray(integral * response / (1 + response * pd)).real


def responses(loop: Loop, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P from the plant's matrices, C_pd, and h K_i/(z - 1)."""
    plant = loop.sampled
    c = coefficients(loop.gains, loop.period)[:, 0]
    z = np.exp(1j * omega)
    w = -2 * np.sin(omega / 2) ** 2 + 1j * np.sin(omega)
    order = len(plant.phi)
    phi = np.asarray(plant.phi) - np.eye(order)
    gamma = np.multiply.outer(z ** -float(plant.delay), plant.gamma_new) + np.multiply.outer(
        z ** -float(plant.delay + 1), plant.gamma_old
    )
    x = np.linalg.solve(w[:, None, None] * np.eye(order) - phi, gamma[:, :, None])[:, 0, 0]
    pd = np.full_like(w, c[KP])
    if loop.gains.kd != 0:
        pd = pd + c[KD_H] * w / (w + 1 - c[PHI])
    return x, pd, c[KI_H] / w
