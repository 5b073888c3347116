"""Compiled collision: the signed clearance between bodies, straight walls and a static map.

A clearance is the distance between two outlines that are apart. Where they overlap it is negative:
the depth at which the deepest point of one lies within the other, taken over their corners and
the midpoints of the pieces of their edges that lie within. Circles are compared by their centres,
and outlines only where the circles around both are near.

Shared arguments: a body (7,) is as in `lidar.shapes.BODY`; `corners` (sum V, 2) and `corner`
(H + 1,) are the outlines of all shapes, see `lidar.shapes.Outlines`: none for a circle, two
corners for a segment. Clearances beyond `limit` [m] are not measured: the result is `limit`.
`grid` is the map: distances (rows, columns) of `lidar.maps.GridMap.distance_field`, 0 in
solid cells, and frame (5,): x, y [m], cosine, sine of its origin, resolution [m]. `spare` (F, 2) is
scratch for the corners of the first body, at least 4.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel

TOUCHING = 1e-12
"""Outlines within this distance touch; their depth then decides whether they overlap [m]."""
ON_EDGE = 1e-9
"""Tolerance beyond the ends of an edge for intersections, as a share of its length."""
FLOAT32 = 1e-6
"""Relative rounding error of the distances of a map."""


@kernel
def segment_distance2(x, y, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Square of the distance from (x, y) to the segment from (ax, ay) to (bx, by) [m^2]."""
    ex, ey, dx, dy = bx - ax, by - ay, x - ax, y - ay
    along, length2 = dx * ex + dy * ey, ex * ex + ey * ey
    if along > 0.0:
        share = min(along / length2, 1.0)
        dx -= share * ex
        dy -= share * ey
    return dx * dx + dy * dy


@kernel
def _side(ax, ay, bx, by, x, y):  # type: ignore[no-untyped-def]
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@kernel
def _edges_distance2(ax, ay, bx, by, px, py, qx, qy):  # type: ignore[no-untyped-def]
    """Square of the distance between two segments [m^2]; -1 if they cross."""
    if (_side(ax, ay, bx, by, px, py) > 0.0) != (_side(ax, ay, bx, by, qx, qy) > 0.0) and (
        _side(px, py, qx, qy, ax, ay) > 0.0
    ) != (_side(px, py, qx, qy, bx, by) > 0.0):
        return -1.0
    return min(
        segment_distance2(ax, ay, px, py, qx, qy),
        segment_distance2(bx, by, px, py, qx, qy),
        segment_distance2(px, py, ax, ay, bx, by),
        segment_distance2(qx, qy, ax, ay, bx, by),
    )


@kernel
def outline_point(x, y, corners, begin, end):  # type: ignore[no-untyped-def]
    """Signed distance from (x, y) to the outline of `corners[begin:end]`; negative inside."""
    if end - begin == 2:
        return math.sqrt(
            segment_distance2(
                x, y, corners[begin, 0], corners[begin, 1], corners[begin + 1, 0],
                corners[begin + 1, 1],
            )
        )  # fmt: skip
    least, inside = np.inf, False
    ax, ay = corners[end - 1, 0], corners[end - 1, 1]
    for v in range(begin, end):
        bx, by = corners[v, 0], corners[v, 1]
        least = min(least, segment_distance2(x, y, ax, ay, bx, by))
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
        ax, ay = bx, by
    return -math.sqrt(least) if inside else math.sqrt(least)


@kernel
def _next_cut(ax, ay, ex, ey, after, q, q_begin, q_end):  # type: ignore[no-untyped-def]
    """Next cut of the edge from (ax, ay) along (ex, ey) by outline q, as a share of its length."""
    least = 1.0
    cx, cy = q[q_end - 1, 0], q[q_end - 1, 1]
    for w in range(q_begin, q_end):
        dx, dy = q[w, 0], q[w, 1]
        fx, fy = dx - cx, dy - cy
        cross = ex * fy - ey * fx
        if cross != 0.0:
            at = ((cx - ax) * fy - (cy - ay) * fx) / cross
            if after + ON_EDGE < at < least:
                along = ((cx - ax) * ey - (cy - ay) * ex) / cross
                if -ON_EDGE <= along <= 1.0 + ON_EDGE:
                    least = at
        cx, cy = dx, dy
    return least


