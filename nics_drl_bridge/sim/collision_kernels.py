"""Compiled collision tests: clearances and touches of bodies, straight walls and a map.

A `Solid` is a placed outline. The clearance of two solids is the distance between their outlines,
at most `limit` [m]. It is negative if they overlap: the distance of the first one's
origin from the other, minus the radius of the circle around the first one. Nearest
points closer than `skin` [m] are listed as touches. Shared arguments: a body (7,) has
the columns of `state`, a wall (4,) has two ends; the distances of a map are 0 in solid
cells; `listed` is scratch memory, to which touches are appended.

Bodies may be sorted into square cells, so that those around a point are found without
testing all. A body is in the cell of its centre. A body that moves or is larger than a
cell is in no cell and is always found. The outermost cells extend to infinity.
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
from nics_drl_bridge.sim.state import Array, BodyCells, MapField, Touches

LEFT, BOTTOM, PER_METRE, SIDE, LARGEST, MOVED, FRAME = range(7)
"""Columns of `BodyCells.frame`: x, y of the first cell [m], cells per metre, cells in a row,
maximum radius of the bodies in cells [m], maximum distance moved since then [m]."""
PER_BODY = 1.0  # Cells

OVERLAP = 1e-12  # minimum overlap [m]
FLOAT32 = 1e-6  # Relative rounding error of the distances of a map
CORNERS_OF_WALL = 2


class Outline(NamedTuple):
    """One outline: the corners from `begin` to before `end`, none for a circle."""

    corners: Array
    begin: int
    end: int


class Solid(NamedTuple):
    """A placed outline."""

    body: int  # number of the body; -1 for a wall or a cell of the map
    outline: Outline  # in its own frame
    x: float  # origin of that frame [m]
    y: float
    cos: float  # of its heading
    sin: float
    radius: float  # of a circle, else 0 [m]
    reach: float  # radius of the circle around the origin that encloses it [m]


class Edge(NamedTuple):
    """A straight line between two points [m]; for a circle, both are the centre."""

    ax: float
    ay: float
    bx: float
    by: float


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
def solid_of(k: int, body: Array, outlines: OutlineArrays) -> Solid:
    """Return body number k as a solid."""
    outline = outline_of(body, outlines)
    radius = body[RADIUS] if is_round(body, outlines) else 0.0
    return Solid(
        k, outline, body[X], body[Y], body[COS], body[SIN], radius, body[RADIUS]
    )


@kernel
def from_edge(x: float, y: float, edge: Edge) -> tuple[float, float]:
    """Return the vector to (x, y) from the nearest point of an edge."""
    ex = edge.bx - edge.ax
    ey = edge.by - edge.ay
    dx = x - edge.ax
    dy = y - edge.ay
    along = dx * ex + dy * ey
    if along > 0.0:
        share = min(along / (ex * ex + ey * ey), 1.0)
        return dx - share * ex, dy - share * ey
    return dx, dy


@kernel
def edge_distance2(x: float, y: float, edge: Edge) -> float:
    """Square of the distance from (x, y) to an edge [m^2]."""
    dx, dy = from_edge(x, y, edge)
    return dx * dx + dy * dy


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
    if end - begin == CORNERS_OF_WALL:
        bx = corners[begin, 0]
        by = corners[begin, 1]
        return math.sqrt(edge_distance2(x, y, Edge(bx, by, ax, ay)))
    for v in range(begin, end):
        bx = corners[v, 0]
        by = corners[v, 1]
        least = min(least, edge_distance2(x, y, Edge(ax, ay, bx, by)))
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
        ax = bx
        ay = by
    return -math.sqrt(least) if inside else math.sqrt(least)


@kernel
def _count_edges(outline: Outline) -> int:
    """Number of edges; a circle counts as one edge without length."""
    corners = outline.end - outline.begin
    return corners if corners > CORNERS_OF_WALL else 1


@kernel
def _get_edge(v: int, outline: Outline) -> Edge:
    corners = outline.corners
    if outline.begin == outline.end:
        return Edge(0.0, 0.0, 0.0, 0.0)
    i = outline.begin + v
    j = i + 1 if i + 1 < outline.end else outline.begin
    return Edge(corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1])


@kernel
def _place_edge(edge: Edge, x: float, y: float, c: float, s: float) -> Edge:
    return Edge(
        x + c * edge.ax - s * edge.ay,
        y + s * edge.ax + c * edge.ay,
        x + c * edge.bx - s * edge.by,
        y + s * edge.bx + c * edge.by,
    )


@kernel
def _side(edge: Edge, x: float, y: float) -> float:
    """Positive left of the line through an edge, negative right of it."""
    across = (edge.bx - edge.ax) * (y - edge.ay)
    return across - (edge.by - edge.ay) * (x - edge.ax)


@kernel
def _find_nearest(p: Edge, q: Edge) -> tuple[float, float, float, float]:
    """Return the vector from the nearest point of q to that of p, and the nearest point of p."""
    nx, ny = from_edge(p.ax, p.ay, q)
    x = p.ax
    y = p.ay
    if p.ax == p.bx and p.ay == p.by:
        return nx, ny, x, y
    p_crosses = (_side(q, p.ax, p.ay) > 0.0) != (_side(q, p.bx, p.by) > 0.0)
    q_crosses = (_side(p, q.ax, q.ay) > 0.0) != (_side(p, q.bx, q.by) > 0.0)
    if p_crosses and q_crosses:
        return 0.0, 0.0, x, y
    ox, oy = from_edge(p.bx, p.by, q)
    if ox * ox + oy * oy < nx * nx + ny * ny:
        nx = ox
        ny = oy
        x = p.bx
        y = p.by
    for cx, cy in ((q.ax, q.ay), (q.bx, q.by)):
        ox, oy = from_edge(cx, cy, p)
        if ox * ox + oy * oy < nx * nx + ny * ny:
            nx = -ox
            ny = -oy
            x = cx - ox
            y = cy - oy
    return nx, ny, x, y


@kernel
def _measure_origin(x: float, y: float, solid: Solid) -> float:
    """Signed distance from a solid of a point in the solid's frame [m]."""
    if solid.radius > 0.0:
        return math.sqrt(x * x + y * y) - solid.radius
    return outline_point(x, y, solid.outline)


