"""95 % intervals: of a rate by Wilson's score, of a mean by Student's t."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A figure and the interval that holds the true one with 95 % confidence.

    Attributes:
        value: NaN where nothing was observed.
        low, high: ends of the interval; infinite for the mean of a single observation.
    """

    value: float
    low: float
    high: float


def rate(hits: int, trials: int) -> Estimate:
    """A share of trials with Wilson's score interval (1927), which holds for few trials too."""
    if trials < 1:
        return Estimate(math.nan, 0.0, 1.0)
    share, z = hits / trials, float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))
    scale = 1.0 + z * z / trials
    middle = (share + z * z / (2.0 * trials)) / scale
    half = z / scale * math.sqrt(share * (1.0 - share) / trials + (z / (2.0 * trials)) ** 2)
    # Of no hit or none but hits, rounding must not part the end from 0 or 1.
    low = 0.0 if hits == 0 else middle - half
    return Estimate(share, low, 1.0 if hits == trials else middle + half)


def mean(values: ArrayLike) -> Estimate:
    """The mean of observations (n,) with the interval of Student's t."""
    seen = np.asarray(values, np.float64)
    if not len(seen):
        return Estimate(math.nan, -math.inf, math.inf)
    middle = float(seen.mean())
    if len(seen) == 1:
        return Estimate(middle, -math.inf, math.inf)
    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(seen) - 1))
    half = quantile * float(seen.std(ddof=1)) / math.sqrt(len(seen))
    return Estimate(middle, middle - half, middle + half)
