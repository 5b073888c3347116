"""Compiled times of impact: the first contact of a moving body with another within a substep.

Conservative advancement: two features, a corner or an edge with a radius around it, are advanced by
a time in which they cannot meet, until they touch or the substep ends. Along the direction between
their nearest points, a corner approaches by at most its velocity times the time plus half its
maximum acceleration times the time squared. The bound is exact to first order, so that sliding
along a wall takes few iterations, and no contact is missed at any speed.

Features touch when they are within `SLACK` and approach each other; bodies that overlap before are
left to `careful_kernels`. Times are in the substep [s]; body -1 is the map.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import (
    COS,
    HEADING,
    RADIUS,
    SIN,
    OutlineArrays,
    X,
    Y,
)
from nics_drl_bridge.robot.kernels import move
from nics_drl_bridge.sim import collision_kernels as collision
from nics_drl_bridge.sim.state import Array, MapField

VX, VY, TURN, STOP, FROM, WISH_X, WISH_Y, WISH_TURN, HOLDS, FIRST_HOLD = range(10)
"""Columns of `flights`: velocity [m/s, m/s, rad/s]; time of its stop in the substep [s]; time at
which the body is where `world` says [s]; the velocity that a robot would have if nothing held it;
and the number of its holds, with which both are in the map frame, too; then the holds."""
HOLD_X, HOLD_Y, ARM, PUSH, HOLD = range(5)
"""Columns of a hold: direction away from what holds a robot; lever arm of its point there [m]; and
the speed that it is given [m/s]."""
MOST_HOLDS = (
    8  # Maximum number of holds in a substep; a robot with more is wedged in, and stops
)
FLIGHT = FIRST_HOLD + MOST_HOLDS * HOLD
SWEEPS = 30  # Number of passes over the holds to find speeds that satisfy all of them
(
    TIME,
    WITH,
    OWN,
    OTHERS,
    NX,
    NY,
    OWN_X,
    OWN_Y,
    OTHERS_X,
    OTHERS_Y,
    DEPTH,
    AFTER,
    PRESSED,
    EVENT,
) = range(14)
"""Columns of `events`: time of a robot's first contact [s]; the other body; the rates of its own
and of the other's nearest point along the direction (NX, NY) from the other to it, 0 if there is
none, negative if approaching [m/s]; these points [m]; the clearance, negative where it overlaps
something, before and after the substep [m]; and 1 if it touched something before."""
SLACK = 1e-7  # Bodies touch if they are nearer than this to each other and approach [m]
NOTHING = 1e-12  # Distances up to this count as zero [m]
PARTING = 1e-5  # Speed at which a deflected body moves away, so that roundings don't add up [m/s]
# Maximum number of iterations, then a pair counts as touching: only absurd turns need more
MOST_LOOKS = 2000


class Moving(NamedTuple):
    """The bodies of one world within a substep."""

    world: Array  # (K + M, 7) obstacles, then robots, as the substep begins
    flights: Array  # (K + M, FLIGHT) their motion; robots in their own frame, all else in the map
    first: int  # index of the first robot
    outlines: OutlineArrays
    series: Array  # see `robot.kernels`


class Edge(NamedTuple):
    """A straight line between two points [m]; both are the same for the centre of a circle."""

    ax: float
    ay: float
    bx: float
    by: float


class Placed(NamedTuple):
    """An edge of a body in the map at a time, and how it moves."""

    edge: Edge
    x: float  # origin of the body [m]
    y: float
    vx: float  # its velocity in the map [m/s]
    vy: float
    turn: float  # [rad/s]
    bend: float  # acceleration of its origin [m/s^2]


@kernel
def in_own_frame(b: int, moving: Moving) -> bool:
    """True if the velocity of a body is in its own frame: that of a robot until it slides."""
    return b >= moving.first and moving.flights[b, HOLDS] == 0.0


@kernel
def pose_at(b: int, time: float, moving: Moving) -> tuple[float, float, float, float]:
    """Return x, y [m], cosine and sine of the heading of a body at a time."""
    if b < 0:
        return 0.0, 0.0, 1.0, 0.0
    world = moving.world
    flights = moving.flights
    time = max(min(time, flights[b, STOP]) - flights[b, FROM], 0.0)
    x = world[b, X]
    y = world[b, Y]
    c = world[b, COS]
    s = world[b, SIN]
    vx = flights[b, VX]
    vy = flights[b, VY]
    turn = flights[b, TURN] * time
    if in_own_frame(b, moving):
        return move(x, y, c, s, vx, vy, turn, time, moving.series)  # type: ignore[no-any-return]
    if turn != 0.0:
        cos = math.cos(turn)
        sin = math.sin(turn)
        c, s = c * cos - s * sin, s * cos + c * sin
    return x + vx * time, y + vy * time, c, s


@kernel
def _placed_at(b: int, edge: Edge, time: float, moving: Moving) -> Placed:
    x, y, c, s = pose_at(b, time, moving)
    placed = _in_map(edge, x, y, c, s)
    if b < 0 or time >= moving.flights[b, STOP]:
        return Placed(placed, x, y, 0.0, 0.0, 0.0, 0.0)
    flight = moving.flights[b]
    vx = flight[VX]
    vy = flight[VY]
    turn = flight[TURN]
    if not in_own_frame(b, moving):
        return Placed(placed, x, y, vx, vy, turn, 0.0)
    bend = abs(turn) * math.sqrt(vx * vx + vy * vy)
    return Placed(placed, x, y, c * vx - s * vy, s * vx + c * vy, turn, bend)


@kernel
def speed_at(b: int, time: float, flights: Array) -> float:
    """Speed of the origin of a body from a time on [m/s]."""
    if b < 0 or time >= flights[b, STOP]:
        return 0.0
    return math.sqrt(flights[b, VX] ** 2 + flights[b, VY] ** 2)


@kernel
def _between(p: Edge, q: Edge) -> tuple[float, float]:
    """Return the vector from the nearest point of q to that of p; zero where they cross."""
    nx, ny = collision.from_segment(p.ax, p.ay, q.ax, q.ay, q.bx, q.by)
    if p.ax == p.bx and p.ay == p.by:
        return nx, ny
    if collision.cross(p.ax, p.ay, p.bx, p.by, q.ax, q.ay, q.bx, q.by):
        return 0.0, 0.0
    for x, y, edge, sign in (
        (p.bx, p.by, q, 1.0),
        (q.ax, q.ay, p, -1.0),
        (q.bx, q.by, p, -1.0),
    ):
        ox, oy = collision.from_segment(x, y, edge.ax, edge.ay, edge.bx, edge.by)
        if ox * ox + oy * oy < nx * nx + ny * ny:
            nx = sign * ox
            ny = sign * oy
    return nx, ny


@kernel
def _root(gap: float, rate: float, bend: float) -> float:
    """Return when gap + rate t - bend t^2 / 2 reaches zero, for a gap > 0."""
    if bend == 0.0:
        return np.inf if rate >= 0.0 else -gap / rate
    both = math.sqrt(rate * rate + 2.0 * bend * gap)
    return (rate + both) / bend if rate >= 0.0 else 2.0 * gap / (both - rate)


@kernel
def _in_map(edge: Edge, x: float, y: float, c: float, s: float) -> Edge:
    ax = edge.ax
    ay = edge.ay
    bx = edge.bx
    by = edge.by
    return Edge(
        x + c * ax - s * ay,
        y + s * ax + c * ay,
        x + c * bx - s * by,
        y + s * bx + c * by,
    )


@kernel
def _reach(edge: Edge) -> float:
    ax = edge.ax
    ay = edge.ay
    bx = edge.bx
    by = edge.by
    return math.sqrt(max(ax * ax + ay * ay, bx * bx + by * by))


@kernel
def _next_stop(b: int, time: float, until: float, flights: Array) -> float:
    return flights[b, STOP] if b >= 0 and time < flights[b, STOP] < until else until


@kernel
def _rate(nx: float, ny: float, body: Placed, x: float, y: float) -> float:
    # A turn moves a point (x, y) from the origin along n by turn * (x ny - y nx).
    return nx * (body.vx - body.turn * (y - body.y)) + ny * (
        body.vy + body.turn * (x - body.x)
    )


@kernel
def _free_time(
    p: Placed, q: Placed, nx: float, ny: float, gap: float, bend: float
) -> tuple[float, float, float]:
    """Time in which edges `gap` [m] apart along n (q to p) cannot meet, with its corners' rates."""
    far = nx * p.edge.ax + ny * p.edge.ay
    far2 = nx * p.edge.bx + ny * p.edge.by
    near = nx * q.edge.ax + ny * q.edge.ay
    near2 = nx * q.edge.bx + ny * q.edge.by
    rate_p = _rate(nx, ny, p, p.edge.ax, p.edge.ay)
    rate_p2 = _rate(nx, ny, p, p.edge.bx, p.edge.by)
    rate_q = -_rate(nx, ny, q, q.edge.ax, q.edge.ay)
    rate_q2 = -_rate(nx, ny, q, q.edge.bx, q.edge.by)
    front = min(far, far2)
    beyond = max(near, near2)
    keep = 0.5 * SLACK if gap > SLACK else 0.25 * gap
    free = np.inf
    own_rate = 0.0
    other_rate = 0.0
    for ahead, u in ((far, rate_p), (far2, rate_p2)):
        for behind, v in ((near, rate_q), (near2, rate_q2)):
            root = _root(gap - keep + (ahead - front) + (beyond - behind), u + v, bend)
            if root < free:
                free = root
                own_rate = u
                other_rate = v
    return free, own_rate, other_rate


