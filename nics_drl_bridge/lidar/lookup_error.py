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
OUTLIER = 0.3
"""No beam may be found that is off by more than this [m]."""
DEVIATIONS = 2.0
"""A squared error may be so many of its standard deviations greater than what was found: rare beams
make most of it."""
LEAST_WIDTH = 0.1
"""A stretch of distances is worth a look-up from this part of the lidar's range on."""
SLANT = np.radians(1.5)
"""So nearly along an edge the lidar looks where outliers are looked for [rad]."""
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
    rings, and no beam is off by more than `OUTLIER`: long thin shapes err where they are near and
    seen at a slant, and what is far errs where a beam grazes it, which an error over all the
    lidar's range hides. Only beams count that return when looked up and in truth: which beams hit
    follows from the silhouette, and is exact. Where the shape stands is the same for all shapes.

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
    (low, high), (corners, corner) = exact[3], exact[5]
    outline = corners[corner[shape] : corner[shape + 1]]
    rings = np.concatenate([[0.0], np.geomspace(TOUCHING * high, high, RINGS)]) + radius
    edges = np.geomspace(max(low, TOUCHING * high), high, BANDS + 1)[1:-1]
    squares, counts = np.zeros((2, RINGS, PLACES, BANDS))
    worst = np.zeros(RINGS)
    for i in range(RINGS):
        poses = _around(exact, rings[i : i + 2], SEED + i)
        for some in (poses, _slanted(poses, outline, SEED + i)) if len(outline) else (poses,):
            one, other = _scans(place(some[:, None], radius, shape), exact, baked, room)
            both = np.isfinite(one) & np.isfinite(other)
            found, truth = other[both] - one[both], one[both]
            worst[i] = max(worst[i], np.abs(found).max(initial=0.0))
            if some is poses:
                cell = np.nonzero(both)[0] * BANDS + np.searchsorted(edges, truth)
                square = np.bincount(cell, np.square(found), PLACES * BANDS)
                squares[i] = square.reshape(PLACES, BANDS)
                counts[i] = np.bincount(cell, minlength=PLACES * BANDS).reshape(PLACES, BANDS)
    return _widest(rings, squares, counts, np.where(worst <= OUTLIER, greatest, 0.0))


def _widest(rings: Array, squares: Array, counts: Array, greatest: Array) -> tuple[float, float]:
    """The edges of the widest stretch of rings in which all errors are small."""
    best, width = (np.inf, np.inf), LEAST_WIDTH * (rings[-1] - rings[0])
    for i in range(RINGS):
        for j in range(i + 1, RINGS + 1):
            wider = rings[j] - rings[i] > width and (greatest[i:j] > 0.0).all()
            if wider and _small(squares[i:j], counts[i:j], greatest[i]):
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


def _scans(
    bodies: Array, exact: tuple[Any, ...], baked: tuple[Any, ...], room: tuple[NDArray[Any], ...]
) -> tuple[Array, Array]:
    """(P, B) ranges to one body (P, 1, 7) in each of P places: computed, and looked up."""
    mount, directions = exact[0], exact[1]
    robots = np.tile([-mount[0], -mount[1], 0.0], (PLACES, 1, 1))  # the lidar is at the origin
    scans = np.empty((2, PLACES, 1, len(directions)), np.float32)
    for ranges, sensor in zip(scans, (exact, baked), strict=True):
        worlds = np.arange(PLACES)
        scan_kernels.scan_worlds(ranges, robots, worlds, bodies, -1, NO_WALLS, sensor, room)
    one, other = scans[:, :, 0].astype(np.float64)
    return one, other


def _around(exact: tuple[Any, ...], between: Array, seed: int) -> Array:
    """(PLACES, 3) poses of a body in the view of the lidar, between two distances."""
    rng, (mount, _, beams) = np.random.default_rng(seed), exact[:3]
    distance = rng.uniform(between[0], between[1], PLACES)
    bearing = mount[2] + beams[0] + rng.uniform(0.0, beams[1] * beams[3], PLACES)
    heading = rng.uniform(-np.pi, np.pi, PLACES)
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing), heading], axis=1)


def _slanted(poses: Array, outline: Array, seed: int) -> Array:
    """Poses at which the lidar, at the origin, is nearly on the line of an edge.

    There a beam may run along the edge, and a look-up be off by its length: too rarely to be found
    among any poses, and too much to be left out.
    """
    rng = np.random.default_rng(seed)
    along = np.roll(outline, -1, axis=0) - outline
    length = np.hypot(*along.T)
    chosen = rng.choice(len(along), len(poses), p=length**2 / np.sum(length**2))
    aside = (along[:, 0] * outline[:, 1] - along[:, 1] * outline[:, 0]) / np.maximum(length, 1e-12)
    distance, bearing = np.hypot(poses[:, 0], poses[:, 1]), np.arctan2(poses[:, 1], poses[:, 0])
    direction = np.arctan2(along[chosen, 1], along[chosen, 0])
    onto = np.arcsin(np.clip(aside[chosen] / distance, -1.0, 1.0))
    heading = bearing - direction + onto + rng.uniform(-SLANT, SLANT, len(poses))
    return np.column_stack([poses[:, :2], heading])
