"""Nonlinear plants near a state at rest: their linear model, by central differences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tdof_npid_ros.plants.ode import Ode, Sprott

STEP = 1e-6  # of a central difference, relative to the size of what is varied; errors of order 1e-10


class LinearModel(NamedTuple):
    """dx/dt = a x + b u + e d, y = c x, for deviations; a (states, states), b and e (states,), c (states,)."""

    a: np.ndarray
    b: np.ndarray
    e: np.ndarray
    c: np.ndarray


def linearised(plant: Ode | Sprott) -> LinearModel:
    """The linear model of a plant where it begins (`plant.at_rest(y)` begins at rest).

    Where the right-hand side has a kink or a jump there (the circuit's sign at y = 0), it is a secant's slope.

    Example:
        >>> [round(value, 6) for value in linearised(Sprott().at_rest(1.0)).a[2].tolist()]  # -b, -1, -a
        [-1.2, -1.0, -0.6]
    """
    x, u = np.array(plant.initial_state), plant.initial_effort

    def slope(state: np.ndarray, effort: float, disturbance: float) -> np.ndarray:
        return np.array(plant.derivative(tuple(map(float, state)), effort, disturbance))

    def column(i: int) -> np.ndarray:
        step = np.zeros(len(x))
        step[i] = STEP * max(1.0, abs(x[i]))
        return np.asarray((slope(x + step, u, 0.0) - slope(x - step, u, 0.0)) / (2.0 * step[i]))

    def seen(i: int) -> float:
        step = np.zeros(len(x))
        step[i] = STEP * max(1.0, abs(x[i]))
        above, below = (plant.output(tuple(map(float, x + sign * step))) for sign in (1.0, -1.0))
        return float((above - below) / (2.0 * step[i]))

    states = range(len(x))
    h = STEP * max(1.0, abs(u))
    return LinearModel(
        np.stack([column(i) for i in states], axis=1),
        (slope(x, u + h, 0.0) - slope(x, u - h, 0.0)) / (2.0 * h),
        (slope(x, u, STEP) - slope(x, u, -STEP)) / (2.0 * STEP),
        np.array([seen(i) for i in states]),
    )
