"""Compiled steps of a scan: bodies looked up (Eq. 3), fused by the minimum (Eq. 4).

Instead of taking the nearest row of the table, a look-up blends the two rows around the true
distance, and in each row the two points around a beam. The true silhouette decides which beams hit,
because an edge on the wrong side of a beam is by far the largest error of a plain look-up.
`scan_kernels` takes each step for many bodies at once.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import exact_kernels
from nics_drl_bridge.lidar import exact_kernels as exact

ABOVE_ZERO = (
    2.0**24
)  # added before truncation to an integer, so that numbers are rounded down
PER_TURN = 0.5 / math.pi
UNSEEN, LOOKED_UP, COMPUTED = range(3)
ATAN = tuple(
    map(
        np.float32,
        (
            0.999999881,
            -0.333319604,
            0.199692354,
            -0.140165851,
            0.0990609676,
            -0.0593671016,
            0.0241661891,
            -0.00466877315,
        ),
    )
)
TABLE_SHAPE = np.dtype(
    [  # parameters of a shape in the table
        ("per_metre", np.float64),  # grid distances per metre
        ("rotations", np.float64),  # in a full turn, 0 for a circle
        ("parts_per_rotation", np.float64),  # periods of the rotational symmetry
        ("first_cell", np.int64),
        ("cells_per_part", np.int64),
        ("hull_end", np.int64),  # the corner after its last
        ("corners_per_part", np.int64),
        ("corners", np.int64),
        ("round_radius", np.float64),  # of a circle [m], 0 for others
    ]
)


class TableArrays(NamedTuple):
    """A `table.LidarTable` for the kernels."""

    shapes: Any  # (H,) of `TABLE_SHAPE`
    distances: int  # grid distances of each shape
    # (cells, 4) of each grid distance at each rotation: begin of its row; its first beam, relative
    # to the bearing, and its width; the other and the first corner of the hull that may be its
    # right silhouette; those of the left one. Pairs are 16 bits each
    cells: NDArray[np.int32]
    # (R,) ranges [m], one phase of the points after the other
    rows: NDArray[np.float32]
    shift: int  # log2 of the phases
    hulls: NDArray[np.float64]  # (sum V, 2) corners, see `shapes.Outlines`


class LidarArrays(NamedTuple):
    """A lidar with its table, for the kernels."""

    mount: NDArray[np.float64]  # (3,) pose on the robot
    beams: exact.Beams
    range_min: float  # [m]
    range_max: float
    sweep_time: float  # duration of a sweep [s]
    between: NDArray[np.float64]  # (H, 2) squares of the distances of a look-up [m^2]
    outlines: exact.OutlineArrays  # `outlines`, `table`: of the shapes
    table: TableArrays
    exact: bool  # True if maps are scanned exactly, from cell to cell


@kernel(inline=True)
def sensor_pose(pose, mount):  # type: ignore[no-untyped-def]
    """Return x, y, heading of a lidar in its world, from the pose (3,) of its robot."""
    x = pose[0]
    y = pose[1]
    heading = pose[2]
    if mount[0] != 0.0 or mount[1] != 0.0:
        c = math.cos(heading)
        s = math.sin(heading)
        x = x + c * mount[0] - s * mount[1]
        y = y + s * mount[0] + c * mount[1]
    return x, y, heading + mount[2]


@kernel
def compute(out, here, bodies, me, near, walls, lidar, found):  # type: ignore[no-untyped-def]
    """Fuse walls, and those bodies in `near` that are not looked up."""
    computed = False
    for k in near:
        if k != me and way_of(bodies[k], here.x, here.y, lidar) == COMPUTED:
            body = bodies[k]
            outlines = lidar.outlines
            computed = True
            exact_kernels.body_into(
                out, lidar.beams, here, body, outlines, lidar.range_max
            )
    limits = lidar.range_min, lidar.range_max
    if computed:
        exact_kernels.finish(out, lidar.range_min, lidar.range_max)
    exact_kernels.walls_into(out, lidar.beams, here, walls, limits, found)


@kernel(contracts=True, inline=True)
def way_of(body, x, y, lidar):  # type: ignore[no-untyped-def]
    """How to scan a body: computed if the lidar is in its circle or the table is too coarse."""
    dx = body[exact.X] - x
    dy = body[exact.Y] - y
    radius = body[exact.RADIUS]
    d2 = dx * dx + dy * dy
    reach = lidar.range_max + radius
    if not (radius > 0.0 and d2 <= reach * reach):
        return UNSEEN
    h = np.uintp(np.int32(body[exact.SHAPE]))
    kept = d2 >= radius * radius and lidar.between[h, 0] <= d2 <= lidar.between[h, 1]
    return LOOKED_UP if kept else COMPUTED


@kernel(contracts=True, inline=True)
def polar(dx, dy):  # type: ignore[no-untyped-def]
    """Return the distance [m] and bearing [rad] of a point, in single precision."""
    distance = math.sqrt(np.float32(dx * dx + dy * dy))
    return distance, arctan2_single(np.float32(dy), np.float32(dx))


@kernel(contracts=True, inline=True)
def nearest_cell(distance, bearing, radius, heading, shape, table):  # type: ignore[no-untyped-def]
    """Cell below a distance at the nearest rotation, first hull corner, weight of the next cell."""
    place = (distance - radius) * shape.per_metre
    ring = np.int32(
        max(min(np.int32(place), np.int32(table.distances - 2)), np.int32(0))
    )
    share = (heading - bearing) * PER_TURN
    share -= np.floor(share)
    turn = np.int32(share * shape.rotations + 0.5)
    turn = np.int32(max(min(turn, np.int32(shape.rotations)), np.int32(0)))
    part = np.int32((turn + 0.5) * shape.parts_per_rotation)
    cell = (
        turn * table.distances - part * shape.cells_per_part + shape.first_cell + ring
    )
    return (
        cell,
        shape.hull_end - part * shape.corners_per_part,
        np.float32(place - ring),
    )


class Seen(NamedTuple):
    """A shape as seen from the lidar."""

    d2: float  # square of its distance [m^2]
    cos: float  # of its heading relative to its bearing, times the distance [m]
    sin: float


@kernel(contracts=True, inline=True)
def seen_at(dx, dy, c, s):  # type: ignore[no-untyped-def]
    """Return a shape at (dx, dy) from the lidar, turned by (c, s), as seen from there."""
    return Seen(dx * dx + dy * dy, c * dx + s * dy, s * dx - c * dy)


@kernel(contracts=True, inline=True)
def silhouette(pair, hull, shape, hulls, seen, side):  # type: ignore[no-untyped-def]
    """Direction of the right (side 1) or left (-1) silhouette of a shape from its bearing [rad].

    It is one corner of a pair. A negative index is minus the stride of climbing from the other.
    """
    first = hull + (pair & 0xFFFF)
    other = pair >> 16
    if other < 0:
        along, across = outermost(
            hulls, hull, shape.corners, first - hull, -other, seen, side
        )
        return arctan2_single(np.float32(across), np.float32(along))
    one = hulls[np.uintp(first)]
    two = hulls[np.uintp(hull + other)]
    return tangent(seen, one[0], one[1], two[0], two[1], shape.round_radius, side)


@kernel(contracts=True, inline=True)
def tangent(seen, x1, y1, x2, y2, radius, side):  # type: ignore[no-untyped-def]
    """Direction of a silhouette: the outer of two corners, or the tangent to a circle [rad]."""
    ax, ay = seen_from(seen, x1, y1)
    bx, by = seen_from(seen, x2, y2)
    outer = side * (ax * by - ay * bx) < 0.0
    ax = bx if outer else ax
    ay = by if outer else ay
    along = math.sqrt(max(seen.d2 - radius * radius, 0.0))
    ax = along if radius > 0.0 else ax
    ay = -side * radius if radius > 0.0 else ay
    return arctan2_single(np.float32(ay), np.float32(ax))


@kernel(contracts=True, inline=True)
def seen_from(seen, x, y):  # type: ignore[no-untyped-def]
    """Return a corner (x, y) of a hull along and across the bearing, times the distance."""
    return seen.d2 + seen.cos * x - seen.sin * y, seen.sin * x + seen.cos * y


@kernel(contracts=True, inline=True)
def in_beams(right, left, bearing, heading, beams):  # type: ignore[no-untyped-def]
    """Return a bearing and both silhouettes in beams, the right one in the first turn."""
    per_beam = 1.0 / beams.step
    turn = 2.0 * math.pi * per_beam
    per_turn = 1.0 / turn
    low = right * per_beam
    high = left * per_beam
    middle = (bearing - (heading + beams.first)) * per_beam
    middle -= np.floor((middle + low) * per_turn) * turn
    return middle, middle + low, middle + high


@kernel(contracts=True, inline=True)
def beams_between(middle, low, high, count, shift):  # type: ignore[no-untyped-def]
    """First beam between silhouettes, number of hits; the point before that beam, its weight."""
    begin = np.int32(low)  # conversion is faster than rounding up
    begin = np.int32(max(np.int32(begin + np.int32(low > begin)), np.int32(0)))
    hits = np.int32(min(np.int32(high), np.int32(count - 1)) - begin + 1)
    exact = (begin - middle) * np.int32(1 << shift) + ABOVE_ZERO
    point = np.int32(exact)
    return (
        begin,
        hits,
        np.int32(point - np.int32(ABOVE_ZERO)),
        np.float32(exact - point),
    )


@kernel(inline=True)
def points_of(start, place, point, shift, hits):  # type: ignore[no-untyped-def]
    """Indices of a row's points around the first beam; the second may belong to the next beam."""
    phases = np.int32(1 << shift)
    width = np.int32(place & 0xFFFF)
    beam = point >> shift
    phase = np.int32(point & (phases - 1))
    skip = max(
        min(np.int32(beam - (place >> 16)), np.int32(width - hits - 1)), np.int32(0)
    )
    at = np.int32(start + phase * width + skip)
    last = np.int32(phase + 1) == phases
    return at, np.int32(at - phase * width + 1 if last else at + width)