@kernel
def _deepest(p, p_begin, p_end, q, q_begin, q_end):  # type: ignore[no-untyped-def]
    """Depth of the edges of outline p within outline q [m]; 0 if they do not overlap."""
    depth = 0.0
    if q_end - q_begin == 2:
        return depth
    ax, ay = p[p_end - 1, 0], p[p_end - 1, 1]
    for v in range(p_begin, p_end):
        bx, by = p[v, 0], p[v, 1]
        ex, ey = bx - ax, by - ay
        depth = max(depth, -outline_point(bx, by, q, q_begin, q_end))
        at = 0.0
        while at < 1.0:
            cut = _next_cut(ax, ay, ex, ey, at, q, q_begin, q_end)
            middle = 0.5 * (at + cut)
            depth = max(
                depth, -outline_point(ax + middle * ex, ay + middle * ey, q, q_begin, q_end)
            )
            at = cut
        ax, ay = bx, by
    return depth


@kernel
def outline_gap(p, p_begin, p_end, x, y, reach, q, q_begin, q_end, limit):  # type: ignore[no-untyped-def]
    """Signed clearance of two outlines in one frame.

    Args:
        p, p_begin, p_end: the corners of one, preferably the one with fewer corners.
        x, y, reach: a circle that encloses it.
        q, q_begin, q_end: the corners of the other.
        limit: see the module.
    """
    least, crossing, touching = limit * limit, False, False
    ax, ay = q[q_end - 1, 0], q[q_end - 1, 1]
    for v in range(q_begin, q_end):
        bx, by = q[v, 0], q[v, 1]
        near = reach + math.sqrt(least)
        if segment_distance2(x, y, ax, ay, bx, by) <= near * near:
            cx, cy = p[p_end - 1, 0], p[p_end - 1, 1]
            for w in range(p_begin, p_end):
                dx, dy = p[w, 0], p[w, 1]
                distance2 = _edges_distance2(ax, ay, bx, by, cx, cy, dx, dy)
                crossing = crossing or distance2 < 0.0
                touching = touching or distance2 <= TOUCHING * TOUCHING
                least = min(least, max(distance2, 0.0))
                cx, cy = dx, dy
        ax, ay = bx, by
    overlapping = crossing or touching
    if not overlapping and q_end - q_begin > 2:
        overlapping = outline_point(p[p_begin, 0], p[p_begin, 1], q, q_begin, q_end) < 0.0
    if not overlapping and p_end - p_begin > 2:
        overlapping = outline_point(q[q_begin, 0], q[q_begin, 1], p, p_begin, p_end) < 0.0
    if not overlapping:
        return math.sqrt(least)
    depth = max(
        _deepest(p, p_begin, p_end, q, q_begin, q_end),
        _deepest(q, q_begin, q_end, p, p_begin, p_end),
    )
    if depth > 0.0:
        return -depth
    return -TOUCHING if crossing and (q_end - q_begin > 2 or p_end - p_begin > 2) else 0.0


@kernel
def body_gap(body, other, corners, corner, limit, spare):  # type: ignore[no-untyped-def]
    """Signed clearance of two bodies; see the module."""
    dx, dy = body[0] - other[0], body[1] - other[1]
    far = body[5] + other[5] + max(limit, 0.0)
    if dx * dx + dy * dy > far * far:
        return limit
    begin, end = corner[int(body[6])], corner[int(body[6]) + 1]
    first, last = corner[int(other[6])], corner[int(other[6]) + 1]
    c, s = other[3], other[4]
    if begin == end:
        x, y = c * dx + s * dy, c * dy - s * dx
        if first == last:
            gap = math.sqrt(dx * dx + dy * dy) - other[5]
        else:
            gap = outline_point(x, y, corners, first, last)
        return min(gap - body[5], limit)
    if first == last:
        x, y = -(body[3] * dx + body[4] * dy), -(body[3] * dy - body[4] * dx)
        return min(outline_point(x, y, corners, begin, end) - other[5], limit)
    x, y = c * dx + s * dy, c * dy - s * dx
    cos, sin = body[3] * c + body[4] * s, body[4] * c - body[3] * s
    for v in range(end - begin):
        px, py = corners[begin + v, 0], corners[begin + v, 1]
        spare[v, 0], spare[v, 1] = x + cos * px - sin * py, y + sin * px + cos * py
    return min(
        outline_gap(spare, 0, end - begin, x, y, body[5], corners, first, last, max(limit, 0.0)),
        limit,
    )


