"""Stamps: bursts of arrivals become sample times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_STAMPS = 20
BURSTY = 5.0
"""In bursts the mean interval is this many times the 30th percentile of the intervals."""
WITHIN_BURST = 0.25
"""Share of the period below which two stamps belong to one burst."""


@dataclass(frozen=True)
class Bursts:
    """Arrivals that come several at a time.

    Attributes:
        period_s: usual time between two bursts [s].
        size: usual number of samples in one.
        of: (T,) the burst that each sample belongs to.
        newest: (K,) index of the last sample of each burst, the freshest on arrival.
    """

    period_s: float
    size: float
    of: NDArray[np.intp]
    newest: NDArray[np.intp]


def find_bursts(t: Array) -> Bursts | None:
    """Finds bursts in stamps (T,) [s]; None when the samples come one by one."""
    if len(t) < MIN_STAMPS:
        return None
    gaps = np.diff(t)
    if gaps.mean() <= BURSTY * np.percentile(gaps, 30):
        return None
    period = float(np.median(gaps[gaps > gaps.mean()]))
    starts = np.concatenate([[True], gaps > WITHIN_BURST * period])
    of = np.cumsum(starts) - 1
    newest = np.append(np.flatnonzero(starts)[1:] - 1, len(t) - 1)
    return Bursts(period, float(np.median(np.bincount(of))), of, newest)


def spread(t: Array, bursts: Bursts | None) -> Array:
    """Sample times (T,) of arrival stamps (T,) [s].

    The samples of a burst were taken one after the other since the burst before, the newest
    just before its arrival. After a gap they are taken to fill one period, or more if there
    are more of them than usual.
    """
    if bursts is None:
        return t
    count = np.bincount(bursts.of)
    arrival = t[np.concatenate([[0], bursts.newest[:-1] + 1])]
    since = np.diff(arrival, prepend=arrival[0] - bursts.period_s)
    span = np.minimum(since, bursts.period_s * np.maximum(1.0, count / bursts.size))
    behind = bursts.newest[bursts.of] - np.arange(len(t))
    return np.asarray(arrival[bursts.of] - span[bursts.of] * behind / count[bursts.of])


def newest(t: Array, bursts: Bursts | None) -> NDArray[np.intp]:
    """Indices of the samples whose time is known best: the newest of each burst, or all."""
    return np.arange(len(t)) if bursts is None else bursts.newest
