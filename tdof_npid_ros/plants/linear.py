"""Linear plants: transfer functions with dead time, discretised exactly for a held input."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mpmath

from tdof_npid_ros.plants.kernels import SampledLinear
from tdof_npid_ros.plants.plant import PlantError, nanoseconds

DIGITS = 50  # of the matrix exponential: its entries, rounded, are the same doubles on every processor

LONGEST_DEAD_TIME = 1e9  # s
MOST_DELAY = 1_000_000  # samples: what a lane's efforts on their way take of memory is 8 MB

_PRECISION = threading.Lock()  # mpmath's precision belongs to the whole process


@dataclass(frozen=True)
class TransferFunction:
    """G(s) = numerator(s)/denominator(s) · exp(-dead_time s); the disturbance adds to the effort.

    The state is the observable canonical form's: x[0] is the output, so a parameter that changes while the loop runs
    does not make the output jump.

    Args:
        numerator, denominator: coefficients, highest power of s first; the numerator's degree is the lower one.
        dead_time: s, any number that is not negative; it need not be a multiple of the sample period.

    Raises:
        PlantError: not a strictly proper transfer function, or a dead time that is negative.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    dead_time: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "numerator", _trimmed("numerator", self.numerator))
        object.__setattr__(self, "denominator", _trimmed("denominator", self.denominator))
        if len(self.numerator) >= len(self.denominator):
            raise PlantError(
                f"numerator of degree {len(self.numerator) - 1} over denominator of degree "
                f"{len(self.denominator) - 1}: the numerator's degree must be the lower one (strictly proper)"
            )
        if not 0 <= self.dead_time <= LONGEST_DEAD_TIME:
            raise PlantError(f"dead_time is {self.dead_time} s: it must be from 0 to {LONGEST_DEAD_TIME:g}")

    @property
    def initial_state(self) -> tuple[float, ...]:
        """At rest: one zero per state."""
        return (0.0,) * (len(self.denominator) - 1)

    def sampled(self, sample_period_ns: int) -> SampledLinear:
        """The plant as the closed loop steps it, every `sample_period_ns`."""
        return _sample(self.numerator, self.denominator, nanoseconds(self.dead_time), sample_period_ns)


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
    delay, late_ns = divmod(dead_time_ns, period_ns)
    if delay > MOST_DELAY:
        raise PlantError(
            f"dead_time is {dead_time_ns / 1e9:g} s, {delay:,} samples: it must not be more than {MOST_DELAY:,}"
        )
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
