"""The characteristic function of one closed loop, whose zeros are its modes; counted and found anywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import KD_H, KI_H, KP, PHI, coefficients
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.pulse import PulseTransfer, polynomial
from tdof_npid_ros.stability.screen import DEEPEST, MOST_POINTS, frequency_grid, on_circle

RIGHT = 1.0  # rad: most that the function may turn between two points of a count
SURE = 1e-6  # relative, in that distance: within which an estimate is confirmed
NEAREST = 1e-15  # distance of a mode to the circle, below which it counts as on it
FARTHEST = 1.0 - 1e-9  # inside the circle: modes nearer to z = 0 die out at once
CLOSE = 1e-6  # relative, in the distance to the circle: how near the slowest mode is found


@dataclass(frozen=True)
class Characteristic:
    """χ(w) = a v s + z^-lag b n, with n = v (K_p s + K_dh w) + h K_i s, w = z - 1; and L = z^-lag b n/(a v s).

    All polynomials are coefficients of w, lowest power first.

    Attributes:
        plant: the pulse transfer function z^-lag b/a.
        open: a v s; numerator: b n.
    """

    plant: PulseTransfer
    open: tuple[float, ...]
    numerator: tuple[float, ...]

    @property
    def finite_modes(self) -> int:
        """Zeros of χ; besides, there are as many as the delay has samples, for |z| -> 0 without feedback."""
        return len(self.open) - 1

    def loop(self, w: np.ndarray) -> np.ndarray:
        """L, of the shape of w, complex; w not at a pole of L."""
        return np.asarray(self._delayed(w) / polynomial(self.open, w))

    def value(self, w: np.ndarray) -> np.ndarray:
        """χ, of the shape of w, complex."""
        return np.asarray(polynomial(self.open, w) + self._delayed(w))

    def _delayed(self, w: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(polynomial(self.numerator, w) * np.exp(-self.plant.lag * np.log1p(w)))

    def modes_outside(self, beyond: float) -> int:
        """How many modes have a modulus above 1 + beyond, by the argument principle.

        Args:
            beyond: above -1; no mode lies on that circle.

        Raises:
            StabilityError: a mode lies on the circle, to within rounding.
        """
        omega = np.concatenate([[0.0], frequency_grid(self.plant)])
        for _ in range(2 * DEEPEST):
            value = self.value(self._around(omega, beyond))
            value[[0, -1]] = value[[0, -1]].real
            if not np.all(np.isfinite(value)) or np.any(value == 0.0):
                break
            turn = np.angle(value[1:] * value[:-1].conj() / np.abs(value[1:] * value[:-1]))
            wide = np.abs(turn) > RIGHT
            if not wide.any():
                return self.finite_modes - round(float(np.sum(turn)) / math.pi)
            halves = 0.5 * (omega[1:] + omega[:-1])[wide]
            if np.any(np.diff(omega)[wide] < 1e-15) or len(omega) > 4 * MOST_POINTS:
                break
            omega = np.union1d(omega, halves)
        raise StabilityError(f"a mode lies on the circle of radius {1.0 + beyond:.12g}")

    def radius(self, guess: float | None = None) -> float:
        """The spectral radius less 1: how far the slowest mode, or the one that grows fastest, lies beyond the circle.

        Args:
            guess: an estimate, which makes it faster.
        """
        if guess is not None:
            low, high = guess - SURE * abs(guess), guess + SURE * abs(guess)
            if low > -1.0 and self._outside(low) and not self._outside(high):
                return guess
        grows = self._outside(0.0)
        sign = 1.0 if grows else -1.0
        near, far = NEAREST, 1e-6  # distances to the circle: the mode lies beyond the one, not beyond the other
        if self._outside(sign * near) != grows:
            return 0.0 if grows else -near
        while self._outside(sign * far) == grows:
            if not grows and far == FARTHEST:
                return -far
            near, far = far, 8.0 * far if grows else min(8.0 * far, FARTHEST)
        while far > near * (1.0 + CLOSE):
            middle = math.sqrt(near * far)
            near, far = (middle, far) if self._outside(sign * middle) == grows else (near, middle)
        return sign * math.sqrt(near * far)

    def _outside(self, beyond: float) -> bool:
        """Whether there is a mode outside the circle, or on it."""
        try:
            return self.modes_outside(beyond) > 0
        except StabilityError:
            return True

    @staticmethod
    def _around(omega: np.ndarray, beyond: float) -> np.ndarray:
        return np.asarray(beyond + (1.0 + beyond) * on_circle(omega))


def characteristic(plant: PulseTransfer, gains: Gains) -> Characteristic:
    """The characteristic function of a loop of one lane.

    Args:
        plant: with the controller's filter, if it has one.

    Example:
        >>> from tdof_npid_ros.case import load_case
        >>> from tdof_npid_ros.stability.plant import loop_plant
        >>> case = load_case("p1-c4")
        >>> characteristic(loop_plant(case), case.gains).modes_outside(0.0)
        0
    """
    c = coefficients(gains, plant.sample_period)[:, 0]
    s = np.array([1.0 - c[PHI], 1.0]) if c[KD_H] else np.ones(1)
    v = np.array([0.0, 1.0]) if c[KI_H] else np.ones(1)
    direct = np.polynomial.polynomial.polyadd(c[KP] * s, [0.0, c[KD_H]])
    n = np.polynomial.polynomial.polyadd(np.convolve(v, direct), c[KI_H] * s)
    open_ = np.convolve(np.convolve(plant.a, v), s)
    return Characteristic(plant, tuple(open_.tolist()), tuple(np.convolve(plant.b, n).tolist()))
