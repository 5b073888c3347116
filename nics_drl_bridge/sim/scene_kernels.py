"""Compiled drawing of scenes: obstacles, starts and goals, one seed after another.

Every number is drawn from its own counter, so a seed's scene is the same in any batch.
Obstacles are placed one by one without overlap, in cells known to be free. Pairs of
starts and goals follow. If a placement fails, it is repeated with new numbers.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import (
    Array,
    Integers,
    Mask,
    ShortIntegers,
    structure_of,
)
from nics_drl_bridge.lidar.exact_kernels import (
    COS,
    HEADING,
    RADIUS,
    SHAPE,
    SIN,
    OutlineArrays,
    X,
    Y,
)
from nics_drl_bridge.sim import collision_kernels as collision
from nics_drl_bridge.sim.state import BodyCells, MapField, Records, Touches

TRIES = 2000
RESTARTS = 50
# Number of start-goal pairs without a path after which the obstacles are redrawn
DETOURS = 4
MARGIN = 1e-9  # Minimum distance of obstacles from walls and from each other [m]
DRAWN = 0
NO_OBSTACLES = 1
NO_ROBOTS = 2


class ObstacleGroup:
    """A group of obstacles."""

    least: int  # number of obstacles
    greatest: int
    gap: float  # [m]
    first_shape: int  # in `ScenePlan.choices`
    shapes: int
    is_fixed: bool
    moves: bool


GROUP = structure_of(ObstacleGroup)


class DrawnPlace:
    """A place of starts or goals."""

    x1: float  # region [m]
    y1: float
    x2: float
    y2: float
    least_heading: float  # [rad]
    greatest_heading: float
    share: float  # cumulative fraction of the places up to this one


PLACE = structure_of(DrawnPlace)


class NextDraw:
    """The next draw of a scene, see `random_kernels.uniform_of`."""

    source: np.uint64
    counter: int


DRAWS = structure_of(NextDraw)


class FreeSpace(NamedTuple):
    """Everything that is in every scene, and the space between where robots fit."""

    cells: MapField  # distances to the nearest wall or solid cell of the map
    # (rows, columns) label of the connected free area; 0 for none
    area: ShortIntegers
    bounds: Array  # (4,) minimum x, y and maximum x, y of the field [m]
    walls: Array  # (W, 4)
    grid: MapField  # the static map
    # (C,) row-major indices of the cells where a robot may start, and of those with any free space;
    # none where nothing is drawn there
    for_robots: ShortIntegers
    for_anything: ShortIntegers
    room: float  # clearance that a robot on its path needs at the centre of a cell [m]


class ScenePlan(NamedTuple):
    """What scenes are drawn from: K obstacles in G groups, of H shapes in S sizes."""

    space: FreeSpace
    outlines: OutlineArrays  # of all shapes, the last of which is a disc
    radii: Array  # (H,) of the circles around them [m]
    groups: Records  # (G,) of `GROUP`
    group: Integers  # (K,) of each obstacle
    choices: Integers  # shapes that each group may take, one group after the other
    variants: Integers  # (S, H) index of each shape in each size
    poses: Array  # (K, 3) of the obstacles at fixed poses
    starts: Records  # (P,) of `PLACE`; none for anywhere
    goals: Records  # (P,) of `PLACE`
    footprint: float  # radius of a robot [m]
    clearance: float  # [m]
    least: float  # distance of a goal from its start [m]
    greatest: float
    around: bool  # True to draw goals around their starts


class SceneScratch(NamedTuple):
    """Scratch memory of one call; each thread needs its own."""

    draws: Records  # (1,) of `DRAWS`
    seen: Integers  # (rows * columns,) number of the search that last visited each cell
    stack: Integers  # (rows * columns,) cells to visit
    latest: Integers  # (1,) number of the latest search
    active: Mask  # (K,) obstacles of the scene
    gaps: Array  # (K,) free space around each obstacle [m]
    trial: Array  # (7,) an obstacle
    disc: Array  # (7,) a robot
    listed: Touches
    cells: BodyCells  # of the obstacles, once all are placed


@kernel
def wall_distances(cells: MapField, walls: Array) -> None:
    """Lower the distances of cells to the distances to the walls, in place."""
    distances = cells.distances
    for i in range(len(distances)):
        for j in range(distances.shape[1]):
            x, y = place_in(i + 0.5, j + 0.5, cells)
            distances[i, j] = min(distances[i, j], collision.wall_distance(x, y, walls))


@kernel
def place_in(row: float, column: float, cells: MapField) -> tuple[float, float]:
    """Return x, y [m] of a place in the grid, given as fractional row and column."""
    u = column * cells.cell
    v = row * cells.cell
    return (
        cells.x + cells.cos * u - cells.sin * v,
        cells.y + cells.sin * u + cells.cos * v,
    )


@kernel
def cell_of(x: float, y: float, cells: MapField) -> tuple[int, int, float]:
    """Return row and column of a point, and its distance from the cell's centre [m]."""
    u, v = collision.in_grid(x, y, cells)
    u /= cells.cell
    v /= cells.cell
    i = math.floor(v)
    j = math.floor(u)
    return i, j, cells.cell * math.sqrt((u - j - 0.5) ** 2 + (v - i - 0.5) ** 2)


