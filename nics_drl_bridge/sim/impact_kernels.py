"""Compiled times of impact: the first contact of a moving body with another within a substep.

Conservative advancement: two features, each a corner or an edge with a radius around it, are
advanced by a time in which they cannot meet, again and again until they touch or the substep ends.
Along the direction between their nearest points, a corner approaches by at most its velocity times
the time plus half of its greatest acceleration times the time squared. The bound is exact to first
order, so that a body sliding along a wall or passing a corner takes few iterations. No contact is
missed, at any speed.

Two features touch when they are within `SLACK` and approach each other; they do not overlap then.
Bodies that overlap at the outset are not handled here, see `careful_kernels`.

Shared arguments: `world` (K + M, 7) obstacles, then robots, as the substep begins; `flights`
(K + M, 5) their motion in it, columns below, velocities of obstacles (k < `first`) in the map
frame and those of robots in the body frame; `outlines` corners, and the first corner of each
outline; `series` see `robot.kernels`. Body index -1 is the map, which does not move.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.kernels import move
from nics_drl_bridge.sim.collision_kernels import map_bound, segment_distance2

VX, VY, TURN, STOP, FLIGHT = range(5)
"""Columns of `flights`: velocity [m/s, m/s, rad/s], and time of its stop in the substep [s]."""
TIME, WITH, OWN, OTHERS, DEPTH, AFTER, EVENT = range(7)
"""Columns of `events`: time of a robot's first contact [s]; the other body; the rates of its own
and of the other's nearest point along the direction between them, negative if approaching [m/s];
and the clearance, negative where it overlaps something, before and after the substep [m]."""
SLACK = 1e-7
"""Bodies touch if they are nearer than this to each other and approach [m]."""
NOTHING = 1e-12
"""Distances up to this count as zero [m]."""
MOST_LOOKS = 2000
"""Iterations after which a pair counts as touching: only absurdly fast rotations need more."""


@kernel
def pose_at(b, time, world, flights, first, series):  # type: ignore[no-untyped-def]
    """Returns x, y [m], cosine and sine of the heading of a body at a time of the substep [s]."""
    if b < 0:
        return 0.0, 0.0, 1.0, 0.0
    time = min(time, flights[b, STOP])
    x, y, c, s = world[b, 0], world[b, 1], world[b, 3], world[b, 4]
    vx, vy, turn = flights[b, VX], flights[b, VY], flights[b, TURN] * time
    if b >= first:
        return move(x, y, c, s, vx, vy, turn, time, series)
    if turn != 0.0:
        cos, sin = math.cos(turn), math.sin(turn)
        c, s = c * cos - s * sin, s * cos + c * sin
    return x + vx * time, y + vy * time, c, s


@kernel
def velocity_at(b, time, c, s, flights, first):  # type: ignore[no-untyped-def]
    """Returns velocity in the map, turn rate and acceleration of a body's origin at a time."""
    if b < 0 or time >= flights[b, STOP]:
        return 0.0, 0.0, 0.0, 0.0
    vx, vy, turn = flights[b, VX], flights[b, VY], flights[b, TURN]
    if b < first:
        return vx, vy, turn, 0.0
    bend = abs(turn) * math.sqrt(vx * vx + vy * vy)
    return c * vx - s * vy, s * vx + c * vy, turn, bend


@kernel
def speed_at(b, time, flights):  # type: ignore[no-untyped-def]
    """Speed of the origin of a body from a time on [m/s]."""
    if b < 0 or time >= flights[b, STOP]:
        return 0.0
    return math.sqrt(flights[b, VX] ** 2 + flights[b, VY] ** 2)


