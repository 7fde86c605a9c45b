"""The compiled side of the plants: what the closed loop does with one lane of a plant in one step.

A sampled plant is a named tuple of numbers. Numba specialises the closed loop on its type, so the number of states
is known to the compiler and a lane's state lives in registers. Three functions are all the loop knows of a plant:
`plant_output`, `plant_input` and `plant_advance`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import types

from tdof_npid_ros.compiled import compiled, implementation_of, uncached
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.plants.states import along, linear_map, runge_kutta_mean

_ALL_WHOLE = 2.0**51  # floats from here on have no room for a fraction worth rounding
_ROUND = 1.5 * 2.0**52  # adding it and taking it away rounds to a whole number


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


class SampledNoisy(NamedTuple):
    """A plant whose output bears noise; its state is the plant's, then the step and the episode (`plants.noise`)."""

    plant: Any
    noise: float
    quantum: float
    seed: float
    delay: int


def kernel_for(plant: Any, entry: Any) -> Any:
    """The entry point to call with a plant: as it is, or uncached for a user's own plant."""
    inner = plant
    while hasattr(inner, "plant"):  # noisy, or one of many lanes'
        inner = inner.plant
    return uncached(entry) if isinstance(inner, SampledOde) else entry


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
def _mixed(z: Any) -> Any:
    """The finaliser of SplitMix64: each bit of the result depends on all of z."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled
def _sum_of_quarters(z: Any) -> Any:
    """The sum of the four numbers of 16 bits in z."""
    low, next_, high = np.uint64(0xFFFF), np.uint64(16), np.uint64(32)
    return (z & low) + ((z >> next_) & low) + ((z >> high) & low) + (z >> np.uint64(48))


@compiled
def standard_noise(seed: Any, episode: Any, step: Any) -> Any:
    """Nearly normal noise of mean 0 and deviation 1: the sum of twelve uniform numbers; the arguments are whole."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    key = _mixed(_mixed(np.uint64(seed) + golden) ^ np.uint64(episode))
    first = key + np.uint64(3) * np.uint64(step) * golden
    total = _sum_of_quarters(_mixed(first + golden))
    total += _sum_of_quarters(_mixed(first + np.uint64(2) * golden))
    total += _sum_of_quarters(_mixed(first + np.uint64(3) * golden))
    return (np.float64(np.int64(total)) - 393210.0) * (1.0 / 65536.0)


@compiled
def measured(y: Any, noise: Any, quantum: Any, seed: Any, step: Any, episode: Any) -> Any:
    """An output as it is measured: with noise, then rounded to a quantum, to even where it lies between two."""
    y = y + noise * standard_noise(seed, episode, step)
    if quantum > 0.0:
        quanta = y / quantum
        if abs(quanta) < _ALL_WHOLE:
            y = ((quanta + _ROUND) - _ROUND) * quantum
    return y


@compiled
def runge_kutta(plant: Any, x: Any, u: Any, d: Any, step: Any) -> Any:
    """One step of the classical fourth-order Runge-Kutta method with u and d held."""
    k1 = plant_derivative(plant, x, u, d)
    k2 = plant_derivative(plant, along(x, k1, 0.5 * step), u, d)
    k3 = plant_derivative(plant, along(x, k2, 0.5 * step), u, d)
    k4 = plant_derivative(plant, along(x, k3, step), u, d)
    return runge_kutta_mean(x, step, k1, k2, k3, k4)


def is_sampled(plant: Any, kind: type) -> bool:
    """Whether a plant's type, as Numba knows it, is that of a named tuple."""
    return isinstance(plant, types.BaseNamedTuple) and plant.instance_class is kind


@implementation_of(plant_output)
def _plant_output(plant: Any, x: Any) -> Any:
    if is_sampled(plant, SampledNoisy):
        return lambda plant, x: measured(
            plant_output(plant.plant, x[:-2]), plant.noise, plant.quantum, plant.seed, x[-2], x[-1]
        )
    if is_sampled(plant, SampledOde):
        return lambda plant, x: plant.output(x, plant.parameters)
    return lambda plant, x: x[0]


@implementation_of(plant_input)
def _plant_input(plant: Any, u: Any, d: Any) -> Any:
    if is_sampled(plant, SampledNoisy):
        return lambda plant, u, d: plant_input(plant.plant, u, d)
    if is_sampled(plant, SampledLinear) or is_sampled(plant, SampledOffset):
        return lambda plant, u, d: u + d
    return lambda plant, u, d: u


@implementation_of(plant_derivative)
def _plant_derivative(plant: Any, x: Any, u: Any, d: Any) -> Any:
    if is_sampled(plant, SampledSprott):
        return sprott_derivative
    return lambda plant, x, u, d: plant.derivative(x, u, d, plant.parameters)


@implementation_of(plant_advance)
def _plant_advance(plant: Any, x: Any, v_old: Any, v_new: Any, d: Any) -> Any:
    if is_sampled(plant, SampledNoisy):
        return lambda plant, x, v_old, v_new, d: (
            *plant_advance(plant.plant, x[:-2], v_old, v_new, d),
            x[-2] + 1.0,
            x[-1],
        )
    if is_sampled(plant, SampledLinear):
        return lambda plant, x, v_old, v_new, d: linear_map(
            plant.phi, x, plant.gamma_old, v_old, plant.gamma_new, v_new
        )
    if is_sampled(plant, SampledOffset):
        return lambda plant, x, v_old, v_new, d: along(
            linear_map(plant.phi, x, plant.gamma_old, v_old, plant.gamma_new, v_new), plant.constant, 1.0
        )
    if is_sampled(plant, SampledSprott):
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
