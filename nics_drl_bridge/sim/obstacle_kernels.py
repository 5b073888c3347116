"""Compiled motion of circular obstacles: one call at reset, one per world and period.

Draws depend only on seed, step and k. Pedestrians follow the social force model of
Helbing and Molnar (1995), Phys. Rev. E 51, 4282, with its equation numbers: an
attraction to the goal (2), repulsion by others along ellipses that anticipate their
next step (3, 4) and by walls (5), reduced for objects out of sight (8), and a
fluctuation. Distances are between surfaces. The anticipated step is that of the
relative motion (Johansson, Helbing, Shukla 2007): with the other's own step, a walker
would push against a robot in its way.

`restrain` then limits each step to free space. Each wall, body and side of the field
limits an obstacle to a half plane: it may move by at most `room` along the unit vector
to the nearest point. If two bodies move, each may use half of the gap, so that neither
needs to know the other's step (buffered Voronoi cells; Zhou, Wang, Bandyopadhyay,
Schwager 2017). A displacement within all half planes stays free of contacts throughout
the period.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, X, Y
from nics_drl_bridge.robot.kernels import wrap
from nics_drl_bridge.sim.collision_kernels import find_wall, in_grid
from nics_drl_bridge.sim.state import (
    PATROL,
    PEDESTRIAN,
    STILL,
    MapField,
    Record,
    Records,
    State,
    Surroundings,
)

SLACK = 1e-6  # Unused margin [m], so that rounding never makes two bodies touch
ROBOT_GAP = 0.1  # gap that an obstacle keeps from a robot [m]; less looks like contact
# Number of times a displacement is deflected before it is shortened instead
PASSES = 3
FINEST = 0.25  # Minimum step along a path through a static map, in cells
HALVINGS = 8  # Number of bisections of its last step to find the end of the free path


class Traffic(NamedTuple):
    """Everything that the moving obstacles of one world avoid in a period."""

    bodies: Array  # (K + M, 7) obstacles, then robots
    first: int  # index of the first robot
    speeds: Array  # (M, 2) velocity of the robots in `map` [m/s]
    plans: Records  # (K,) motions of the obstacles
    walls: Array  # (W, 4)
    field: Array  # (4,) minimum x, y and maximum x, y of the field [m]
    grid: MapField
    period: float  # [s]


DRAWS = 64  # Maximum number of draws per obstacle and period
MOST = 10_000  # Maximum number of obstacles, on which the draws must not depend
TURN = 2.0  # Maximum turn rate of an obstacle [rad/s]
MOST_CORNERS = 32  # Maximum number of waypoints that a patrol passes in a period
# Minimum distance for which a force is computed [m]: at 0 it has no direction
NEAREST = 1e-3
FAR = 8.0  # Forces beyond this many ranges are neglected
STRONGEST = 5.0  # Maximum acceleration of a person [m/s^2]; the model has no bound
ARRIVED = 0.3  # A goal is reached within this distance [m]
ROOM = 0.2  # Free space around a walker at a new goal [m]
LEAST_WALK = 1.0  # Minimum distance of a new goal [m], if such a goal is found
# A goal is abandoned after twice the time of the straight path plus this [s]
PATIENCE = 5.0
CANDIDATES = 16


@kernel
def reset_marks(n: int, data: State, plans: Records) -> None:
    """Begin the memory of the moving obstacles of world n, which is 0; draw their speeds."""
    for k in range(len(plans)):
        mark = data.marks[n, k]
        row = plans[k]
        if row.kind == STILL:
            continue
        share = random.uniform(data.seeds[n], random.MOTION_STREAM, k * DRAWS)
        mark.speed = row.slowest + (row.fastest - row.slowest) * share
        mark.goal_x = data.bodies[n, k, X]
        mark.goal_y = data.bodies[n, k, Y]
        mark.until = -1.0
        mark.way = 1


@kernel(inline=True)
def steer(
    n: int,
    data: State,
    scene: Surroundings,
    period: float,
    speeds: Array,
) -> None:
    """Set the obstacles' velocities for a period [s]; `speeds` (M, 2) are the robots' [m/s].

    An obstacle stays in the field and avoids walls, other obstacles, and robots that
    keep their velocity.
    """
    velocity = data.velocity[n]
    plans = scene.plans
    traffic = Traffic(
        data.bodies[n],
        len(velocity),
        speeds,
        plans,
        scene.walls,
        scene.bounds,
        scene.grid,
        period,
    )
    # walkers first, because they react to the velocities of the last period
    for k in range(len(velocity)):
        velocity[k, :] = 0.0
        if plans[k].kind == PEDESTRIAN and traffic.bodies[k, RADIUS] > 0.0:
            velocity[k, 0], velocity[k, 1] = _walk(k, n, traffic, data)
    for k in range(len(velocity)):
        kind = plans[k].kind
        mark = data.marks[n, k]
        body = traffic.bodies[k]
        if kind == STILL or body[RADIUS] <= 0.0:
            continue
        dx = velocity[k, 0] * period
        dy = velocity[k, 1] * period
        if kind == PATROL:
            dx, dy = _follow(mark, body, plans[k], scene.waypoints, period, False)
        wished_x = dx
        wished_y = dy
        dx, dy = restrain(dx, dy, k, traffic, kind != PATROL)
        if kind == PATROL and dx == wished_x and dy == wished_y:
            _follow(mark, body, plans[k], scene.waypoints, period, True)
        mark.vx = dx / period
        mark.vy = dy / period
        velocity[k, 0] = mark.vx
        velocity[k, 1] = mark.vy
        if dx != 0.0 or dy != 0.0:  # it faces the direction of motion
            turn = wrap(math.atan2(dy, dx) - body[HEADING]) / period
            velocity[k, 2] = min(max(turn, -TURN), TURN)


@kernel
def _follow(
    mark: Record,
    body: Array,
    row: Record,
    waypoints: Array,
    period: float,
    keep: bool,
) -> tuple[float, float]:
    """Displacement of a patrol along its path in a period; `keep` stores its progress."""
    index = mark.index
    way = mark.way
    rest = mark.rest
    x = body[X]
    y = body[Y]
    left = period
    for _ in range(MOST_CORNERS):
        pause = min(rest, left)
        rest -= pause
        left -= pause
        if left <= 0.0:
            break
        goal = waypoints[row.first + index]
        away = math.hypot(goal[0] - x, goal[1] - y)
        reach = mark.speed * left
        if away > reach:
            x += (goal[0] - x) * reach / away
            y += (goal[1] - y) * reach / away
            break
        x = goal[0]
        y = goal[1]
        left -= away / mark.speed
        rest = row.pause
        if row.loop:
            index = (index + 1) % row.count
        else:
            way = way if 0 <= index + way < row.count else -way
            index += way
    if keep:
        mark.index = index
        mark.way = way
        mark.rest = rest
    return x - body[X], y - body[Y]


@kernel
def repulsion(
    rx: float,
    ry: float,
    vx: float,
    vy: float,
    foresight: float,
    strength: float,
    reach: float,
) -> tuple[float, float]:
    """Return the force (3, 4) of another walker [m/s^2], - V0 grad exp(-b / sigma).

    2 b = sqrt((|r| + |r - v dt|)^2 - (v dt)^2), with r [m] from the other to this one, not zero,
    its relative velocity v [m/s], `foresight` dt, `strength` V0 [m^2/s^2] and `reach` sigma [m].
    """
    sx = vx * foresight
    sy = vy * foresight
    qx = rx - sx
    qy = ry - sy
    distance = math.sqrt(rx * rx + ry * ry)
    next_distance = max(math.sqrt(qx * qx + qy * qy), NEAREST)
    both = distance + next_distance
    b = 0.5 * math.sqrt(max(both * both - sx * sx - sy * sy, NEAREST * NEAREST))
    if b > FAR * reach:
        return 0.0, 0.0
    size = strength / reach * math.exp(-b / reach) * both / (4.0 * b)
    return size * (rx / distance + qx / next_distance), size * (
        ry / distance + qy / next_distance
    )


@kernel(inline=True)
def _from_bodies(
    k: int,
    ex: float,
    ey: float,
    marks: Records,
    traffic: Traffic,
) -> tuple[float, float]:
    bodies = traffic.bodies
    first = traffic.first
    row = traffic.plans[k]
    ax = 0.0
    ay = 0.0
    for j in range(len(bodies)):
        if j == k or bodies[j, RADIUS] <= 0.0:
            continue
        rx = bodies[k, X] - bodies[j, X]
        ry = bodies[k, Y] - bodies[j, Y]
        if j < first:
            vx = marks[j].vx
            vy = marks[j].vy
        else:
            vx = traffic.speeds[j - first, 0]
            vy = traffic.speeds[j - first, 1]
        vx -= marks[k].vx
        vy -= marks[k].vy
        near = bodies[k, RADIUS] + bodies[j, RADIUS]
        far = near + FAR * row.range + math.sqrt(vx * vx + vy * vy) * row.foresight
        away2 = rx * rx + ry * ry
        if away2 > far * far or away2 == 0.0:
            continue
        away = math.sqrt(away2)
        share = max(away - near, NEAREST) / away
        fx, fy = repulsion(
            rx * share,
            ry * share,
            vx,
            vy,
            row.foresight,
            row.repulsion,
            row.range,
        )
        # Reduced by (8) outside the field of view of a walker that looks along e.
        seen = -(ex * fx + ey * fy) >= row.cos_view * math.sqrt(fx * fx + fy * fy)
        weight = 1.0 if seen else row.behind
        ax += weight * fx
        ay += weight * fy
    return ax, ay


@kernel(inline=True)
def _from_walls(k: int, traffic: Traffic) -> tuple[float, float]:
    body = traffic.bodies[k]
    row = traffic.plans[k]
    ax = 0.0
    ay = 0.0
    far = body[RADIUS] + FAR * row.wall_range
    for wall in traffic.walls:
        dx, dy, away2 = find_wall(body[X], body[Y], wall)
        if 0.0 < away2 < far * far:
            away = math.sqrt(away2)
            gap = max(away - body[RADIUS], 0.0)
            size = row.wall_repulsion / row.wall_range * math.exp(-gap / row.wall_range)
            ax -= size * dx / away
            ay -= size * dy / away
    away = map_distance(body[X], body[Y], traffic.grid)
    if away < far:
        dx, dy = map_direction(body[X], body[Y], traffic.grid)
        gap = max(away - body[RADIUS], 0.0)
        size = row.wall_repulsion / row.wall_range * math.exp(-gap / row.wall_range)
        ax -= size * dx
        ay -= size * dy
    return ax, ay


@kernel
def _choose_goal(
    mark: Record, k: int, traffic: Traffic, seed: int, counter: int
) -> float:
    """Draw walker k's next goal, in free space if possible; return its distance [m]."""
    body = traffic.bodies[k]
    field = traffic.field
    room = body[RADIUS] + ROOM
    wide = max((field[2] - field[0]) / 2.0 - body[RADIUS] - ROOM, 0.0)
    deep = max((field[3] - field[1]) / 2.0 - body[RADIUS] - ROOM, 0.0)
    away = 0.0
    for i in range(CANDIDATES):
        right = random.uniform(seed, random.MOTION_STREAM, counter + 2 * i)
        up = random.uniform(seed, random.MOTION_STREAM, counter + 2 * i + 1)
        mark.goal_x = (field[0] + field[2]) / 2.0 + (2.0 * right - 1.0) * wide
        mark.goal_y = (field[1] + field[3]) / 2.0 + (2.0 * up - 1.0) * deep
        away = math.hypot(mark.goal_x - body[X], mark.goal_y - body[Y])
        is_far = away >= LEAST_WALK
        if is_far and clearance(mark.goal_x, mark.goal_y, k, traffic) >= room:
            break
    return away


