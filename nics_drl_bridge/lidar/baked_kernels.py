"""The look-up of one body in the table, step by step (Eq. 3 and 4).

Eq. 3: a scan depends only on the pose of the body relative to the lidar. The body is at the
distance d and the bearing b from the lidar, and its rotation relative to the line of sight is
phi = heading - b. A beam at the angle a has the range

    r(a) = R(d, phi, a - b),

where R(d, phi, .) is the scan of the shape straight ahead at the distance d, rotated by phi. The
table holds R at grid distances d_i and grid rotations phi_j as rows of points at the angles c_p. A
look-up takes the nearest grid rotation phi_j. It finds i and p with d_i <= d < d_(i+1) and
c_p <= a - b < c_(p+1), where c_p is p fractions of a beam away from the bearing, and blends
linearly over distance and angle:

    r_i(a) = (1 - v) R(d_i, phi_j, c_p) + v R(d_i, phi_j, c_(p+1))    v: weight of the next point
    r(a)   = (1 - w) r_i(a) + w r_(i+1)(a)                            w: weight of the far row

Rotations are not blended. Instead, the exact silhouettes of the body, its outermost directions to
the right and to the left, decide which beams hit: a plain look-up errs most where it puts an edge
on the wrong side of a beam. Beams between the silhouettes have the range r(a), others `inf`.

Eq. 4: a beam's range in the scan is the minimum of r(a) over all bodies.

The steps for one body are, in order:

1. `classify_body`: is it visible, and does the table cover its distance?
2. `find_polar`: d and b.
3. `find_cell`: the cell (i, j) of the table, w, and the start of the shape's hull.
4. `view_shape`, `find_silhouette`: the silhouettes, each from two corners that the cell names.
5. `convert_to_beams`, `find_hits`: the beams that hit, p of the first one, and v.
6. `find_points`: where the points c_p and c_(p+1) are in memory, for each of the two rows.
7. `blend_range`: r(a), for each beam that hits. The caller takes the minimum.

`scan_kernels` takes each step for many bodies at once. Exact kernels scan what is not looked up.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import exact_kernels
from nics_drl_bridge.lidar.arrays import Array, ShortIntegers, Singles
from nics_drl_bridge.lidar.exact_kernels import (
    RADIUS,
    SHAPE,
    Beams,
    LidarPose,
    OutlineArrays,
    X,
    Y,
)

Index = int | np.integer[Any]

TABLE_SHAPE = np.dtype(
    [  # one shape of the table
        ("distances_per_metre", np.float64),  # grid distances
        ("rotations", np.float64),  # grid rotations in a full turn, 0 for a circle
        # A period is the smallest rotation after which the shape looks the same.
        ("periods_per_rotation", np.float64),
        ("first_cell", np.int64),
        ("cells_per_period", np.int64),
        ("second_hull", np.int64),  # first corner of the second copy of its hull
        ("corners_per_period", np.int64),
        ("corners", np.int64),  # of the hull
        ("round_radius", np.float64),  # radius of a circle [m], 0 for other shapes
    ]
)
# Columns of `TableArrays.cells`.
ROW_START, ROW_EXTENT, RIGHT_CORNERS, LEFT_CORNERS = range(4)
# Sides of a shape as seen from the lidar.
RIGHT, LEFT = 1.0, -1.0


class TableArrays(NamedTuple):
    """A `table.LidarTable` for the kernels."""

    shapes: Any  # (H,) of `TABLE_SHAPE`
    distances: int  # grid distances of each shape
    # (cells, 4) of each grid distance at each grid rotation: where its row starts in `rows`; the
    # row's extent, see `unpack_extent`; corners for the right and the left silhouette, see
    # `unpack_corners`
    cells: ShortIntegers
    rows: Singles  # (R,) ranges [m]; in a row all points of one phase, then those of the next
    shift: int  # log2 of the phases, which are the points per beam
    hulls: Array  # (sum V, 2) corners [m], see `shapes.Outlines`; each hull twice


class LidarArrays(NamedTuple):
    """A lidar with its table, for the kernels."""

    mount: Array  # (3,) pose on the robot
    beams: Beams
    range_min: float  # [m]
    range_max: float  # [m]
    sweep_time: float  # duration of a sweep [s]
    # (H, 2) squares of the minimum and maximum distance of a look-up, for each shape [m^2]
    between: Array
    outlines: OutlineArrays  # of the shapes
    table: TableArrays
    exact: bool  # True if maps are scanned exactly, from cell to cell


@kernel(inline=True)
def locate_lidar(robot_pose: Array, mount: Array) -> tuple[LidarPose, float]:
    """Return the pose and the heading [rad] of a lidar in its world, from its robot's pose (3,)."""
    x = robot_pose[0]
    y = robot_pose[1]
    robot_heading = robot_pose[2]
    if mount[0] != 0.0 or mount[1] != 0.0:
        c = math.cos(robot_heading)
        s = math.sin(robot_heading)
        x = x + c * mount[0] - s * mount[1]
        y = y + s * mount[0] + c * mount[1]
    heading = robot_heading + mount[2]
    return LidarPose(x, y, math.cos(heading), math.sin(heading)), heading


