"""Compiled collision: the signed clearance between bodies, straight walls and a static map.

It is the distance between two outlines that are apart, at most `limit` [m]. Where they overlap it
is negative: the depth at which the deepest point of one lies within the other, over their corners
and the midpoints of the pieces of edges within. Shared arguments: a body (7,) has the columns of
`state`, a wall (4,) two ends; the distances of a map are 0 in solid cells; `spare` (F, 2), at least
4, is scratch for the corners of the first body.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import (
    COS,
    RADIUS,
    SHAPE,
    SIN,
    OutlineArrays,
    X,
    Y,
)
from nics_drl_bridge.sim.state import Array, MapField

# Outlines this near touch; their depth then decides about an overlap [m]
TOUCHING = 1e-12
ON_EDGE = 1e-9  # tolerance beyond an edge's ends for intersections, as a fraction of its length
FLOAT32 = 1e-6  # Relative rounding error of the distances of a map


class Outline(NamedTuple):
    """One outline: the corners from `begin` to before `end`, none for a circle."""

    corners: Array
    begin: int
    end: int


@kernel
def outline_of(body: Array, outlines: OutlineArrays) -> Outline:
    """Return the outline of a body's shape, in the body's frame."""
    shape = int(body[SHAPE])
    return Outline(outlines.corners, outlines.first[shape], outlines.first[shape + 1])


@kernel
def is_round(body: Array, outlines: OutlineArrays) -> bool:
    """True for a circle."""
    shape = int(body[SHAPE])
    return outlines.first[shape] == outlines.first[shape + 1]


@kernel
def from_segment(
    x: float, y: float, ax: float, ay: float, bx: float, by: float
) -> tuple[float, float]:
    """Return the vector to (x, y) from the nearest point of the segment (ax, ay) to (bx, by)."""
    ex = bx - ax
    ey = by - ay
    dx = x - ax
    dy = y - ay
    along = dx * ex + dy * ey
    if along > 0.0:
        share = min(along / (ex * ex + ey * ey), 1.0)
        return dx - share * ex, dy - share * ey
    return dx, dy


@kernel
def segment_distance2(
    x: float, y: float, ax: float, ay: float, bx: float, by: float
) -> float:
    """Square of the distance from (x, y) to the segment from (ax, ay) to (bx, by) [m^2]."""
    dx, dy = from_segment(x, y, ax, ay, bx, by)
    return dx * dx + dy * dy


@kernel
def _side(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> float:
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@kernel
def cross(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    px: float,
    py: float,
    qx: float,
    qy: float,
) -> bool:
    """True if the segments from a to b and from p to q cross."""
    return (_side(ax, ay, bx, by, px, py) > 0.0) != (
        _side(ax, ay, bx, by, qx, qy) > 0.0
    ) and (_side(px, py, qx, qy, ax, ay) > 0.0) != (_side(px, py, qx, qy, bx, by) > 0.0)


@kernel
def _edges_distance2(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    px: float,
    py: float,
    qx: float,
    qy: float,
) -> float:
    """Square of the distance between two segments [m^2]; -1 if they cross."""
    if cross(ax, ay, bx, by, px, py, qx, qy):
        return -1.0
    return min(
        segment_distance2(ax, ay, px, py, qx, qy),
        segment_distance2(bx, by, px, py, qx, qy),
        segment_distance2(px, py, ax, ay, bx, by),
        segment_distance2(qx, qy, ax, ay, bx, by),
    )


@kernel
def outline_point(x: float, y: float, outline: Outline) -> float:
    """Signed distance from (x, y) to an outline; negative inside."""
    corners = outline.corners
    begin = outline.begin
    end = outline.end
    least = np.inf
    inside = False
    ax = corners[end - 1, 0]
    ay = corners[end - 1, 1]
    if end - begin == 2:
        bx = corners[begin, 0]
        by = corners[begin, 1]
        return math.sqrt(segment_distance2(x, y, bx, by, ax, ay))
    for v in range(begin, end):
        bx = corners[v, 0]
        by = corners[v, 1]
        least = min(least, segment_distance2(x, y, ax, ay, bx, by))
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
        ax = bx
        ay = by
    return -math.sqrt(least) if inside else math.sqrt(least)


@kernel
def _next_cut(
    ax: float, ay: float, ex: float, ey: float, after: float, q: Outline
) -> float:
    """Next cut of the edge from (ax, ay) along (ex, ey) by outline q, as a fraction of the edge."""
    least = 1.0
    cx = q.corners[q.end - 1, 0]
    cy = q.corners[q.end - 1, 1]
    for w in range(q.begin, q.end):
        dx = q.corners[w, 0]
        dy = q.corners[w, 1]
        fx = dx - cx
        fy = dy - cy
        cross = ex * fy - ey * fx
        if cross != 0.0:
            at = ((cx - ax) * fy - (cy - ay) * fx) / cross
            if after + ON_EDGE < at < least:
                along = ((cx - ax) * ey - (cy - ay) * ex) / cross
                if -ON_EDGE <= along <= 1.0 + ON_EDGE:
                    least = at
        cx = dx
        cy = dy
    return least


@kernel
def _deepest(p: Outline, q: Outline) -> float:
    depth = 0.0
    if q.end - q.begin == 2:
        return depth
    ax = p.corners[p.end - 1, 0]
    ay = p.corners[p.end - 1, 1]
    for v in range(p.begin, p.end):
        bx = p.corners[v, 0]
        by = p.corners[v, 1]
        ex = bx - ax
        ey = by - ay
        depth = max(depth, -outline_point(bx, by, q))
        at = 0.0
        while at < 1.0:
            cut = _next_cut(ax, ay, ex, ey, at, q)
            middle = 0.5 * (at + cut)
            depth = max(depth, -outline_point(ax + middle * ex, ay + middle * ey, q))
            at = cut
        ax = bx
        ay = by
    return depth


@kernel
def _outline_gap(
    p: Outline, x: float, y: float, reach: float, q: Outline, limit: float
) -> float:
    """Signed clearance of two outlines in one frame; a circle (x, y, reach) encloses p."""
    least = limit * limit
    crossing = False
    touching = False
    ax = q.corners[q.end - 1, 0]
    ay = q.corners[q.end - 1, 1]
    for v in range(q.begin, q.end):
        bx = q.corners[v, 0]
        by = q.corners[v, 1]
        near = reach + math.sqrt(least)
        if segment_distance2(x, y, ax, ay, bx, by) <= near * near:
            cx = p.corners[p.end - 1, 0]
            cy = p.corners[p.end - 1, 1]
            for w in range(p.begin, p.end):
                dx = p.corners[w, 0]
                dy = p.corners[w, 1]
                distance2 = _edges_distance2(ax, ay, bx, by, cx, cy, dx, dy)
                crossing = crossing or distance2 < 0.0
                touching = touching or distance2 <= TOUCHING * TOUCHING
                least = min(least, max(distance2, 0.0))
                cx = dx
                cy = dy
        ax = bx
        ay = by
    overlapping = crossing or touching
    if not overlapping and q.end - q.begin > 2:
        overlapping = (
            outline_point(p.corners[p.begin, 0], p.corners[p.begin, 1], q) < 0.0
        )
    if not overlapping and p.end - p.begin > 2:
        overlapping = (
            outline_point(q.corners[q.begin, 0], q.corners[q.begin, 1], p) < 0.0
        )
    if not overlapping:
        return math.sqrt(least)
    depth = max(_deepest(p, q), _deepest(q, p))
    if depth > 0.0:
        return -depth
    if crossing and (q.end - q.begin > 2 or p.end - p.begin > 2):
        return -TOUCHING
    return 0.0


@kernel
def body_gap(
    body: Array, obstacle: Array, outlines: OutlineArrays, limit: float, spare: Array
) -> float:
    """Signed clearance of two bodies; see the module."""
    dx = body[X] - obstacle[X]
    dy = body[Y] - obstacle[Y]
    far = body[RADIUS] + obstacle[RADIUS] + max(limit, 0.0)
    if dx * dx + dy * dy > far * far:
        return limit
    mine = outline_of(body, outlines)
    outline = outline_of(obstacle, outlines)
    c = obstacle[COS]
    s = obstacle[SIN]
    x = c * dx + s * dy
    y = c * dy - s * dx
    if mine.begin == mine.end:
        if outline.begin == outline.end:
            gap = math.sqrt(dx * dx + dy * dy) - obstacle[RADIUS]
        else:
            gap = outline_point(x, y, outline)
        return min(gap - body[RADIUS], limit)
    if outline.begin == outline.end:
        x = -(body[COS] * dx + body[SIN] * dy)
        y = -(body[COS] * dy - body[SIN] * dx)
        return min(outline_point(x, y, mine) - obstacle[RADIUS], limit)
    cos = body[COS] * c + body[SIN] * s
    sin = body[SIN] * c - body[COS] * s
    for v in range(mine.end - mine.begin):
        px = mine.corners[mine.begin + v, 0]
        py = mine.corners[mine.begin + v, 1]
        spare[v, 0] = x + cos * px - sin * py
        spare[v, 1] = y + sin * px + cos * py
    placed = Outline(spare, 0, mine.end - mine.begin)
    return min(
        _outline_gap(placed, x, y, body[RADIUS], outline, max(limit, 0.0)), limit
    )


@kernel
def wall_gap(
    body: Array, wall: Array, outlines: OutlineArrays, limit: float, spare: Array
) -> float:
    """Signed clearance of a body and a straight wall."""
    distance2 = segment_distance2(body[X], body[Y], wall[0], wall[1], wall[2], wall[3])
    far = body[RADIUS] + max(limit, 0.0)
    if distance2 > far * far:
        return limit
    outline = outline_of(body, outlines)
    if outline.begin == outline.end:
        return min(math.sqrt(distance2) - body[RADIUS], limit)
    for v in range(2):
        dx = wall[2 * v] - body[X]
        dy = wall[2 * v + 1] - body[Y]
        spare[v, 0], spare[v, 1] = (
            body[COS] * dx + body[SIN] * dy,
            body[COS] * dy - body[SIN] * dx,
        )
    x = 0.5 * (spare[0, 0] + spare[1, 0])
    y = 0.5 * (spare[0, 1] + spare[1, 1])
    reach = math.hypot(spare[0, 0] - x, spare[0, 1] - y)
    return min(
        _outline_gap(Outline(spare, 0, 2), x, y, reach, outline, max(limit, 0.0)), limit
    )


@kernel
def _along(x: float, y: float, wall: Array) -> float:
    ex = wall[2] - wall[0]
    ey = wall[3] - wall[1]
    length2 = ex * ex + ey * ey
    if length2 > 0.0:
        return min(max(((x - wall[0]) * ex + (y - wall[1]) * ey) / length2, 0.0), 1.0)
    return 0.0


@kernel
def on_wall(x: float, y: float, wall: Array) -> tuple[float, float]:
    """Return the point of a straight wall nearest to a point."""
    share = _along(x, y, wall)
    return wall[0] + share * (wall[2] - wall[0]), wall[1] + share * (wall[3] - wall[1])


@kernel
def wall_distance(x: float, y: float, walls: Array) -> float:
    """Distance from a point to the nearest straight wall (W, 4) [m]; inf if there is none."""
    least = np.inf
    for w in range(walls.shape[0]):
        ax = walls[w, 0]
        ay = walls[w, 1]
        share = _along(x, y, walls[w])
        ex = walls[w, 2] - ax
        ey = walls[w, 3] - ay
        least = min(least, np.hypot(x - ax - share * ex, y - ay - share * ey))
    return least


@kernel
def in_grid(x: float, y: float, grid: MapField) -> tuple[float, float]:
    """Return a point of the map frame in the frame of a grid [m]."""
    dx = x - grid.x
    dy = y - grid.y
    return grid.cos * dx + grid.sin * dy, grid.cos * dy - grid.sin * dx


@kernel
def cells_near(
    x: float, y: float, far: float, grid: MapField
) -> tuple[int, int, int, int]:
    """Return first and last + 1 row and column of the cells up to `far` [m] from a point."""
    rows, columns = grid.distances.shape
    low_i = math.floor((y - far) / grid.cell)
    high_i = math.floor((y + far) / grid.cell)
    low_j = math.floor((x - far) / grid.cell)
    high_j = math.floor((x + far) / grid.cell)
    return (
        max(low_i, 0),
        min(high_i, rows - 1) + 1,
        max(low_j, 0),
        min(high_j, columns - 1) + 1,
    )


@kernel
def _bounds(x: float, y: float, grid: MapField) -> tuple[float, float]:
    """Bound on the distance from (x, y) to a solid cell, from that of the nearest cell [m]."""
    rows, columns = grid.distances.shape
    size = grid.cell
    i = min(max(math.floor(y / size), 0), rows - 1)
    j = min(max(math.floor(x / size), 0), columns - 1)
    # From outside, the nearest point of the map is nearer to each of its cells than (x, y) is.
    px = min(max(x, 0.0), columns * size)
    py = min(max(y, 0.0), rows * size)
    within = math.hypot(px - (j + 0.5) * size, py - (i + 0.5) * size)
    outside = math.hypot(x - px, y - py)
    middle = grid.distances[i, j]
    return middle * (1.0 - FLOAT32) - within, middle * (
        1.0 + FLOAT32
    ) + within + outside


@kernel
def map_bound(body: Array, grid: MapField) -> float:
    """Lower bound on the distance from the circle around a body to the map [m]."""
    if grid.distances.size == 0:
        return np.inf
    x, y = in_grid(body[X], body[Y], grid)
    return _bounds(x, y, grid)[0] - body[RADIUS]


@kernel
def map_gap(
    body: Array, grid: MapField, outlines: OutlineArrays, limit: float, spare: Array
) -> float:
    """Signed clearance of a body and the solid cells of a map."""
    if grid.distances.size == 0:
        return limit
    size = grid.cell
    radius = body[RADIUS]
    outline = outline_of(body, outlines)
    x, y = in_grid(body[X], body[Y], grid)
    low, high = _bounds(x, y, grid)
    if low - radius > limit:
        return limit
    c = body[COS] * grid.cos + body[SIN] * grid.sin
    s = body[SIN] * grid.cos - body[COS] * grid.sin
    far = radius + max(min(limit, high), 0.0) + size
    least = limit
    low_i, end_i, low_j, end_j = cells_near(x, y, far, grid)
    for i in range(low_i, end_i):
        for j in range(low_j, end_j):
            dx = max(j * size - x, x - (j + 1) * size, 0.0)
            dy = max(i * size - y, y - (i + 1) * size, 0.0)
            near = radius + max(least, 0.0)
            if grid.distances[i, j] > 0.0 or dx * dx + dy * dy > near * near:
                continue
            if outline.begin == outline.end:
                least = min(least, math.sqrt(dx * dx + dy * dy) - radius)
                continue
            for v in range(4):
                across = (j + ((v + 1) // 2) % 2) * size - x
                up = (i + v // 2) * size - y
                spare[v, 0] = c * across + s * up
                spare[v, 1] = c * up - s * across
            mx = 0.5 * (spare[0, 0] + spare[2, 0])
            my = 0.5 * (spare[0, 1] + spare[2, 1])
            square = Outline(spare, 0, 4)
            reach = 0.75 * size
            gap = _outline_gap(square, mx, my, reach, outline, max(least, 0.0))
            least = min(least, gap)
    return least
