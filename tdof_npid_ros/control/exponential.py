"""exp(-q), the same bits on every processor.

The C library picks its `exp` by processor, and the last bit of the result differs between them; this one is plain
IEEE arithmetic, so a controller and a simulation on different hosts agree. It also vectorises over lanes.
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
# exp(f) = 1 + f + f² (c0 + c1 f + … + c9 f⁹) within 4e-18 for |f| <= ln(2)/2: minimax, by Remez' algorithm.
_C = (
    0.5000000000000011, 0.16666666666666413, 0.041666666666530246, 0.008333333333494357, 0.0013888888943603685,
    0.000198412695067425, 2.4801493129301335e-05, 2.755758628627501e-06, 2.7630236589949976e-07, 2.500007031530457e-08,
)  # fmt: skip


@compiled
def exp_minus(q: float) -> float:
    """exp(-q) for q >= 0, within 2 units in the last place; exactly 1 for q = 0.

    2**n * exp(f) with f = -q - n ln 2, |f| <= ln(2)/2, by a polynomial of degree 11 in Estrin's order.
    """
    q = min(q, _LARGEST)
    shifted = fma(q, -_LOG2_E, _ROUND)
    n = shifted - _ROUND
    f = fma(n, -_LN2_LOW, fma(n, -_LN2_HIGH, -q))
    f2 = f * f
    f4 = f2 * f2
    low = fma(f2, fma(f, _C[1], _C[0]), 1.0 + f)
    middle = fma(f2, fma(f, _C[5], _C[4]), fma(f, _C[3], _C[2]))
    high = fma(f2, fma(f, _C[9], _C[8]), fma(f, _C[7], _C[6]))
    mantissa = fma(f4, fma(f4, high, middle), low)
    exponent = np.float64(shifted).view(np.int64) << 52
    return np.int64(np.float64(mantissa).view(np.int64) + exponent).view(np.float64)
