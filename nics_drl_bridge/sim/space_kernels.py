"""Compiled queries of free space: a body fits at a pose, a path exists between two points.

Free poses are decided by true distances between outlines; the grid of distances only saves most of
that work.

Shared arguments. `static` is what stands in every scene: for each cell of the grid the distance
from its centre to the nearest wall or solid cell of the map, and the number of its area of
connected free space, 0 where a robot does not fit, (rows, columns) each; frame (5,) x, y [m],
cosine, sine of the outer corner of cell (0, 0), side of a cell [m]; bounds (4,) least x, y and
greatest x, y of the field; walls (W, 4); the map, see `collision_kernels`. `outlines` is corners,
first corner of each outline, radii (H,) of all shapes, the last of which is a disc. `spare` is
scratch, see `collision_kernels`.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim.collision_kernels import body_gap, map_gap, wall_gap

FLOAT32 = 1e-6
"""Relative rounding error of the distances of the grid."""


@kernel(allocates=True)
def wall_distance(x, y, walls):  # type: ignore[no-untyped-def]
    """Distance from a point to the nearest straight wall (W, 4) [m]; inf if there is none."""
    least = np.inf
    for w in range(walls.shape[0]):
        ax, ay = walls[w, 0], walls[w, 1]
        ex, ey = walls[w, 2] - ax, walls[w, 3] - ay
        length2 = ex * ex + ey * ey
        share = 0.0
        if length2 > 0.0:
            share = min(max(((x - ax) * ex + (y - ay) * ey) / length2, 0.0), 1.0)
        least = min(least, np.hypot(x - ax - share * ex, y - ay - share * ey))
    return least


@kernel(allocates=True)
def wall_distances(distance, frame, walls):  # type: ignore[no-untyped-def]
    """Lowers distances (rows, columns) of cells to the distances to the walls, in place."""
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            x, y = place_in(i + 0.5, j + 0.5, frame)
            distance[i, j] = min(distance[i, j], wall_distance(x, y, walls))


@kernel
def place_in(row, column, frame):  # type: ignore[no-untyped-def]
    """Returns x, y [m] of a place in the grid, given as fractional row and column."""
    u, v = column * frame[4], row * frame[4]
    return frame[0] + frame[2] * u - frame[3] * v, frame[1] + frame[3] * u + frame[2] * v


@kernel
def cell_of(x, y, frame):  # type: ignore[no-untyped-def]
    """Returns row and column of a point, and its distance from the centre of that cell [m]."""
    dx, dy = x - frame[0], y - frame[1]
    u = (frame[2] * dx + frame[3] * dy) / frame[4]
    v = (frame[2] * dy - frame[3] * dx) / frame[4]
    i, j = math.floor(v), math.floor(u)
    return i, j, frame[4] * math.sqrt((u - j - 0.5) ** 2 + (v - i - 0.5) ** 2)


@kernel
def _within(x, y, static):  # type: ignore[no-untyped-def]
    """True if a point is in field and grid; with lower and upper bound of its distance to walls."""
    distance, _, frame, bounds, _, _ = static
    i, j, off = cell_of(x, y, frame)
    inside = 0 <= i < distance.shape[0] and 0 <= j < distance.shape[1]
    inside = inside and bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3]
    if not inside:
        return False, 0.0, 0.0
    middle = distance[i, j]
    return True, middle * (1.0 - FLOAT32) - off, middle * (1.0 + FLOAT32) + off


@kernel
def clear_of_walls(body, room, static, outlines, spare):  # type: ignore[no-untyped-def]
    """True if a body (7,) lies in the field and keeps `room` [m] from walls and map."""
    corners, corner, _ = outlines
    inside, low, high = _within(body[0], body[1], static)
    round_ = corner[int(body[6])] == corner[int(body[6]) + 1]
    if inside and low >= body[5] + room:
        return True
    if round_ and (not inside or high < body[5] + room):
        return False
    if not round_:  # its origin may lie outside its outline
        first = corners[corner[int(body[6])]]
        x = body[0] + body[3] * first[0] - body[4] * first[1]
        y = body[1] + body[4] * first[0] + body[3] * first[1]
        if not _within(x, y, static)[0]:
            return False
    for w in range(static[4].shape[0]):
        if wall_gap(body, static[4][w], corners, corner, room, spare) < room:
            return False
    return map_gap(body, static[5], corners, corner, room, spare) >= room


@kernel
def clear_of_bodies(body, room, bodies, gaps, outlines, spare):  # type: ignore[no-untyped-def]
    """True if a body (7,) keeps max(`room`, gap of the other) [m] from each of `bodies` (K, 7)."""
    corners, corner, _ = outlines
    mine = corner[int(body[6])] == corner[int(body[6]) + 1]
    for k in range(bodies.shape[0]):
        if bodies[k, 5] <= 0.0:
            continue
        gap = max(room, gaps[k])
        dx, dy, far = body[0] - bodies[k, 0], body[1] - bodies[k, 1], body[5] + bodies[k, 5] + gap
        if dx * dx + dy * dy >= far * far:
            continue
        shape = int(bodies[k, 6])
        if mine and corner[shape] == corner[shape + 1]:
            return False
        if body_gap(body, bodies[k], corners, corner, gap, spare) < gap:
            return False
    return True


@kernel
def clear_of_still(disc, room, still, bodies, outlines, spare):  # type: ignore[no-untyped-def]
    """True if a disc (7,) keeps `room` [m] from all static obstacles."""
    corners, corner, _ = outlines
    for k in range(bodies.shape[0]):
        if bodies[k, 5] <= 0.0 or still[k] == 0:
            continue
        dx, dy, far = disc[0] - bodies[k, 0], disc[1] - bodies[k, 1], disc[5] + bodies[k, 5] + room
        if dx * dx + dy * dy < far * far:
            shape = int(bodies[k, 6])
            if corner[shape] == corner[shape + 1]:
                return False
            if body_gap(disc, bodies[k], corners, corner, room, spare) < room:
                return False
    return True


@kernel
def area_of(x, y, static):  # type: ignore[no-untyped-def]
    """Returns the number of the area that contains a point; 0 for none."""
    i, j, _ = cell_of(x, y, static[2])
    label = static[1]
    if 0 <= i < label.shape[0] and 0 <= j < label.shape[1]:
        return label[i, j]
    return 0


@kernel
def joined(x, y, gx, gy, disc, room, still, static, bodies, none, outlines, search, spare):  # type: ignore[no-untyped-def]
    """True if a disc can move between two points among obstacles, from cell to cell.

    Searches from both ends, each towards the other first: where there is no path, one end is often
    enclosed and its search ends soon. The cells of both points count as free.

    Args:
        x, y, gx, gy: the points [m], in one area.
        disc: (7,) the robot; its position is overwritten.
        room: free space required around it at the centre of a cell [m].
        still: (K,) 1 for static obstacles; others are ignored.
        search: number of the search that last visited each cell (rows * columns), two stacks of as
            many, the number of the latest search (1,).
    """
    label, frame = static[1], static[2]
    seen, stack, latest = search
    rows, columns = label.shape
    i, j, _ = cell_of(x, y, frame)
    gi, gj, _ = cell_of(gx, gy, frame)
    area, start, goal = label[i, j], i * columns + j, gi * columns + gj
    if start == goal:
        return True
    latest[0] += 2
    stack[0, 0], stack[1, 0] = start, goal
    seen[start], seen[goal] = latest[0], latest[0] + 1
    height, other = 1, 1  # of the stack of this side, and of that of the other one
    side = 0
    while height > 0:
        height -= 1
        cell = stack[side, height]
        i, j = cell // columns, cell % columns
        ti, tj = (gi, gj) if side == 0 else (start // columns, start % columns)
        up, right = (1 if ti >= i else -1), (1 if tj >= j else -1)
        steep = abs(ti - i) >= abs(tj - j)
        for way in range(4):  # the last one is popped first
            toward = 1 if way > 1 else -1
            along = (way == 0 or way == 3) == steep
            row = i + (toward * up if along else 0)
            column = j + (0 if along else toward * right)
            if not (0 <= row < rows and 0 <= column < columns):
                continue
            new = row * columns + column
            if seen[new] == latest[0] + 1 - side:
                return True
            if label[row, column] != area or seen[new] == latest[0] + side:
                continue
            disc[0], disc[1] = place_in(row + 0.5, column + 0.5, frame)
            if clear_of_still(disc, room, still, bodies, outlines, spare):
                seen[new] = latest[0] + side
                stack[side, height] = new
                height += 1
        height, other, side = other, height, 1 - side
    return False
