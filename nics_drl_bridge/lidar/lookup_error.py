"""Distances at which a shape may be looked up, measured for the renderer `auto`.

The space around the lidar is divided into rings by the shape's distance, and the returns into bands
by their range. For each ring, `find_lookup_distances`

1. places the shape at random in the ring (`_place_around`), and again so that the lidar is nearly
   in line with one of its edges (`_turn_edge_on`), where rare beams have large errors;
2. scans all placements by both renderers, and compares the beams that have a return in both;
3. sums the squared errors of the random placements by placement and band, and keeps the
   largest error of any beam, including the edge-on placements.

Then it takes the widest interval of rings in which no beam is off by more than
`OUTLIER` and `_is_small` holds in each ring, and in each band over all rings of the interval:

    mean + DEVIATIONS * spread <= greatest^2

With the sum of squared errors q_p and the number of beams n_p of each placement p, that is

    mean = sum(q_p) / sum(n_p)
    spread = sqrt(sum((q_p - mean * n_p)^2)) / sum(n_p)    the standard deviation of this mean

The errors of the beams of one placement are correlated, so placements are the
independent samples, not beams.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.lidar import scan_kernels
from nics_drl_bridge.lidar.arrays import AnyArray, Array
from nics_drl_bridge.lidar.maps import stack_fixtures
from nics_drl_bridge.lidar.scan_kernels import LidarArrays
from nics_drl_bridge.lidar.shapes import place

# Rings around the lidar, placements in each, bands of range; rings and bands grow geometrically.
RINGS = 13
PLACES = 256
BANDS = 8
SEED = 0
# of the nearest ring from the shape's circle, as a fraction of the lidar's range
TOUCHING = 1e-3
OUTLIER = 0.3  # maximum allowed error of any beam [m]
DEVIATIONS = 2.0  # safety margin on the squared error, in standard deviations
# maximum angle between line of sight and edge in the search for outliers [rad]
SLANT = np.radians(1.5)
# minimum interval of looked-up distances, as a fraction of the lidar's range
NARROWEST = 0.1


def find_lookup_distances(
    exact: LidarArrays, baked: LidarArrays, shape: int, radius: float, greatest: float
) -> tuple[float, float]:
    """Find the distances between which looking up a shape has an RMSE of at most `greatest` [m].

    Long thin shapes have large errors when they are near and seen edge-on, distant ones
    where a beam grazes them. Only beams with a return in both scans count, because which
    beams hit is exact. Placements are the same for all shapes.

    Args:
        exact: `Scanner.arguments` of this renderer.
        baked: the same of this one.
        shape: index in the table.
        radius: of the shape [m].
        greatest: RMSE [m].

    Returns:
        The minimum and the maximum distance to the shape's origin [m]; both inf if it
        may not be looked up.
    """
    edges = np.geomspace(TOUCHING * exact.range_max, exact.range_max, RINGS)
    rings = np.concatenate([[0.0], edges]) + radius
    sums = _sample_rings(rings, exact, baked, shape, radius)
    best = (np.inf, np.inf)
    width = NARROWEST * (rings[-1] - rings[0])
    for i, j in combinations(range(RINGS + 1), 2):
        if rings[j] - rings[i] <= width or sums.worst[i:j].max() > OUTLIER:
            continue
        if _is_small(sums.squares[i:j], sums.counts[i:j], greatest):
            best = (float(rings[i]), float(rings[j]))
            width = rings[j] - rings[i]
    return best


class _Sums(NamedTuple):
    """Errors by ring, placement and band of range."""

    squares: Array  # (R, P, B) sums of squared errors [m^2]
    counts: Array  # (R, P, B) numbers of beams
    worst: Array  # (R,) largest error of any beam [m]


def _sample_rings(
    rings: Array, exact: LidarArrays, baked: LidarArrays, shape: int, radius: float
) -> _Sums:
    """Scan a shape at random places in rings (R + 1,) by both renderers, and edge-on."""
    corners, first = exact.outlines
    outline = corners[first[shape] : first[shape + 1]]
    lowest = max(exact.range_min, TOUCHING * exact.range_max)
    limits = np.geomspace(lowest, exact.range_max, BANDS + 1)
    by_band = np.zeros((2, RINGS, PLACES, BANDS))
    sums = _Sums(by_band[0], by_band[1], np.zeros(RINGS))
    for i in range(RINGS):
        poses = _place_around(exact, rings[i : i + 2], SEED + i)
        errors = _compare(place(poses[:, None], radius, shape), exact, baked)
        by_band[:, i] = _sum_by_band(errors, limits[1:-1])
        sums.worst[i] = np.abs(errors.error).max(initial=0.0)
        if len(outline) > 0:
            poses = _turn_edge_on(poses, outline, SEED + i)
            errors = _compare(place(poses[:, None], radius, shape), exact, baked)
            sums.worst[i] = np.abs(errors.error).max(initial=sums.worst[i])
    return sums


class _Errors(NamedTuple):
    """Errors of the beams that have a return in both scans of a placement."""

    placement: NDArray[np.int_]  # index of the placement
    truth: Array  # exact range [m]
    error: Array  # looked-up range minus exact range [m]


def _sum_by_band(errors: _Errors, limits: Array) -> tuple[AnyArray, AnyArray]:
    """Return squared errors and numbers of beams (P, B) of each placement, by band of range."""
    cell = errors.placement * BANDS + np.searchsorted(limits, errors.truth)
    squares = np.bincount(cell, np.square(errors.error), PLACES * BANDS)
    counts = np.bincount(cell, minlength=PLACES * BANDS)
    return squares.reshape(PLACES, BANDS), counts.reshape(PLACES, BANDS)


def _is_small(squares: Array, counts: Array, greatest: float) -> bool:
    """True if the RMSE is small in each ring and band, from sums and counts (R, P, B)."""
    rings = (squares.sum(axis=2), counts.sum(axis=2))
    bands = (squares.reshape(-1, BANDS).T, counts.reshape(-1, BANDS).T)
    for square, count in (rings, bands):
        total = np.maximum(count.sum(axis=1), 1.0)
        mean = square.sum(axis=1) / total
        rest = square - mean[:, None] * count
        spread = np.sqrt(np.square(rest).sum(axis=1)) / total
        if (mean + DEVIATIONS * spread > greatest**2).any():
            return False
    return True


def _compare(bodies: Array, exact: LidarArrays, baked: LidarArrays) -> _Errors:
    """Scan bodies (P, 1, 7) of P placements by both renderers."""
    count = exact.beams.directions.shape[1]
    # the lidar is at the origin
    robots = np.tile([-exact.mount[0], -exact.mount[1], 0.0], (PLACES, 1, 1))
    scans = np.empty((2, PLACES, 1, count), np.float32)
    scratch = scan_kernels.scan_scratch(count)
    nearby = np.arange(bodies.shape[1], dtype=np.int32)
    empty = stack_fixtures([np.zeros((0, 4))], [None], np.zeros(PLACES, np.int64))
    for ranges, sensor in zip(scans, (exact, baked), strict=True):
        scan_kernels.scan_worlds(
            ranges,
            robots,
            np.arange(PLACES),
            bodies,
            nearby,
            -1,
            empty,
            sensor,
            scratch,
        )
    exact_ranges, baked_ranges = scans[:, :, 0].astype(np.float64)
    both = np.isfinite(exact_ranges) & np.isfinite(baked_ranges)
    truth = exact_ranges[both]
    return _Errors(np.nonzero(both)[0], truth, baked_ranges[both] - truth)


def _place_around(exact: LidarArrays, between: Array, seed: int) -> Array:
    """Draw poses (P, 3) within the lidar's angles, at distances between two limits (2,) [m]."""
    rng = np.random.default_rng(seed)
    beams = exact.beams
    distance = rng.uniform(between[0], between[1], PLACES)
    bearing = exact.mount[2] + beams.first
    bearing += rng.uniform(0.0, beams.step * beams.directions.shape[1], PLACES)
    heading = rng.uniform(-np.pi, np.pi, PLACES)
    return np.stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), heading], axis=1
    )


def _turn_edge_on(poses: Array, outline: Array, seed: int) -> Array:
    """Turn shapes at poses (P, 3) so that the lidar is nearly in line with a random edge.

    Long edges are drawn more often. An edge whose line passes the shape's origin at a signed
    distance `aside` is in line with a lidar at the distance d if the angle between the edge and
    the line of sight to the origin is asin(aside / d).
    """
    rng = np.random.default_rng(seed)
    along = np.roll(outline, -1, axis=0) - outline
    length = np.hypot(*along.T)
    probability = length**2 / np.sum(length**2)
    chosen = rng.choice(len(along), len(poses), p=probability)
    cross = along[:, 0] * outline[:, 1] - along[:, 1] * outline[:, 0]
    aside = cross / np.maximum(length, 1e-12)
    distance = np.hypot(poses[:, 0], poses[:, 1])
    bearing = np.arctan2(poses[:, 1], poses[:, 0])
    direction = np.arctan2(along[chosen, 1], along[chosen, 0])
    onto = np.arcsin(np.clip(aside[chosen] / distance, -1.0, 1.0))
    heading = bearing - direction + onto + rng.uniform(-SLANT, SLANT, len(poses))
    return np.column_stack([poses[:, :2], heading])
