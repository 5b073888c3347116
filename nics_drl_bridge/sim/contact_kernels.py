"""Compiled contacts: which robots may touch something within a period, and what they touch.

A robot whose circle cannot meet anything within the period moves freely; for the others, `near`
lists the bodies that each substep tests. In a crowded world the bodies are sorted into square cells
each period, and a robot tests only those around it; bodies larger than a cell are always tested.
"""

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SIN, X, Y
from nics_drl_bridge.robot.kernels import wrap
from nics_drl_bridge.sim import collision_kernels as collision
from nics_drl_bridge.sim.state import Array, Cells, Nearby, State, Surroundings

FREE, BODIES, WALLS, MAP = 0, 1, 2, 4  # Bit flags of what a robot may meet
SEVERAL = 32  # Most bodies that are listed near a robot; if there are more, all are tested
LEFT, BOTTOM, PER_METRE, LARGEST, MOVED, FRAME = range(6)
"""Columns of `Cells.frame`: x, y of the first cell [m], cells per metre, greatest radius of the
bodies in cells [m], greatest distance moved since by any body [m]."""


@kernel
def reaches(n: int, state: State, nearby: Nearby, period: float) -> tuple[float, bool]:
    """Writes how far each body reaches in a period [s]; longest path, and if an obstacle moves."""
    reach, way, bodies, velocity = nearby.reach, nearby.way, state.bodies, state.velocity
    longest, moving = 0.0, False
    obstacles = velocity.shape[1]
    for k in range(obstacles):
        reach[k] = bodies[n, k, RADIUS]
        vx, vy = velocity[n, k, 0], velocity[n, k, 1]
        if (vx != 0.0 or vy != 0.0 or velocity[n, k, 2] != 0.0) and reach[k] > 0.0:
            moved = math.sqrt(vx * vx + vy * vy) * period
            reach[k] += moved
            longest, moving = max(longest, moved), True
    for m in range(way.shape[0]):
        reach[obstacles + m] = bodies[n, obstacles + m, RADIUS] + way[m]
        longest = max(longest, way[m])
    return longest, moving


@kernel
def find_near(
    n: int, m: int, bodies: Array, scene: Surroundings, nearby: Nearby, cells: Cells
) -> int:
    """Returns flags of what robot m of world n may meet; writes row m of `nearby.near`."""
    near, reach, walls = nearby.near, nearby.reach, scene.walls
    me = bodies.shape[1] - near.shape[0] + m
    x, y, own = bodies[n, me, X], bodies[n, me, Y], reach[me]
    count, several = 0, bodies_around(x, y, own, cells) if scene.crowded else bodies.shape[1]
    for i in range(several):
        k = cells.found[i] if scene.crowded else i
        dx, dy, far = bodies[n, k, X] - x, bodies[n, k, Y] - y, own + reach[k]
        if dx * dx + dy * dy <= far * far and k != me and reach[k] > 0.0:
            if count < SEVERAL:
                near[m, 1 + count] = k
            count += 1
    near[m, 0] = count
    meets = BODIES if count > 0 else FREE
    for w in range(walls.shape[0]):
        d2 = collision.segment_distance2(x, y, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3])
        if d2 <= own * own:
            meets |= WALLS
            break
    if collision.map_bound(bodies[n, me], scene.grid) <= own - bodies[n, me, RADIUS]:
        meets |= MAP  # without a map, the bound is inf
    return meets


@kernel
def contact(
    body: Array, m: int, world: Array, scene: Surroundings, nearby: Nearby, spare: Array,
    limit: float,
) -> tuple[float, int]:  # fmt: skip
    """Clearance [m], up to `limit`, of robot m placed as `body` (7,), and nearest body or -1."""
    outlines, near, least, whom = scene.outlines, nearby.near, limit, -1
    if nearby.meets[m] & BODIES:
        me = world.shape[0] - near.shape[0] + m
        listed = near[m, 0] <= SEVERAL
        for i in range(near[m, 0] if listed else world.shape[0]):
            k = near[m, 1 + i] if listed else i
            if k == me or world[k, RADIUS] <= 0.0:
                continue
            gap = collision.body_gap(body, world[k], outlines, limit, spare)
            if gap < least:
                least, whom = gap, k
    if nearby.meets[m] & WALLS:
        for w in range(scene.walls.shape[0]):
            gap = collision.wall_gap(body, scene.walls[w], outlines, limit, spare)
            if gap < least:
                least, whom = gap, -1
    if nearby.meets[m] & MAP:
        gap = collision.map_gap(body, scene.grid, outlines, limit, spare)
        if gap < least:
            least, whom = gap, -1
    return least, whom