@kernel
def area_of(x: float, y: float, space: FreeSpace) -> int:
    """Return the number of the area that contains a point; 0 for none."""
    i, j, _ = cell_of(x, y, space.cells)
    if 0 <= i < space.area.shape[0] and 0 <= j < space.area.shape[1]:
        return space.area[i, j]
    return 0


@kernel
def _within(x: float, y: float, space: FreeSpace) -> tuple[bool, float, float]:
    """Whether a point is inside field and grid, and bounds on its distance to walls."""
    distances = space.cells.distances
    bounds = space.bounds
    i, j, off = cell_of(x, y, space.cells)
    inside = 0 <= i < distances.shape[0] and 0 <= j < distances.shape[1]
    inside = inside and bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3]
    if not inside:
        return False, 0.0, 0.0
    middle = distances[i, j]
    return (
        True,
        middle * (1.0 - collision.FLOAT32) - off,
        middle * (1.0 + collision.FLOAT32) + off,
    )


@kernel(inline=True)
def _clear_of_walls(body: Array, room: float, plan: ScenePlan, listed: Touches) -> bool:
    space = plan.space
    outlines = plan.outlines
    inside, low, high = _within(body[X], body[Y], space)
    if inside and low >= body[RADIUS] + room:
        return True
    if collision.is_round(body, outlines):
        if not inside or high < body[RADIUS] + room:
            return False
    else:  # the origin of the shape may lie outside its outline
        first = outlines.corners[outlines.first[int(body[SHAPE])]]
        x = body[X] + body[COS] * first[0] - body[SIN] * first[1]
        y = body[Y] + body[SIN] * first[0] + body[COS] * first[1]
        if not _within(x, y, space)[0]:
            return False
    solid = collision.solid_of(0, body, outlines)
    gap = collision.wall_gap(solid, space.walls, room, 0.0, listed)
    return collision.map_gap(solid, space.grid, gap, 0.0, listed) >= room


@kernel(inline=True)
def _clear_of(
    body: Array,
    obstacle: Array,
    room: float,
    outlines: OutlineArrays,
    listed: Touches,
) -> bool:
    dx = body[X] - obstacle[X]
    dy = body[Y] - obstacle[Y]
    far = body[RADIUS] + obstacle[RADIUS] + room
    if dx * dx + dy * dy >= far * far:
        return True
    if collision.is_round(body, outlines) and collision.is_round(obstacle, outlines):
        return False
    one = collision.solid_of(0, body, outlines)
    other = collision.solid_of(0, obstacle, outlines)
    return collision.find_gap(one, other, room, 0.0, listed) >= room


