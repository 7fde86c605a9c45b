"""exp(-q), the same bits on every processor.

The C library picks its `exp` by processor, and the last bit of the result differs between them; this one is plain
IEEE arithmetic, so a controller and a simulation on different hosts agree (E1). It also vectorises over lanes.
"""

from __future__ import annotations

import numpy as np

from tdof_npid_ros.compiled import compiled
from tdof_npid_ros.compiled import fused_multiply_add as fma

_LOG2_E = 1.4426950408889634
_LN2_HIGH = 0.693147180369123816490  # the upper bits of ln 2, so that n * _LN2_HIGH is exact for |n| < 2048
_LN2_LOW = 1.90821492927058770002e-10
_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding it rounds to an integer, held in the low bits
_LARGEST = 700.0  # beyond it exp(-q) is taken as exp(-700) = 1e-304: finite, normal, and nothing beside 1


@compiled
def exp_minus(q: float) -> float:
    """exp(-q) for q >= 0, within 2 units in the last place; exactly 1 for q = 0.

    2**n * exp(f) with f = -q - n ln 2, |f| <= ln(2)/2, by the Taylor polynomial of degree 13 in Estrin's order.
    """
    q = min(q, _LARGEST)
    shifted = fma(q, -_LOG2_E, _ROUND)
    n = shifted - _ROUND
    f = fma(n, -_LN2_LOW, fma(n, -_LN2_HIGH, -q))
    f2 = f * f
    f4 = f2 * f2
    low = fma(f4, fma(f2, fma(f, 1 / 5040, 1 / 720), fma(f, 1 / 120, 1 / 24)), fma(f2, fma(f, 1 / 6, 0.5), 1.0 + f))
    high = fma(
        f4,
        fma(f, 1 / 6227020800, 1 / 479001600),
        fma(f2, fma(f, 1 / 39916800, 1 / 3628800), fma(f, 1 / 362880, 1 / 40320)),
    )
    mantissa = fma(f4 * f4, high, low)
    exponent = np.float64(shifted).view(np.int64) << 52
    return np.int64(np.float64(mantissa).view(np.int64) + exponent).view(np.float64)
