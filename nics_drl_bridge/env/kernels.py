"""Compiled inner loops of the tasks: actions, observations, and the navigation task.

The batched loops call a scalar function per robot, so that results are bit-identical for one robot
and for thousands. Shapes: R robots of any worlds, B beams, C commands, O parts of an observation,
the first P of them a scan. Bearings are computed here because numpy's vectorised functions round
the remainder of a batch differently from its body.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.sector_kernels import SectorPlan, resample
from nics_drl_bridge.random_kernels import episode_seed

LIMIT = 1000.0
"""Maximum distance [m], speed [m/s] and turn rate [rad/s] in an observation."""


class ScanShares(NamedTuple):
    """The scan part of an observation.

    Attributes:
        per_metre: 1 / maximum range [1/m].
        leaves: (B,) range at which each beam leaves the footprint [m].
        plan: of the sectors; without any, the beams are used directly.
    """

    per_metre: np.float32
    leaves: NDArray[np.float32]
    plan: SectorPlan


@kernel(allocates=True)
def episode_seeds(seeds, numbers, out):  # type: ignore[no-untyped-def]
    """Seeds (n,) of the episodes with these numbers (n,) in envs with these seeds (n,)."""
    for i in range(seeds.shape[0]):
        out[i] = episode_seed(seeds[i], numbers[i])


@kernel(allocates=True)
def commands(out, actions, low, high):  # type: ignore[no-untyped-def]
    """Scales actions (R, C), cut to [-1, 1], to commands (R, C) between their limits (C,)."""
    for i in range(out.shape[0]):
        for c in range(out.shape[1]):
            share = (min(max(float(actions[i, c]), -1.0), 1.0) + 1.0) / 2.0
            out[i, c] = low[c] + share * (high[c] - low[c])


@kernel(allocates=True)
def finite(values):  # type: ignore[no-untyped-def]
    """True if all values (R, C) are finite."""
    for i in range(values.shape[0]):
        for c in range(values.shape[1]):
            if not math.isfinite(values[i, c]):
                return False
    return True


@kernel(allocates=True)
def look(shares, ranges, per_metre, leaves):  # type: ignore[no-untyped-def]
    """Writes a scan as shares of the maximum range; returns True if something is too close.

    Args:
        shares: (B,) float32, result: 1 no return, 0 too close or unknown.
        ranges: (B,) float32 [m], REP-117.
        per_metre: 1 / maximum range [1/m], float32.
        leaves: (B,) float32 range at which each beam leaves the footprint [m].
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    hits = np.int32(0)
    for b in range(shares.shape[0]):
        # A comparison with NaN (unknown) is False; -inf (too close) is below every range.
        share = ranges[b] * per_metre
        share = share if share > zero else zero
        shares[b] = share if share < one else one
        hits |= np.int32(ranges[b] < leaves[b])
    return hits != 0


