"""The structures that a plant may have, and what their parameters are called."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tdof_npid_ros.plants.linear import TransferFunction


@dataclass(frozen=True)
class Structure:
    """A family of plants: numerator/denominator · exp(-dead_time s), with time in units of its time constant.

    Attributes:
        name: what it is called in results, and `text` in sentences.
        shape: how many numbers make its denominator: none, or the logarithm of its time constant, then that of its
            damping.
        order: of the denominator.
        numerators: how many coefficients the numerator has; 2 with a zero.
        integrating, unstable: whether it has a pole at 0 or a positive one.
    """

    name: str
    text: str
    shape: int
    order: int
    numerators: int = 1
    integrating: bool = False
    unstable: bool = False

    @property
    def nonlinear(self) -> int:
        """Number of parameters but the numerator's: the denominator's and the dead time."""
        return self.shape + 1

    @property
    def parameters(self) -> int:
        """Number of parameters in all."""
        return self.nonlinear + self.numerators

    def denominator(self, shape: np.ndarray) -> tuple[float, ...]:
        """Without its leading 1, lowest power first."""
        if self.name == "second_order" or self.name == "second_order_zero":
            return (1.0, 2.0 * math.exp(shape[1]))
        return _DENOMINATORS[self.name]

    def scale(self, shape: np.ndarray) -> float:
        """The time constant, s: the unit of time of the denominator; 1 s where there is none."""
        return math.exp(shape[0]) if self.shape else 1.0

    def physical(self, shape: np.ndarray, dead_time: float, numerator: np.ndarray) -> dict[str, float]:
        """The parameters by the names that users know, in SI units."""
        t = self.scale(shape)
        values = {"gain": float(numerator[0])}
        if self.integrating:
            values["gain"] /= t
        if self.name.startswith("second_order") and self.shape == 2:
            damping = math.exp(shape[1])
            if damping > 1.0:
                root = math.sqrt(damping**2 - 1.0)
                values |= {"time_constant_1": t * (damping + root), "time_constant_2": t / (damping + root)}
            else:
                values |= {"natural_period": 2.0 * math.pi * t, "damping": damping}
        elif self.shape:
            values["time_constant"] = t
        if self.numerators == 2:
            values["zero_time_constant"] = self._zero(numerator) * t
        return values | {"dead_time": dead_time}

    def slow_share(self, shape: np.ndarray, numerator: np.ndarray) -> float:
        """How much of a step's response the slower of two real poles makes, as a fraction of the gain; 1 where there
        are no two. Next to nothing where a zero cancels it."""
        if self.shape < 2 or (damping := math.exp(shape[1])) <= 1.0:
            return 1.0
        root = math.sqrt(damping**2 - 1.0)
        return abs(damping + root - self._zero(numerator)) / (2.0 * root)

    def _zero(self, numerator: np.ndarray) -> float:
        """The zero's time constant in units of the time constant; 0 where there is no zero."""
        return float(numerator[1] / numerator[0]) if self.numerators == 2 else 0.0

    def transfer_function(self, shape: np.ndarray, dead_time: float, numerator: np.ndarray) -> TransferFunction:
        """The plant that the closed loop runs with."""
        t = self.scale(shape)
        polynomial = (1.0, *reversed(self.denominator(shape)))
        denominator = tuple(a * t ** (self.order - i) for i, a in enumerate(polynomial))
        return TransferFunction(tuple(float(c) * t**i for i, c in enumerate(numerator))[::-1], denominator, dead_time)

    def catalogued(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]] | None:
        """Model and parameters of the plants' catalogue, from the physical ones; None where it has no such model."""
        if self.name == "first_order":
            return "first_order", dict(values)
        if self.name == "second_order_equal":
            return "second_order", dict(values)
        if self.name == "third_order_zero":
            return "third_order", {**values, "zero_time_constant": -values["zero_time_constant"]}
        return None


_DENOMINATORS: dict[str, tuple[float, ...]] = {
    "integrator": (0.0,),
    "first_order": (1.0,),
    "second_order_equal": (1.0, 2.0),
    "integrator_lag": (0.0, 1.0),
    "unstable_first_order": (-1.0,),
    "third_order_zero": (1.0, 3.0, 3.0),
}

STRUCTURES = {
    structure.name: structure
    for structure in (
        Structure("integrator", "integrator with dead time", 0, 1, integrating=True),
        Structure("first_order", "first order with dead time", 1, 1),
        Structure("second_order_equal", "second order with two equal time constants and dead time", 1, 2),
        Structure("integrator_lag", "integrator with a lag and dead time", 1, 2, integrating=True),
        Structure("unstable_first_order", "unstable first order with dead time", 1, 1, unstable=True),
        Structure("second_order", "second order with dead time", 2, 2),
        Structure("third_order_zero", "third order with equal time constants, a zero and dead time", 1, 3, 2),
        Structure("second_order_zero", "second order with a zero and dead time", 2, 2, 2),
    )
}
