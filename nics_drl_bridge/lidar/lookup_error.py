"""How far a look-up is off for one shape: what the renderer `auto` decides by."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.lidar import scan_kernels
from nics_drl_bridge.lidar.shapes import place

Array = NDArray[np.float64]
PLACES, SEED = 512, 0
NO_WALLS = np.zeros((0, 4))


def lookup_error(
    exact: tuple[Any, ...],
    baked: tuple[Any, ...],
    room: tuple[NDArray[Any], ...],
    shape: int,
    radius: float,
) -> float:
    """RMSE of the ranges to a shape, over the beams that return when looked up and in truth.

    Silhouettes are no part of it: they are exact. The shape stands at places that are spread
    evenly over what the lidar sees, the same for all.

    Args:
        exact: `Scanner.arguments` of that renderer.
        baked: the same of this one.
        room: see `scanner.Scanner.room`.
        shape: its index in the table.
        radius: of the shape [m].

    Returns:
        The error [m]; NaN where no beam returns.
    """
    mount, directions, beams, limits = exact[:4]
    robots = np.tile([-mount[0], -mount[1], 0.0], (PLACES, 1, 1))  # the lidar is at the origin
    bodies = _around(mount[2] + beams[0], beams[1] * beams[3], limits[1], shape, radius)
    scans = np.empty((2, PLACES, 1, len(directions)), np.float32)
    for ranges, sensor in zip(scans, (exact, baked), strict=True):
        worlds = np.arange(PLACES)
        scan_kernels.scan_worlds(ranges, robots, worlds, bodies, -1, NO_WALLS, sensor, room)
    one, other = scans[:, np.isfinite(scans).all(axis=0)].astype(np.float64)
    return float(np.sqrt(np.mean(np.square(one - other)))) if one.size else float("nan")


def _around(begin: float, view: float, range_max: float, shape: int, radius: float) -> Array:
    """(PLACES, 1, 7) a body anywhere in a view that begins at an angle and is so wide [rad]."""
    rng = np.random.default_rng(SEED)
    distance = np.sqrt(rng.uniform(radius**2, (range_max + radius) ** 2, PLACES))
    bearing, heading = begin + rng.uniform(0.0, view, PLACES), rng.uniform(-np.pi, np.pi, PLACES)
    poses = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), heading], axis=1)
    return place(poses[:, None], radius, shape)