@kernel(inline=True)
def _walk(k: int, n: int, traffic: Traffic, data: State) -> tuple[float, float]:
    """Return the next velocity of walker k in `map` [m/s]; makes < `DRAWS` draws."""
    seed = data.seeds[n]
    step = data.steps[n]
    counter = ((step + 1) * MOST + k) * DRAWS
    mark = data.marks[n, k]
    row = traffic.plans[k]
    body = traffic.bodies[k]
    period = traffic.period
    x = body[X]
    y = body[Y]
    away = math.hypot(mark.goal_x - x, mark.goal_y - y)
    if step >= mark.until or away < ARRIVED:
        away = _choose_goal(mark, k, traffic, seed, counter + 4)
        mark.until = step + (2.0 * away / mark.speed + PATIENCE) / period
    ex = 0.0
    ey = 0.0
    if away > 0.0:
        ex = (mark.goal_x - x) / away
        ey = (mark.goal_y - y) / away
    ax, ay = _from_bodies(k, ex, ey, data.marks[n], traffic)
    bx, by = _from_walls(k, traffic)
    ax += bx + (mark.speed * ex - mark.vx) / row.relaxation
    ay += by + (mark.speed * ey - mark.vy) / row.relaxation
    if row.fluctuation > 0.0:
        ax += row.fluctuation * random.normal(seed, random.MOTION_STREAM, counter // 2)
        ay += row.fluctuation * random.normal(
            seed, random.MOTION_STREAM, counter // 2 + 1
        )
    size = math.hypot(ax, ay)
    share = period * min(1.0, STRONGEST / size) if size > 0.0 else 0.0
    vx = mark.vx + share * ax
    vy = mark.vy + share * ay
    fast = math.hypot(vx, vy)
    if fast > row.fastest:
        vx = vx * row.fastest / fast
        vy = vy * row.fastest / fast
    return vx, vy


@kernel
def map_distance(x: float, y: float, grid: MapField) -> float:
    """Distance from a point to the static map [m], bilinear between the centres of cells."""
    distances = grid.distances
    rows, columns = distances.shape
    if rows < 2 or columns < 2:
        return np.inf
    u, v = in_grid(x, y, grid)
    u = u / grid.cell - 0.5
    v = v / grid.cell - 0.5
    u = min(max(u, 0.0), columns - 1.0)
    v = min(max(v, 0.0), rows - 1.0)
    j = min(int(u), columns - 2)
    i = min(int(v), rows - 2)
    if distances[i, j] == np.inf:
        return np.inf
    u -= j
    v -= i
    low = distances[i, j] * (1.0 - u) + distances[i, j + 1] * u
    high = distances[i + 1, j] * (1.0 - u) + distances[i + 1, j + 1] * u
    return low * (1.0 - v) + high * v


@kernel
def map_direction(x: float, y: float, grid: MapField) -> tuple[float, float]:
    """Unit vector to the nearest point of the static map; zero where there is none."""
    step = 0.5 * grid.cell
    gx = map_distance(x - step, y, grid) - map_distance(x + step, y, grid)
    gy = map_distance(x, y - step, grid) - map_distance(x, y + step, grid)
    length = math.hypot(gx, gy)
    if not 0.0 < length < np.inf:
        return 0.0, 0.0
    return gx / length, gy / length


@kernel
def clearance(x: float, y: float, k: int, traffic: Traffic) -> float:
    """Distance from a point to the nearest object except body k [m]."""
    bodies = traffic.bodies
    walls = traffic.walls
    field = traffic.field
    least = min(min(x - field[0], field[2] - x), min(y - field[1], field[3] - y))
    for w in range(len(walls)):
        ox, oy, away2 = find_wall(x, y, walls[w])
        if least > 0.0 and 0.0 < away2 < least * least:
            least = math.sqrt(away2)
    for j in range(len(bodies)):
        if j != k and bodies[j, RADIUS] > 0.0:
            ox = bodies[j, X] - x
            oy = bodies[j, Y] - y
            reach = least + bodies[j, RADIUS]
            away2 = ox * ox + oy * oy
            if reach > 0.0 and 0.0 < away2 < reach * reach:
                least = math.sqrt(away2) - bodies[j, RADIUS]
    return min(least, map_distance(x, y, traffic.grid))


@kernel
def _hold(
    dx: float,
    dy: float,
    nx: float,
    ny: float,
    room: float,
    bend: bool,
) -> tuple[float, float]:
    """Limit a displacement along n to `room`, by deflecting or shortening it."""
    ahead = dx * nx + dy * ny
    room = max(room - SLACK, 0.0)
    if ahead <= room:
        return dx, dy
    if bend:
        return dx - (ahead - room) * nx, dy - (ahead - room) * ny
    return dx * (room / ahead), dy * (room / ahead)


@kernel
def _hold_bodies(
    dx: float,
    dy: float,
    k: int,
    traffic: Traffic,
    bend: bool,
) -> tuple[float, float]:
    bodies = traffic.bodies
    first = traffic.first
    speeds = traffic.speeds
    period = traffic.period
    x = bodies[k, X]
    y = bodies[k, Y]
    radius = bodies[k, RADIUS]
    length = math.sqrt(dx * dx + dy * dy)
    for j in range(len(bodies)):
        if j == k or bodies[j, RADIUS] <= 0.0:
            continue
        ox = bodies[j, X] - x
        oy = bodies[j, Y] - y
        near = radius + bodies[j, RADIUS]
        step = 0.0
        if j >= first:
            vx = speeds[j - first, 0]
            vy = speeds[j - first, 1]
            step = math.sqrt(vx * vx + vy * vy) * period
            near += ROBOT_GAP
        reach = near + 2.0 * (length + SLACK) + step
        away2 = ox * ox + oy * oy
        if away2 >= reach * reach or away2 == 0.0:
            continue
        away = math.sqrt(away2)
        nx = ox / away
        ny = oy / away
        room = away - near
        if j >= first:
            towards = speeds[j - first, 0] * nx + speeds[j - first, 1] * ny
            room += min(towards, 0.0) * period
        elif traffic.plans[j].kind != STILL:
            room *= 0.5
        dx, dy = _hold(dx, dy, nx, ny, room, bend)
    return dx, dy


@kernel
def _hold_walls(
    dx: float,
    dy: float,
    body: Array,
    traffic: Traffic,
    bend: bool,
) -> tuple[float, float]:
    radius = body[RADIUS]
    reach = radius + math.sqrt(dx * dx + dy * dy) + 2.0 * SLACK
    for side, bound in ((-1.0, 0), (1.0, 2)):
        room = side * traffic.field[bound] - radius - side * body[X]
        dx, dy = _hold(dx, dy, side, 0.0, room, bend)
        room = side * traffic.field[bound + 1] - radius - side * body[Y]
        dx, dy = _hold(dx, dy, 0.0, side, room, bend)
    for wall in traffic.walls:
        ox, oy, away2 = find_wall(body[X], body[Y], wall)
        if 0.0 < away2 < reach * reach:
            away = math.sqrt(away2)
            dx, dy = _hold(dx, dy, ox / away, oy / away, away - radius, bend)
    return dx, dy


@kernel
def _hold_map(
    dx: float,
    dy: float,
    body: Array,
    grid: MapField,
    bend: bool,
) -> tuple[float, float]:
    x = body[X]
    y = body[Y]
    radius = body[RADIUS]
    length = math.sqrt(dx * dx + dy * dy)
    clearance = map_distance(x, y, grid) - radius
    if clearance - SLACK > length or length == 0.0:
        return dx, dy
    nx, ny = map_direction(x, y, grid)
    if bend:
        return _hold(dx, dy, nx, ny, clearance, True)
    if clearance <= SLACK and dx * nx + dy * ny <= 0.0 and nx * nx + ny * ny > 0.0:
        # In contact with the map, it may only move where the clearance does not decrease.
        if map_distance(x + dx, y + dy, grid) - radius >= clearance:
            return dx, dy
        return 0.0, 0.0
    free = _find_free_part(dx, dy, length, body, grid)
    return dx * free, dy * free


@kernel
def _find_free_part(
    dx: float, dy: float, length: float, body: Array, grid: MapField
) -> float:
    """Return the part of a displacement, from 0 to 1, before a body touches the map."""
    free = 0.0
    way = 0.0
    room = map_distance(body[X], body[Y], grid) - body[RADIUS]
    finest = FINEST * grid.cell / length
    while way < 1.0:
        way = min(way + max(room / length, finest), 1.0)
        x = body[X] + dx * way
        y = body[Y] + dy * way
        room = map_distance(x, y, grid) - body[RADIUS]
        if room < SLACK:
            break
        free = way
    for _ in range(HALVINGS if free < way else 0):
        middle = 0.5 * (free + way)
        x = body[X] + dx * middle
        y = body[Y] + dy * middle
        if map_distance(x, y, grid) - body[RADIUS] < SLACK:
            way = middle
        else:
            free = middle
    return free


@kernel(inline=True)
def restrain(
    dx: float,
    dy: float,
    k: int,
    traffic: Traffic,
    bends: bool,
) -> tuple[float, float]:
    """Return the feasible part of a displacement [m]; obstacle k slides if `bends`."""
    body = traffic.bodies[k]
    for _ in range(PASSES if bends else 0):
        wished_x = dx
        wished_y = dy
        dx, dy = _hold_bodies(dx, dy, k, traffic, True)
        dx, dy = _hold_walls(dx, dy, body, traffic, True)
        dx, dy = _hold_map(dx, dy, body, traffic.grid, True)
        if dx == wished_x and dy == wished_y:
            break
    # Shortening keeps the limits that are already met, so all are met afterwards.
    dx, dy = _hold_bodies(dx, dy, k, traffic, False)
    dx, dy = _hold_walls(dx, dy, body, traffic, False)
    return _hold_map(dx, dy, body, traffic.grid, False)
