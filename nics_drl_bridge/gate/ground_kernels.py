"""Compiled: ground in square cells around the robot, and what a scan shows of it.

`times` (n, n) are those at which each cell was last known to be free [s]; -inf of cells that are
not known to be free. Rows run along y of odometry, columns along x. The robot's frame is that at
the scan.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate.evidence_kernels import MountedBeams, find_beam
from nics_drl_bridge.gate.shield_kernels import Body, compute_clearance
from nics_drl_bridge.interface import Array
from nics_drl_bridge.kernels import kernel

Ranges = NDArray[np.float32]
Flags = NDArray[np.bool_]


class Grid(NamedTuple):
    """Position of the cells relative to the robot.

    Attributes:
        x: from the robot to the first corner, along x of odometry [m].
        y: from the robot to the first corner, along y of odometry [m].
        width: of a cell [m].
        cosine: of the robot's heading in odometry.
        sine: of the robot's heading in odometry.
    """

    x: float
    y: float
    width: float
    cosine: float
    sine: float


@kernel(allocates=True)
def shift_cells(times: Ranges, columns_moved: int, rows_moved: int) -> Ranges:
    """Returns the times (n, n) shifted by columns and rows; -inf for new cells."""
    shifted = np.full(times.shape, -np.inf, times.dtype)
    rows, columns = times.shape
    for i in range(max(0, -rows_moved), min(rows, rows - rows_moved)):
        for j in range(max(0, -columns_moved), min(columns, columns - columns_moved)):
            shifted[i, j] = times[i + rows_moved, j + columns_moved]
    return shifted


@kernel
def forget_old(
    times: Ranges, grid: Grid, kept_radius: float, now: float, oldest: float
) -> None:
    """Forgets cells that were last known to be free before `oldest` [s].

    Known cells within `kept_radius` [m] of the robot count as known now.
    """
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _locate_cell(i, j, grid)
            if not times[i, j] >= oldest:
                times[i, j] = -np.inf
            elif x * x + y * y <= kept_radius * kept_radius:
                times[i, j] = now


@kernel(allocates=True)
def mark_seen(
    times: Ranges,
    grid: Grid,
    ranges: Ranges,
    lidar: MountedBeams,
    range_max: float,
    tolerance: float,
    now: float,
) -> Flags:
    """Marks cells that a scan (B,) shows to be free; returns those that are fully in view.

    All beams towards a cell must be longer than its distance and a tolerance [m]. Cells in which
    beams end are not free.
    """
    is_seen = np.zeros(times.shape, np.bool_)
    beams = len(ranges)
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _locate_cell(i, j, grid)
            distance, first, last = _find_view(x, y, grid.width, lidar)
            if first < 0 or last >= beams:
                continue
            is_seen[i, j] = True
            free = range_max
            for b in range(first, last + 1):
                free = np.minimum(free, ranges[b])  # NaN if either is
            if free > distance + tolerance:
                times[i, j] = now
    _clear_returns(times, grid, ranges, lidar)
    return is_seen


@kernel
def _find_view(
    x: float, y: float, width: float, lidar: MountedBeams
) -> tuple[float, int, int]:
    """Returns the distance [m] of a cell from the lidar, and the first and last beam towards it."""
    dx = x - lidar.x
    dy = y - lidar.y
    distance = max(math.sqrt(dx * dx + dy * dy), width)
    middle = find_beam(x, y, lidar)
    half_width = math.ceil(0.5 * width / (distance * abs(lidar.step)))
    return distance, middle - half_width, middle + half_width


@kernel
def _clear_returns(
    times: Ranges, grid: Grid, ranges: Ranges, lidar: MountedBeams
) -> None:
    """Marks cells in which beams (B,) end as not free."""
    for b in range(len(ranges)):
        if np.isfinite(ranges[b]):
            angle = lidar.first + b * lidar.step + lidar.heading
            x = lidar.x + ranges[b] * math.cos(angle)
            y = lidar.y + ranges[b] * math.sin(angle)
            j = math.floor((grid.cosine * x - grid.sine * y - grid.x) / grid.width)
            i = math.floor((grid.sine * x + grid.cosine * y - grid.y) / grid.width)
            if 0 <= i < times.shape[0] and 0 <= j < times.shape[1]:
                times[i, j] = -np.inf


@kernel
def mark_covered(times: Ranges, grid: Grid, body: Body, now: float) -> None:
    """Marks the cells under the footprint as free."""
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _locate_cell(i, j, grid)
            is_far = x * x + y * y > body.radius**2
            if not is_far and compute_clearance(x, y, body) <= 0.0:
                times[i, j] = now


@kernel(allocates=True)
def find_unseen(times: Ranges, is_seen: Flags, grid: Grid) -> Array:
    """Returns the centres (Q, 2) of the cells at the border of free or visible ground [m].

    Everything outside the outermost cells is unknown.
    """
    last_i = times.shape[0] - 1
    last_j = times.shape[1] - 1
    middles = np.empty((times.size, 2))
    count = 0
    for i in range(last_i + 1):
        for j in range(last_j + 1):
            is_inner = 0 < i < last_i and 0 < j < last_j
            if is_seen[i, j] or (is_inner and times[i, j] > -np.inf):
                continue
            if _has_known_neighbour(i, j, times, is_seen):
                x, y = _locate_cell(i, j, grid)
                middles[count, 0] = x
                middles[count, 1] = y
                count += 1
    return middles[:count].copy()


@kernel
def _has_known_neighbour(i: int, j: int, times: Ranges, is_seen: Flags) -> bool:
    """True if one of the four neighbours of a cell is free or visible."""
    for row, column in ((i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j)):
        row = min(max(row, 0), times.shape[0] - 1)
        column = min(max(column, 0), times.shape[1] - 1)
        if is_seen[row, column] or times[row, column] > -np.inf:
            return True
    return False


@kernel
def _locate_cell(i: int, j: int, grid: Grid) -> tuple[float, float]:
    """Returns the centre of a cell in the robot's frame [m]."""
    dx = grid.x + (j + 0.5) * grid.width
    dy = grid.y + (i + 0.5) * grid.width
    return grid.cosine * dx + grid.sine * dy, grid.cosine * dy - grid.sine * dx
