"""Rates and means with their 95 % intervals."""

import math
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import ArrayLike

CONFIDENCE = 0.95


@dataclass(frozen=True)
class ConfidenceInterval:
    """A statistic and its 95 % interval: NaN without observations, infinite with only one."""

    value: float
    low: float
    high: float

    def text(self, unit: str) -> str:
        """Formats the statistic with its interval, or whichever part is known."""
        if math.isnan(self.value):
            return "unknown"
        formatted = f"{self.value:.2f} {unit}"
        return formatted + (
            f" ({self.low:.2f} to {self.high:.2f})" if math.isfinite(self.low) else ""
        )


def estimate_rate(hits: int, trials: int) -> ConfidenceInterval:
    """Returns the fraction of hits, with Wilson's interval (1927), valid even for few trials."""
    if trials < 1:
        return ConfidenceInterval(math.nan, 0.0, 1.0)
    share = hits / trials
    z = float(scipy.special.ndtri(0.5 + CONFIDENCE / 2.0))
    scale = 1.0 + z * z / trials
    middle = (share + z * z / (2.0 * trials)) / scale
    half = (
        z
        / scale
        * math.sqrt(share * (1.0 - share) / trials + (z / (2.0 * trials)) ** 2)
    )
    # If all trials agree, rounding must not move the bound away from 0 or 1.
    low = 0.0 if hits == 0 else middle - half
    return ConfidenceInterval(share, low, 1.0 if hits == trials else middle + half)


def estimate_mean(values: ArrayLike) -> ConfidenceInterval:
    """Returns the mean of observations (n,) with the interval of Student's t."""
    observed = np.asarray(values, np.float64)
    middle = float(observed.mean()) if len(observed) else math.nan
    if len(observed) < 2:
        return ConfidenceInterval(middle, -math.inf, math.inf)
    quantile = float(scipy.special.stdtrit(len(observed) - 1, 0.5 + CONFIDENCE / 2.0))
    half = quantile * float(observed.std(ddof=1)) / math.sqrt(len(observed))
    return ConfidenceInterval(middle, middle - half, middle + half)


def bound_rate(failures: int, trials: int) -> tuple[float, float]:
    """Returns the 95 % bounds of a rate by Clopper and Pearson (1934).

    Without failures the upper bound is one-sided, about 3 / trials; a two-sided one would be 3.7 /
    trials. Since the data decide which of the two is used, the joint confidence is at
    least 92.5 %.
    """
    if trials == 0:
        return 0.0, 1.0
    if failures == 0:
        return 0.0, 1.0 - math.pow(1.0 - CONFIDENCE, 1.0 / trials)
    tail = (1.0 - CONFIDENCE) / 2.0
    passed = trials - failures
    low = float(scipy.special.betaincinv(failures, passed + 1, tail))
    if passed == 0:
        return low, 1.0
    return low, float(scipy.special.betaincinv(failures + 1, passed, 1.0 - tail))