@kernel(contracts=True, inline=True)
def classify_body(
    body: Array, lidar_pose: LidarPose, lidar: LidarArrays
) -> tuple[bool, bool]:
    """Return whether a body (7,) is visible, and whether it is looked up (step 1).

    It is visible unless it is absent, out of range, or behind all beams. A visible body that is not
    looked up is scanned exactly: the lidar is within its circle, or the table is too coarse.
    """
    dx = body[X] - lidar_pose.x
    dy = body[Y] - lidar_pose.y
    radius = body[RADIUS]
    distance2 = dx * dx + dy * dy
    reach = lidar.range_max + radius
    ahead = lidar_pose.c * dx + lidar_pose.s * dy
    aside = lidar_pose.c * dy - lidar_pose.s * dx
    behind = lidar.beams.behind
    is_behind = (behind[0, 0] * ahead + behind[0, 1] * aside >= radius) & (
        behind[1, 0] * ahead + behind[1, 1] * aside >= radius
    )
    is_visible = (distance2 <= reach * reach) & (radius > 0.0) & (not is_behind)
    h = np.uintp(np.int32(body[SHAPE]))
    is_in_table = (distance2 >= lidar.between[h, 0]) & (
        distance2 <= lidar.between[h, 1]
    )
    is_looked_up = is_visible & (distance2 >= radius * radius) & is_in_table
    return is_visible, is_looked_up


@kernel(contracts=True, inline=True)
def find_polar(dx: float, dy: float) -> tuple[float, float]:
    """Return the distance [m] and the bearing [rad] of a point, in single precision (step 2)."""
    distance = math.sqrt(np.float32(dx * dx + dy * dy))
    return distance, arctan2_single(np.float32(dy), np.float32(dx))


TURNS_PER_RAD = 0.5 / math.pi


class TableCell(NamedTuple):
    """A place in the table: a grid distance and the nearest grid rotation."""

    # Index in `TableArrays.cells`; the next cell is that of the next grid distance.
    place: int
    hull: int  # index in `TableArrays.hulls` from which the cell's corners are counted
    far_weight: np.float32  # weight of the row of the next grid distance


@kernel(contracts=True, inline=True)
def find_cell(
    distance: float,
    bearing: float,
    radius: float,
    heading: float,
    shape: Any,
    table: TableArrays,
) -> TableCell:
    """Find the cell of the grid distance below and of the nearest grid rotation (step 3).

    Args:
        distance: of the body's origin [m].
        bearing: of the body in the world [rad].
        radius: of the circle around the body [m], the first grid distance.
        heading: of the body in the world [rad].
        shape: its `TABLE_SHAPE`.
        table: the table.
    """
    # i and j number the grid distances and the grid rotations, see the formula above.
    exact_i = (distance - radius) * shape.distances_per_metre
    last_i = np.int32(table.distances - 2)
    i = np.int32(max(min(np.int32(exact_i), last_i), np.int32(0)))
    turns = (heading - bearing) * TURNS_PER_RAD
    turns -= np.floor(turns)
    j = np.int32(turns * shape.rotations + 0.5)
    j = np.int32(max(min(j, np.int32(shape.rotations)), np.int32(0)))
    # Only one period of the rotational symmetry is in the table.
    period = np.int32((j + 0.5) * shape.periods_per_rotation)
    first = shape.first_cell - period * shape.cells_per_period
    return TableCell(
        first + j * table.distances + i,
        shape.second_hull - period * shape.corners_per_period,
        np.float32(exact_i - i),
    )


class ShapeView(NamedTuple):
    """A shape relative to the line of sight, which points from the lidar to its origin."""

    distance2: float  # square of the distance of its origin [m^2]
    cos: float  # cosine of its rotation from the line of sight, times the distance [m]
    sin: float  # sine of that rotation, times the distance [m]


@kernel(contracts=True, inline=True)
def view_shape(dx: float, dy: float, cos: float, sin: float) -> ShapeView:
    """Return the view of a shape at (dx, dy) from the lidar, turned by its heading."""
    return ShapeView(dx * dx + dy * dy, cos * dx + sin * dy, sin * dx - cos * dy)


@kernel(contracts=True, inline=True)
def view_corner(view: ShapeView, x: float, y: float) -> tuple[float, float]:
    """Return a corner (x, y) of a shape along and across the line of sight, times the distance."""
    return view.distance2 + view.cos * x - view.sin * y, view.sin * x + view.cos * y


