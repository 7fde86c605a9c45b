"""The compiled side of the plants: what the closed loop does with one lane of a plant in one step.

A sampled plant is a named tuple of numbers. Numba specialises the closed loop on its type, so the number of states
is known to the compiler and a lane's state lives in registers. Three functions are all the loop knows of a plant:
`plant_output`, `plant_input` and `plant_advance`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from numba import types

from tdof_npid_ros.compiled import compiled, implementation_of, uncached
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.plants.states import along, linear_map, runge_kutta_mean


class SampledLinear(NamedTuple):
    """x⁺ = phi x + gamma_old v[k-delay-1] + gamma_new v[k-delay], y = x[0], v = u + d."""

    phi: tuple[tuple[float, ...], ...]
    gamma_old: tuple[float, ...]
    gamma_new: tuple[float, ...]
    delay: int


class SampledOffset(NamedTuple):
    """A linear plant about an operating point that is not 0: `SampledLinear` plus a constant term in each step."""

    phi: tuple[tuple[float, ...], ...]
    gamma_old: tuple[float, ...]
    gamma_new: tuple[float, ...]
    delay: int
    constant: tuple[float, ...]


class SampledSprott(NamedTuple):
    """The Sprott circuit (16), one fourth-order Runge-Kutta step a sample."""

    a: float
    b: float
    c: float
    step: float
    delay: int


class SampledOde(NamedTuple):
    """A user's plant: its compiled derivative and output, `substeps` Runge-Kutta steps of `step` seconds a sample."""

    derivative: Callable[..., Any]
    output: Callable[..., Any]
    parameters: tuple[float, ...]
    step: float
    substeps: int
    delay: int


def kernel_for(plant: Any, entry: Any) -> Any:
    """The entry point to call with a plant: as it is, or uncached for a user's own plant."""
    return uncached(entry) if isinstance(plant, SampledOde) else entry


def check_same_delay(plant: Any, slots: int) -> None:
    """Make sure that a sampled plant fits the `slots` that the efforts on their way have: compiled code does not look.

    Raises:
        PlantError: it does not.
    """
    if plant.delay + 2 != slots:
        raise PlantError("dead_time cannot change while the loop runs: begin a new episode with it")


def plant_output(plant: Any, x: Any) -> Any:
    """The output y of a plant in state x."""


def plant_input(plant: Any, u: Any, d: Any) -> Any:
    """What enters the plant's dead time: effort and disturbance, or the effort alone."""


def plant_advance(plant: Any, x: Any, v_old: Any, v_new: Any, d: Any) -> Any:
    """The state one sample on. v_new, v_old: the input `delay` and `delay + 1` samples ago."""


def plant_derivative(plant: Any, x: Any, u: Any, d: Any) -> Any:
    """dx/dt of a nonlinear plant."""


@compiled
def runge_kutta(plant: Any, x: Any, u: Any, d: Any, step: Any) -> Any:
    """One step of the classical fourth-order Runge-Kutta method with u and d held."""
    k1 = plant_derivative(plant, x, u, d)
    k2 = plant_derivative(plant, along(x, k1, 0.5 * step), u, d)
    k3 = plant_derivative(plant, along(x, k2, 0.5 * step), u, d)
    k4 = plant_derivative(plant, along(x, k3, step), u, d)
    return runge_kutta_mean(x, step, k1, k2, k3, k4)


def _is(plant: Any, kind: type) -> bool:
    return isinstance(plant, types.BaseNamedTuple) and plant.instance_class is kind


@implementation_of(plant_output)
def _plant_output(plant: Any, x: Any) -> Any:
    if _is(plant, SampledOde):
        return lambda plant, x: plant.output(x, plant.parameters)
    return lambda plant, x: x[0]


@implementation_of(plant_input)
def _plant_input(plant: Any, u: Any, d: Any) -> Any:
    if _is(plant, SampledLinear) or _is(plant, SampledOffset):
        return lambda plant, u, d: u + d
    return lambda plant, u, d: u


@implementation_of(plant_derivative)
def _plant_derivative(plant: Any, x: Any, u: Any, d: Any) -> Any:
    if _is(plant, SampledSprott):
        return sprott_derivative
    return lambda plant, x, u, d: plant.derivative(x, u, d, plant.parameters)


@implementation_of(plant_advance)
def _plant_advance(plant: Any, x: Any, v_old: Any, v_new: Any, d: Any) -> Any:
    if _is(plant, SampledLinear):
        return lambda plant, x, v_old, v_new, d: linear_map(
            plant.phi, x, plant.gamma_old, v_old, plant.gamma_new, v_new
        )
    if _is(plant, SampledOffset):
        return lambda plant, x, v_old, v_new, d: along(
            linear_map(plant.phi, x, plant.gamma_old, v_old, plant.gamma_new, v_new), plant.constant, 1.0
        )
    if _is(plant, SampledSprott):
        return lambda plant, x, v_old, v_new, d: runge_kutta(plant, x, v_new, d, plant.step)
    return _ode_advance


def sprott_derivative(plant: Any, x: Any, u: Any, d: Any) -> Any:
    """Equation (16); a: damping, b: stiffness, c: size of the switched term."""
    sign = 1.0 if x[0] > 0.0 else (-1.0 if x[0] < 0.0 else 0.0)
    return (x[1], x[2] + u, plant.c * sign - plant.b * x[0] - x[1] - plant.a * x[2] + d)


def _ode_advance(plant: Any, x: Any, v_old: Any, v_new: Any, d: Any) -> Any:
    for _ in range(plant.substeps):
        x = runge_kutta(plant, x, v_new, d, plant.step)
    return x