@kernel
def find_gap(
    one: Solid,
    other: Solid,
    limit: float,
    skin: float,
    listed: Touches,
) -> float:
    """Clearance of a solid from another one, up to `limit`, see the module."""
    limit = max(limit, 0.0)
    dx = one.x - other.x
    dy = one.y - other.y
    far = one.reach + other.reach + max(limit, skin)
    if dx * dx + dy * dy > far * far:
        return limit
    x = other.cos * dx + other.sin * dy
    y = other.cos * dy - other.sin * dx
    c = one.cos * other.cos + one.sin * other.sin
    s = one.sin * other.cos - one.cos * other.sin
    least = max(limit, OVERLAP)
    may_contain = _count_edges(other.outline) > 1
    earlier = listed.number[0]
    for v in range(_count_edges(other.outline)):
        q = _get_edge(v, other.outline)
        far = one.reach + other.radius + max(least, skin)
        if edge_distance2(x, y, q) > far * far:
            continue
        may_contain = True
        for w in range(_count_edges(one.outline)):
            p = _place_edge(_get_edge(w, one.outline), x, y, c, s)
            nx, ny, px, py = _find_nearest(p, q)
            away = math.sqrt(nx * nx + ny * ny)
            gap = away - one.radius - other.radius
            least = min(least, gap)
            count = listed.number[0]
            if OVERLAP < gap < skin and count < len(listed.touches):
                touch = listed.touches[count]
                touch.other = other.body
                touch.nx = (other.cos * nx - other.sin * ny) / away
                touch.ny = (other.sin * nx + other.cos * ny) / away
                touch.x = other.x + other.cos * px - other.sin * py
                touch.y = other.y + other.sin * px + other.cos * py
                touch.gap = gap
                listed.number[0] = count + 1
    overlaps = least < OVERLAP or (may_contain and _contain(one, other, x, y, c, s))
    if not overlaps:
        return min(least, limit)
    listed.number[0] = earlier
    return min(_measure_origin(x, y, other) - one.reach, -OVERLAP)


@kernel
def _contain(one: Solid, other: Solid, x: float, y: float, c: float, s: float) -> bool:
    """True if one of two solids whose outlines do not meet is inside the other.

    The first one is at (x, y) in the other's frame, rotated by an angle of cosine c and
    sine s.
    """
    if other.radius > 0.0 or _count_edges(other.outline) > 1:
        p = _place_edge(_get_edge(0, one.outline), x, y, c, s)
        if _measure_origin(p.ax, p.ay, other) < 0.0:
            return True
    if one.radius > 0.0 or _count_edges(one.outline) > 1:
        q = _get_edge(0, other.outline)
        qx = c * (q.ax - x) + s * (q.ay - y)
        qy = c * (q.ay - y) - s * (q.ax - x)
        return _measure_origin(qx, qy, one) < 0.0
    return False


