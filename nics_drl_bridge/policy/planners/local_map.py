"""Footprint, rays and scratch memory with which `local_map_kernels` map a scan for planners."""

import math

import numpy as np

from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.geometry import Array, compute_depths
from nics_drl_bridge.lidar.arrays import Integers, Singles
from nics_drl_bridge.policy.planners.local_map_kernels import (
    COARSE,
    Clearance,
    FootprintDiscs,
    LocalMap,
    ScanRays,
    Situation,
)
from nics_drl_bridge.robot.spec import RobotSpec

CELL_M = 0.05  # side of the cells of distances
MOST_M = 4.0  # maximum extent of a map to each side [m]
FINE_M, DEEP_M, BORDER_M = 0.02, 0.03, 0.08
"""Spacing of the lattice, depth from which discs cover all of it, spacing of border points [m]."""
MOST_POINTS = 5000  # maximum number of lattice points; beyond it the lattice is coarser
ROWS = 64  # number of rows of the distance matrix computed at a time


def split_observation(
    task: Navigation, observation: Singles
) -> tuple[Array, Array, Array]:
    """Returns scans (N, P) as fractions, goals (N, 2) in `base_link` [m], and twists (N, 3)."""
    parts = task.scan_parts
    rows = np.atleast_2d(observation).astype(np.float64)
    goals = rows[:, parts : parts + 1] * rows[:, parts + 1 : parts + 3]
    scans = rows[:, :parts]
    twists = rows[:, parts + 3 : parts + 6]
    return np.ascontiguousarray(scans), goals, np.ascontiguousarray(twists)


def fill_outline(robot: RobotSpec) -> FootprintDiscs:
    """Returns a robot's footprint as discs that fill it, and points along its border."""
    if robot.footprint is None:
        radius = robot.footprint_radius
        return FootprintDiscs(np.zeros((0, 3)), np.zeros(2), radius, radius)
    corners = np.array(robot.footprint)
    lattice = _make_lattice(corners)
    depth = compute_depths(lattice, corners)
    lattice = lattice[depth > 0.0]
    depth = depth[depth > 0.0]
    chosen = [*_cover(lattice, depth), *_list_border(corners)]
    reach = np.linalg.norm(lattice[:, None] - corners, axis=-1).max(axis=1)
    middle = int(reach.argmin())
    return FootprintDiscs(
        np.array(chosen), lattice[middle], float(depth.max()), float(reach[middle])
    )


def _cover(lattice: Array, depth: Array) -> list[Array]:
    """Returns discs (3,) at points (N, 2) that cover all points deep within a footprint.

    Greedy: each disc covers as many of the remaining points as possible. The radius of a disc is
    the depth (N,) of its point.
    """
    left = depth > DEEP_M
    covered = _count_covered(lattice, depth, lattice[left])
    chosen = []
    while left.any():
        best = int(covered.argmax())
        chosen.append(np.array([*lattice[best], depth[best]]))
        new = left & (np.linalg.norm(lattice - lattice[best], axis=-1) < depth[best])
        covered -= _count_covered(lattice, depth, lattice[new])
        left &= ~new
    return chosen


def _count_covered(centres: Array, radii: Array, points: Array) -> Integers:
    """Returns the number of points (M, 2) within each disc (N,)."""
    count = np.zeros(len(centres), np.int64)
    for first in range(0, len(points), ROWS):
        x, y = (points[first : first + ROWS, None] - centres).transpose(2, 0, 1)
        count += (np.sqrt(x * x + y * y) < radii).sum(axis=0)
    return count


def _make_lattice(corners: Array) -> Array:
    """Returns points (L, 2) in the box around an outline."""
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    spacing = max(FINE_M, math.sqrt(float(np.prod(high - low)) / MOST_POINTS))
    axes = (
        np.arange(a + spacing / 2, b, spacing) for a, b in zip(low, high, strict=True)
    )
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _list_border(corners: Array) -> list[Array]:
    """Returns discs (3,) without radius along an outline."""
    discs = []
    sides = np.roll(corners, -1, axis=0) - corners
    for corner, side in zip(corners, sides, strict=True):
        count = max(1, round(float(np.linalg.norm(side)) / BORDER_M))
        discs += [np.array([*(corner + side * k / count), 0.0]) for k in range(count)]
    return discs


def make_situation(
    task: Navigation, outline: FootprintDiscs, clearance: Clearance, half: float
) -> Situation:
    """Allocates maps of a task's scans that extend `half` [m] to each side, `MOST_M` at most."""
    sight = task.sight
    directions = np.stack([np.cos(sight.angles), np.sin(sight.angles)], axis=-1)
    coarse = 2 * math.ceil(min(half, MOST_M) / (COARSE * CELL_M))
    distances = np.zeros((COARSE * coarse, COARSE * coarse), np.float32)
    ways, prices = np.zeros((2, coarse, coarse), np.float32)
    reach = outline.outer + clearance.margin + clearance.soft + CELL_M
    return Situation(
        ScanRays(directions, sight.origin, float(sight.range_max)),
        outline,
        clearance,
        LocalMap(distances, ways, CELL_M, reach),
        np.zeros(2),
        np.zeros((task.scan_parts, 2)),
        prices,
    )