@kernel
def _note(event: Array, nx: float, ny: float, p: Placed, q: Placed) -> None:
    """Write where the edges of a contact met: at the corners whose rates it has, or the nearer."""
    event[NX] = nx
    event[NY] = ny
    event[OWN_X], event[OWN_Y] = _corner(nx, ny, p, event[OWN])
    event[OTHERS_X], event[OTHERS_Y] = _corner(-nx, -ny, q, event[OTHERS])


@kernel
def _corner(nx: float, ny: float, body: Placed, rate: float) -> tuple[float, float]:
    edge = body.edge
    first = _rate(nx, ny, body, edge.ax, edge.ay) == rate
    second = _rate(nx, ny, body, edge.bx, edge.by) == rate
    nearer = nx * edge.bx + ny * edge.by < nx * edge.ax + ny * edge.ay
    if second and (nearer or not first):
        return (edge.bx, edge.by)
    return (edge.ax, edge.ay)


@kernel
def touch(
    event: Array,
    a: int,
    edge_a: Edge,
    round_a: float,
    b: int,
    edge_b: Edge,
    round_b: float,
    begin: float,
    moving: Moving,
) -> None:
    """Make `event` (EVENT,) the first contact of an edge of body a with one of body b, if earlier.

    The edges are in the bodies' frames, with a radius [m] around each.
    """
    reach_a = _reach(edge_a)
    reach_b = _reach(edge_b)
    time = begin
    flights = moving.flights
    until = event[TIME]
    for _ in range(MOST_LOOKS):
        p = _placed_at(a, edge_a, time, moving)
        q = _placed_at(b, edge_b, time, moving)
        nx, ny = _between(p.edge, q.edge)
        away = math.sqrt(nx * nx + ny * ny)
        if away <= NOTHING:
            break
        gap = max(away - round_a - round_b, NOTHING)
        nx = nx / away
        ny = ny / away
        bend = p.bend + q.bend + p.turn * p.turn * reach_a + q.turn * q.turn * reach_b
        free, own_rate, other_rate = _free_time(p, q, nx, ny, gap, bend)
        rest = _next_stop(b, time, _next_stop(a, time, until, flights), flights) - time
        if free >= rest:
            if time + rest >= until:
                return
            time += rest
            continue
        # Within half the slack, even the slowest approach is a contact: it would end in an overlap.
        least = 0.5 * gap if gap > 0.5 * SLACK else NOTHING
        if gap <= SLACK and -(own_rate + other_rate) * rest >= least:
            if time < until:
                event[TIME] = time
                event[WITH] = b
                event[OWN] = own_rate
                event[OTHERS] = other_rate
                _note(event, nx, ny, p, q)
            return
        time += free
    if time < until:
        event[TIME] = time
        event[WITH] = b
        event[OWN] = -1.0
        event[OTHERS] = -1.0
        event[NX] = event[NY] = 0.0


