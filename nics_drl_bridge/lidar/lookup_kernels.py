"""The look-up of a body in the table (Eq. 3), and its fusion into a scan (Eq. 4).

Eq. 3: a scan depends only on the pose of the body relative to the lidar. The body is at the
distance d and the bearing b from the lidar, and its rotation relative to the line of sight is
phi = heading - b. A beam at the angle a has the range

    r(a) = R(d, phi, a - b),

where R(d, phi, .) is the scan of the shape straight ahead at the distance d, rotated by phi. The
table holds R at grid distances d_i, which begin at the radius of the shape, and grid rotations
phi_j as rows of points at the angles c_p, which are p / phases beams away from the bearing. A
look-up takes the nearest grid rotation phi_j, finds i and p with d_i <= d < d_(i+1) and
c_p <= a - b < c_(p+1), and blends linearly over distance and angle:

    r_i(a) = (1 - v) R(d_i, phi_j, c_p) + v R(d_i, phi_j, c_(p+1))    v: weight of the next point
    r(a)   = (1 - w) r_i(a) + w r_(i+1)(a)                            w: weight of the far row

Rotations are not blended. Instead, the exact silhouettes of the body, its outermost
directions to the right and left, decide which beams hit: a plain look-up has its
largest errors where it puts an edge on the wrong side of a beam. Beams between the
silhouettes have the range r(a), others `inf`.

Eq. 4: a beam's range in the scan is the minimum of r(a) over all bodies.

`look_up_body` finds i, j, p, v and w in this order; `fuse_look_ups` blends r(a) for each beam.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, ShortIntegers, Singles, structure_of
from nics_drl_bridge.lidar.beam_kernels import (
    TWO_PI,
    Beams,
    LidarPose,
    arctan2,
    beams_within,
    lower,
    span_beams,
)
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SHAPE, SIN, X, Y


class TableShape:
    """One shape of the table."""

    distances_per_metre: float  # grid distances
    rotations: float  # grid rotations in a full turn, 0 for a circle
    # A period is the smallest rotation after which the shape looks the same.
    periods_per_grid_rotation: float
    first_cell: int
    cells_per_period: int
    second_hull: int  # first corner of the second copy of its hull
    corners_per_period: int
    corners: int  # of the hull
    round_radius: float  # radius of a circle [m], 0 for other shapes


TABLE_SHAPE = structure_of(TableShape)
# Columns of `TableArrays.cells`.
ROW_START, ROW_EXTENT, RIGHT_CORNERS, LEFT_CORNERS = range(4)
# Sides of a shape as seen from the lidar.
RIGHT, LEFT = 1.0, -1.0
# Beams are fused in at least two blocks of this size: a varying number would mispredict
# a branch.
BLOCK = 16
LEAST_FUSED = 2 * BLOCK


class TableArrays(NamedTuple):
    """A `table.LidarTable` for the kernels."""

    shapes: Any  # (H,) of `TABLE_SHAPE`
    distances: int  # grid distances of each shape
    # (cells, 4) of each grid distance at each grid rotation: where its row starts in `rows`; the
    # row's first beam, counted from the bearing, and its width in beams, as two shorts; the corners
    # for the right and the left silhouette, see `find_silhouette`
    cells: ShortIntegers
    # (R,) ranges [m]; in a row all points of one phase, then those of the next. Padded, because
    # whole blocks of beams are fused
    rows: Singles
    shift: int  # log2 of the phases, which are the points per beam
    hulls: Array  # (sum V, 2) corners [m], see `shapes.Outlines`; each hull twice


class LookUp:
    """Beams of a scan that hit one body, and where the table has their ranges."""

    first: int  # the first beam
    hits: np.int32  # number of beams
    # indices in `TableArrays.rows` of the points around the first beam
    near: int
    near_next: int
    far: int
    far_next: int
    next_weight: np.float32  # v
    far_weight: np.float32  # w


LOOK_UP = structure_of(LookUp)


@kernel(contracts=True, inline=True)
def look_up_body(
    body: Array,
    lidar: LidarPose,
    beams: Beams,
    table: TableArrays,
    found: Any,
    count: int,
) -> int:
    """Look up a body (7,), and append what `found` (L,) needs to fuse it: see `LOOK_UP`.

    Returns the new `count` of look-ups. Two more must fit: a body across the seam
    between the last and first beam takes two.
    """
    # d, b, and the location of (d, phi) in the table
    dx = body[X] - lidar.x
    dy = body[Y] - lidar.y
    distance = math.sqrt(dx * dx + dy * dy)
    bearing = arctan2(dy, dx)
    shape = table.shapes[np.uintp(np.int32(body[SHAPE]))]
    # i and j number the grid distances and the grid rotations, see the formula above.
    fractional_i = (distance - body[RADIUS]) * shape.distances_per_metre
    last_i = np.int32(table.distances - 2)
    i = np.int32(max(min(np.int32(fractional_i), last_i), np.int32(0)))
    turns = (body[HEADING] - bearing) * (1.0 / TWO_PI)
    turns -= np.floor(turns)
    j = np.int32(turns * shape.rotations + 0.5)
    j = np.int32(max(min(j, np.int32(shape.rotations)), np.int32(0)))
    # Only one period of the rotational symmetry is in the table: the cell of (i, j) is
    # first_cell + (j - its grid rotations before this period) * distances + i.
    period = np.int32((j + 0.5) * shape.periods_per_grid_rotation)
    place = shape.first_cell - period * shape.cells_per_period
    place += j * table.distances + i
    hull = shape.second_hull - period * shape.corners_per_period
    near = table.cells[np.uintp(place)]
    far = table.cells[np.uintp(place + 1)]
    # The silhouettes, and the beams between them
    view = ShapeView(
        distance * distance,
        body[COS] * dx + body[SIN] * dy,
        body[SIN] * dx - body[COS] * dy,
    )
    hulls = table.hulls
    right = find_silhouette(view, near[RIGHT_CORNERS], hull, hulls, shape, RIGHT)
    left = find_silhouette(view, near[LEFT_CORNERS], hull, hulls, shape, LEFT)
    span = span_beams(bearing - lidar.heading + right, left - right, beams)
    bearing_beam = span.right - right / beams.step
    # c_p and c_(p+1) of the first beam, in both rows
    beam_count = beams.directions.shape[1]
    turned_by = 0.0
    for _ in range(2):
        first, end = beams_within(span, turned_by, beam_count)
        hits = np.int32(end - first)
        fractional_point = (first + turned_by - bearing_beam) * (1 << table.shift)
        point = np.floor(fractional_point)
        part = found[np.uintp(count)]
        part.first = first
        part.hits = hits
        part.near, part.near_next = find_points(near, np.int64(point), hits, table)
        part.far, part.far_next = find_points(far, np.int64(point), hits, table)
        part.next_weight = np.float32(fractional_point - point)
        part.far_weight = np.float32(fractional_i - i)
        count += int(hits > 0)
        turned_by = span.full_turn
        if span.left < turned_by:
            break
    return count


@kernel(contracts=True)
def fuse_look_ups(scan: ShortIntegers, rows: Singles, found: Any) -> None:
    """Lower the beams of a scan (B + LEAST_FUSED,) to the look-ups (L,): r(a), and Eq. 4.

    Whole blocks of beams are fused, also beyond the last beam.
    """
    for m in range(len(found)):
        part = found[m]
        first = np.uintp(part.first)
        near = np.uintp(part.near)
        near_next = np.uintp(part.near_next)
        far = np.uintp(part.far)
        far_next = np.uintp(part.far_next)
        hits = part.hits
        next_weight = part.next_weight
        far_weight = part.far_weight
        for k in range(max((hits + BLOCK - 1) & -BLOCK, LEAST_FUSED)):
            j = np.uintp(k)
            near_range = rows[near + j]
            far_range = rows[far + j]
            near_range += next_weight * (rows[near_next + j] - near_range)
            far_range += next_weight * (rows[far_next + j] - far_range)
            distance = near_range + far_weight * (far_range - near_range)
            is_hit = np.int32(k) < hits
            lower(scan, first + j, distance if is_hit else np.float32(np.inf))


class ShapeView(NamedTuple):
    """A shape relative to the line of sight, which points from the lidar to its origin."""

    distance2: float  # square of the distance of its origin [m^2]
    cos: float  # cosine of its rotation from the line of sight, times the distance [m]
    sin: float  # sine of that rotation, times the distance [m]


@kernel(contracts=True, inline=True)
def view_corner(view: ShapeView, corner: Array) -> tuple[float, float]:
    """Return a corner (2,) of a shape along and across the line of sight, times the distance."""
    x = corner[0]
    y = corner[1]
    return view.distance2 + view.cos * x - view.sin * y, view.sin * x + view.cos * y


@kernel(contracts=True, inline=True)
def find_silhouette(
    view: ShapeView, packed: int, hull: int, hulls: Array, shape: Any, side: float
) -> float:
    """Find the direction of a silhouette from the bearing [rad].

    Args:
        view: of the shape.
        packed: two corners of the hull, as shorts; one of them is the silhouette. If a
            cell has more than two candidates, the second number is minus the first
            stride of `climb_hull`, which starts at the first corner.
        hull: index in `hulls` from which its corners are counted.
        hulls: see `TableArrays.hulls`.
        shape: its `TABLE_SHAPE`.
        side: `RIGHT` or `LEFT`.
    """
    first = packed & 0xFFFF
    second = packed >> 16
    if shape.round_radius > 0.0:
        tangent2 = view.distance2 - shape.round_radius * shape.round_radius
        along = math.sqrt(max(tangent2, 0.0))
        across = -side * shape.round_radius
    elif second < 0:
        along, across = climb_hull(
            view, first, -second, hull, hulls, shape.corners, side
        )
    else:
        along, across = view_corner(view, hulls[np.uintp(hull + first)])
        along2, across2 = view_corner(view, hulls[np.uintp(hull + second)])
        is_outer = side * (along * across2 - across * along2) < 0.0
        along = along2 if is_outer else along
        across = across2 if is_outer else across
    direction: float = arctan2(across, along)
    return direction


@kernel(contracts=True)
def climb_hull(
    view: ShapeView,
    first: int,
    stride: int,
    hull: int,
    hulls: Array,
    corners: int,
    side: float,
) -> tuple[float, float]:
    """Climb from corner to corner to a silhouette; return that corner, see `view_corner`.

    Seen from outside, the direction of the corners rises and falls once around the
    hull, so a local optimum is the global one. Only shapes with many corners need this,
    at short distances.

    Args:
        view: of the shape.
        first: the corner to start from.
        stride: corners in the first steps; it is halved until it is 0.
        hull: index of the hull's corner 0 in `hulls`.
        hulls: (sum V, 2) corners of all hulls [m].
        corners: number of corners of the hull.
        side: `RIGHT` or `LEFT`.
    """
    best = first
    along, across = view_corner(view, hulls[np.uintp(hull + best)])
    while stride > 0:
        for _ in range(corners):
            has_moved = False
            for step in (stride, corners - stride):
                candidate = best + step
                candidate -= corners if candidate >= corners else 0
                along2, across2 = view_corner(view, hulls[np.uintp(hull + candidate)])
                if side * (along * across2 - across * along2) < 0.0:
                    best = candidate
                    along = along2
                    across = across2
                    has_moved = True
            if not has_moved:
                break
        stride >>= 1
    return along, across


@kernel(inline=True)
def find_points(
    cell: ShortIntegers, point: int, hits: int, table: TableArrays
) -> tuple[int, int]:
    """Find where a point of a row is in `TableArrays.rows`, and the next one.

    Those of the next beams follow one by one. After the last phase of a beam, the next
    point is the first phase of the next beam.
    """
    phases = 1 << table.shift
    row_beam = cell[ROW_EXTENT] >> 16
    width = cell[ROW_EXTENT] & 0xFFFF
    beam = point >> table.shift
    phase = point & (phases - 1)
    # The row covers all beams that hit but for rounding: stay within it.
    skipped = max(min(beam - row_beam, width - hits - 1), 0)
    place = cell[ROW_START] + phase * width + skipped
    is_last_phase = phase + 1 == phases
    next_place = place - phase * width + 1 if is_last_phase else place + width
    return place, next_place
