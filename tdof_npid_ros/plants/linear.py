"""Linear plants: transfer functions with dead time, discretised exactly for a held input."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import mpmath
import numpy as np

from tdof_npid_ros.parameter import ParameterError
from tdof_npid_ros.parameters import MODELS, OFFSETS
from tdof_npid_ros.plants.hold import hold_lanes
from tdof_npid_ros.plants.kernels import SampledLinear, SampledOffset
from tdof_npid_ros.plants.plant import PlantError, nanoseconds

_LINEAR = MODELS["transfer_function"]

DIGITS = 50  # of the matrix exponential: its entries, rounded, are the same doubles on every processor

LARGEST_ORDER = 20  # a step is compiled for its order: this one takes a minute
MOST_DELAY = 1_000_000  # samples: what a lane's efforts on their way take of memory is 8 MB

_PRECISION = threading.Lock()  # mpmath's precision belongs to the whole process


@dataclass(frozen=True)
class TransferFunction:
    """y - output_offset = G(s) (u - effort_offset + d), G(s) = numerator(s)/denominator(s) · exp(-dead_time s).

    The offsets are the operating point that the model is about: there the plant is at rest, and there it begins.

    The state is the observable canonical form's: x[0] is the output, so a parameter that changes while the loop runs
    does not make the output jump.

    Args:
        numerator, denominator: coefficients, highest power of s first; the numerator's degree is the lower one.
        dead_time: s, any number that is not negative; it need not be a multiple of the sample period.
        output_offset, effort_offset: the operating point, in the units of y and u.
        start: the output with which it begins, at rest; None: the operating point's.

    Raises:
        PlantError: not a strictly proper transfer function, or a dead time that is negative.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    dead_time: float = _LINEAR["dead_time"].default
    output_offset: float = _LINEAR["output_offset"].default
    effort_offset: float = _LINEAR["effort_offset"].default
    start: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "numerator", _trimmed("numerator", self.numerator))
        object.__setattr__(self, "denominator", _trimmed("denominator", self.denominator))
        if len(self.numerator) >= len(self.denominator):
            raise PlantError(
                f"numerator of degree {len(self.numerator) - 1} over denominator of degree "
                f"{len(self.denominator) - 1}: the numerator's degree must be the lower one (strictly proper)"
            )
        if len(self.denominator) - 1 > LARGEST_ORDER:
            raise PlantError(
                f"denominator is of degree {len(self.denominator) - 1}: it must be {LARGEST_ORDER} or less"
            )
        try:
            for name in ("dead_time", *OFFSETS):
                object.__setattr__(self, name, _LINEAR[name].checked(getattr(self, name)))
        except ParameterError as error:
            raise PlantError(str(error)) from None

    @property
    def initial_state(self) -> tuple[float, ...]:
        """At rest: the output, and what holds it there; zeros at an operating point of zeros."""
        leading = self.denominator[0]
        deviation, input_ = self.initial_output - self.output_offset, self.initial_effort - self.effort_offset
        order = len(self.denominator) - 1
        b = (0.0,) * (order - len(self.numerator)) + self.numerator
        held = (
            0.0 + (self.denominator[i + 1] * deviation - b[i] * input_) / leading for i in range(order - 1)
        )  # no -0.0
        return (self.initial_output, *held)

    @property
    def initial_output(self) -> float:
        """y at time 0."""
        return self.output_offset if self.start is None else self.start

    @property
    def initial_effort(self) -> float:
        """u before time 0: what holds the output where it begins."""
        gain, integrates = self.numerator[-1], self.denominator[-1] == 0.0
        if self.start is None or integrates:
            return self.effort_offset
        return self.effort_offset + (self.start - self.output_offset) * self.denominator[-1] / gain

    def at_rest(self, output: float) -> TransferFunction:
        """The same plant, beginning at rest with this output."""
        if self.numerator[-1] == 0.0 and output != self.output_offset:
            raise PlantError(
                f"no effort holds the output at {output:g}: the numerator is 0 at s = 0, so the plant rests at "
                f"{self.output_offset:g} alone"
            )
        return replace(self, start=output)

    def sampled(self, sample_period_ns: int) -> SampledLinear | SampledOffset:
        """The plant as the closed loop steps it, every `sample_period_ns`."""
        transfer = (self.numerator, self.denominator, nanoseconds(self.dead_time), sample_period_ns)
        if self.output_offset == 0.0 and self.effort_offset == 0.0:
            return _sample(*transfer)
        return _sample_offset(*transfer, self.output_offset, self.effort_offset)


def _trimmed(name: str, coefficients: Sequence[float]) -> tuple[float, ...]:
    values = tuple(float(c) for c in coefficients)
    if not all(math.isfinite(c) for c in values):
        raise PlantError(f"{name} is {list(values)}: every coefficient must be finite")
    while values and values[0] == 0.0:
        values = values[1:]
    if not values:
        raise PlantError(f"{name} has no coefficient other than 0")
    return values