@kernel
def hold(
    b: int, nx: float, ny: float, px: float, py: float, time: float, moving: Moving
) -> None:
    """Stop the point (px, py) of a robot from moving against n, from a time on.

    Of all motions that its holds allow, it makes the one closest to its free motion, measured by
    the energy of a ring: it slides without friction, and a held corner deflects it. The speeds
    that the holds give are found by projected Gauss-Seidel sweeps.
    """
    flight = moving.flights[b]
    body = moving.world[b]
    holds = flight[FIRST_HOLD:FLIGHT].reshape(MOST_HOLDS, HOLD)
    count = int(flight[HOLDS])
    inertia = body[RADIUS] * body[RADIUS]
    x, y, c, s = pose_at(b, time, moving)
    if count == 0:
        vx = flight[VX]
        vy = flight[VY]
        flight[WISH_X] = c * vx - s * vy
        flight[WISH_Y] = s * vx + c * vy
        flight[WISH_TURN] = flight[TURN]
    body[HEADING] += flight[TURN] * (time - flight[FROM])
    body[X] = x
    body[Y] = y
    body[COS] = c
    body[SIN] = s
    holds[count, HOLD_X] = nx
    holds[count, HOLD_Y] = ny
    holds[count, PUSH] = 0.0
    holds[count, ARM] = (px - x) * ny - (py - y) * nx
    vx = flight[WISH_X]
    vy = flight[WISH_Y]
    turn = flight[WISH_TURN]
    for i in range(count):
        vx += holds[i, PUSH] * holds[i, HOLD_X]
        vy += holds[i, PUSH] * holds[i, HOLD_Y]
        turn += holds[i, PUSH] * holds[i, ARM] / inertia
    for _ in range(SWEEPS if count else 1):
        for i in range(count + 1):
            ux = holds[i, HOLD_X]
            uy = holds[i, HOLD_Y]
            arm = holds[i, ARM]
            lacks = PARTING - ux * vx - uy * vy - turn * arm
            push = max(holds[i, PUSH] + lacks / (1.0 + arm * arm / inertia), 0.0)
            more = push - holds[i, PUSH]
            holds[i, PUSH] = push
            vx = vx + more * ux
            vy = vy + more * uy
            turn = turn + more * arm / inertia
    flight[VX] = vx
    flight[VY] = vy
    flight[TURN] = turn
    flight[FROM] = time
    flight[HOLDS] += 1.0


