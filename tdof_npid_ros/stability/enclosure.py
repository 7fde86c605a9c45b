"""Functions of the frequency enclosed on whole intervals, so that what is proved holds between grid points, too.

On an interval of half width r about ω a function f is known by its value and slope at ω and by a bound on |f''| over
the interval: everywhere in it, f differs from its tangent by at most bend r²/2. Sums, products and quotients keep that
true.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

Array = np.ndarray
MOST_INTERVALS = 4_000_000  # that a search may look at
NARROWEST = 1e-14  # half width in rad, below which an interval is not halved


@dataclass(frozen=True)
class Enclosure:
    """A function on intervals, (intervals,) each: value and slope at the centres, a bound on the second derivative.

    Attributes:
        value, slope: complex, at the centres.
        bend: real, at least |f''| on the whole interval.
        radius: half widths, rad.
    """

    value: Array
    slope: Array
    bend: Array
    radius: Array

    @property
    def most(self) -> Array:
        """At least |f| on the interval."""
        return np.asarray(np.abs(self.value) + self._swing)

    @property
    def least(self) -> Array:
        """At most |f| on the interval, not below 0."""
        return np.asarray(np.maximum(np.abs(self.value) - self._swing, 0.0))

    @property
    def low(self) -> Array:
        """At most Re f on the interval."""
        return np.asarray(self.value.real - np.abs(self.slope.real) * self.radius - 0.5 * self.bend * self.radius**2)

    @property
    def _swing(self) -> Array:
        return np.asarray(np.abs(self.slope) * self.radius + 0.5 * self.bend * self.radius**2)

    @property
    def _steepest(self) -> Array:
        return np.asarray(np.abs(self.slope) + self.bend * self.radius)

    def __add__(self, other: Enclosure | complex) -> Enclosure:
        if not isinstance(other, Enclosure):
            return Enclosure(self.value + other, self.slope, self.bend, self.radius)
        return Enclosure(self.value + other.value, self.slope + other.slope, self.bend + other.bend, self.radius)

    def __sub__(self, other: Enclosure | complex) -> Enclosure:
        return self + (-1.0 * other if isinstance(other, Enclosure) else -other)

    def __mul__(self, other: Enclosure | complex) -> Enclosure:
        if not isinstance(other, Enclosure):
            return Enclosure(self.value * other, self.slope * other, self.bend * abs(other), self.radius)
        bend = self.bend * other.most + 2.0 * self._steepest * other._steepest + self.most * other.bend
        return Enclosure(
            self.value * other.value, self.slope * other.value + self.value * other.slope, bend, self.radius
        )

    __rmul__ = __mul__

    def inverse(self) -> Enclosure:
        """1/f; with an infinite bend where f may be 0."""
        least = self.least
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            value = 1.0 / self.value
            bend = 2.0 * self._steepest**2 / least**3 + self.bend / least**2
        return Enclosure(value, -self.slope * value * value, np.where(least > 0.0, bend, np.inf), self.radius)

    def conjugate(self) -> Enclosure:
        """The conjugate of f."""
        return Enclosure(self.value.conj(), self.slope.conj(), self.bend, self.radius)

    def blurred(self, error: Array) -> Enclosure:
        """The same function, known only to within an error, (intervals,): on each interval the bend covers it."""
        with np.errstate(divide="ignore", invalid="ignore"):
            extra = np.where(self.radius > 0.0, 2.0 * error / self.radius**2, 0.0)
        return Enclosure(self.value, self.slope, self.bend + extra, self.radius)

    @property
    def real(self) -> Enclosure:
        """Re f."""
        return Enclosure(self.value.real + 0j, self.slope.real + 0j, self.bend, self.radius)

    def squared(self) -> Enclosure:
        """|f|²."""
        return (self * self.conjugate()).real


class Minimum(NamedTuple):
    """The least value of a real function.

    Attributes:
        at_least: the function is nowhere lower: proved on all intervals; -inf if that was not possible.
        found: a value that it has, at the frequency `omega` (rad per sample).
    """

    at_least: float
    found: float
    omega: float


Function = Callable[[Array, Array], Enclosure]  # of centres and half widths, (intervals,) each


def minimum(function: Function, edges: Array, tolerance: float) -> Minimum:
    """The least value of Re f between the first and the last of the edges (increasing frequencies).

    Intervals that may hold it are halved until what is proved is within `tolerance` of what is found.
    """
    low, high = edges[:-1], edges[1:]
    at_least, found, omega, looked = np.inf, np.inf, 0.0, 0
    while len(low):
        looked += len(low)
        center, radius = 0.5 * (low + high), 0.5 * (high - low)
        f = function(center, radius)
        bound, value = np.nan_to_num(f.low, nan=-np.inf), f.value.real
        best = int(np.argmin(np.where(np.isnan(value), np.inf, value)))
        if value[best] < found:
            found, omega = float(value[best]), float(center[best])
        settled = bound >= found - tolerance
        if looked > MOST_INTERVALS or np.any(radius[~settled] < NARROWEST):
            return Minimum(-np.inf, found, omega)
        at_least = min(at_least, float(np.min(bound[settled], initial=np.inf)))
        low, high = _halves(low[~settled], high[~settled])
    return Minimum(min(at_least, found), found, omega)


def is_positive(function: Function, edges: Array) -> bool | None:
    """Whether Re f is above 0 on all intervals, proved; None if it is too near to 0 to tell."""
    low, high = edges[:-1], edges[1:]
    looked = 0
    while len(low):
        looked += len(low)
        center, radius = 0.5 * (low + high), 0.5 * (high - low)
        f = function(center, radius)
        if np.any(f.value.real <= 0.0):
            return False
        open_ = ~(f.low > 0.0)
        if looked > MOST_INTERVALS or np.any(radius[open_] < NARROWEST):
            return None
        low, high = _halves(low[open_], high[open_])
    return True


def turning(function: Function, edges: Array) -> float | None:
    """By how much the argument of f grows from the first to the last edge, in rad; None if f comes too near to 0.

    On each interval f stays within a circle that does not hold 0, so its argument turns by less than half a turn.
    """
    low, high = edges[:-1], edges[1:]
    looked, total = 0, 0.0
    while len(low):
        looked += len(low)
        f = function(0.5 * (low + high), 0.5 * (high - low))
        sure = f.least > 0.0
        if looked > MOST_INTERVALS or np.any((high - low)[~sure] < NARROWEST):
            return None
        nothing = np.zeros(int(sure.sum()))
        begin, end = (function(edge[sure], nothing).value for edge in (low, high))
        total += float(np.sum(np.angle(end * begin.conj())))
        low, high = _halves(low[~sure], high[~sure])
    return total


def _halves(low: Array, high: Array) -> tuple[Array, Array]:
    middle = 0.5 * (low + high)
    return np.concatenate([low, middle]), np.concatenate([middle, high])