@kernel(inline=True)
def _is_clear(
    x: float,
    y: float,
    room: float,
    moving: bool,
    plan: ScenePlan,
    bodies: Array,
    scratch: SceneScratch,
) -> bool:
    disc = scratch.disc
    disc[X] = x
    disc[Y] = y
    cells = scratch.cells
    for i in range(collision.find_around(0, x, y, disc[RADIUS] + room, cells)):
        k = cells.found[i]
        counts = moving or not plan.groups[plan.group[k]].moves
        if counts and not _clear_of(
            disc, bodies[k], room, plan.outlines, scratch.listed
        ):
            return False
    return True


@kernel
def _is_free(
    x: float,
    y: float,
    plan: ScenePlan,
    bodies: Array,
    scratch: SceneScratch,
) -> bool:
    return _is_clear(
        x, y, plan.clearance, True, plan, bodies, scratch
    ) and _clear_of_walls(scratch.disc, plan.clearance, plan, scratch.listed)


@kernel
def _is_joined(
    x: float,
    y: float,
    gx: float,
    gy: float,
    plan: ScenePlan,
    bodies: Array,
    scratch: SceneScratch,
) -> bool:
    """True if a robot can move between two points of an area, from cell to cell.

    Of the neighbouring cells, the one nearest to the goal is visited first. The cells
    of both points count as free.
    """
    cells = plan.space.cells
    label = plan.space.area
    room = plan.space.room - plan.footprint
    seen = scratch.seen
    stack = scratch.stack
    rows, columns = label.shape
    i, j, _ = cell_of(x, y, cells)
    gi, gj, _ = cell_of(gx, gy, cells)
    area = label[i, j]
    scratch.latest[0] += 1
    latest = scratch.latest[0]
    seen[i * columns + j] = latest
    stack[0] = i * columns + j
    height = 1
    while height > 0:
        height -= 1
        i = stack[height] // columns
        j = stack[height] % columns
        if i == gi and j == gj:
            return True
        up = 1 if gi >= i else -1
        right = 1 if gj >= j else -1
        steep = abs(gi - i) >= abs(gj - j)
        for way in range(4):  # the last one is popped first
            toward = 1 if way > 1 else -1
            along = (way == 0 or way == 3) == steep
            row = i + (toward * up if along else 0)
            column = j + (0 if along else toward * right)
            if not (0 <= row < rows and 0 <= column < columns):
                continue
            cell = row * columns + column
            if label[row, column] != area or seen[cell] == latest:
                continue
            seen[cell] = latest
            cx, cy = place_in(row + 0.5, column + 0.5, cells)
            is_goal = row == gi and column == gj
            if is_goal or _is_clear(cx, cy, room, False, plan, bodies, scratch):
                stack[height] = cell
                height += 1
    return False


@kernel
def _draw(scratch: SceneScratch) -> float:
    """Draw the next number of the scene, uniform from 0 to below 1."""
    draws = scratch.draws[0]
    draws.counter += 1
    return random.uniform_of(draws.source, draws.counter - 1)


@kernel
def _draw_point(
    chosen: ShortIntegers, cells: MapField, scratch: SceneScratch
) -> tuple[float, float]:
    """Draw a point in one of the chosen cells, given by row-major indices."""
    cell = int(_draw(scratch) * len(chosen))
    # if all cells are allowed, skip the look-up, which would miss the cache
    if len(chosen) < cells.distances.size:
        cell = chosen[cell]
    row = cell // cells.distances.shape[1] + _draw(scratch)
    column = cell % cells.distances.shape[1] + _draw(scratch)
    return place_in(row, column, cells)


@kernel
def _put(
    body: Array,
    x: float,
    y: float,
    heading: float,
    shape: int,
    plan: ScenePlan,
) -> None:
    body[X] = x
    body[Y] = y
    body[HEADING] = heading
    body[COS] = math.cos(heading)
    body[SIN] = math.sin(heading)
    body[RADIUS] = plan.radii[shape]
    body[SHAPE] = shape