@lru_cache(maxsize=64)
def _sample(
    numerator: tuple[float, ...], denominator: tuple[float, ...], dead_time_ns: int, period_ns: int
) -> SampledLinear:
    """Exact zero-order-hold equivalent.

    With dead time (delay + τ/h) samples, 0 <= τ < h, the input seen in [t_k, t_k + h) is v[k-delay-1] for τ seconds
    and v[k-delay] for the rest: both contributions are blocks of exp([[A, B], [0, 0]] t).
    """
    delay, late_ns = _delay_of(dead_time_ns, period_ns)
    with _PRECISION, mpmath.workdps(DIGITS):
        period, late = mpmath.mpf(period_ns) / 10**9, mpmath.mpf(late_ns) / 10**9
        a, b = _observable_form(numerator, denominator)
        phi_rest, gamma_new = _hold(a, b, period - late)
        _, gamma_late = _hold(a, b, late)
        phi, _ = _hold(a, b, period)
        gamma_old = phi_rest * gamma_late
        order = len(denominator) - 1
        return SampledLinear(
            phi=tuple(tuple(float(phi[i, j]) for j in range(order)) for i in range(order)),
            gamma_old=tuple(float(gamma_old[i]) for i in range(order)),
            gamma_new=tuple(float(gamma_new[i]) for i in range(order)),
            delay=delay,
        )


@lru_cache(maxsize=64)
def _sample_offset(
    numerator: tuple[float, ...],
    denominator: tuple[float, ...],
    dead_time_ns: int,
    period_ns: int,
    output_offset: float,
    effort_offset: float,
) -> SampledOffset:
    """As `_sample`, and a constant: x⁺ - c = phi (x - c) + gamma (v - v0), c = (y0, 0, …)."""
    return _about(_sample(numerator, denominator, dead_time_ns, period_ns), output_offset, effort_offset)


def _about(linear: SampledLinear, output_offset: float, effort_offset: float) -> SampledOffset:
    with _PRECISION, mpmath.workdps(DIGITS):
        constant = tuple(
            float(
                mpmath.mpf(output_offset) * ((i == 0) - mpmath.mpf(linear.phi[i][0]))
                - mpmath.mpf(effort_offset) * (mpmath.mpf(linear.gamma_old[i]) + mpmath.mpf(linear.gamma_new[i]))
            )
            for i in range(len(linear.phi))
        )
    return SampledOffset(*linear, constant=constant)


def sampled_lanes(plants: Sequence[TransferFunction], sample_period_ns: int) -> list[SampledLinear | SampledOffset]:
    """Many plants as the closed loop steps them: the bits of `TransferFunction.sampled`, some hundred times faster.

    Raises:
        PlantError: their orders differ.
    """
    orders = {len(plant.denominator) - 1 for plant in plants}
    if len(orders) > 1:
        raise PlantError(f"plants of the orders {sorted(orders)}: all lanes need the same")
    order, count = orders.pop(), len(plants)
    delays = [_delay_of(nanoseconds(plant.dead_time), sample_period_ns) for plant in plants]
    numerator = np.array([(0.0,) * (order - len(plant.numerator)) + plant.numerator for plant in plants])
    denominator = np.array([plant.denominator for plant in plants])
    late = np.array([float(late_ns) for _, late_ns in delays])
    phi, sure = np.empty((count, order, order)), np.empty(count, bool)
    old, new = np.empty((2, count, order))
    hold_lanes(numerator, denominator, late, float(sample_period_ns), phi, old, new, sure)
    found: list[SampledLinear | SampledOffset] = []
    for plant, (delay, _), is_sure, *step in zip(
        plants, delays, sure.tolist(), phi.tolist(), old.tolist(), new.tolist(), strict=True
    ):
        if not is_sure:
            found.append(plant.sampled(sample_period_ns))
            continue
        linear = SampledLinear(tuple(map(tuple, step[0])), tuple(step[1]), tuple(step[2]), delay)
        at_zero = plant.output_offset == 0.0 and plant.effort_offset == 0.0
        found.append(linear if at_zero else _about(linear, plant.output_offset, plant.effort_offset))
    return found


def _delay_of(dead_time_ns: int, period_ns: int) -> tuple[int, int]:
    """A dead time in whole samples, and the rest in ns.

    Raises:
        PlantError: it takes too much memory.
    """
    delay, late_ns = divmod(dead_time_ns, period_ns)
    if delay > MOST_DELAY:
        raise PlantError(
            f"dead_time is {dead_time_ns / 1e9:g} s, {delay:,} samples: it must not be more than {MOST_DELAY:,}"
        )
    return delay, late_ns


def _observable_form(
    numerator: tuple[float, ...], denominator: tuple[float, ...]
) -> tuple[mpmath.matrix, mpmath.matrix]:
    order = len(denominator) - 1
    a, b = mpmath.zeros(order), mpmath.zeros(order, 1)
    leading = mpmath.mpf(denominator[0])
    padded = (0.0,) * (order - len(numerator)) + numerator
    for i in range(order):
        a[i, 0] = -mpmath.mpf(denominator[i + 1]) / leading
        b[i] = mpmath.mpf(padded[i]) / leading
        if i + 1 < order:
            a[i, i + 1] = mpmath.mpf(1)
    return a, b


def _hold(a: mpmath.matrix, b: mpmath.matrix, time: mpmath.mpf) -> tuple[mpmath.matrix, mpmath.matrix]:
    """exp(A t) and the integral of exp(A s) B over 0..t."""
    order = a.rows
    block = mpmath.zeros(order + 1)
    block[:order, :order] = a * time
    block[:order, order] = b * time
    exponential = mpmath.expm(block, method="taylor")
    return exponential[:order, :order], exponential[:order, order]