@kernel
def wall_gap(
    one: Solid,
    walls: Array,
    limit: float,
    skin: float,
    listed: Touches,
) -> float:
    """Clearance of a solid from straight walls (W, 4), see the module."""
    corners = walls.reshape((-1, 2))
    least = limit
    for w in range(len(walls)):
        far = one.reach + max(least, skin)
        if wall_distance2(one.x, one.y, walls[w]) <= far * far:
            outline = Outline(corners, 2 * w, 2 * w + 2)
            wall = Solid(-1, outline, 0.0, 0.0, 1.0, 0.0, 0.0, np.inf)
            least = min(least, find_gap(one, wall, least, skin, listed))
    return least


@kernel
def wall_distance2(x: float, y: float, wall: Array) -> float:
    """Square of the distance from a point to a straight wall (4,) [m^2]."""
    return find_wall(x, y, wall)[2]


@kernel
def find_wall(x: float, y: float, wall: Array) -> tuple[float, float, float]:
    """Return the vector to the nearest point of a straight wall, and its length squared."""
    dx, dy = from_edge(x, y, Edge(wall[0], wall[1], wall[2], wall[3]))
    return -dx, -dy, dx * dx + dy * dy


@kernel
def wall_distance(x: float, y: float, walls: Array) -> float:
    """Distance from a point to the nearest straight wall (W, 4) [m]; inf if there is none."""
    least = np.inf
    for w in range(len(walls)):
        least = min(least, wall_distance2(x, y, walls[w]))
    return math.sqrt(least)


@kernel
def in_grid(x: float, y: float, grid: MapField) -> tuple[float, float]:
    """Return a point of the map frame in the frame of a grid [m]."""
    dx = x - grid.x
    dy = y - grid.y
    return grid.cos * dx + grid.sin * dy, grid.cos * dy - grid.sin * dx


@kernel
def _bounds(x: float, y: float, grid: MapField) -> tuple[float, float]:
    """Bounds on the distance from (x, y) to a solid cell, by the nearest cell's [m]."""
    rows, columns = grid.distances.shape
    size = grid.cell
    i = min(max(math.floor(y / size), 0), rows - 1)
    j = min(max(math.floor(x / size), 0), columns - 1)
    # Outside the map, its nearest point is closer to each of its cells than (x, y) is.
    px = min(max(x, 0.0), columns * size)
    py = min(max(y, 0.0), rows * size)
    within = math.hypot(px - (j + 0.5) * size, py - (i + 0.5) * size)
    outside = math.hypot(x - px, y - py)
    middle = grid.distances[i, j]
    low = middle * (1.0 - FLOAT32) - within
    return low, middle * (1.0 + FLOAT32) + within + outside


@kernel
def map_bound(body: Array, grid: MapField) -> float:
    """Lower bound on the distance from the circle around a body to the map [m]."""
    if grid.distances.size == 0:
        return np.inf
    x, y = in_grid(body[X], body[Y], grid)
    return _bounds(x, y, grid)[0] - body[RADIUS]