@kernel
def _edges(outline: collision.Outline) -> int:
    """Number of edges of an outline: one of a segment, and a circle counts as a single point."""
    return outline.end - outline.begin if outline.end - outline.begin > 2 else 1


@kernel
def _edge_of(v: int, outline: collision.Outline) -> Edge:
    corners = outline.corners
    begin = outline.begin
    end = outline.end
    if begin == end:
        return Edge(0.0, 0.0, 0.0, 0.0)
    i = begin + v
    j = begin + (v + 1 if begin + v + 1 < end else 0)
    return Edge(corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1])


@kernel
def touch_edge(
    event: Array,
    a: int,
    b: int,
    edge_b: Edge,
    round_b: float,
    begin: float,
    moving: Moving,
) -> None:
    """Make `event` (EVENT,) a's first contact from `begin` on with an edge, in b's frame."""
    world = moving.world
    flights = moving.flights
    x, y, _, _ = pose_at(a, begin, moving)
    ox, oy, oc, os = pose_at(b, begin, moving)
    placed = _in_map(edge_b, ox, oy, oc, os)
    spin = abs(flights[b, TURN]) if b >= 0 and begin < flights[b, STOP] else 0.0
    speed = (
        speed_at(a, begin, flights)
        + speed_at(b, begin, flights)
        + spin * _reach(edge_b)
    )
    far = world[a, RADIUS] + round_b + speed * (event[TIME] - begin)
    if speed == 0.0 and (begin >= flights[a, STOP] or flights[a, TURN] == 0.0):
        return
    if (
        collision.segment_distance2(x, y, placed.ax, placed.ay, placed.bx, placed.by)
        > far * far
    ):
        return
    outline = collision.outline_of(world[a], moving.outlines)
    round_a = world[a, RADIUS] if outline.begin == outline.end else 0.0
    for v in range(_edges(outline)):
        edge = _edge_of(v, outline)
        touch(event, a, edge, round_a, b, edge_b, round_b, begin, moving)


