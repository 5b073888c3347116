"""What tasks of several robots share: who sees whom and what, (..., M, P)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env import kernels

Array = NDArray[np.float64]


def seen(pose: Array, points: Array) -> Array:
    """Points (..., P, 2) as each robot (..., M, 3) sees them, (..., M, P, 3); see `bearing`."""
    robots, places, shape = _batched(pose, points)
    out = np.empty((len(robots), robots.shape[1], places.shape[1], 3))
    kernels.pair_bearings(out, robots, places)
    return out.reshape(*shape, 3)


def distances(pose: Array, points: Array) -> Array:
    """From each robot (..., M, 3) to each point (..., P, 2): (..., M, P) [m]."""
    robots, places, shape = _batched(pose, points)
    out = np.empty((len(robots), robots.shape[1], places.shape[1]))
    kernels.pair_distances(out, robots, places)
    return out.reshape(shape)


def _batched(pose: Array, points: Array) -> tuple[Array, Array, tuple[int, ...]]:
    """(R, M, 3) poses and (R, P, 2) points of R worlds, and the shape (..., M, P)."""
    shape = (*pose.shape[:-1], points.shape[-2])
    poses = np.ascontiguousarray(pose, np.float64).reshape(-1, *pose.shape[-2:])
    places = np.ascontiguousarray(points, np.float64).reshape(-1, *points.shape[-2:])
    return poses, places, shape


def others(of_all: Array) -> Array:
    """Each robot's row of the others, (..., M, M - 1, F) of (..., M, M, F): no diagonal."""
    count = of_all.shape[-2]
    lead, width = of_all.shape[:-3], of_all.shape[-1]
    # Without its first, a row of all pairs has a diagonal entry after every `count` others.
    flat = of_all.reshape(*lead, count * count, width)[..., 1:, :]
    kept = flat.reshape(*lead, count - 1, count + 1, width)[..., :-1, :]
    return np.asarray(kept.reshape(*lead, count, count - 1, width))


def total(values: Array) -> Array:
    """Sums (...) over the last axis, one after the other: the same bits for every batch."""
    summed = values[..., 0].copy()
    for k in range(1, values.shape[-1]):
        summed += values[..., k]
    return np.asarray(summed)