@kernel
def _choose_obstacles(
    wanted: int,
    size: int,
    plan: ScenePlan,
    bodies: Array,
    scratch: SceneScratch,
) -> None:
    """Draw the obstacles of the scene, and the shape of each."""
    total = 0
    before = 0
    k = 0
    for group in plan.groups:
        if not group.is_fixed:
            total += group.greatest
    for group in plan.groups:
        span = group.greatest - group.least + 1
        count = group.least + int(_draw(scratch) * span)
        if not group.is_fixed:
            if wanted >= 0:  # in proportion to the size of the group
                most = min(wanted, total)
                up_to = most * before + total // 2
                count = (up_to + most * group.greatest) // total - up_to // total
            before += group.greatest
        for number in range(group.greatest):
            choice = group.first_shape + int(_draw(scratch) * group.shapes)
            scratch.active[k] = number < count
            bodies[k, :] = 0.0
            bodies[k, COS] = 1.0
            bodies[k, SHAPE] = plan.variants[size, plan.choices[choice]]
            k += 1


@kernel
def _place_obstacles(plan: ScenePlan, bodies: Array, scratch: SceneScratch) -> bool:
    """Place the obstacles of the scene; return True if there was space for all of them."""
    space = plan.space
    first = plan.outlines.first
    trial = scratch.trial
    for k in range(len(bodies)):
        group = plan.groups[plan.group[k]]
        scratch.gaps[k] = max(group.gap, MARGIN)
        bodies[k, RADIUS] = 0.0
        if group.is_fixed:
            pose = plan.poses[k]
            _put(bodies[k], pose[0], pose[1], pose[2], int(bodies[k, SHAPE]), plan)
    for k in range(len(bodies)):
        if plan.groups[plan.group[k]].is_fixed or not scratch.active[k]:
            continue
        shape = int(bodies[k, SHAPE])
        heading = 0.0
        placed = False
        for _ in range(TRIES):
            x, y = _draw_point(space.for_anything, space.cells, scratch)
            if first[shape] < first[shape + 1]:
                heading = (2.0 * _draw(scratch) - 1.0) * math.pi
            _put(trial, x, y, heading, shape, plan)
            placed = _is_apart(k, plan, bodies, scratch) and _clear_of_walls(
                trial, MARGIN, plan, scratch.listed
            )
            if placed:
                _put(bodies[k], x, y, heading, shape, plan)
                break
        if not placed:
            return False
    return True


@kernel
def _is_apart(k: int, plan: ScenePlan, bodies: Array, scratch: SceneScratch) -> bool:
    """True if the trial of obstacle k keeps its gap from those that are placed."""
    for j in range(len(bodies)):
        gap = max(scratch.gaps[k], scratch.gaps[j])
        if bodies[j, RADIUS] > 0.0 and not _clear_of(
            scratch.trial, bodies[j], gap, plan.outlines, scratch.listed
        ):
            return False
    return True


@kernel
def _draw_place(
    places: Records, space: FreeSpace, scratch: SceneScratch
) -> tuple[float, float, float]:
    """Draw x, y, heading of a start or goal in one of the places."""
    if len(places) == 0:
        x, y = _draw_point(space.for_robots, space.cells, scratch)
        return x, y, (2.0 * _draw(scratch) - 1.0) * math.pi
    share = _draw(scratch)
    p = 0
    while p < len(places) - 1 and share >= places[p].share:
        p += 1
    place = places[p]
    x = place.x1 + _draw(scratch) * (place.x2 - place.x1)
    y = place.y1 + _draw(scratch) * (place.y2 - place.y1)
    spread = place.greatest_heading - place.least_heading
    return x, y, place.least_heading + _draw(scratch) * spread


@kernel
def _draw_goal(
    x: float, y: float, plan: ScenePlan, scratch: SceneScratch
) -> tuple[float, float]:
    """Draw a goal for a start at x, y: in one of the places, or in the ring around it."""
    if not plan.around:
        gx, gy, _ = _draw_place(plan.goals, plan.space, scratch)
        return gx, gy
    turn = 2.0 * math.pi * _draw(scratch)
    inner = plan.least * plan.least
    ring = plan.greatest * plan.greatest - inner
    far = math.sqrt(inner + _draw(scratch) * ring)
    scratch.draws[0].counter += 2  # as many draws as a place takes
    return x + far * math.cos(turn), y + far * math.sin(turn)


