"""Compiled separation: a round obstacle moves no further than its free space.

Each wall, body and side of the field limits an obstacle to a half plane: along the unit vector to
the nearest point it may move by `room`. Of two that both move, each may use half of the gap, so
that neither needs to know the other's step (buffered Voronoi cells; Zhou, Wang, Bandyopadhyay,
Schwager 2017). A displacement within all half planes is free of contacts throughout the period.

Shared arguments, all of one world: `bodies` (K + M, 7), see `lidar.shapes.BODY`, robots from index
`first`; `walls` (W, 4); `half` (2,) half the size of the field [m]; `distances` see
`obstacles.distance_arrays`; `scene` is (bodies, walls, half, distances).
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel

# A row of a plan (K, P): the motion of an obstacle.
(
    KIND, SPEED_LOW, SPEED_HIGH, FIRST, COUNT, LOOP, PAUSE,
    RELAXATION, REPULSION, RANGE, WALL_REPULSION, WALL_RANGE, FORESIGHT, VIEW, BEHIND,
    FLUCTUATION,
) = range(16)  # fmt: skip
PLAN = 16

# Values of the column KIND.
STILL, WANDER, PATROL, PEDESTRIAN = range(4)

# Memory of an obstacle, a row of marks (N, K, F).
SPEED, VX, VY, DIRECTION, AIM, GOAL_X, GOAL_Y, UNTIL, INDEX, WAY, REST = range(11)
MARK = 11

SLACK = 1e-6
"""Margin that is never used [m]: rounding must not make two bodies touch."""
PASSES = 3
"""Number of times a displacement is bent before the remaining excess is shortened."""
FINEST = 0.25
"""Least step along a path through a static map, in cells."""
HALVINGS = 8
"""Number of bisections of its last step to find the end of the free path."""


@kernel(allocates=True)
def on_wall(x, y, wall):  # type: ignore[no-untyped-def]
    """Returns the point of a straight wall (4,) nearest to a point."""
    ex, ey = wall[2] - wall[0], wall[3] - wall[1]
    length2 = ex * ex + ey * ey
    share = 0.0
    if length2 > 0.0:
        share = min(max(((x - wall[0]) * ex + (y - wall[1]) * ey) / length2, 0.0), 1.0)
    return wall[0] + share * ex, wall[1] + share * ey


@kernel(allocates=True)
def map_distance(x, y, distances):  # type: ignore[no-untyped-def]
    """Distance from a point to the static map [m], bilinear between the centres of cells."""
    grid, frame = distances
    rows, columns = grid.shape
    if rows < 2 or columns < 2:
        return np.inf
    dx, dy = x - frame[0], y - frame[1]
    u = (frame[2] * dx + frame[3] * dy) / frame[4] - 0.5
    v = (frame[2] * dy - frame[3] * dx) / frame[4] - 0.5
    u, v = min(max(u, 0.0), columns - 1.0), min(max(v, 0.0), rows - 1.0)
    j, i = min(int(u), columns - 2), min(int(v), rows - 2)
    if grid[i, j] == np.inf:
        return np.inf
    u, v = u - j, v - i
    low = grid[i, j] * (1.0 - u) + grid[i, j + 1] * u
    high = grid[i + 1, j] * (1.0 - u) + grid[i + 1, j + 1] * u
    return low * (1.0 - v) + high * v


@kernel(allocates=True)
def map_direction(x, y, distances):  # type: ignore[no-untyped-def]
    """Unit vector to the nearest point of the static map; zero where there is none."""
    step = 0.5 * distances[1][4]
    gx = map_distance(x - step, y, distances) - map_distance(x + step, y, distances)
    gy = map_distance(x, y - step, distances) - map_distance(x, y + step, distances)
    length = math.hypot(gx, gy)
    if not 0.0 < length < np.inf:
        return 0.0, 0.0
    return gx / length, gy / length


@kernel(allocates=True)
def clearance(x, y, k, scene):  # type: ignore[no-untyped-def]
    """Distance from a point to the nearest object except body k [m], and the unit vector to it."""
    bodies, walls, half, distances = scene
    least, nx, ny = half[0] - abs(x), math.copysign(1.0, x), 0.0
    if half[1] - abs(y) < least:
        least, nx, ny = half[1] - abs(y), 0.0, math.copysign(1.0, y)
    for w in range(walls.shape[0]):
        px, py = on_wall(x, y, walls[w])
        ox, oy = px - x, py - y
        away2 = ox * ox + oy * oy
        if least > 0.0 and 0.0 < away2 < least * least:
            least = math.sqrt(away2)
            nx, ny = ox / least, oy / least
    for j in range(bodies.shape[0]):
        if j != k and bodies[j, 5] > 0.0:
            ox, oy, reach = bodies[j, 0] - x, bodies[j, 1] - y, least + bodies[j, 5]
            away2 = ox * ox + oy * oy
            if reach > 0.0 and 0.0 < away2 < reach * reach:
                away = math.sqrt(away2)
                least, nx, ny = away - bodies[j, 5], ox / away, oy / away
    away = map_distance(x, y, distances)
    if away < least:
        nx, ny = map_direction(x, y, distances)
        least = away
    return least, nx, ny


@kernel(allocates=True)
def _hold(dx, dy, nx, ny, room, bend):  # type: ignore[no-untyped-def]
    """Limits a displacement to `room` along n.

    Either the excess along n is removed (`bend`), or the whole displacement is shortened.
    """
    ahead = dx * nx + dy * ny
    room = max(room - SLACK, 0.0)
    if ahead <= room:
        return dx, dy
    if bend:
        return dx - (ahead - room) * nx, dy - (ahead - room) * ny
    return dx * (room / ahead), dy * (room / ahead)


@kernel(allocates=True)
def _hold_bodies(dx, dy, k, bodies, first, speeds, rows, period, bend):  # type: ignore[no-untyped-def]
    """Limits the displacement of body k to the room that the other bodies leave."""
    x, y, radius = bodies[k, 0], bodies[k, 1], bodies[k, 5]
    length = math.sqrt(dx * dx + dy * dy)
    for j in range(bodies.shape[0]):
        if j == k or bodies[j, 5] <= 0.0:
            continue
        ox, oy, near = bodies[j, 0] - x, bodies[j, 1] - y, radius + bodies[j, 5]
        step = 0.0
        if j >= first:
            vx, vy = speeds[j - first, 0], speeds[j - first, 1]
            step = math.sqrt(vx * vx + vy * vy) * period
        reach = near + 2.0 * (length + SLACK) + step
        away2 = ox * ox + oy * oy
        if away2 >= reach * reach or away2 == 0.0:
            continue
        away = math.sqrt(away2)
        nx, ny, room = ox / away, oy / away, away - near
        if j >= first:
            towards = speeds[j - first, 0] * nx + speeds[j - first, 1] * ny
            room += min(towards, 0.0) * period
        elif rows[j, KIND] != STILL:
            room *= 0.5
        dx, dy = _hold(dx, dy, nx, ny, room, bend)
    return dx, dy


@kernel(allocates=True)
def _hold_walls(dx, dy, x, y, radius, walls, half, bend):  # type: ignore[no-untyped-def]
    """Limits a displacement to the field and to this side of the walls."""
    reach = radius + math.sqrt(dx * dx + dy * dy) + 2.0 * SLACK
    for side in (-1.0, 1.0):
        dx, dy = _hold(dx, dy, side, 0.0, half[0] - radius - side * x, bend)
        dx, dy = _hold(dx, dy, 0.0, side, half[1] - radius - side * y, bend)
    for w in range(walls.shape[0]):
        px, py = on_wall(x, y, walls[w])
        ox, oy = px - x, py - y
        away2 = ox * ox + oy * oy
        if 0.0 < away2 < reach * reach:
            away = math.sqrt(away2)
            dx, dy = _hold(dx, dy, ox / away, oy / away, away - radius, bend)
    return dx, dy


@kernel(allocates=True)
def _hold_map(dx, dy, x, y, radius, distances, bend):  # type: ignore[no-untyped-def]
    """Limits a displacement to keep clear of the static map, by marching along the path."""
    length = math.sqrt(dx * dx + dy * dy)
    here = map_distance(x, y, distances) - radius
    if here - SLACK > length or length == 0.0:
        return dx, dy
    nx, ny = map_direction(x, y, distances)
    if bend:
        return _hold(dx, dy, nx, ny, here, True)
    if here <= SLACK and dx * nx + dy * ny <= 0.0 and nx * nx + ny * ny > 0.0:
        # In contact with the map it may only move to where there is no less room.
        return (dx, dy) if map_distance(x + dx, y + dy, distances) - radius >= here else (0.0, 0.0)
    free, way, finest = 0.0, 0.0, FINEST * distances[1][4] / length
    room = here
    while way < 1.0:
        way = min(way + max(room / length, finest), 1.0)
        room = map_distance(x + dx * way, y + dy * way, distances) - radius
        if room < SLACK:
            break
        free = way
    for _ in range(HALVINGS if free < way else 0):
        middle = 0.5 * (free + way)
        if map_distance(x + dx * middle, y + dy * middle, distances) - radius < SLACK:
            way = middle
        else:
            free = middle
    return dx * free, dy * free


@kernel(allocates=True)
def restrain(dx, dy, k, scene, first, speeds, rows, period, bends):  # type: ignore[no-untyped-def]
    """Returns the part of a displacement [m] that body k can make within a period.

    Args:
        k: index of the body, below `first`.
        speeds: (M, 2) velocity of the robots in `map` [m/s].
        rows: (K, P) plans, which define the moving obstacles.
        period: [s].
        bends: whether it slides along obstructions or keeps its direction.
    """
    bodies, walls, half, distances = scene
    x, y, radius = bodies[k, 0], bodies[k, 1], bodies[k, 5]
    for _ in range(PASSES if bends else 0):
        wished_x, wished_y = dx, dy
        dx, dy = _hold_bodies(dx, dy, k, bodies, first, speeds, rows, period, True)
        dx, dy = _hold_walls(dx, dy, x, y, radius, walls, half, True)
        dx, dy = _hold_map(dx, dy, x, y, radius, distances, True)
        if dx == wished_x and dy == wished_y:
            break
    # Shortening preserves limits already met, so all are met afterwards.
    dx, dy = _hold_bodies(dx, dy, k, bodies, first, speeds, rows, period, False)
    dx, dy = _hold_walls(dx, dy, x, y, radius, walls, half, False)
    return _hold_map(dx, dy, x, y, radius, distances, False)
