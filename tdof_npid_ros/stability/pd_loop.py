"""What is left of the loop when the integral action is cut open: the PD loop, and what the integral action sees of it.

With P = z^-lag b/a and the PD action's (K_p s + K_dh w)/s, w = z - 1, everything is made of polynomials in w and of the
delay: E = a s, U = b (K_p s + K_dh w), N = b s, X = E + z^-lag U, Q = P/(1 + P C_pd) = z^-lag N/X, S = E/X. The pole of
the integral action is split off: (Q(z) - Q(1))/w has none, and is written out without a difference of near numbers.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import KD_H, KI_H, KP, PHI, coefficients
from tdof_npid_ros.stability.enclosure import Enclosure, Minimum, minimum, turning
from tdof_npid_ros.stability.pulse import PulseTransfer
from tdof_npid_ros.stability.screen import frequency_grid, on_circle

Array = np.ndarray
ROUNDING = 1e-14  # relative error of a sum whose terms do not cancel


class PdLoop:
    """The PD loop of one lane, and the functions of the frequency that the certificate needs.

    Attributes:
        integral: h K_i.
        dc: Q(1), what the output ends in when the integral action steps by 1; nan for a PD loop with a mode at z = 1.
        edges: of the intervals with which a search begins, from 0 to π.
    """

    def __init__(self, plant: PulseTransfer, gains: Gains) -> None:
        c = coefficients(gains, plant.sample_period)[:, 0]
        s = np.array([1.0 - c[PHI], 1.0]) if c[KD_H] else np.ones(1)
        direct = np.polynomial.polynomial.polyadd(c[KP] * s, [0.0, c[KD_H]])
        self.plant = plant
        self.integral = float(c[KI_H])
        self._e = np.convolve(plant.a, s)
        self._u = np.convolve(plant.b, direct)
        self._n = np.convolve(plant.b, s)
        self._x1 = float(self._e[0] + self._u[0])
        self.dc = float(self._n[0]) / self._x1 if self._x1 else math.nan
        self.edges = np.concatenate([[0.0], frequency_grid(plant)])

    @cached_property
    def is_stable(self) -> bool | None:
        """Whether all modes of the PD loop, hidden ones too, lie within the circle, proved; None: too near to tell."""
        turned = turning(lambda center, radius: self._parts(center, radius)[3], self.edges)
        return None if turned is None else round(turned / math.pi) == len(self._e) - 1

    def integral_view(self, center: Array, radius: Array) -> tuple[Enclosure, Enclosure]:
        """Re G, and H = h K_i Q, on intervals of the frequency; G = H/(z - 1) is what the integral action sees."""
        w, delay, delay_slope, x = self._parts(center, radius)
        inverse = x.inverse()
        numerator = self._divided(w, delay, delay_slope)
        re_g = (numerator * inverse).real * (self.integral / self._x1) - 0.5 * self.integral * self.dc
        h = delay * self._polynomial(self._n, w) * inverse * self.integral
        return re_g, h

    def sensitivities(self, center: Array, radius: Array) -> tuple[Enclosure, Enclosure, Enclosure, Enclosure]:
        """Q, (Q - Q(1))/w, S and (S - S(1))/w of the PD loop, on intervals of the frequency."""
        w, delay, delay_slope, x = self._parts(center, radius)
        inverse = x.inverse()
        e1, u1 = float(self._e[0]), float(self._u[0])
        q_divided = self._divided(w, delay, delay_slope) * inverse * (1.0 / self._x1)
        ed, ud = self._polynomial(self._e[1:], w), self._polynomial(self._u[1:], w)
        s_divided = (u1 * ed - e1 * u1 * delay_slope - e1 * (delay * ud)) * inverse * (1.0 / self._x1)
        q = delay * self._polynomial(self._n, w) * inverse
        return q, q_divided, self._polynomial(self._e, w) * inverse, s_divided

    @property
    def sensitivity_dc(self) -> float:
        """S(1)."""
        return float(self._e[0]) / self._x1

    def re_g(self, omega: Array) -> Array:
        """Re G at frequencies in rad per sample, 0 included."""
        return self.integral_view(omega, np.zeros_like(omega))[0].value.real

    def h(self, omega: Array) -> Array:
        """H = h K_i Q at frequencies in rad per sample, complex."""
        return self.integral_view(omega, np.zeros_like(omega))[1].value

    def least_re_g(self, tolerance: float) -> Minimum:
        """The least Re G over all frequencies."""
        at_zero = float(self.re_g(np.zeros(1))[0])
        found = minimum(lambda center, radius: self.integral_view(center, radius)[0], self.edges, tolerance)
        if at_zero <= found.found:
            return Minimum(min(found.at_least, at_zero), at_zero, 0.0)
        return found

    def _parts(self, center: Array, radius: Array) -> tuple[Enclosure, Enclosure, Enclosure, Enclosure]:
        """w, the delay z^-lag, (z^-lag - 1)/w, and X."""
        z = np.exp(1j * center)
        w = Enclosure(on_circle(center), 1j * z, np.ones_like(center), radius)
        lag = self.plant.lag
        turned = np.exp(-1j * lag * center)
        delay = Enclosure(turned, -1j * lag * turned, np.full_like(center, float(lag) ** 2), radius)
        x = self._polynomial(self._e, w) + delay * self._polynomial(self._u, w)
        size = np.abs(w.value)
        terms = np.polyval(np.abs(self._e[::-1]), size) + np.polyval(np.abs(self._u[::-1]), size)
        x = x.blurred(ROUNDING * terms)  # where X is a small difference of large terms, that matters
        return w, delay, _delay_slope(lag, center, radius), x

    def _divided(self, w: Enclosure, delay: Enclosure, delay_slope: Enclosure) -> Enclosure:
        """X X(1) (Q - Q(1))/w."""
        n1, e1 = float(self._n[0]), float(self._e[0])
        nd, ed, ud = (self._polynomial(p[1:], w) for p in (self._n, self._e, self._u))
        return n1 * e1 * delay_slope + self._x1 * (delay * nd) - n1 * ed - n1 * (delay * ud)

    @staticmethod
    def _polynomial(coefficients: Array, w: Enclosure) -> Enclosure:
        nothing = np.zeros_like(w.value)
        value = Enclosure(nothing, nothing, np.zeros_like(w.radius), w.radius)
        for coefficient in coefficients[::-1]:
            value = value * w + float(coefficient)
        return value


def _delay_slope(lag: int, center: Array, radius: Array) -> Enclosure:
    """(z^-lag - 1)/(z - 1) = -(z^-1 + … + z^-lag)."""
    half = 0.5 * center
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(half > 0.0, np.sin(lag * half) / np.sin(half), float(lag))
        value = -np.exp(-1j * (lag + 1) * half) * ratio
        # From z^-lag = 1 + w f: f' = ((z^-lag)' - w' f)/w; near 0 from the sum itself.
        w, z = on_circle(center), np.exp(1j * center)
        slope = (-1j * lag * np.exp(-1j * lag * center) - 1j * z * value) / w
    first, second, third = _power_sums(lag)
    near = lag * center < SERIES
    slope = np.where(near, 1j * first + center * second - 0.5j * center**2 * third, slope)
    size = 2.0 * np.sin(0.5 * np.maximum(np.minimum(center - radius, math.pi), 0.0))  # the least |w|
    with np.errstate(divide="ignore", invalid="ignore"):
        steepest = np.minimum((lag + np.minimum(2.0 / size, lag)) / size, first)
        bend = (float(lag) ** 2 + np.minimum(2.0 / size, lag) + 2.0 * steepest) / size
    return Enclosure(value, slope, np.minimum(np.nan_to_num(bend, nan=np.inf, posinf=np.inf), second), radius)


SERIES = 1e-4  # lag · ω below which the slope is taken from its series: its error is of order SERIES³


def _power_sums(lag: int) -> tuple[float, float, float]:
    """Σ i, Σ i² and Σ i³ for i up to lag."""
    n = float(lag)
    return n * (n + 1) / 2, n * (n + 1) * (2 * n + 1) / 6, (n * (n + 1) / 2) ** 2
