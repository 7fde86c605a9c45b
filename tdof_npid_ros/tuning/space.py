"""The space that a search runs in: every parameter from 0 to 1, along the scale that suits it.

What matters of a gain is by which factor it changes. Where its bounds span decades, most of a linear scale is one
decade, and what lies in the others is a corner that no random population meets. So a gain runs along a logarithmic
scale; where one of its bounds is 0, the scale is linear close to it, so that 0 is in it. That also spreads the
derivative time K_d/K_p evenly over its decades: on a linear scale a random population knows K_d near its bound only,
and with a small K_p that is a valley of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdof_npid_ros.compiled import entry_point
from tdof_npid_ros.control.exponential import exp_minus
from tdof_npid_ros.tuning import TuningError

Array = NDArray[np.float64]

DECADES_FROM_ZERO = 4
"""Of a logarithmic scale that ends at 0, below its other end; farther down it is linear."""


@dataclass(frozen=True)
class Space:
    """Bounded parameters and their scales. The same points on every machine: no math library.

    Attributes:
        lower, upper: [d], lower < upper.
        logarithmic: [d], whether the parameter runs along a logarithmic scale; its bounds do not differ in sign.
    """

    lower: Array
    upper: Array
    logarithmic: tuple[bool, ...]

    @classmethod
    def of_bounds(cls, lower: ArrayLike, upper: ArrayLike, logarithmic: Sequence[bool] = ()) -> Space:
        """The space between bounds [d], linear by default.

        Raises:
            TuningError: not one finite lower below its upper for each parameter; or a logarithmic scale through 0.
        """
        low, high = _bounds(lower, upper)
        scales = tuple(map(bool, logarithmic)) or (False,) * low.size
        if len(scales) != low.size or any(low[j] * high[j] < 0.0 for j, is_log in enumerate(scales) if is_log):
            raise TuningError(
                f"bounds {low.tolist()} to {high.tolist()}, logarithmic {list(scales)}: one scale for each "
                "parameter, and no logarithmic one through 0"
            )
        return cls(low, high, scales)

    def at(self, unit: Array) -> Array:
        """Parameters [n, d] or [d] of points in 0 .. 1; within the bounds to the last bit."""
        x: Array = self.lower + unit * (self.upper - self.lower)
        for j in np.flatnonzero(self.logarithmic):
            near, far, offset, span = self._scale(int(j))
            u = unit[..., j]
            x[..., j] = np.where(u > 0.0, (far + offset) * _exp_minus_of(span * (1.0 - u)) - offset, near)
        clipped: Array = np.clip(x, self.lower, self.upper)
        return clipped

    def of(self, parameters: Array) -> Array:
        """Points [n, d] in 0 .. 1 of parameters [n, d]; `at` gives these back but for rounding."""
        unit: Array = (parameters - self.lower) / (self.upper - self.lower)
        for j in np.flatnonzero(self.logarithmic):
            _, far, offset, span = self._scale(int(j))
            for i, x in enumerate(parameters[:, j]):
                factor = Decimal(far + offset) / Decimal(float(x) + offset)
                unit[i, j] = 1.0 - float(factor.ln()) / span
        clipped: Array = np.clip(unit, 0.0, 1.0)
        return clipped

    def checked(self, points: ArrayLike) -> Array:
        """Points [k, d] as an array.

        Raises:
            TuningError: they are not within the bounds.
        """
        array = np.array(points, dtype=np.float64).reshape(-1, self.lower.size)
        if not ((array >= self.lower) & (array <= self.upper)).all():
            raise TuningError(f"starts {array.tolist()}: each must be within the bounds")
        return array

    def _scale(self, j: int) -> tuple[float, float, float, float]:
        """The bound nearer to 0 and the other one; the offset from which the scale is logarithmic, and its span."""
        near, far = sorted((float(self.lower[j]), float(self.upper[j])), key=abs)
        offset = far / 10.0**DECADES_FROM_ZERO if near == 0.0 else 0.0
        return near, far, offset, float((Decimal(far + offset) / Decimal(near + offset)).ln())


def _bounds(lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
    try:
        low, high = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    except (TypeError, ValueError):
        raise TuningError(f"bounds {lower!r}, {upper!r}: give two lists of numbers") from None
    if low.ndim != 1 or low.shape != high.shape or low.size == 0:
        raise TuningError(f"bounds of shapes {low.shape} and {high.shape}: give one lower and upper a parameter")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise TuningError(f"bounds {low.tolist()} to {high.tolist()}: each lower must be finite and below its upper")
    return low, high


def _exp_minus_of(q: Array) -> Array:
    result = np.empty(q.size)
    _exponentials(np.ravel(q), result)
    return result.reshape(q.shape)


@entry_point
def _exponentials(q: Array, result: Array) -> None:
    """exp(-q) by number, (n,)."""
    for i in range(len(q)):
        result[i] = exp_minus(q[i])