@kernel(contracts=True, inline=True)
def blended(rows, one, two, other, other2, share, blend, least, most):  # type: ignore[no-untyped-def]
    """Range between two points of a row and two of the farther one [m].

    Beyond `most` it is `inf`, below `least` `-inf` (REP-117).
    """
    value = rows[np.uintp(one)]
    farther = rows[np.uintp(other)]
    value += share * (rows[np.uintp(two)] - value)
    farther += share * (rows[np.uintp(other2)] - farther)
    value += blend * (farther - value)
    value = value if value <= most else np.float32(np.inf)
    return value if value >= least else np.float32(-np.inf)


@kernel(contracts=True)
def outermost(hulls, hull, corners, first, stride, seen, side):  # type: ignore[no-untyped-def]
    """Climb along a hull to a silhouette, see `silhouette`, from the corner `first`.

    Seen from outside, the direction of the corners rises and falls once around the hull, so that a
    local optimum is the global one. Only shapes with many corners need it, at short distances.
    """
    best = first
    x, y = seen_from(
        seen, hulls[np.uintp(hull + best), 0], hulls[np.uintp(hull + best), 1]
    )
    while stride > 0:
        for _ in range(corners):
            moved = False
            for step in (stride, corners - stride):
                other = best + step
                other -= corners if other >= corners else 0
                corner = hulls[np.uintp(hull + other)]
                ax, ay = seen_from(seen, corner[0], corner[1])
                if side * (x * ay - y * ax) < 0.0:
                    best = other
                    x = ax
                    y = ay
                    moved = True
            if not moved:
                break
        stride >>= 1
    return x, y


@kernel(contracts=True, inline=True)
def arctan2_single(y, x):  # type: ignore[no-untyped-def]
    """Like `exact_kernels.arctan2`, in single precision, within 2e-7 rad."""
    ax = abs(x)
    ay = abs(y)
    ratio = min(ax, ay) / max(ax, ay)
    s = ratio * ratio
    r = ATAN[7]
    for k in range(6, -1, -1):
        r = r * s + ATAN[k]
    r *= ratio
    r = np.float32(0.5 * math.pi) - r if ay > ax else r
    r = np.float32(math.pi) - r if x < np.float32(0.0) else r
    return math.copysign(r, y)