@kernel
def _is_spaced(x: float, y: float, others: Array, m: int, plan: ScenePlan) -> bool:
    """True if robots fit at x, y and at the first m of others."""
    least = 2.0 * plan.footprint + plan.clearance
    for k in range(m):
        dx = x - others[k, 0]
        dy = y - others[k, 1]
        if dx * dx + dy * dy <= least * least:
            return False
    return True


@kernel
def _place_robots(
    plan: ScenePlan,
    bodies: Array,
    starts: Array,
    goals: Array,
    scratch: SceneScratch,
) -> bool:
    """Draw a start and a goal for each robot; return True if all were found."""
    for m in range(len(starts)):
        placed = False
        detours = 0
        for _ in range(TRIES):
            x, y, heading = _draw_place(plan.starts, plan.space, scratch)
            area = area_of(x, y, plan.space)
            if area == 0 or not _is_free(x, y, plan, bodies, scratch):
                continue
            gx, gy = _draw_goal(x, y, plan, scratch)
            distance2 = (gx - x) * (gx - x) + (gy - y) * (gy - y)
            fits = plan.least * plan.least <= distance2 <= plan.greatest * plan.greatest
            fits = fits and area_of(gx, gy, plan.space) == area
            fits = fits and _is_spaced(x, y, starts, m, plan)
            fits = fits and _is_spaced(gx, gy, goals, m, plan)
            if not (fits and _is_free(gx, gy, plan, bodies, scratch)):
                continue
            if not _is_joined(x, y, gx, gy, plan, bodies, scratch):
                detours += 1
                if detours == DETOURS:
                    break
                continue
            starts[m, 0] = x
            starts[m, 1] = y
            starts[m, 2] = heading
            goals[m, 0] = gx
            goals[m, 1] = gy
            placed = True
            break
        if not placed:
            return False
    return True


@kernel
def choose_members(seeds: Integers, members: int, out: Integers) -> None:
    """Write the index of the world of each seed (n,) among the members of a set."""
    for n in range(len(seeds)):
        share = random.uniform(seeds[n], random.MEMBER_STREAM, 0)
        out[n] = min(int(share * members), members - 1)


@kernel(allocates=True)
def draw_scenes(
    packed: Any,
    seeds: Integers,
    wanted: Integers,
    sizes: Integers,
    bodies: Array,
    starts: Array,
    goals: Array,
    scratch: SceneScratch,
) -> tuple[int, int]:
    """Draw the scenes of some seeds (n,) to bodies (n, K, 7), start (n, M, 3), goals (n, M, 2).

    If K exceeds the world's number of obstacles, the remaining ones are absent.
    `wanted` (n,) are numbers of random obstacles, -1 for the world's own number;
    `sizes` (n,) are rows of `plan.variants`. Returns the first row that could not be
    drawn, or n, and the reason.
    """
    plan: ScenePlan = packed.content
    count = len(plan.group)
    disc = scratch.disc
    _put(disc, 0.0, 0.0, 0.0, len(plan.radii) - 1, plan)
    disc[RADIUS] = plan.footprint
    for n in range(len(seeds)):
        state = NO_OBSTACLES
        obstacles = bodies[n, :count]
        scratch.draws[0].source = random.source(seeds[n], random.SCENE_STREAM)
        scratch.draws[0].counter = 0
        _choose_obstacles(wanted[n], sizes[n], plan, obstacles, scratch)
        for _ in range(RESTARTS):
            if _place_obstacles(plan, obstacles, scratch):
                collision.sort_into_cells(0, obstacles, count, scratch.cells)
                state = NO_ROBOTS
                if _place_robots(plan, obstacles, starts[n], goals[n], scratch):
                    state = DRAWN
                    break
        if state != DRAWN:
            return n, state
    return len(seeds), DRAWN