@kernel
def map_gap(
    one: Solid,
    grid: MapField,
    limit: float,
    skin: float,
    listed: Touches,
) -> float:
    """Clearance of a solid from the solid cells of a map, see the module."""
    if grid.distances.size == 0:
        return limit
    size = grid.cell
    x, y = in_grid(one.x, one.y, grid)
    low, high = _bounds(x, y, grid)
    if low - one.reach > max(limit, skin):
        return limit
    square = listed.square
    for v in range(4):
        square[v, 0] = ((v + 1) // 2) % 2 * size
        square[v, 1] = v // 2 * size
    outline = Outline(square, 0, 4)
    least = limit
    far = one.reach + max(min(limit, high), skin) + size
    rows, columns = grid.distances.shape
    end_i = min(math.floor((y + far) / size) + 1, rows)
    end_j = min(math.floor((x + far) / size) + 1, columns)
    for i in range(max(math.floor((y - far) / size), 0), end_i):
        for j in range(max(math.floor((x - far) / size), 0), end_j):
            dx = max(j * size - x, x - (j + 1) * size, 0.0)
            dy = max(i * size - y, y - (i + 1) * size, 0.0)
            far = one.reach + max(least, skin)
            if grid.distances[i, j] > 0.0 or dx * dx + dy * dy > far * far:
                continue
            cx = grid.x + grid.cos * j * size - grid.sin * i * size
            cy = grid.y + grid.sin * j * size + grid.cos * i * size
            cell = Solid(-1, outline, cx, cy, grid.cos, grid.sin, 0.0, 1.5 * size)
            least = min(least, find_gap(one, cell, least, skin, listed))
    return least


def body_cells(worlds: int, bodies: int, ordered: bool = False) -> BodyCells:
    """Allocate cells for K bodies in each of N worlds; 0 worlds to test all bodies."""
    rows = worlds
    if ordered:
        rows = min(worlds, 1)
    side = max(int(math.sqrt(PER_BODY * bodies)), 1)
    cells = BodyCells(
        np.full((worlds, side * side + 2), -1, np.int32),
        np.full((rows, bodies), -1, np.int32),
        ordered,
        np.zeros((worlds, FRAME)),
        np.arange(bodies, dtype=np.int32),
    )
    cells.frame[:, SIDE] = side
    return cells


@kernel(inline=True)
def _place(way: float, cells_per_metre: float, side: float) -> int:
    return int(min(max(way * cells_per_metre, 0.0), side - 1.0))


@kernel(inline=True)
def _cell(body: Array, is_sorted: bool, frame: Array) -> int:
    side = int(frame[SIDE])
    if not is_sorted or body[RADIUS] * frame[PER_METRE] > 1.0:
        return side * side
    frame[LARGEST] = max(frame[LARGEST], body[RADIUS])
    row = _place(body[Y] - frame[BOTTOM], frame[PER_METRE], side)
    return row * side + _place(body[X] - frame[LEFT], frame[PER_METRE], side)


@kernel
def sort_into_cells(n: int, bodies: Array, count: int, cells: BodyCells) -> None:
    """Sort the bodies (K, 7) of a world; the first `count` go into cells."""
    low_x = np.inf
    low_y = np.inf
    high_x = -np.inf
    high_y = -np.inf
    for k in range(count):
        if bodies[k, RADIUS] > 0.0:
            low_x = min(low_x, bodies[k, X])
            high_x = max(high_x, bodies[k, X])
            low_y = min(low_y, bodies[k, Y])
            high_y = max(high_y, bodies[k, Y])
    extent = max(high_x - low_x, high_y - low_y, 1e-6)
    frame = cells.frame[n]
    frame[LEFT] = low_x
    frame[BOTTOM] = low_y
    frame[PER_METRE] = 1.0
    if extent < np.inf:
        frame[PER_METRE] = frame[SIDE] / extent
    frame[LARGEST] = 0.0
    frame[MOVED] = 0.0
    first = cells.first[n]
    cell_of = cells.found
    then = cells.then[0 if cells.ordered else n]
    first[:] = 0
    for k in range(len(bodies)):
        if bodies[k, RADIUS] > 0.0:
            cell_of[k] = _cell(bodies[k], k < count, frame)
            first[cell_of[k]] += 1
    for cell in range(1, len(first)):
        first[cell] += first[cell - 1]
    # Each entry is now the end of its cell; filled from the end, it becomes the beginning.
    for k in range(len(bodies) - 1, -1, -1):
        if bodies[k, RADIUS] > 0.0:
            first[cell_of[k]] -= 1
            then[first[cell_of[k]]] = k


@kernel(inline=True)
def _copy(body: Array, to: Array) -> None:
    for i in range(7):
        to[i] = body[i]


@kernel
def put_in_order(
    n: int,
    bodies: Array,
    obstacles: int,
    spare: Array,
    cells: BodyCells,
) -> None:
    """Sort the obstacles, the first of the bodies (K, 7), in place, absent ones last.

    None of these may move. Neighbours then share cache lines, so that few accesses miss
    the cache. `spare` (K, 7) is scratch.
    """
    sort_into_cells(n, bodies[:obstacles], obstacles, cells)
    first = cells.first[n]
    count = first[-1]
    for k in range(obstacles):
        _copy(bodies[k], spare[k])
    for i in range(count):
        _copy(spare[cells.then[0, i]], bodies[i])
    for k in range(obstacles):
        if spare[k, RADIUS] <= 0.0:
            _copy(spare[k], bodies[count])
            count += 1
    first[-1] = len(bodies)  # absent and moving bodies are always found


@kernel(inline=True)
def find_around(n: int, x: float, y: float, reach: float, cells: BodyCells) -> int:
    """Write bodies that may be within `reach` [m] to `cells.found`; return how many."""
    first = cells.first
    found = cells.found
    if len(first) == 0:
        return len(found)  # `found` lists all bodies
    frame = cells.frame[n]
    per_metre = frame[PER_METRE]
    side = int(frame[SIDE])
    far = reach + frame[LARGEST] + frame[MOVED]
    x -= frame[LEFT]
    y -= frame[BOTTOM]
    left = _place(x - far, per_metre, side)
    right = _place(x + far, per_metre, side)
    high = _place(y + far, per_metre, side)
    count = 0
    for row in range(_place(y - far, per_metre, side), high + 2):
        begin = row * side + left
        end = row * side + right
        if row > high:  # those in no cell
            begin = side * side
            end = begin
        for i in range(first[n, begin], first[n, end + 1]):
            found[count] = i if cells.ordered else cells.then[n, i]
            count += 1
    return count