@kernel
def wall_gap(body, wall, corners, corner, limit, spare):  # type: ignore[no-untyped-def]
    """Signed clearance of a body and a straight wall (4,)."""
    distance2 = segment_distance2(body[0], body[1], wall[0], wall[1], wall[2], wall[3])
    far = body[5] + max(limit, 0.0)
    if distance2 > far * far:
        return limit
    begin, end = corner[int(body[6])], corner[int(body[6]) + 1]
    if begin == end:
        return min(math.sqrt(distance2) - body[5], limit)
    for v in range(2):
        dx, dy = wall[2 * v] - body[0], wall[2 * v + 1] - body[1]
        spare[v, 0], spare[v, 1] = body[3] * dx + body[4] * dy, body[3] * dy - body[4] * dx
    x, y = 0.5 * (spare[0, 0] + spare[1, 0]), 0.5 * (spare[0, 1] + spare[1, 1])
    reach = math.hypot(spare[0, 0] - x, spare[0, 1] - y)
    gap = outline_gap(spare, 0, 2, x, y, reach, corners, begin, end, max(limit, 0.0))
    return min(gap, limit)


@kernel
def _in_grid(body, frame):  # type: ignore[no-untyped-def]
    """Returns x, y [m], cosine and sine of a body in the frame of the map."""
    dx, dy = body[0] - frame[0], body[1] - frame[1]
    x, y = frame[2] * dx + frame[3] * dy, frame[2] * dy - frame[3] * dx
    c, s = body[3] * frame[2] + body[4] * frame[3], body[4] * frame[2] - body[3] * frame[3]
    return x, y, c, s


@kernel
def _bounds(x, y, distances, size):  # type: ignore[no-untyped-def]
    """Bounds on the distance from (x, y) to a solid cell, from that of the nearest cell [m]."""
    rows, columns = distances.shape
    i = min(max(math.floor(y / size), 0), rows - 1)
    j = min(max(math.floor(x / size), 0), columns - 1)
    # From outside, the nearest point of the map is nearer to each of its cells than (x, y) is.
    px, py = min(max(x, 0.0), columns * size), min(max(y, 0.0), rows * size)
    within = math.hypot(px - (j + 0.5) * size, py - (i + 0.5) * size)
    outside = math.hypot(x - px, y - py)
    middle = distances[i, j]
    return middle * (1.0 - FLOAT32) - within, middle * (1.0 + FLOAT32) + within + outside


@kernel
def map_bound(body, grid):  # type: ignore[no-untyped-def]
    """Lower bound on the distance from the circle around a body to the map [m]."""
    distances, frame = grid
    if distances.size == 0:
        return np.inf
    x, y, _, _ = _in_grid(body, frame)
    return _bounds(x, y, distances, frame[4])[0] - body[5]


@kernel
def map_gap(body, grid, corners, corner, limit, spare):  # type: ignore[no-untyped-def]
    """Signed clearance of a body and the solid cells of a map."""
    distances, frame = grid
    if distances.size == 0:
        return limit
    size, radius = frame[4], body[5]
    x, y, c, s = _in_grid(body, frame)
    low, high = _bounds(x, y, distances, size)
    if low - radius > limit:
        return limit
    far = radius + max(min(limit, high), 0.0) + size
    begin, end = corner[int(body[6])], corner[int(body[6]) + 1]
    least = limit
    for i in range(
        max(math.floor((y - far) / size), 0),
        min(math.floor((y + far) / size), distances.shape[0] - 1) + 1,
    ):
        for j in range(
            max(math.floor((x - far) / size), 0),
            min(math.floor((x + far) / size), distances.shape[1] - 1) + 1,
        ):
            if distances[i, j] > 0.0:
                continue
            dx = max(j * size - x, x - (j + 1) * size, 0.0)
            dy = max(i * size - y, y - (i + 1) * size, 0.0)
            near = radius + max(least, 0.0)
            if dx * dx + dy * dy > near * near:
                continue
            if begin == end:
                least = min(least, math.sqrt(dx * dx + dy * dy) - radius)
                continue
            for v in range(4):
                across = (j + ((v + 1) // 2) % 2) * size - x
                up = (i + v // 2) * size - y
                spare[v, 0], spare[v, 1] = c * across + s * up, c * up - s * across
            mx, my = 0.5 * (spare[0, 0] + spare[2, 0]), 0.5 * (spare[0, 1] + spare[2, 1])
            gap = outline_gap(
                spare, 0, 4, mx, my, 0.75 * size, corners, begin, end, max(least, 0.0)
            )
            least = min(least, gap)
    return least
