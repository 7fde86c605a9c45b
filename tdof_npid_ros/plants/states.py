"""A plant's state as a tuple of numbers, in compiled code.

Each function takes a tuple apart, first number and rest, so that its loop over the states is unrolled when it is
compiled: a lane's state stays in registers, and the loop over lanes can be vectorised.
"""

from __future__ import annotations

from typing import Any

from tdof_npid_ros.compiled import implementation_of


def along(x: Any, slope: Any, step: Any) -> Any:
    """x + step · slope."""


def dot(row: Any, x: Any) -> Any:
    """The scalar product."""


def linear_map(phi: Any, x: Any, gamma_old: Any, v_old: Any, gamma_new: Any, v_new: Any) -> Any:
    """phi x + gamma_old v_old + gamma_new v_new."""


def runge_kutta_mean(x: Any, step: Any, k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    """x + step/6 · (k1 + 2 k2 + 2 k3 + k4)."""


def either(condition: Any, x: Any, otherwise: Any) -> Any:
    """x where the condition holds, else the other tuple."""


def loaded(x: Any, array: Any, at: Any, stride: Any) -> Any:
    """A tuple like x from array[at], array[at + stride], …"""


def store(x: Any, array: Any, at: Any, stride: Any) -> Any:
    """Write x to array[at], array[at + stride], …"""


@implementation_of(along)
def _along(x: Any, slope: Any, step: Any) -> Any:
    if len(x) == 0:
        return lambda x, slope, step: ()
    return lambda x, slope, step: (x[0] + step * slope[0], *along(x[1:], slope[1:], step))


@implementation_of(dot)
def _dot(row: Any, x: Any) -> Any:
    if len(x) == 1:
        return lambda row, x: row[0] * x[0]
    return lambda row, x: row[0] * x[0] + dot(row[1:], x[1:])


@implementation_of(linear_map)
def _linear_map(phi: Any, x: Any, gamma_old: Any, v_old: Any, gamma_new: Any, v_new: Any) -> Any:
    if len(phi) == 0:
        return lambda phi, x, gamma_old, v_old, gamma_new, v_new: ()
    return lambda phi, x, gamma_old, v_old, gamma_new, v_new: (
        dot(phi[0], x) + (gamma_old[0] * v_old + gamma_new[0] * v_new),
        *linear_map(phi[1:], x, gamma_old[1:], v_old, gamma_new[1:], v_new),
    )


@implementation_of(runge_kutta_mean)
def _runge_kutta_mean(x: Any, step: Any, k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    if len(x) == 0:
        return lambda x, step, k1, k2, k3, k4: ()
    return lambda x, step, k1, k2, k3, k4: (
        x[0] + step / 6.0 * (k1[0] + 2.0 * k2[0] + 2.0 * k3[0] + k4[0]),
        *runge_kutta_mean(x[1:], step, k1[1:], k2[1:], k3[1:], k4[1:]),
    )


@implementation_of(either)
def _either(condition: Any, x: Any, otherwise: Any) -> Any:
    if len(x) == 0:
        return lambda condition, x, otherwise: ()
    return lambda condition, x, otherwise: (
        x[0] if condition else otherwise[0],
        *either(condition, x[1:], otherwise[1:]),
    )


@implementation_of(loaded)
def _loaded(x: Any, array: Any, at: Any, stride: Any) -> Any:
    if len(x) == 0:
        return lambda x, array, at, stride: ()
    return lambda x, array, at, stride: (array[at], *loaded(x[1:], array, at + stride, stride))


@implementation_of(store)
def _store(x: Any, array: Any, at: Any, stride: Any) -> Any:
    if len(x) == 0:
        return lambda x, array, at, stride: None

    def store_first(x: Any, array: Any, at: Any, stride: Any) -> Any:
        array[at] = x[0]
        store(x[1:], array, at + stride, stride)

    return store_first