@kernel(inline=True)
def unpack_corners(packed: int) -> tuple[int, int]:
    """Return two corners of the hull, either of which may be a silhouette anywhere in a cell.

    If there are more than two, the second is negative: minus the first stride of `climb_hull`,
    which starts at the first.
    """
    return packed & 0xFFFF, packed >> 16


@kernel(contracts=True, inline=True)
def find_silhouette(
    view: ShapeView, packed: int, hull: int, hulls: Array, shape: Any, side: float
) -> float:
    """Find the direction of a silhouette from the bearing, by any number of corners (step 4) [rad].

    `packed` are the cell's corners of that side; `hull` is `TableCell.hull`.
    """
    first, second = unpack_corners(packed)
    if second < 0:
        along, across = climb_hull(
            view, first, -second, hull, hulls, shape.corners, side
        )
        direction: float = arctan2_single(np.float32(across), np.float32(along))
        return direction
    corner1 = hulls[np.uintp(hull + first)]
    corner2 = hulls[np.uintp(hull + second)]
    direction = find_tangent(
        view, corner1[0], corner1[1], corner2[0], corner2[1], shape.round_radius, side
    )
    return direction


@kernel(contracts=True, inline=True)
def find_tangent(
    view: ShapeView,
    x1: float,
    y1: float,
    x2: float,
    y2: float,
    round_radius: float,
    side: float,
) -> float:
    """Find the direction of the outer of two corners, or of the tangent to a circle [rad]."""
    along, across = view_corner(view, x1, y1)
    along2, across2 = view_corner(view, x2, y2)
    is_outer = side * (along * across2 - across * along2) < 0.0
    along = along2 if is_outer else along
    across = across2 if is_outer else across
    tangent_length = math.sqrt(max(view.distance2 - round_radius * round_radius, 0.0))
    along = tangent_length if round_radius > 0.0 else along
    across = -side * round_radius if round_radius > 0.0 else across
    direction: float = arctan2_single(np.float32(across), np.float32(along))
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

    Seen from outside, the direction of the corners rises and falls once around the hull, so that a
    local optimum is the global one. Only shapes with many corners need it, at short distances.

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
    start = hulls[np.uintp(hull + best)]
    along, across = view_corner(view, start[0], start[1])
    while stride > 0:
        for _ in range(corners):
            has_moved = False
            for step in (stride, corners - stride):
                candidate = best + step
                candidate -= corners if candidate >= corners else 0
                corner = hulls[np.uintp(hull + candidate)]
                along2, across2 = view_corner(view, corner[0], corner[1])
                if side * (along * across2 - across * along2) < 0.0:
                    best = candidate
                    along = along2
                    across = across2
                    has_moved = True
            if not has_moved:
                break
        stride >>= 1
    return along, across


class BeamSpan(NamedTuple):
    """Directions of a body, as fractional indices of beams."""

    centre: float  # its bearing
    right: float  # its silhouettes; the right one is in the first turn from beam 0 on
    left: float


@kernel(contracts=True, inline=True)
def convert_to_beams(
    bearing: float, right: float, left: float, lidar_heading: float, beams: Beams
) -> BeamSpan:
    """Convert a bearing in the world, and silhouettes from there, to beams (step 5) [rad]."""
    beams_per_rad = 1.0 / beams.step
    full_turn = 2.0 * math.pi * beams_per_rad
    turns_per_beam = 1.0 / full_turn
    to_right = right * beams_per_rad
    to_left = left * beams_per_rad
    centre = (bearing - (lidar_heading + beams.first)) * beams_per_rad
    centre -= np.floor((centre + to_right) * turns_per_beam) * full_turn
    return BeamSpan(centre, centre + to_right, centre + to_left)


class Hits(NamedTuple):
    """Beams that hit a body."""

    first_beam: np.int32
    beams: np.int32  # number of beams; 0 or less if none hits
    # The last point at or before the first beam, counted from the bearing.
    point: np.int32
    next_weight: np.float32  # weight of the point after it


# Added before a number is truncated to an integer, so that negative numbers are rounded down too.
ABOVE_ZERO = 2.0**24


@kernel(contracts=True, inline=True)
def find_hits(span: BeamSpan, beam_count: int, shift: int) -> Hits:
    """Find the beams between the silhouettes, and the table's points around the first (step 5)."""
    first = np.int32(span.right)  # a conversion is faster than rounding up
    first = np.int32(max(np.int32(first + np.int32(span.right > first)), np.int32(0)))
    last = min(np.int32(span.left), np.int32(beam_count - 1))
    beams = np.int32(last - first + 1)
    exact_point = (first - span.centre) * np.int32(1 << shift) + ABOVE_ZERO
    point = np.int32(exact_point)
    next_weight = np.float32(exact_point - point)
    return Hits(first, beams, np.int32(point - np.int32(ABOVE_ZERO)), next_weight)


