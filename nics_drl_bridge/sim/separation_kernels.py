"""Compiled separation: a round obstacle moves no further than its free space.

Each wall, body and side of the field limits an obstacle to a half plane: along the unit vector to
the nearest point it may move by `room`. Of two that both move, each may use half of the gap, so
that neither needs to know the other's step (buffered Voronoi cells; Zhou, Wang, Bandyopadhyay,
Schwager 2017). A displacement within all half planes is free of contacts throughout the period.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y
from nics_drl_bridge.sim.collision_kernels import in_grid, on_wall
from nics_drl_bridge.sim.state import MapField

# A row of a plan (K, P): the motion of an obstacle.
(
    KIND,
    SPEED_LOW,
    SPEED_HIGH,
    FIRST,
    COUNT,
    LOOP,
    PAUSE,
    RELAXATION,
    REPULSION,
    RANGE,
    WALL_REPULSION,
    WALL_RANGE,
    FORESIGHT,
    VIEW,
    BEHIND,
    FLUCTUATION,
    PLAN,
) = range(17)
STILL, PATROL, PEDESTRIAN = range(3)  # values of the column KIND
# Memory of an obstacle, a row of marks (N, K, F).
SPEED, VX, VY, GOAL_X, GOAL_Y, UNTIL, INDEX, WAY, REST, MARK = range(10)
SLACK = 1e-6  # Margin that is never used [m]: rounding must not make two bodies touch
ROBOT_GAP = 0.1  # gap that an obstacle keeps to a robot, like people [m]; less looks like contact
# Number of times a displacement is bent before the remaining excess is shortened
PASSES = 3
FINEST = 0.25  # Minimum step along a path through a static map, in cells
HALVINGS = 8  # Number of bisections of its last step to find the end of the free path


class Traffic(NamedTuple):
    """Everything that the moving obstacles of one world keep clear of in a period."""

    bodies: Array  # (K + M, 7) obstacles, then robots
    first: int  # index of the first robot
    speeds: Array  # (M, 2) velocity of the robots in `map` [m/s]
    plans: Array  # (K, P) motions of the obstacles
    walls: Array  # (W, 4)
    field: Array  # (4,) minimum x, y and maximum x, y of the field [m]
    grid: MapField
    period: float  # [s]


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
    u = u - j
    v = v - i
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
    for w in range(walls.shape[0]):
        px, py = on_wall(x, y, walls[w])
        ox = px - x
        oy = py - y
        away2 = ox * ox + oy * oy
        if least > 0.0 and 0.0 < away2 < least * least:
            least = math.sqrt(away2)
    for j in range(bodies.shape[0]):
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
    dx: float, dy: float, nx: float, ny: float, room: float, bend: bool
) -> tuple[float, float]:
    """Limit a displacement to `room` along n: bend it, or shorten the whole."""
    ahead = dx * nx + dy * ny
    room = max(room - SLACK, 0.0)
    if ahead <= room:
        return dx, dy
    if bend:
        return dx - (ahead - room) * nx, dy - (ahead - room) * ny
    return dx * (room / ahead), dy * (room / ahead)


@kernel
def _hold_bodies(
    dx: float, dy: float, k: int, traffic: Traffic, bend: bool
) -> tuple[float, float]:
    bodies = traffic.bodies
    first = traffic.first
    speeds = traffic.speeds
    period = traffic.period
    x = bodies[k, X]
    y = bodies[k, Y]
    radius = bodies[k, RADIUS]
    length = math.sqrt(dx * dx + dy * dy)
    for j in range(bodies.shape[0]):
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
        elif traffic.plans[j, KIND] != STILL:
            room *= 0.5
        dx, dy = _hold(dx, dy, nx, ny, room, bend)
    return dx, dy


@kernel
def _hold_walls(
    dx: float, dy: float, body: Array, traffic: Traffic, bend: bool
) -> tuple[float, float]:
    x = body[X]
    y = body[Y]
    radius = body[RADIUS]
    walls = traffic.walls
    field = traffic.field
    reach = radius + math.sqrt(dx * dx + dy * dy) + 2.0 * SLACK
    for side, bound in ((-1.0, 0), (1.0, 2)):
        dx, dy = _hold(dx, dy, side, 0.0, side * field[bound] - radius - side * x, bend)
        dx, dy = _hold(
            dx, dy, 0.0, side, side * field[bound + 1] - radius - side * y, bend
        )
    for w in range(walls.shape[0]):
        px, py = on_wall(x, y, walls[w])
        ox = px - x
        oy = py - y
        away2 = ox * ox + oy * oy
        if 0.0 < away2 < reach * reach:
            away = math.sqrt(away2)
            dx, dy = _hold(dx, dy, ox / away, oy / away, away - radius, bend)
    return dx, dy


@kernel
def _hold_map(
    dx: float, dy: float, body: Array, grid: MapField, bend: bool
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
            return (dx, dy)
        return (0.0, 0.0)
    free = 0.0
    way = 0.0
    room = clearance
    finest = FINEST * grid.cell / length
    while way < 1.0:
        way = min(way + max(room / length, finest), 1.0)
        room = map_distance(x + dx * way, y + dy * way, grid) - radius
        if room < SLACK:
            break
        free = way
    for _ in range(HALVINGS if free < way else 0):
        middle = 0.5 * (free + way)
        if map_distance(x + dx * middle, y + dy * middle, grid) - radius < SLACK:
            way = middle
        else:
            free = middle
    return dx * free, dy * free


@kernel
def restrain(
    dx: float, dy: float, k: int, traffic: Traffic, bends: bool
) -> tuple[float, float]:
    """Return the part of a displacement [m] that obstacle k can make; with `bends` it slides."""
    body = traffic.bodies[k]
    for _ in range(PASSES if bends else 0):
        wished_x = dx
        wished_y = dy
        dx, dy = _hold_bodies(dx, dy, k, traffic, True)
        dx, dy = _hold_walls(dx, dy, body, traffic, True)
        dx, dy = _hold_map(dx, dy, body, traffic.grid, True)
        if dx == wished_x and dy == wished_y:
            break
    # Shortening preserves limits already met, so all are met afterwards.
    dx, dy = _hold_bodies(dx, dy, k, traffic, False)
    dx, dy = _hold_walls(dx, dy, body, traffic, False)
    return _hold_map(dx, dy, body, traffic.grid, False)
