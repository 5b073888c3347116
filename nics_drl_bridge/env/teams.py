"""What tasks of several robots share: who sees whom and what, (..., M, P)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.task import bearing, distance

Array = NDArray[np.float64]


def seen(pose: Array, points: Array) -> Array:
    """Points (..., P, 2) as each robot (..., M, 3) sees them, (..., M, P, 3); see `bearing`."""
    return bearing(pose[..., :, None, :], points[..., None, :, :])


def distances(pose: Array, points: Array) -> Array:
    """From each robot (..., M, 3) to each point (..., P, 2): (..., M, P) [m]."""
    return distance(pose[..., :, None, :], points[..., None, :, :])


def others(of_all: Array) -> Array:
    """Each robot's row of the others, (..., M, M - 1, F) of (..., M, M, F): no diagonal."""
    count = of_all.shape[-2]
    index = [[k for k in range(count) if k != m] for m in range(count)]
    return np.asarray(of_all[..., np.arange(count)[:, None], np.array(index), :])


def total(values: Array) -> Array:
    """Sums (...) over the last axis, one after the other: the same bits for every batch."""
    summed = values[..., 0].copy()
    for k in range(1, values.shape[-1]):
        summed += values[..., k]
    return np.asarray(summed)
