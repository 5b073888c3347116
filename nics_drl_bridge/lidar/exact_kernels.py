"""Compiled exact scanner: the ranges of one object in one scan.

Each function lowers the ranges of the beams that hit its object in a scan `out` (B,), float32 [m];
applied one after the other, they compute the minimum of Eq. 4. Positions are in the lidar's frame.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, Integers, ShortIntegers, Singles

TWO_PI = 2.0 * math.pi
# beams this near to an edge, in beams, are candidates; the exact test decides
ROUNDING = 1e-6
IN_LINE = 1e-9  # a wall whose line passes a lidar nearer than this is seen edge-on [m]
HALF_PI = 0.5 * math.pi
TINY = 1e-300  # avoids NaN for the angle of a zero vector
ATAN = (
    0.9999999996145,
    -0.3333332366563,
    0.1999959585417,
    -0.1427904841688,
    0.1105378475317,
    -0.0879611755717,
    0.0671011398839,
    -0.0442736682632,
    0.0222034549106,
    -0.0071661648959,
    0.0010844927512,
)
X, Y, HEADING, COS, SIN, RADIUS, SHAPE = range(7)
"""Columns of a placed body; an absent body has radius 0, and `SHAPE` is an index."""
INF, MINUS_INF = np.array([np.inf, -np.inf], np.float32).view(np.int32)
# beams intersected with a wall at once; with MANY, a multiple of UNIT
BLOCK = 48
UNIT = 16
MANY = 1000
TOGETHER = 8  # walls whose beams are found at once
AX, AY, BX, BY, CROSS, EX, EY, FIRST, END, FIRST_AGAIN, END_AGAIN = (
    np.uintp(k * TOGETHER) for k in range(11)
)
"""Of a wall: its ends; what `edge` calls so; its beams, and those of a turn further."""


class Beams(NamedTuple):
    """Directions of the beams in the frame of the lidar."""

    directions: Array  # (2, B) cosines and sines, in rows that vectorise
    first: float  # angle of beam 0 [rad]
    step: float  # between beams [rad]
    closed: bool  # True for a full circle
    # (4 Q,) cosines, sines of turns by up to Q beams either way
    turns: Singles
    # (2, 2) unit vectors: what lies farther along both than its radius is behind all beams
    behind: Array


class LidarPose(NamedTuple):
    """Pose of a lidar in its world: position [m], cosine and sine of its heading."""

    x: float
    y: float
    c: float
    s: float


class OutlineArrays(NamedTuple):
    """Outlines of all shapes, see `shapes.Outlines`."""

    corners: Array  # (sum V, 2) of all outlines [m]
    first: Integers  # (H + 1,) first corner of each outline; a circle has none


@kernel(allocates=True)
def beams_of(directions: Array, first: float, step: float, closed: bool) -> Beams:
    """Return the beams of directions (2, B) that are a `step` apart, from `first` on [rad]."""
    most = max(min(int(HALF_PI / step), directions.shape[1]), 1) + BLOCK
    angles = step * np.arange(-most, most)
    turns = np.concatenate((np.cos(angles), np.sin(angles))).astype(np.float32)
    count = directions.shape[1]
    # Half of the angle without beams, less half a step so that rounding does not matter.
    blind = min(max(math.pi - 0.5 * step * count, 0.0), HALF_PI)
    back = first + 0.5 * step * (count - 1) + math.pi
    sides = np.array([back + blind - HALF_PI, back - blind + HALF_PI])
    behind = np.stack((np.cos(sides), np.sin(sides)), axis=1)
    return Beams(directions, first, step, closed, turns, behind)


@kernel(inline=True)
def arctan2(y: float, x: float) -> float:
    """Angle of (x, y) within 3e-10 rad, branchless: a polynomial fitted at Chebyshev nodes."""
    ax = abs(x)
    ay = abs(y)
    ratio = min(ax, ay) / (max(ax, ay) + TINY)
    s = ratio * ratio
    r = ATAN[10]
    for k in range(9, -1, -1):
        r = r * s + ATAN[k]
    r *= ratio
    r = HALF_PI - r if ay > ax else r
    r = math.pi - r if x < 0.0 else r
    return math.copysign(r, y)


@kernel
def beam_span(low: float, high: float, beams: Beams) -> tuple[int, int]:
    """First beam and number of beams in [low, high]; in a full circle modulo the count."""
    count = beams.directions.shape[1]
    first = math.ceil((low - beams.first) / beams.step - ROUNDING)
    last = math.floor((high - beams.first) / beams.step + ROUNDING)
    if beams.closed:
        return first % count, min(last - first + 1, count)
    first = max(first, 0)
    last = min(last, count - 1)
    return first, max(last - first + 1, 0)


@kernel
def circle(
    out: Singles,
    beams: Beams,
    x: float,
    y: float,
    radius: float,
    range_max: float,
) -> None:
    """Fuse the exact ranges to a circle at (x, y)."""
    d2 = x * x + y * y
    r2 = radius * radius
    d = math.sqrt(d2)
    if d - radius > range_max or radius <= 0.0:
        return
    count = out.shape[0]
    if d2 <= r2:  # the lidar is inside: every beam hits the far side
        for i in range(count):
            c = beams.directions[0, i]
            s = beams.directions[1, i]
            across = c * y - s * x
            out[i] = min(
                out[i], c * x + s * y + math.sqrt(max(r2 - across * across, 0.0))
            )
        return
    bearing = math.atan2(y, x)
    half = math.asin(radius / d)
    turns = 1 if beams.closed else 3
    for turn in range(turns):
        shift = 0.0 if turns == 1 else (turn - 1) * TWO_PI
        first, hits = beam_span(bearing - half + shift, bearing + half + shift, beams)
        for k in range(hits):
            i = first + k
            if i >= count:
                i -= count
            c = beams.directions[0, i]
            s = beams.directions[1, i]
            across = c * y - s * x
            rest = r2 - across * across
            if rest >= 0.0:
                out[i] = min(out[i], c * x + s * y - math.sqrt(rest))


@kernel(inline=True)
def edge(
    out: Singles,
    beams: Beams,
    x1: float,
    y1: float,
    angle1: float,
    x2: float,
    y2: float,
    angle2: float,
    one_sided: bool,
) -> None:
    """Fuse the exact ranges to the straight wall from (x1, y1) to (x2, y2).

    The angles are the directions of its ends [rad]; `one_sided`: visible from its right.
    """
    count = out.shape[0]
    ex = x2 - x1
    ey = y2 - y1
    cross = x1 * ey - y1 * ex
    if cross == 0.0 or (one_sided and cross > 0.0):  # seen edge-on, or from behind
        return
    if cross > 0.0:
        low = angle1
        high = angle2
    else:
        low = angle2
        high = angle1
    if high < low:
        high += TWO_PI
    turns = 1 if beams.closed else 3
    for turn in range(turns):
        shift = 0.0 if turns == 1 else (turn - 1) * TWO_PI
        first, hits = beam_span(low + shift, high + shift, beams)
        if hits > 0:
            _cross(
                out, beams.directions, first, min(first + hits, count), cross, ex, ey
            )
            _cross(out, beams.directions, 0, first + hits - count, cross, ex, ey)


@kernel(contracts=True, inline=True)
def _cross(
    out: Singles,
    directions: Array,
    begin: int,
    end: int,
    cross: float | np.float32,
    ex: float,
    ey: float,
) -> None:
    cross = np.float32(cross)  # a division in single precision takes half the time
    # Ranges are fused as whole numbers, in the same order: of floats LLVM masks the store.
    whole = out.view(np.int32)
    for k in range(end - begin):
        i = np.uintp(begin + k)
        distance = cross / np.float32(directions[0, i] * ey - directions[1, i] * ex)
        distance = distance if distance >= np.float32(0.0) else np.float32(np.inf)
        whole[i] = min(whole[i], np.float32(distance).view(np.int32))


@kernel
def polygon(
    out: Singles,
    beams: Beams,
    x: float,
    y: float,
    c: float,
    s: float,
    corners: Array,
) -> None:
    """Fuse the exact ranges to the outline `corners` (V, 2), turned by (c, s), at (x, y)."""
    last = corners.shape[0] - 1
    cull = beside_convex(x, y, c, s, corners)
    ax, ay = turned(x, y, c, s, corners[last])
    angle = arctan2(ay, ax)
    for v in range(last + 1):
        bx, by = turned(x, y, c, s, corners[v])
        next_angle = arctan2(by, bx)
        edge(out, beams, ax, ay, angle, bx, by, next_angle, cull)
        ax = bx
        ay = by
        angle = next_angle


@kernel
def beside_convex(x: float, y: float, c: float, s: float, corners: Array) -> bool:
    """True if an outline is convex, the lidar outside: rays first meet sides from their right."""
    last = corners.shape[0] - 1
    rounds = 0
    bx, by = turned(x, y, c, s, corners[max(last - 1, 0)])
    ax, ay = turned(x, y, c, s, corners[last])
    ex = ax - bx
    ey = ay - by
    for v in range(last + 1):
        bx, by = turned(x, y, c, s, corners[v])
        gx = bx - ax
        gy = by - ay
        cross = ax * by - ay * bx
        # the lidar may lie on a side towards it
        if ex * gy - ey * gx < 0.0 or cross == 0.0:
            return False
        if (ay <= 0.0) != (by <= 0.0):  # it crosses the ray ahead, or the one behind
            rounds += int(ay <= 0.0 and cross > 0.0) - int(ay > 0.0 and cross < 0.0)
        ax = bx
        ay = by
        ex = gx
        ey = gy
    return rounds == 0


@kernel(inline=True)
def turned(
    x: float, y: float, c: float, s: float, corner: Array
) -> tuple[float, float]:
    """Position of a corner (2,) of a shape turned by (c, s) and placed at (x, y)."""
    return x + c * corner[0] - s * corner[1], y + s * corner[0] + c * corner[1]


@kernel
def finish(out: Singles, range_min: float, range_max: float) -> None:
    """Apply the limits to a scan (B,): too far becomes `inf`, too close `-inf` (REP-117)."""
    low = np.float32(range_min)
    high = np.float32(range_max)
    for i in range(out.shape[0]):
        value = out[i]
        value = value if value <= high else np.float32(np.inf)
        out[i] = value if value >= low else np.float32(-np.inf)


@kernel
def walls_into(
    out: Singles,
    beams: Beams,
    lidar: LidarPose,
    walls: Array,
    limits: tuple[float, float],
    scratch: Array,
) -> None:
    """Fuse walls (W, 4) into a scan from a `LidarPose`, as `finish` would leave them.

    Limits are range_min and range_max [m]; `scratch` (11 TOGETHER,) is memory.
    """
    whole = out.view(np.int32)
    for begin in range(0, walls.shape[0], TOGETHER):
        _find_walls(scratch, beams, lidar, walls, begin, limits[1], out.shape[0])
        for j in range(min(TOGETHER, walls.shape[0] - begin)):
            w = np.uintp(j)
            for first, end in ((FIRST, END), (FIRST_AGAIN, END_AGAIN)):
                if scratch[w + first] < scratch[w + end]:
                    line = scratch[w + CROSS], scratch[w + EX], scratch[w + EY]
                    _wall(
                        whole,
                        beams,
                        int(scratch[w + first]),
                        int(scratch[w + end]),
                        line,
                        limits,
                    )


@kernel(inline=True)
def _find_walls(
    scratch: Array,
    beams: Beams,
    lidar: LidarPose,
    walls: Array,
    begin: int,
    range_max: float,
    count: int,
) -> None:
    """Find the beams that meet some walls in range, none for the others; without branches."""
    c = lidar.c
    s = lidar.s
    per_beam = 1.0 / beams.step
    turn = TWO_PI * per_beam
    per_turn = beams.step / TWO_PI
    for j in range(min(TOGETHER, walls.shape[0] - begin)):
        for i in range(4):
            scratch[np.uintp(j + i * TOGETHER)] = walls[begin + j, i]
    for j in range(TOGETHER):  # unused ones contain old values
        k = np.uintp(j)
        ax = scratch[k + AX] - lidar.x
        ay = scratch[k + AY] - lidar.y
        bx = scratch[k + BX] - lidar.x
        by = scratch[k + BY] - lidar.y
        ax, ay = c * ax + s * ay, c * ay - s * ax
        bx, by = c * bx + s * by, c * by - s * bx
        ex = bx - ax
        ey = by - ay
        length2 = ex * ex + ey * ey
        cross = ax * ey - ay * ex
        chord2 = range_max * range_max * length2 - cross * cross
        share = 1.0 / length2
        # As fractions of its length: the wall is nearest at `foot`, and in range within +-`half`.
        foot = -(ax * ex + ay * ey) * share
        half = math.sqrt(max(chord2, 0.0)) * share
        begins = max(foot - half - ROUNDING, 0.0)
        ends = min(foot + half + ROUNDING, 1.0)
        seen = (
            (chord2 >= 0.0)
            & (begins <= ends)
            & (cross * cross > IN_LINE * IN_LINE * length2)
        )
        angle_a = arctan2(ay + begins * ey, ax + begins * ex)
        angle_b = arctan2(ay + ends * ey, ax + ends * ex)
        low = angle_a if cross > 0.0 else angle_b
        wide = angle_b - angle_a if cross > 0.0 else angle_a - angle_b
        # a whole turn, or rounding
        wide = wide + TWO_PI if wide < -1.0 else max(wide, 0.0)
        low = (low - beams.first) * per_beam
        low -= np.floor(low * per_turn) * turn
        high = low + wide * per_beam
        scratch[k + CROSS] = cross
        scratch[k + EX] = ex
        scratch[k + EY] = ey
        scratch[k + FIRST] = np.ceil(low - ROUNDING)
        scratch[k + END] = min(np.floor(high + ROUNDING) + 1.0, count) if seen else 0.0
        scratch[k + FIRST_AGAIN] = max(np.ceil(low - turn - ROUNDING), 0.0)
        scratch[k + END_AGAIN] = (
            min(np.floor(high - turn + ROUNDING) + 1.0, count) if seen else 0.0
        )


@kernel(inline=True)
def _wall(
    whole: ShortIntegers,
    beams: Beams,
    first: int,
    end: int,
    line: tuple[float, float, float],
    limits: tuple[float, float],
) -> None:
    count = whole.shape[0]
    few = BLOCK <= whole.shape[0] < MANY
    # a quarter turn at a time
    most = beams.turns.shape[0] // 4 - BLOCK
    if few:
        most = min(most, BLOCK)
    else:
        most = min(most, count)
    for begin in range(first, end, most):
        until = min(begin + most, end)
        width = min((until - begin + UNIT - 1) // UNIT * UNIT, count)
        if few:
            _wall_piece(
                whole,
                beams,
                min(begin, count - BLOCK),
                BLOCK,
                begin,
                until,
                line,
                limits,
            )
        else:
            _wall_piece(
                whole,
                beams,
                min(begin, count - width),
                width,
                begin,
                until,
                line,
                limits,
            )


@kernel(contracts=True, inline=True)
def _wall_piece(
    whole: ShortIntegers,
    beams: Beams,
    place: int,
    width: int,
    begin: int,
    end: int,
    line: tuple[float, float, float],
    limits: tuple[float, float],
) -> None:
    """Fuse a wall into the beams in [begin, end), of the `width` beams from a place on.

    Directions are rotated in single precision from the first beam, or from the last if the angle of
    incidence grows: up to a quarter turn, nothing cancels out. Ranges are compared as integers,
    which have the same order as floats; negative ones, as unsigned integers, exceed the limit.
    """
    cross = np.float32(line[0])
    ex = line[1]
    ey = line[2]
    least = np.float32(limits[0]).view(np.int32)
    most = np.float32(limits[1]).view(np.uint32)
    skip = np.int32(place - begin)
    hits = np.uint32(end - begin)
    sines = beams.turns.shape[0] // 2
    start = np.uintp(begin)
    c = beams.directions[0, start]
    s = beams.directions[1, start]
    if (s * ey + c * ex) * line[0] > 0.0:  # the angle of incidence grows
        start = np.uintp(end - 1)
        c = beams.directions[0, start]
        s = beams.directions[1, start]
    across = np.float32(c * ey - s * ex)
    along = np.float32(s * ey + c * ex)
    at = np.uintp(place)
    turn = np.uintp(sines // 2 + place) - start
    for k in range(width):
        j = np.uintp(k)
        cosine = beams.turns[turn + j]
        sine = beams.turns[turn + j + np.uintp(sines)]
        distance = cross / (across * cosine - along * sine)
        bits = np.float32(distance).view(np.int32)
        meets = (np.uint32(skip) < hits) & (np.uint32(bits) <= most)
        skip = np.int32(skip + np.int32(1))  # of 32 bits, as the ranges
        bits = bits if meets else INF
        whole[at + j] = min(whole[at + j], bits if bits >= least else MINUS_INF)


@kernel
def body_into(
    out: Singles,
    beams: Beams,
    lidar: LidarPose,
    body: Array,
    outlines: OutlineArrays,
    range_max: float,
) -> None:
    """Fuse one body (7,) into a scan from a `LidarPose`."""
    c = lidar.c
    s = lidar.s
    dx = body[X] - lidar.x
    dy = body[Y] - lidar.y
    x = c * dx + s * dy
    y = c * dy - s * dx
    shape = int(body[SHAPE])
    begin = outlines.first[shape]
    end = outlines.first[shape + 1]
    if begin == end:
        circle(out, beams, x, y, body[RADIUS], range_max)
    else:
        cos = body[COS] * c + body[SIN] * s
        sin = body[SIN] * c - body[COS] * s
        polygon(out, beams, x, y, cos, sin, outlines.corners[begin:end])