@kernel
def move_obstacles(bodies: Array, start: Array, velocity: Array, n: int, time: float) -> None:
    """Moves the obstacles of world n to `time` [s] after their poses `start` (K, 3)."""
    for k in range(velocity.shape[1]):
        bodies[n, k, X] = start[k, 0] + velocity[n, k, 0] * time
        bodies[n, k, Y] = start[k, 1] + velocity[n, k, 1] * time
        if velocity[n, k, 2] != 0.0:
            heading = wrap(start[k, 2] + velocity[n, k, 2] * time)
            bodies[n, k, HEADING] = heading
            bodies[n, k, COS], bodies[n, k, SIN] = math.cos(heading), math.sin(heading)


@kernel
def put_body(bodies: Array, n: int, k: int, pose: Array) -> None:
    """Places body k of world n at a pose (3,)."""
    bodies[n, k, X], bodies[n, k, Y], bodies[n, k, HEADING] = pose[0], pose[1], pose[2]
    bodies[n, k, COS], bodies[n, k, SIN] = math.cos(pose[2]), math.sin(pose[2])


@kernel
def _cell(way: float, per_metre: float, side: int) -> int:
    return int(min(max(way * per_metre, 0.0), side - 1.0))


@kernel
def sort_bodies(bodies: Array, n: int, cells: Cells) -> None:
    """Sorts the bodies of world n into cells, about two cells per body."""
    begin, order, cell_of, frame = cells.begin, cells.order, cells.cell_of, cells.frame
    count, side = bodies.shape[1], int(math.sqrt(begin.shape[0] - 2))
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for k in range(count):
        if bodies[n, k, RADIUS] > 0.0:
            low_x, high_x = min(low_x, bodies[n, k, X]), max(high_x, bodies[n, k, X])
            low_y, high_y = min(low_y, bodies[n, k, Y]), max(high_y, bodies[n, k, Y])
    extent = max(high_x - low_x, high_y - low_y, 1e-6)
    per_metre = side / extent if extent < np.inf else 1.0
    frame[LEFT], frame[BOTTOM], frame[PER_METRE] = low_x, low_y, per_metre
    frame[LARGEST] = frame[MOVED] = 0.0
    begin[:] = 0
    for k in range(count):
        radius, cell = bodies[n, k, RADIUS], side * side
        if radius * per_metre <= 1.0:
            i = _cell(bodies[n, k, Y] - low_y, per_metre, side)
            cell = i * side + _cell(bodies[n, k, X] - low_x, per_metre, side)
            frame[LARGEST] = max(frame[LARGEST], radius)
        cell_of[k] = cell
        begin[cell + 1] += 1
    for cell in range(begin.shape[0] - 1):
        begin[cell + 1] += begin[cell]
    for k in range(count - 1, -1, -1):
        cell = cell_of[k] + 1
        begin[cell] -= 1
        order[begin[cell]] = k
    # Each entry is now the start of the cell before it, and the last one the end of all cells.
    for cell in range(begin.shape[0] - 1):
        begin[cell] = begin[cell + 1]
    begin[begin.shape[0] - 1] = count


@kernel
def bodies_around(x: float, y: float, reach: float, cells: Cells) -> int:
    """Writes to `cells.found` the bodies that may be within `reach` [m] of (x, y); their number."""
    begin, order, frame, found = cells.begin, cells.order, cells.frame, cells.found
    side = int(math.sqrt(begin.shape[0] - 2))
    reach += frame[LARGEST] + frame[MOVED]
    left = _cell(x - reach - frame[LEFT], frame[PER_METRE], side)
    right = _cell(x + reach - frame[LEFT], frame[PER_METRE], side)
    low = _cell(y - reach - frame[BOTTOM], frame[PER_METRE], side)
    high = _cell(y + reach - frame[BOTTOM], frame[PER_METRE], side)
    count = 0
    for i in range(low, high + 1):
        for k in range(begin[i * side + left], begin[i * side + right + 1]):
            found[count] = order[k]
            count += 1
    for k in range(begin[side * side], begin[side * side + 1]):
        found[count] = order[k]
        count += 1
    return count
