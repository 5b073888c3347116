"""Compiled: cells of ground around the robot, seen free by a scan or under its footprint."""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.gate.shield_kernels import clearance
from nics_drl_bridge.kernels import kernel


class Cells(NamedTuple):
    """Where square cells lie, whose rows run along y of odometry, as seen from the robot.

    Attributes:
        x: of their first corner from the robot, along x of odometry [m].
        y: the same along y [m].
        width: of a cell [m].
        cosine: of the robot's heading.
        sine: of it.
    """

    x: float
    y: float
    width: float
    cosine: float
    sine: float


class Look(NamedTuple):
    """What a scan is judged by.

    Attributes:
        now: its time [s].
        oldest: time of ground that is still remembered [s].
        far: greatest range [m].
        tolerance: margin before a return that is not free [m].
    """

    now: float
    oldest: float
    far: float
    tolerance: float


@kernel
def _middle(i, j, cells):  # type: ignore[no-untyped-def]
    """Returns the middle of a cell in the robot's frame [m]."""
    dx, dy = cells.x + (j + 0.5) * cells.width, cells.y + (i + 0.5) * cells.width
    return cells.cosine * dx + cells.sine * dy, cells.cosine * dy - cells.sine * dx


@kernel(allocates=True)
def shifted(times, across, up):  # type: ignore[no-untyped-def]
    """Returns times (n, n) of cells that moved by so many columns and rows; -inf of new ones."""
    out = np.full(times.shape, -np.inf, times.dtype)
    rows, columns = times.shape
    for i in range(max(0, -up), min(rows, rows - up)):
        for j in range(max(0, -across), min(columns, columns - across)):
            out[i, j] = times[i + up, j + across]
    return out


@kernel
def cover(times, cells, body, away, now):  # type: ignore[no-untyped-def]
    """Notes in times (n, n) that cells up to a distance from the footprint are free."""
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _middle(i, j, cells)
            far = x * x + y * y > (body.radius + away) ** 2
            if not far and clearance(x, y, body) <= away:
                times[i, j] = now


@kernel(allocates=True)
def survey(times, cells, ranges, lidar, room, look):  # type: ignore[no-untyped-def]
    """Notes in times (n, n) what a scan (B,) shows; returns which cells it sees as a whole."""
    # What is older is forgotten, but for cells within `room` [m] of the robot.
    sees, beams = np.zeros(times.shape, np.bool_), len(ranges)
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _middle(i, j, cells)
            if times[i, j] >= look.oldest and x * x + y * y <= room * room:
                times[i, j] = look.now
            dx, dy = x - lidar.x, y - lidar.y
            away = max(math.sqrt(dx * dx + dy * dy), cells.width)
            middle = _beam(x, y, lidar)
            beside = math.ceil(0.5 * cells.width / (away * abs(lidar.step)))
            if middle - beside >= 0 and middle + beside < beams:
                sees[i, j], least = True, look.far
                for b in range(middle - beside, middle + beside + 1):
                    # Not `min`: an unknown beam shows nothing.
                    least = ranges[b] if not ranges[b] >= least else least
                if least > away + look.tolerance:
                    times[i, j] = look.now
            if not times[i, j] >= look.oldest:
                times[i, j] = -np.inf
    _note_returns(times, cells, ranges, lidar)
    return sees


@kernel
def _note_returns(times, cells, ranges, lidar):  # type: ignore[no-untyped-def]
    """Notes in times (n, n) that cells in which beams (B,) end are not free."""
    for b in range(len(ranges)):
        if np.isfinite(ranges[b]):
            angle = lidar.first + b * lidar.step + lidar.heading
            x, y = lidar.x + ranges[b] * math.cos(angle), lidar.y + ranges[b] * math.sin(angle)
            j = math.floor((cells.cosine * x - cells.sine * y - cells.x) / cells.width)
            i = math.floor((cells.sine * x + cells.cosine * y - cells.y) / cells.width)
            if 0 <= i < times.shape[0] and 0 <= j < times.shape[1]:
                times[i, j] = -np.inf


@kernel
def _beam(x, y, lidar):  # type: ignore[no-untyped-def]
    """Returns the number of the beam towards a point, beyond those of a scan if there is none."""
    circle = 2.0 * math.pi / abs(lidar.step)
    at = (math.atan2(y - lidar.y, x - lidar.x) - lidar.heading - lidar.first) / lidar.step
    return math.floor(at - circle * math.floor((at + 0.5) / circle) + 0.5)


@kernel(allocates=True)
def unseen(times, sees, cells):  # type: ignore[no-untyped-def]
    """Returns the middles (Q, 2) of the cells in which free or seen ground ends [m]."""
    # What lies beyond the outermost cells is not known.
    last_i, last_j = times.shape[0] - 1, times.shape[1] - 1
    out, count = np.empty((times.size, 2)), 0
    for i in range(last_i + 1):
        for j in range(last_j + 1):
            inner = 0 < i < last_i and 0 < j < last_j
            if sees[i, j] or (inner and times[i, j] > -np.inf):
                continue
            known = False
            for across, up in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                k, m = min(max(i + up, 0), last_i), min(max(j + across, 0), last_j)
                known = known or sees[k, m] or times[k, m] > -np.inf
            if known:
                out[count, 0], out[count, 1] = _middle(i, j, cells)
                count += 1
    return out[:count].copy()