@kernel
def _from_segment(x, y, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Returns the vector from the nearest point of a segment to (x, y)."""
    ex, ey, dx, dy = bx - ax, by - ay, x - ax, y - ay
    along = dx * ex + dy * ey
    if along > 0.0:
        share = min(along / (ex * ex + ey * ey), 1.0)
        return dx - share * ex, dy - share * ey
    return dx, dy


@kernel
def _between(p, q):  # type: ignore[no-untyped-def]
    """Returns the vector from the nearest point of segment q to that of p; zero if they cross."""
    ax, ay, bx, by = p
    cx, cy, dx, dy = q
    nx, ny = _from_segment(ax, ay, cx, cy, dx, dy)
    if ax == bx and ay == by:
        return nx, ny
    one = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)
    two = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
    three = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    four = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
    if (one > 0.0) != (two > 0.0) and (three > 0.0) != (four > 0.0):
        return 0.0, 0.0
    ox, oy = _from_segment(bx, by, cx, cy, dx, dy)
    if ox * ox + oy * oy < nx * nx + ny * ny:
        nx, ny = ox, oy
    ox, oy = _from_segment(cx, cy, ax, ay, bx, by)
    if ox * ox + oy * oy < nx * nx + ny * ny:
        nx, ny = -ox, -oy
    ox, oy = _from_segment(dx, dy, ax, ay, bx, by)
    if ox * ox + oy * oy < nx * nx + ny * ny:
        nx, ny = -ox, -oy
    return nx, ny


@kernel
def _root(gap, rate, bend):  # type: ignore[no-untyped-def]
    """Returns the first time t > 0 with gap + rate t - bend t^2 / 2 = 0, for a gap > 0."""
    if bend == 0.0:
        return np.inf if rate >= 0.0 else -gap / rate
    both = math.sqrt(rate * rate + 2.0 * bend * gap)
    return (rate + both) / bend if rate >= 0.0 else 2.0 * gap / (both - rate)


@kernel
def _placed(edge, x, y, c, s):  # type: ignore[no-untyped-def]
    """Returns an edge (ax, ay, bx, by) of a body at x, y, with cosine and sine of its heading."""
    ax, ay, bx, by = edge
    return x + c * ax - s * ay, y + s * ax + c * ay, x + c * bx - s * by, y + s * bx + c * by


@kernel
def _reach(edge):  # type: ignore[no-untyped-def]
    ax, ay, bx, by = edge
    return math.sqrt(max(ax * ax + ay * ay, bx * bx + by * by))


@kernel
def _next_stop(b, time, until, flights):  # type: ignore[no-untyped-def]
    """Returns the time a body stops if that is between two times, otherwise the later one."""
    return flights[b, STOP] if b >= 0 and time < flights[b, STOP] < until else until


@kernel
def touch(a, edge, round_a, b, other, round_b, begin, until, world, flights, first, series):  # type: ignore[no-untyped-def]  # fmt: skip
    """Finds the time at which an edge of one body first touches an edge of another.

    Args:
        a, b: the bodies.
        edge, other: (4,) the ends of their edges in the bodies' frames [m].
        round_a, round_b: the radii around them [m].
        begin, until: times of the substep [s].

    Returns:
        The time [s], inf if not before `until`; and the rates of the nearest point of each along
        the direction between them [m/s], negative if it approaches.
    """
    reach_a, reach_b, time = _reach(edge), _reach(other), begin
    for _ in range(MOST_LOOKS):
        x, y, c, s = pose_at(a, time, world, flights, first, series)
        vx, vy, turn, bend_a = velocity_at(a, time, c, s, flights, first)
        p = _placed(edge, x, y, c, s)
        ox, oy, oc, os = pose_at(b, time, world, flights, first, series)
        wx, wy, spin, bend_b = velocity_at(b, time, oc, os, flights, first)
        q = _placed(other, ox, oy, oc, os)
        nx, ny = _between(p, q)
        away = math.sqrt(nx * nx + ny * ny)
        if away <= NOTHING:
            return time, -1.0, -1.0
        gap, nx, ny = max(away - round_a - round_b, NOTHING), nx / away, ny / away
        bend = bend_a + bend_b + turn * turn * reach_a + spin * spin * reach_b
        # A turn moves a point (x, y) from the origin along n by turn * (x ny - y nx).
        rate_p = nx * (vx - turn * (p[1] - y)) + ny * (vy + turn * (p[0] - x))
        rate_p2 = nx * (vx - turn * (p[3] - y)) + ny * (vy + turn * (p[2] - x))
        rate_q = -nx * (wx - spin * (q[1] - oy)) - ny * (wy + spin * (q[0] - ox))
        rate_q2 = -nx * (wx - spin * (q[3] - oy)) - ny * (wy + spin * (q[2] - ox))
        far, far2 = nx * p[0] + ny * p[1], nx * p[2] + ny * p[3]
        near, near2 = nx * q[0] + ny * q[1], nx * q[2] + ny * q[3]
        beyond = max(near, near2)
        front = min(far, far2)
        keep = 0.5 * SLACK if gap > SLACK else 0.25 * gap
        free, own, others = np.inf, 0.0, 0.0
        for i in range(2):
            room_p = (far if i == 0 else far2) - front
            u = rate_p if i == 0 else rate_p2
            for j in range(2):
                room_q = beyond - (near if j == 0 else near2)
                v = rate_q if j == 0 else rate_q2
                root = _root(gap - keep + room_p + room_q, u + v, bend)
                if root < free:
                    free, own, others = root, u, v
        rest = _next_stop(b, time, _next_stop(a, time, until, flights), flights) - time
        if free >= rest:
            if time + rest >= until:
                return np.inf, 0.0, 0.0
            time += rest
            continue
        closing = -(own + others)
        if gap <= SLACK and closing * rest >= 0.5 * gap:
            return time, own, others
        time += free
    return time, -1.0, -1.0


@kernel
def _edge_of(v, begin, end, corners):  # type: ignore[no-untyped-def]
    """Returns edge v of an outline, or the origin for a circle, which has no edges."""
    if begin == end:
        return 0.0, 0.0, 0.0, 0.0
    w = v + 1 if begin + v + 1 < end else 0
    return (
        corners[begin + v, 0], corners[begin + v, 1], corners[begin + w, 0], corners[begin + w, 1],
    )  # fmt: skip


@kernel
def _edges(begin, end):  # type: ignore[no-untyped-def]
    """Number of edges of an outline: one for a segment, and one without extent for a circle."""
    return end - begin if end - begin > 2 else 1


@kernel
def _touch_edge(event, a, b, other, round_b, begin, scene):  # type: ignore[no-untyped-def]
    """Sets `event` (EVENT,) to the first contact of body a with an edge of body b, if sooner.

    Args:
        begin: earliest time [s].
        scene: world, flights, first, outlines, series.
    """
    world, flights, first, (corners, corner), series = scene
    x, y, _, _ = pose_at(a, begin, world, flights, first, series)
    ox, oy, oc, os = pose_at(b, begin, world, flights, first, series)
    px, py, qx, qy = _placed(other, ox, oy, oc, os)
    spin = abs(flights[b, TURN]) if b >= 0 and begin < flights[b, STOP] else 0.0
    speed = speed_at(a, begin, flights) + speed_at(b, begin, flights) + spin * _reach(other)
    far = world[a, 5] + round_b + speed * (event[TIME] - begin)
    if speed == 0.0 and (begin >= flights[a, STOP] or flights[a, TURN] == 0.0):
        return
    if segment_distance2(x, y, px, py, qx, qy) > far * far:
        return
    low, high = corner[int(world[a, 6])], corner[int(world[a, 6]) + 1]
    round_a = world[a, 5] if low == high else 0.0
    for v in range(_edges(low, high)):
        edge = _edge_of(v, low, high, corners)
        time, own, others = touch(
            a, edge, round_a, b, other, round_b, begin, event[TIME], world, flights, first, series
        )
        if time < event[TIME]:
            event[TIME], event[WITH], event[OWN], event[OTHERS] = time, b, own, others


@kernel
def touch_body(event, a, b, begin, scene):  # type: ignore[no-untyped-def]
    """As `_touch_edge`, for all edges of body b."""
    world, flights, first, (corners, corner), series = scene
    x, y, _, _ = pose_at(a, begin, world, flights, first, series)
    ox, oy, _, _ = pose_at(b, begin, world, flights, first, series)
    speed = speed_at(a, begin, flights) + speed_at(b, begin, flights)
    far = world[a, 5] + world[b, 5] + speed * (event[TIME] - begin)
    if (x - ox) * (x - ox) + (y - oy) * (y - oy) > far * far:
        return
    low, high = corner[int(world[b, 6])], corner[int(world[b, 6]) + 1]
    round_b = world[b, 5] if low == high else 0.0
    for v in range(_edges(low, high)):
        _touch_edge(event, a, b, _edge_of(v, low, high, corners), round_b, begin, scene)


@kernel
def touch_walls(event, a, walls, begin, scene):  # type: ignore[no-untyped-def]
    """As `_touch_edge`, for straight walls (W, 4)."""
    for w in range(walls.shape[0]):
        wall = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        _touch_edge(event, a, -1, wall, 0.0, begin, scene)


@kernel
def _solid(distances, i, j):  # type: ignore[no-untyped-def]
    inside = 0 <= i < distances.shape[0] and 0 <= j < distances.shape[1]
    return inside and distances[i, j] <= 0.0


@kernel
def touch_map(event, a, grid, begin, scene):  # type: ignore[no-untyped-def]
    """As `_touch_edge`, for the sides of the solid cells of a map, see `collision_kernels`."""
    world, flights, first, _, series = scene
    distances, frame = grid
    if distances.size == 0:
        return
    speed = speed_at(a, begin, flights)
    if map_bound(world[a], grid) > speed * event[TIME]:
        return
    way = speed * (event[TIME] - begin)
    px, py, _, _ = pose_at(a, begin, world, flights, first, series)
    size, c, s = frame[4], frame[2], frame[3]
    x, y = c * (px - frame[0]) + s * (py - frame[1]), c * (py - frame[1]) - s * (px - frame[0])
    far = world[a, 5] + way + SLACK
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
            for side in range(4):
                beside = (1, 0, -1, 0)[side], (0, 1, 0, -1)[side]
                if _solid(distances, i + beside[0], j + beside[1]):
                    continue  # nothing can touch a side between two solid cells
                u, v = (0, 1, 1, 0)[side], (1, 1, 0, 0)[side]
                u2, v2 = (1, 1, 0, 0)[side], (1, 0, 0, 1)[side]
                u, v, u2, v2 = (j + u) * size, (i + v) * size, (j + u2) * size, (i + v2) * size
                edge = (
                    frame[0] + c * u - s * v, frame[1] + s * u + c * v,
                    frame[0] + c * u2 - s * v2, frame[1] + s * u2 + c * v2,
                )  # fmt: skip
                _touch_edge(event, a, -1, edge, 0.0, begin, scene)
