"""The noise of a record: what of it is correlated from sample to sample, and how large it is."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

MOST_LAGS = 12
SAMPLES_PER_LAG = 40
WORTH = 10.0  # of the criterion, for a longer model of the noise


def autoregression(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """The coefficients of noise[k] = e[k] + sum of c_j noise[k - j], by Yule and Walker; none where it is white.

    The least order wins whose AIC nothing longer betters by more than `WORTH`.
    """
    count = sum(map(len, residuals))
    most = min(MOST_LAGS, count // SAMPLES_PER_LAG)
    covariance = autocovariance(residuals, most)
    if most < 1 or not covariance[0] > 0.0:
        return np.zeros(0)
    found = [np.zeros(0)]
    criteria = [count * math.log(covariance[0])]
    variance, coefficients = covariance[0], np.zeros(0)
    for order in range(1, most + 1):  # Levinson and Durbin
        reflection = (covariance[order] - coefficients @ covariance[order - 1 : 0 : -1]) / variance
        coefficients = np.append(coefficients - reflection * coefficients[::-1], reflection)
        variance *= max(1.0 - reflection**2, 1e-12)
        found.append(coefficients)
        criteria.append(count * math.log(variance) + 2.0 * order)
    return next(c for c, criterion in zip(found, criteria, strict=True) if criterion <= min(criteria) + WORTH)


def autocovariance(residuals: Sequence[np.ndarray], lags: int) -> np.ndarray:
    """At lags 0 to `lags`, over all stretches, (lags + 1,)."""
    count = sum(map(len, residuals))
    return np.array(
        [
            sum(float(r[lag:] @ r[: max(len(r) - lag, 0)]) for r in residuals if len(r) > lag) / count
            for lag in range(lags + 1)
        ]
    )


def roughness(outputs: Sequence[np.ndarray]) -> float:
    """Standard deviation of white noise as second differences show it: robustly, so that steps do not count."""
    second = np.concatenate([np.diff(y, 2) for y in outputs if len(y) > 2] or [np.zeros(1)])
    return 1.4826 * float(np.median(np.abs(second))) / math.sqrt(6.0)
