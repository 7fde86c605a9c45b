"""Linear plants under a held input, many at once: the same doubles as 50 digits give, in double-double arithmetic.

A double-double is a pair of doubles, the second no more than half a unit in the last place of the first: 106 bits. The
Taylor series of exp(A t) is summed beside a bound of its rounding errors. Where that bound leaves open which double is
the nearest one (about once in a million numbers), or the series would be long, the caller computes with more digits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tdof_npid_ros.compiled import called, compiled, entry_point, fused_multiply_add

LARGEST_NORM = 4.0  # of |A| t: beyond it, terms grow so much before they fall that digits are lost
MOST_TERMS = 80
ERROR = 2.0**-97  # relative, of a term: 20 operations of 2**-104 each, and a factor of 6 to be sure
NEGLIGIBLE = 2.0**-120  # of the largest sum: a term below it ends the series


@compiled
def _two_sum(a: Any, b: Any) -> Any:
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@compiled
def _quick_sum(a: Any, b: Any) -> Any:
    total = a + b
    return total, b - (total - a)


@compiled
def _add(a: Any, b: Any) -> Any:
    high, low = _two_sum(a[0], b[0])
    more, least = _two_sum(a[1], b[1])
    high, low = _quick_sum(high, low + more)
    return _quick_sum(high, low + least)


@compiled
def _multiply(a: Any, b: Any) -> Any:
    high = a[0] * b[0]
    low = fused_multiply_add(a[0], b[0], -high)
    return _quick_sum(high, low + (a[0] * b[1] + a[1] * b[0]))


@compiled
def _divide(a: Any, by: Any) -> Any:
    """A double-double by a double."""
    first = a[0] / by
    product = first * by
    rest = (a[0] - product) - fused_multiply_add(first, by, -product) + a[1]
    second = rest / by
    product = second * by
    rest = (rest - product) - fused_multiply_add(second, by, -product)
    high, low = _quick_sum(first, second)
    return _quick_sum(high, low + rest / by)


@called
def _exponential(a: Any, b: Any, t: Any, work: Any, phi: Any, gamma: Any) -> Any:
    """exp(A t) and the integral of exp(A s) B over 0..t, A in observable form; False: the series would be too long.

    Args:
        a, b: A's first column and B, (order, 2).
        t: s, a pair.
        work: of the terms, (order, order, 3).
        phi, gamma: written: high and low part, and the bound of their errors, (order, order, 3) and (order, 3).
    """
    n = a.shape[0]
    norm = 1.0
    for i in range(n):
        norm = max(norm, abs(a[i, 0]) + 1.0)
    if not norm * t[0] <= LARGEST_NORM:
        return False
    work[:], phi[:], gamma[:] = 0.0, 0.0, 0.0
    for i in range(n):
        work[i, i, 0] = work[i, i, 2] = 1.0
    for k in range(MOST_TERMS):  # work: (A t)^k / k!, and the same of |A|
        largest = 0.0
        share = _divide(t, k + 1.0)
        for i in range(n):
            moved, most = (0.0, 0.0), 0.0
            driven, most_driven = (0.0, 0.0), 0.0
            for j in range(n):
                term = (work[i, j, 0], work[i, j, 1])
                largest = max(largest, work[i, j, 2])
                phi[i, j, 0], phi[i, j, 1] = _add((phi[i, j, 0], phi[i, j, 1]), term)
                phi[i, j, 2] += (k + 1.0) * n * ERROR * work[i, j, 2]
                moved = _add(moved, _multiply(term, (a[j, 0], a[j, 1])))
                most += work[i, j, 2] * abs(a[j, 0])
                driven = _add(driven, _multiply(term, (b[j, 0], b[j, 1])))
                most_driven += work[i, j, 2] * abs(b[j, 0])
            driven = _multiply(driven, share)
            gamma[i, 0], gamma[i, 1] = _add((gamma[i, 0], gamma[i, 1]), driven)
            gamma[i, 2] += (k + 2.0) * n * ERROR * most_driven * share[0]
            for j in range(n - 1, 0, -1):  # times A: the first column is a, what was in column j goes to j + 1
                work[i, j, 0], work[i, j, 1] = _multiply((work[i, j - 1, 0], work[i, j - 1, 1]), share)
                work[i, j, 2] = work[i, j - 1, 2] * share[0]
            work[i, 0, 0], work[i, 0, 1] = _multiply(moved, share)
            work[i, 0, 2] = most * share[0]
        if largest < NEGLIGIBLE:
            # What is left out is less than the last term's double: the bounds of all that is not exactly 0 take it.
            for i in range(n):
                for j in range(n):
                    phi[i, j, 2] += (phi[i, j, 2] > 0.0) * 4.0 * NEGLIGIBLE * phi[i, j, 2] / ERROR
                gamma[i, 2] += (gamma[i, 2] > 0.0) * 4.0 * NEGLIGIBLE * gamma[i, 2] / ERROR
            return True
    return False


@compiled
def _is_sure(high: Any, low: Any, bound: Any) -> Any:
    """Whether the nearest double of a number within `bound` of high + low is `high`."""
    return high + (low + 2.0 * bound) == high and high + (low - 2.0 * bound) == high


@entry_point
def hold_lanes(
    numerator: np.ndarray,
    denominator: np.ndarray,
    late_ns: np.ndarray,
    period_ns: float,
    phi: np.ndarray,
    gamma_old: np.ndarray,
    gamma_new: np.ndarray,
    sure: np.ndarray,
) -> None:
    """The step of many plants of one order, sampled under a held input that comes `late_ns` within each sample.

    Args:
        numerator: (plants, order), the highest power first, and `denominator`, (plants, order + 1).
        late_ns: (plants,), whole numbers from 0 to below period_ns.
        phi: (plants, order, order), written, as are `gamma_old` and `gamma_new`, (plants, order).
        sure: (plants,), written: whether all of a plant's numbers are the nearest doubles.
    """
    plants, n = numerator.shape
    a, b = np.empty((n, 2)), np.empty((n, 2))
    work = np.empty((n, n, 3))
    whole, rest, late = np.empty((n, n, 3)), np.empty((n, n, 3)), np.empty((n, n, 3))
    driven, new, old = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    for p in range(plants):
        for i in range(n):
            a[i, 0], a[i, 1] = _divide((-denominator[p, i + 1], 0.0), denominator[p, 0])
            b[i, 0], b[i, 1] = _divide((numerator[p, i], 0.0), denominator[p, 0])
        ok = _exponential(a, b, _divide((period_ns, 0.0), 1e9), work, whole, driven)
        if ok and late_ns[p] > 0.0:
            ok = _exponential(a, b, _divide((period_ns - late_ns[p], 0.0), 1e9), work, rest, new)
            ok = ok and _exponential(a, b, _divide((late_ns[p], 0.0), 1e9), work, late, old)
        elif ok:
            new[:] = driven
        sure[p] = ok
        if not ok:
            continue
        for i in range(n):
            for j in range(n):
                phi[p, i, j] = whole[i, j, 0]
                sure[p] = sure[p] and _is_sure(whole[i, j, 0], whole[i, j, 1], whole[i, j, 2])
            gamma_new[p, i] = new[i, 0]
            sure[p] = sure[p] and _is_sure(new[i, 0], new[i, 1], new[i, 2])
            gamma_old[p, i] = 0.0
            if late_ns[p] > 0.0:
                total, bound = (0.0, 0.0), 0.0
                for j in range(n):
                    total = _add(total, _multiply((rest[i, j, 0], rest[i, j, 1]), (old[j, 0], old[j, 1])))
                    bound += rest[i, j, 2] * (abs(old[j, 0]) + old[j, 2]) + abs(rest[i, j, 0]) * old[j, 2]
                    bound += n * ERROR * abs(rest[i, j, 0] * old[j, 0])
                gamma_old[p, i] = total[0]
                sure[p] = sure[p] and _is_sure(total[0], total[1], bound)