@kernel
def touch_body(event: Array, a: int, b: int, begin: float, moving: Moving) -> None:
    """Do the same as `touch_edge` for all of body b."""
    world = moving.world
    flights = moving.flights
    x, y, _, _ = pose_at(a, begin, moving)
    ox, oy, _, _ = pose_at(b, begin, moving)
    speed = speed_at(a, begin, flights) + speed_at(b, begin, flights)
    far = world[a, RADIUS] + world[b, RADIUS] + speed * (event[TIME] - begin)
    if (x - ox) * (x - ox) + (y - oy) * (y - oy) > far * far:
        return
    outline = collision.outline_of(world[b], moving.outlines)
    round_b = world[b, RADIUS] if outline.begin == outline.end else 0.0
    for v in range(_edges(outline)):
        touch_edge(event, a, b, _edge_of(v, outline), round_b, begin, moving)


@kernel
def _solid(distances: Array, i: int, j: int) -> bool:
    inside = 0 <= i < distances.shape[0] and 0 <= j < distances.shape[1]
    return inside and bool(distances[i, j] <= 0.0)


@kernel
def touch_map(
    event: Array, a: int, grid: MapField, begin: float, moving: Moving
) -> None:
    """Do the same as `touch_edge` for the sides of the solid cells of a map."""
    distances = grid.distances
    world = moving.world
    size = grid.cell
    if distances.size == 0:
        return
    speed = speed_at(a, begin, moving.flights)
    if collision.map_bound(world[a], grid) > speed * event[TIME]:
        return
    px, py, _, _ = pose_at(a, begin, moving)
    x, y = collision.in_grid(px, py, grid)
    far = world[a, RADIUS] + speed * (event[TIME] - begin) + SLACK
    low_i, end_i, low_j, end_j = collision.cells_near(x, y, far, grid)
    for i in range(low_i, end_i):
        for j in range(low_j, end_j):
            if distances[i, j] > 0.0:
                continue
            # Each side from a corner (u, v), with the way to the cell beyond: between two solid
            # cells nothing meets it.
            for up, right, u, v in (
                (1, 0, 0, 1),
                (0, 1, 1, 1),
                (-1, 0, 1, 0),
                (0, -1, 0, 0),
            ):
                if not _solid(distances, i + up, j + right):
                    near_x = (j + u) * size
                    near_y = (i + v) * size
                    side = Edge(
                        near_x, near_y, (j + u + up) * size, (i + v - right) * size
                    )
                    edge = _in_map(side, grid.x, grid.y, grid.cos, grid.sin)
                    touch_edge(event, a, -1, edge, 0.0, begin, moving)
