"""The criteria by which a nonlinear loop is known to come to rest from everywhere: circle, multiplier, effort limits.

The integral action integrates ψ(e) = k(e) e, which lies between 0 and e, rises no more steeply than e and falls no more
steeply than FALL e; it sees e = -G ψ(e) of the rest of the loop. Each criterion is an inequality over all frequencies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tdof_npid_ros.stability.enclosure import Enclosure, is_positive
from tdof_npid_ros.stability.pd_loop import PdLoop

Array = np.ndarray
FALL = 2.0 * math.exp(-1.5)  # the steepest fall of exp(-e²/2σ²) e, at |e| = √3 σ
GAP = 1e-7  # between what is proved of Re G and what is found, relative to 1 or to Re G itself
FINE = 16  # points that a search for a multiplier sets between two of the grid
LARGEST_FACTOR = 1e6  # on K_i, that a multiplier is looked for
FACTOR_STEPS = 60  # halvings of the interval of that factor
PROVED = 0.999  # of the largest factor that was found, with which the multiplier is proved to serve


@dataclass(frozen=True)
class Circle:
    """What the circle criterion says: 1 + Re G > 0.

    Attributes:
        re_g_zero: Re G for ω → 0.
        re_g_least: the least Re G, found at `omega` (rad per sample); `at_least` is proved.
    """

    re_g_zero: float
    re_g_least: float
    at_least: float
    omega: float

    @property
    def delta(self) -> float:
        """What is left: above 0 if the criterion holds."""
        return 1.0 + self.at_least

    @property
    def k_max(self) -> float:
        """By what factor K_i may grow; infinite if by any."""
        return -1.0 / self.at_least if self.at_least < 0.0 else math.inf


class Multiplier(NamedTuple):
    """A multiplier that serves: 1 + Re{[1 + q (z - 1)] G} - ½ |q| μ |(z - 1) G|² > 0.

    Attributes:
        q: in samples; `low` to `high` are those that serve with K_i as it is.
        k_max: by what factor K_i may grow with this q.
    """

    q: float
    low: float
    high: float
    k_max: float


def circle(loop: PdLoop) -> Circle:
    """The circle criterion in its critical case; the PD loop is stable."""
    at_zero = float(loop.re_g(np.zeros(1))[0])
    least = loop.least_re_g(GAP * max(1.0, abs(at_zero)))
    return Circle(at_zero, least.found, least.at_least, least.omega)


def multiplier(loop: PdLoop) -> Multiplier | None:
    """The multiplier that lets K_i grow most, proved; None if none was found."""
    omega = np.concatenate([[0.0], np.interp(np.arange(1, FINE * len(loop.edges)) / FINE, np.arange(len(loop.edges)),
                                             loop.edges)])  # fmt: skip
    re_g, h = loop.re_g(omega), loop.h(omega)
    best: Multiplier | None = None
    for sign, steepest in ((1.0, 1.0), (-1.0, FALL)):
        found = _largest(re_g, h, sign, steepest)
        if found is not None and (best is None or found.k_max > best.k_max) and _serves(loop, found):
            best = found
    return best


def _serving(re_g: Array, h: Array, sign: float, steepest: float, k: float) -> tuple[float, float]:
    """The |q| that serve with K_i times k, as an interval; it is empty if none does."""
    c = 1.0 + k * re_g
    a = sign * k * h.real - 0.5 * steepest * k * k * (h.real**2 + h.imag**2)
    if np.any((c <= 0.0) & (a <= 0.0)):
        return math.inf, 0.0
    with np.errstate(divide="ignore"):
        low = float(np.max(np.where(c <= 0.0, -c / a, 0.0)))
        high = float(np.min(np.where(a < 0.0, c / np.abs(a), np.inf)))
    return low, high


def _largest(re_g: Array, h: Array, sign: float, steepest: float) -> Multiplier | None:
    low, high = _serving(re_g, h, sign, steepest, 1.0)
    if not low < high:
        return None
    least, most = 1.0, LARGEST_FACTOR
    for _ in range(FACTOR_STEPS):
        k = math.sqrt(least * most)
        below, above = _serving(re_g, h, sign, steepest, k)
        least, most = (k, most) if below < above else (least, k)
    below, above = _serving(re_g, h, sign, steepest, least)
    q = 0.5 * (below + above) if math.isfinite(above) else 2.0 * below + 1.0
    return Multiplier(sign * q, sign * low, sign * high, least)


def _serves(loop: PdLoop, found: Multiplier) -> bool:
    """Whether the multiplier is proved to serve, with K_i as it is and times k_max, all but a little."""
    steepest = 1.0 if found.q > 0.0 else FALL

    def criterion(k: float, center: Array, radius: Array) -> Enclosure:
        re_g, h = loop.integral_view(center, radius)
        bent = h.squared() * (0.5 * abs(found.q) * steepest * k * k)
        return re_g * k + h.real * (found.q * k) - bent + 1.0

    factors = (1.0, max(1.0, PROVED * found.k_max))
    return all(is_positive(lambda c, r, k=k: criterion(k, c, r), loop.edges) is True for k in factors)  # type: ignore[misc]


def with_limits(loop: PdLoop, tracking: float) -> bool | None:
    """Whether the loop comes to rest also where its effort is limited and back-calculation acts.

    Plant and PD loop are stable, and the circle criterion holds without limits. The effort lost at a limit is one more
    nonlinearity between 0 and its input; the weight of the two is fixed by the residue of the integral action's pole.

    Args:
        tracking: a = 1 - exp(-h/T_t), what of the lost effort goes into the integral action in one sample; above 0.

    Returns:
        None if it is too near the border to tell.
    """
    gain = loop.dc / loop.sensitivity_dc
    weight = tracking * gain / loop.integral

    def criterion(center: Array, radius: Array) -> Enclosure:
        re_g, _ = loop.integral_view(center, radius)
        q, q_divided, s, s_divided = loop.sensitivities(center, radius)
        own = s.real + tracking * (s_divided.real - 0.5 * loop.sensitivity_dc)
        coupling = -0.5 * (q + tracking * (q_divided + gain * s_divided.conjugate() - loop.dc))
        return (re_g + 1.0) * own - coupling.squared() * (1.0 / weight)

    return is_positive(criterion, loop.edges)


def limited_without_integral(loop: PdLoop) -> bool | None:
    """Whether a loop without integral action comes to rest also where its effort is limited: Re S > 0."""
    return is_positive(lambda center, radius: loop.sensitivities(center, radius)[2].real, loop.edges)
