"""At which distances a shape may be looked up: what the renderer `auto` decides by."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.lidar import scan_kernels
from nics_drl_bridge.lidar.shapes import place

Array = NDArray[np.float64]
RINGS, PLACES, BANDS, SEED = 13, 256, 8, 0
"""Rings around the lidar that a shape is put into, times in each, and bands of range that the
errors are sorted into: both grow by the same factor from one to the next."""
TOUCHING = 1e-3
"""The nearest ring ends this far from the shape's circle, in parts of the lidar's range."""
DEVIATIONS = 2.0
"""A squared error may be so many of its standard deviations greater than what was found: rare beams
make most of it."""
NO_WALLS = np.zeros((0, 4))


def lookup_distances(
    exact: tuple[Any, ...],
    baked: tuple[Any, ...],
    room: tuple[NDArray[Any], ...],
    shape: int,
    radius: float,
    greatest: float,
) -> tuple[float, float]:
    """The distances between which looking a shape up has an RMSE of no more than `greatest`.

    That is so in each ring of distances between them, and in each band of ranges over all these
    rings: long thin shapes err where they are near and seen at a slant, and what is far errs where
    a beam grazes it, which an error over all the lidar's range hides. Only beams count that return
    when looked up and in truth: which beams hit follows from the silhouette, and is exact. Where
    the shape stands is the same for all shapes.

    Args:
        exact: `Scanner.arguments` of that renderer.
        baked: the same of this one.
        room: see `scanner.Scanner.room`.
        shape: its index in the table.
        radius: of the shape [m].
        greatest: RMSE [m].

    Returns:
        Least and greatest distance from the lidar to the shape's origin [m]; the least is inf if it
        may not be looked up.
    """
    mount, directions, beams, (low, high) = exact[:4]
    rings = np.concatenate([[0.0], np.geomspace(TOUCHING * high, high, RINGS)]) + radius
    robots = np.tile([-mount[0], -mount[1], 0.0], (PLACES, 1, 1))  # the lidar is at the origin
    scans = np.empty((2, PLACES, 1, len(directions)), np.float32)
    edges = np.geomspace(max(low, TOUCHING * high), high, BANDS + 1)[1:-1]
    squares, counts = np.zeros((2, RINGS, PLACES, BANDS))
    for i in range(RINGS):
        begin, view = mount[2] + beams[0], beams[1] * beams[3]
        bodies = _around(begin, view, rings[i : i + 2], shape, radius, SEED + i)
        for ranges, sensor in zip(scans, (exact, baked), strict=True):
            worlds = np.arange(PLACES)
            scan_kernels.scan_worlds(ranges, robots, worlds, bodies, -1, NO_WALLS, sensor, room)
        both = np.isfinite(scans).all(axis=0)
        one, other = scans[:, both].astype(np.float64)
        cell = np.nonzero(both)[0] * BANDS + np.searchsorted(edges, one)
        square = np.bincount(cell, np.square(one - other), PLACES * BANDS)
        squares[i] = square.reshape(PLACES, BANDS)
        counts[i] = np.bincount(cell, minlength=PLACES * BANDS).reshape(PLACES, BANDS)
    return _widest(rings, squares, counts, greatest)


def _widest(rings: Array, squares: Array, counts: Array, greatest: float) -> tuple[float, float]:
    """The edges of the widest stretch of rings in which all errors are small."""
    best, width = (np.inf, np.inf), 0.0
    for i in range(RINGS):
        for j in range(i + 1, RINGS + 1):
            wider = rings[j] - rings[i] > width
            if wider and _small(squares[i:j], counts[i:j], greatest):
                best, width = (float(rings[i]), float(rings[j])), rings[j] - rings[i]
    return best


def _small(squares: Array, counts: Array, greatest: float) -> bool:
    """Whether an RMSE is small in each ring and in each band, beyond what chance has in it.

    Args:
        squares: (R, P, B) sums of squared errors of R rings, P places in each and B bands.
        counts: (R, P, B) of how many beams.
        greatest: RMSE.
    """
    rings = squares.sum(axis=2), counts.sum(axis=2)
    bands = squares.reshape(-1, BANDS).T, counts.reshape(-1, BANDS).T
    for square, count in (rings, bands):
        total = np.maximum(count.sum(axis=1), 1.0)
        mean = square.sum(axis=1) / total
        spread = np.sqrt(np.square(square - mean[:, None] * count).sum(axis=1)) / total
        if (mean + DEVIATIONS * spread > greatest**2).any():
            return False
    return True


def _around(
    begin: float, view: float, between: Array, shape: int, radius: float, seed: int
) -> Array:
    """(PLACES, 1, 7) a body at distances within a view that begins at an angle and is so wide."""
    rng = np.random.default_rng(seed)
    distance = rng.uniform(between[0], between[1], PLACES)
    bearing, heading = begin + rng.uniform(0.0, view, PLACES), rng.uniform(-np.pi, np.pi, PLACES)
    poses = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), heading], axis=1)
    return place(poses[:, None], radius, shape)
