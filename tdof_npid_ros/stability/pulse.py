"""The pulse transfer function of a sampled linear plant: what its output does under a held input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from tdof_npid_ros.control.law import exp_minus_of
from tdof_npid_ros.plants.kernels import SampledLinear

_Polynomial = list[Fraction]  # coefficients of w, lowest power first


@dataclass(frozen=True)
class PulseTransfer:
    """P(z) = z^-lag · b(w)/a(w), w = z - 1: from the effort to the output, dead time included.

    In powers of w, not of z: with fast sampling all poles lie near z = 1, where powers of z would lose their digits.
    The denominator is the determinant of w I - (phi - I), so modes that the output does not show are in it too.

    Attributes:
        a, b: coefficients of w, lowest power first; a is monic.
        lag: whole samples from the effort to the output, at least 1.
        sample_period: h in s.
    """

    a: tuple[float, ...]
    b: tuple[float, ...]
    lag: int
    sample_period: float

    @cached_property
    def poles(self) -> np.ndarray:
        """The plant's own poles as z - 1, complex, (order,); the delay's poles at z = 0 are not among them."""
        return roots(self.a)

    @cached_property
    def zeros(self) -> np.ndarray:
        """Its zeros as z - 1, complex; none for a plant that the effort does not move."""
        return roots(self.b)

    @property
    def gain(self) -> float:
        """The output that a held effort of 1 ends in; infinite for an integrating plant."""
        return self.b[0] / self.a[0] if self.a[0] else np.copysign(np.inf, self.b[0])

    def at(self, z: np.ndarray) -> np.ndarray:
        """P(z), of the shape of z, complex."""
        w = z - 1.0
        return np.asarray(polynomial(self.b, w) / polynomial(self.a, w) * z ** float(-self.lag))

    def filtered(self, filter_time: float) -> PulseTransfer:
        """The plant with the controller's first-order filter of the output behind it.

        Args:
            filter_time: s; 0: none.
        """
        if filter_time == 0.0:
            return self
        gain = 1.0 - exp_minus_of(self.sample_period / filter_time)  # y_f = y_f⁻ + gain (y - y_f⁻)
        a = _product([Fraction(x) for x in self.a], [Fraction(gain), Fraction(1)])
        b = _product([Fraction(x) for x in self.b], [Fraction(gain), Fraction(gain)])
        return PulseTransfer(_floats(a), _floats(b), self.lag, self.sample_period)


def pulse_transfer(plant: SampledLinear, sample_period: float, output: Sequence[float] | None = None) -> PulseTransfer:
    """The pulse transfer function of a sampled plant; exact in rational numbers, rounded at the end.

    Args:
        plant: x⁺ = phi x + gamma_old v[k-delay-1] + gamma_new v[k-delay].
        sample_period: s.
        output: y = output · x; by default the first state.
    """
    order = len(plant.phi)
    c = [Fraction(x) for x in (output if output is not None else [1.0] + [0.0] * (order - 1))]
    m = [[Fraction(x) - (i == j) for j, x in enumerate(row)] for i, row in enumerate(plant.phi)]
    new, old = ([Fraction(x) for x in gamma] for gamma in (plant.gamma_new, plant.gamma_old))
    # Faddeev and LeVerrier: adj(w I - m) = Σ n_k w^(order-1-k), det(w I - m) = Σ a_i w^i.
    a: _Polynomial = [Fraction(0)] * order + [Fraction(1)]
    b: _Polynomial = [Fraction(0)] * (order + 1)
    n = [[Fraction(i == j) for j in range(order)] for i in range(order)]
    for step in range(order):
        row = [sum((c[i] * n[i][j] for i in range(order)), Fraction(0)) for j in range(order)]
        by_new, by_old = (sum((x * g for x, g in zip(row, gamma, strict=True)), Fraction(0)) for gamma in (new, old))
        b[order - 1 - step] += by_new + by_old
        b[order - step] += by_new
        mn = [[sum((m[i][k] * n[k][j] for k in range(order)), Fraction(0)) for j in range(order)] for i in range(order)]
        a[order - 1 - step] = -sum((mn[i][i] for i in range(order)), Fraction(0)) / (step + 1)
        n = [[mn[i][j] + (a[order - 1 - step] if i == j else 0) for j in range(order)] for i in range(order)]
    return PulseTransfer(_floats(a), _floats(b), plant.delay + 1, sample_period)


def polynomial(coefficients: Sequence[float], w: np.ndarray) -> np.ndarray:
    """The polynomial with these coefficients, lowest power first, at w, complex."""
    value = np.zeros_like(w, dtype=np.complex128)
    for coefficient in reversed(coefficients):
        value = value * w + coefficient
    return value


def roots(coefficients: Sequence[float]) -> np.ndarray:
    """The roots of a polynomial, lowest power first, complex; none if it is constant."""
    return np.asarray(np.roots(np.trim_zeros(np.asarray(coefficients)[::-1], "f")), dtype=np.complex128)


def _product(p: _Polynomial, q: _Polynomial) -> _Polynomial:
    product = [Fraction(0)] * (len(p) + len(q) - 1)
    for i, x in enumerate(p):
        for j, y in enumerate(q):
            product[i + j] += x * y
    return product


def _floats(p: _Polynomial) -> tuple[float, ...]:
    return tuple(float(x) for x in p)