@kernel(inline=True)
def unpack_extent(packed: int) -> tuple[int, int]:
    """Return the first beam of a row, counted from the bearing, and its width in beams."""
    return packed >> 16, packed & 0xFFFF


@kernel(inline=True)
def find_points(
    row_start: int, row_extent: int, hits: Hits, shift: int
) -> tuple[np.int32, np.int32]:
    """Find a row's points around the first beam that hits, as indices in the rows (step 6).

    Those of the further beams follow one by one. With the last phase of a beam, the next point is
    the first phase of the next beam.
    """
    phases = np.int32(1 << shift)
    row_beam, row_width = unpack_extent(row_extent)
    width = np.int32(row_width)
    beam = hits.point >> shift
    phase = np.int32(hits.point & (phases - 1))
    # The row covers all beams that hit but for rounding: stay within it.
    farthest = np.int32(width - hits.beams - 1)
    skipped = max(min(np.int32(beam - row_beam), farthest), np.int32(0))
    point = np.int32(row_start + phase * width + skipped)
    is_last_phase = np.int32(phase + 1) == phases
    next_point = np.int32(point - phase * width + 1 if is_last_phase else point + width)
    return point, next_point


class RowPoints(NamedTuple):
    """Indices in `TableArrays.rows` of the points around a beam, in the near and the far row."""

    near: Index
    near_next: Index
    far: Index
    far_next: Index


class BlendWeights(NamedTuple):
    """Weights of the blend of four points."""

    next_point: np.float32  # of the next point in each row
    far_row: np.float32


@kernel(contracts=True, inline=True)
def blend_range(
    rows: Singles,
    points: RowPoints,
    offset: Index,
    weights: BlendWeights,
    range_min: np.float32,
    range_max: np.float32,
) -> np.float32:
    """Blend the range of the beam `offset` beams after that of the points (step 7) [m].

    Beyond `range_max` it is `inf`, below `range_min` `-inf` (REP-117).
    """
    near = rows[np.uintp(points.near + offset)]
    far = rows[np.uintp(points.far + offset)]
    near += weights.next_point * (rows[np.uintp(points.near_next + offset)] - near)
    far += weights.next_point * (rows[np.uintp(points.far_next + offset)] - far)
    value = near + weights.far_row * (far - near)
    value = value if value <= range_max else np.float32(np.inf)
    return value if value >= range_min else np.float32(-np.inf)


@kernel
def scan_exactly(
    ranges: Singles,
    lidar_pose: LidarPose,
    bodies: Array,
    nearby: Any,
    own_body: int,
    walls: Array,
    lidar: LidarArrays,
    wall_scratch: Array,
) -> None:
    """Fuse walls, and the visible bodies that are not looked up, into a scan (B,).

    Args:
        ranges: (B,) the scan, which is changed.
        lidar_pose: of the lidar.
        bodies: (K, 7) of the lidar's world.
        nearby: indices of the bodies to consider.
        own_body: index of the robot's own body, which it does not see; -1 for none.
        walls: (W, 4) of the lidar's world.
        lidar: the lidar.
        wall_scratch: memory for `exact_kernels.walls_into`.
    """
    has_bodies = False
    for k in nearby:
        is_visible, is_looked_up = classify_body(bodies[k], lidar_pose, lidar)
        if k != own_body and is_visible and not is_looked_up:
            has_bodies = True
            exact_kernels.body_into(
                ranges,
                lidar.beams,
                lidar_pose,
                bodies[k],
                lidar.outlines,
                lidar.range_max,
            )
    if has_bodies:
        exact_kernels.finish(ranges, lidar.range_min, lidar.range_max)
    limits = lidar.range_min, lidar.range_max
    exact_kernels.walls_into(
        ranges, lidar.beams, lidar_pose, walls, limits, wall_scratch
    )


# Coefficients of r, r^3, r^5... in the arc tangent of r in [0, 1].
ATAN = tuple(
    np.float32(coefficient)
    for coefficient in (
        0.999999881,
        -0.333319604,
        0.199692354,
        -0.140165851,
        0.0990609676,
        -0.0593671016,
        0.0241661891,
        -0.00466877315,
    )
)


@kernel(contracts=True, inline=True)
def arctan2_single(y: np.float32, x: np.float32) -> float:
    """Like `exact_kernels.arctan2`, in single precision, within 2e-7 rad."""
    ax = abs(x)
    ay = abs(y)
    ratio = min(ax, ay) / max(ax, ay)
    square = ratio * ratio
    angle = ATAN[7]
    for k in range(6, -1, -1):
        angle = angle * square + ATAN[k]
    angle *= ratio
    angle = np.float32(0.5 * math.pi) - angle if ay > ax else angle
    angle = np.float32(math.pi) - angle if x < np.float32(0.0) else angle
    return math.copysign(angle, y)
