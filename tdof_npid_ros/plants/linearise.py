"""Nonlinear plants near a state at rest: their linear model, by central differences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tdof_npid_ros.plants.ode import Ode, Sprott

STEP = 1e-6  # of a central difference, relative to the size of what is varied; errors of order 1e-10
KINK = 1e-2  # part by which the slopes on the two sides may differ where there is none


class LinearModel(NamedTuple):
    """dx/dt = a x + b u + e d, y = c x, for deviations; a (states, states), b and e (states,), c (states,)."""

    a: np.ndarray
    b: np.ndarray
    e: np.ndarray
    c: np.ndarray


def linearised(plant: Ode | Sprott, disturbance: float = 0.0) -> LinearModel:
    """The linear model of a plant where it begins (`plant.at_rest(y, d)` begins at rest).

    Where the right-hand side has a kink or a jump there (the circuit's sign at y = 0), it is a secant's slope.

    Example:
        >>> [round(value, 6) for value in linearised(Sprott().at_rest(1.0)).a[2].tolist()]  # -b, -1, -a
        [-1.2, -1.0, -0.6]
    """
    states, values = _varied(plant, disturbance)
    slopes = [(above - below) / (2.0 * step) for below, _, above, step in values]
    n = len(states)
    return LinearModel(
        np.stack([slope[:n] for slope in slopes[:n]], axis=1),
        slopes[n][:n],
        slopes[n + 1][:n],
        np.array([slope[n] for slope in slopes[:n]]),
    )


def has_kink(plant: Ode | Sprott, disturbance: float = 0.0) -> bool:
    """Whether the slopes on the two sides of where a plant begins differ: there it has no linear model.

    Example:
        >>> has_kink(Sprott().at_rest(0.0)), has_kink(Sprott().at_rest(1.0))
        (True, False)
    """
    _, values = _varied(plant, disturbance)
    _, wider = _varied(plant, disturbance, 2.0 * STEP)

    def differ(one: np.ndarray, other: np.ndarray, step: float) -> bool:
        return bool(np.any(np.abs(one - other) > KINK * (np.abs(one) + np.abs(other)) + step * STEP))

    return any(
        differ(above - here, here - below, step) or differ(2.0 * (above - below), far_above - far_below, step)
        for (below, here, above, step), (far_below, _, far_above, _) in zip(values, wider, strict=True)
    )


_Values = list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]


def _varied(plant: Ode | Sprott, disturbance: float, relative: float = STEP) -> tuple[np.ndarray, _Values]:
    """The state at the start; and dx/dt and y, (states + 1,), below, at and above it, with the step, for each of the
    states, the effort and the disturbance."""
    start = np.array([*plant.initial_state, plant.initial_effort, disturbance])
    states = len(start) - 2

    def at(point: np.ndarray) -> np.ndarray:
        x = tuple(map(float, point[:states]))
        return np.array([*plant.derivative(x, float(point[-2]), float(point[-1])), plant.output(x)])

    def around(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        step = np.zeros(len(start))
        step[i] = relative * max(1.0, abs(start[i]))
        return at(start - step), at(start), at(start + step), float(step[i])

    return start[:states], [around(i) for i in range(len(start))]
