"""Distances at which a shape may be looked up, measured for the renderer `auto`."""

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar import scan_kernels
from nics_drl_bridge.lidar.baked_kernels import LidarArrays
from nics_drl_bridge.lidar.cell_kernels import body_cells
from nics_drl_bridge.lidar.maps import stack_fixtures
from nics_drl_bridge.lidar.shapes import place

# Rings around the lidar, placements in each, bands of range; rings and bands grow geometrically.
RINGS = 13
PLACES = 256
BANDS = 8
SEED = 0
# of the nearest ring from the shape's circle, as a fraction of the lidar's range
TOUCHING = 1e-3
OUTLIER = 0.3  # maximum allowed error of any beam [m]
DEVIATIONS = 2.0  # safety margin on the squared error, in standard deviations: rare beams dominate
# maximum angle between line of sight and edge in the search for outliers [rad]
SLANT = np.radians(1.5)
# minimum interval of looked-up distances, as a fraction of the lidar's range
NARROWEST = 0.1


def lookup_distances(
    exact: LidarArrays, baked: LidarArrays, shape: int, radius: float, greatest: float
) -> tuple[float, float]:
    """Find the distances between which looking up a shape has an RMSE of at most `greatest` [m].

    So it must be in each ring of distances and each band of ranges over all rings, and no beam off
    by more than `OUTLIER`: long thin shapes err when near and seen at a slant, distant ones where a
    beam grazes them. Only beams with a return in both count: which ones hit is exact. Placements
    are the same for all shapes. `exact` and `baked` are `Scanner.arguments` of these renderers, the
    shape is an index in the table with its radius [m]. Returns the minimum and the maximum distance
    to its origin [m]; both inf if it may not be looked up.
    """
    low, high, (corners, first) = exact.range_min, exact.range_max, exact.outlines
    outline = corners[first[shape] : first[shape + 1]]
    rings = np.concatenate([[0.0], np.geomspace(TOUCHING * high, high, RINGS)]) + radius
    edges = np.geomspace(max(low, TOUCHING * high), high, BANDS + 1)[1:-1]
    squares, counts = np.zeros((2, RINGS, PLACES, BANDS))
    worst = np.zeros(RINGS)
    for i in range(RINGS):
        poses = _around(exact, rings[i : i + 2], SEED + i)
        for some in (
            (poses, _slanted(poses, outline, SEED + i)) if len(outline) else (poses,)
        ):
            one, other = _scans(place(some[:, None], radius, shape), exact, baked)
            both = np.isfinite(one) & np.isfinite(other)
            found = other[both] - one[both]
            truth = one[both]
            worst[i] = max(worst[i], np.abs(found).max(initial=0.0))
            if some is poses:
                cell = np.nonzero(both)[0] * BANDS + np.searchsorted(edges, truth)
                square = np.bincount(cell, np.square(found), PLACES * BANDS)
                squares[i] = square.reshape(PLACES, BANDS)
                counts[i] = np.bincount(cell, minlength=PLACES * BANDS).reshape(
                    PLACES, BANDS
                )
    return _widest(rings, squares, counts, np.where(worst <= OUTLIER, greatest, 0.0))


def _widest(
    rings: Array, squares: Array, counts: Array, greatest: Array
) -> tuple[float, float]:
    """Edges of the widest interval of rings with small errors, or inf if too narrow."""
    best = (np.inf, np.inf)
    width = NARROWEST * (rings[-1] - rings[0])
    for i in range(RINGS):
        for j in range(i + 1, RINGS + 1):
            wider = rings[j] - rings[i] > width and (greatest[i:j] > 0.0).all()
            if wider and _small(squares[i:j], counts[i:j], greatest[i]):
                best = (float(rings[i]), float(rings[j]))
                width = rings[j] - rings[i]
    return best


def _small(squares: Array, counts: Array, greatest: float) -> bool:
    """True if the RMSE is small in each ring and band, from sums and counts (R, P, B)."""
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
    bodies: Array, exact: LidarArrays, baked: LidarArrays
) -> tuple[Array, Array]:
    mount = exact.mount
    directions = exact.beams.directions
    # the lidar is at the origin
    robots = np.tile([-mount[0], -mount[1], 0.0], (PLACES, 1, 1))
    scans = np.empty((2, PLACES, 1, directions.shape[1]), np.float32)
    worlds = np.arange(PLACES)
    lanes = scan_kernels.scan_lanes()
    cells = body_cells(0, bodies.shape[1])
    nothing = np.zeros(PLACES, np.int64)
    around = stack_fixtures([np.zeros((0, 4))], [None], nothing)
    for ranges, sensor in zip(scans, (exact, baked), strict=True):
        scan_kernels.scan_worlds(
            ranges, robots, worlds, bodies, -1, around, sensor, cells, lanes
        )
    one, other = scans[:, :, 0].astype(np.float64)
    return one, other


def _around(exact: LidarArrays, between: Array, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    beams = exact.beams
    distance = rng.uniform(between[0], between[1], PLACES)
    bearing = exact.mount[2] + beams.first
    bearing += rng.uniform(0.0, beams.step * beams.directions.shape[1], PLACES)
    heading = rng.uniform(-np.pi, np.pi, PLACES)
    return np.stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), heading], axis=1
    )


def _slanted(poses: Array, outline: Array, seed: int) -> Array:
    """Draw poses with the lidar nearly in line with an edge: rare, but with large errors."""
    rng = np.random.default_rng(seed)
    along = np.roll(outline, -1, axis=0) - outline
    length = np.hypot(*along.T)
    chosen = rng.choice(len(along), len(poses), p=length**2 / np.sum(length**2))
    aside = (along[:, 0] * outline[:, 1] - along[:, 1] * outline[:, 0]) / np.maximum(
        length, 1e-12
    )
    distance = np.hypot(poses[:, 0], poses[:, 1])
    bearing = np.arctan2(poses[:, 1], poses[:, 0])
    direction = np.arctan2(along[chosen, 1], along[chosen, 0])
    onto = np.arcsin(np.clip(aside[chosen] / distance, -1.0, 1.0))
    heading = bearing - direction + onto + rng.uniform(-SLANT, SLANT, len(poses))
    return np.column_stack([poses[:, :2], heading])