@kernel(allocates=True)
def look_by_sector(shares, ranges, sensor):  # type: ignore[no-untyped-def]
    """Writes the nearest returns of sectors (S,) as shares; returns True if something is too close.

    Contact is judged from the beams (B,) themselves. `sensor` is `ScanShares`.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    resample(shares, ranges, sensor.plan)
    for s in range(shares.shape[0]):
        share = shares[s] * sensor.per_metre
        share = share if share > zero else zero
        shares[s] = share if share < one else one
    hits = np.int32(0)
    for b in range(ranges.shape[0]):
        hits |= np.int32(ranges[b] < sensor.leaves[b])
    return hits != 0


@kernel(allocates=True)
def bearing(pose, x, y):  # type: ignore[no-untyped-def]
    """Distance [m] from a pose (3,) to a point, and cosine and sine of its bearing."""
    dx, dy = x - pose[0], y - pose[1]
    distance = math.sqrt(dx * dx + dy * dy)
    if distance == 0.0:
        return 0.0, 1.0, 0.0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    forward, left = (c * dx + s * dy) / distance, (c * dy - s * dx) / distance
    return distance, min(max(forward, -1.0), 1.0), min(max(left, -1.0), 1.0)


@kernel(allocates=True)
def bearings(out, poses, points):  # type: ignore[no-untyped-def]
    """Writes `bearing` (R, 3) of points (R, 2) from poses (R, 3)."""
    for i in range(out.shape[0]):
        distance, out[i, 1], out[i, 2] = bearing(poses[i], points[i, 0], points[i, 1])
        out[i, 0] = min(distance, LIMIT)


@kernel(allocates=True)
def looks(shares, touched, ranges, sensor):  # type: ignore[no-untyped-def]
    """Writes scans of R robots with `look` or `look_by_sector`; touched (R,) is their result."""
    for i in range(ranges.shape[0]):
        if sensor.plan.first.shape[0] == 0:
            touched[i] = look(shares[i], ranges[i], sensor.per_metre, sensor.leaves)
        else:
            touched[i] = look_by_sector(shares[i], ranges[i], sensor)


@kernel(allocates=True)
def navigate(out, approach, reached, touched, before, pose, twist, ranges, goals, sensor, radius):  # type: ignore[no-untyped-def]
    """Writes observations and outcomes of the navigation task.

    Args:
        out: (R, P + 6) float32, result, see `navigation.Navigation`; P parts of a scan.
        approach: (R,) decrease of the distance to the goal [m], result.
        reached, touched: (R,) bool, True at the goal, or in contact; results.
        before: (R, 3) poses before the step.
        pose, twist: (R, 3).
        ranges: (R, B) float32.
        goals: (R, 2) [m].
        sensor: `ScanShares`.
        radius: of a goal [m].
    """
    parts = out.shape[1] - 6
    for i in range(out.shape[0]):
        if sensor.plan.first.shape[0] == 0:
            touched[i] = look(out[i, :parts], ranges[i], sensor.per_metre, sensor.leaves)
        else:
            touched[i] = look_by_sector(out[i, :parts], ranges[i], sensor)
        distance, c, s = bearing(pose[i], goals[i, 0], goals[i, 1])
        dx, dy = goals[i, 0] - before[i, 0], goals[i, 1] - before[i, 1]
        approach[i] = math.sqrt(dx * dx + dy * dy) - distance
        reached[i] = distance < radius
        out[i, parts] = min(distance, LIMIT)
        out[i, parts + 1], out[i, parts + 2] = c, s
        for k in range(3):
            out[i, parts + 3 + k] = min(max(twist[i, k], -LIMIT), LIMIT)


@kernel(allocates=True)
def distances(out, poses, points):  # type: ignore[no-untyped-def]
    """Writes distances (R,) [m] from poses (R, 3) to points (R, 2)."""
    for i in range(out.shape[0]):
        dx, dy = points[i, 0] - poses[i, 0], points[i, 1] - poses[i, 1]
        out[i] = math.sqrt(dx * dx + dy * dy)


@kernel(allocates=True)
def pair_bearings(out, poses, points):  # type: ignore[no-untyped-def]
    """Writes `bearing` (R, M, P, 3) of each point (R, P, 2) from each pose (R, M, 3)."""
    for r in range(out.shape[0]):
        for m in range(out.shape[1]):
            for p in range(out.shape[2]):
                x, y = points[r, p, 0], points[r, p, 1]
                distance, out[r, m, p, 1], out[r, m, p, 2] = bearing(poses[r, m], x, y)
                out[r, m, p, 0] = min(distance, LIMIT)


@kernel(allocates=True)
def pair_distances(out, poses, points):  # type: ignore[no-untyped-def]
    """Writes distances (R, M, P) [m] from poses (R, M, 3) to points (R, P, 2)."""
    for r in range(out.shape[0]):
        for m in range(out.shape[1]):
            for p in range(out.shape[2]):
                dx, dy = points[r, p, 0] - poses[r, m, 0], points[r, p, 1] - poses[r, m, 1]
                out[r, m, p] = math.sqrt(dx * dx + dy * dy)
