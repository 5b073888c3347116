"""Compiled pedestrians: the social force model of Helbing and Molnar (1995).

"Social force model for pedestrian dynamics", Phys. Rev. E 51, 4282; the numbers of equations are
theirs. A walker is driven towards its goal (2), repelled by others along ellipses that think
their next step ahead (3, 4) and by walls (5), less by what is out of sight (8), and disturbed by
a fluctuation. Bodies are discs of any size, so distances are between surfaces. The step that is
thought ahead is that of the relative motion (Johansson, Helbing, Shukla 2007): with the other's
alone, a walker sees a robot that stands in its way too late, and pushes against it.
"""

from __future__ import annotations

import math

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim import motion_layout as at
from nics_drl_bridge.sim.separation_kernels import clearance, map_direction, map_distance, on_wall

NEAREST = 1e-3
"""Least distance that a force is computed for [m]: at 0 it has no direction."""
FAR = 8.0
"""Beyond so many ranges a force is nothing."""
STRONGEST = 5.0
"""Greatest acceleration [m/s^2]: people do no more, and the model's grows without bound."""
ARRIVED = 0.3
"""A goal is reached within this distance [m]."""
ROOM = 0.2
"""Free space around a walker at a new goal [m]."""
LEAST_WALK = 1.0
"""A new goal is at least so far away [m], if such a one is found."""
PATIENCE = 5.0
"""A walker gives a goal up after twice the time that the straight way takes, and so many s."""
TRIES = 16


@kernel(allocates=True)
def repulsion(rx, ry, vx, vy, foresight, strength, reach):  # type: ignore[no-untyped-def]
    """The force (3, 4) of another walker; 2 b = sqrt((|r| + |r - v dt|)^2 - (v dt)^2).

    Args:
        rx, ry: from the other to this one [m], not zero.
        vx, vy: velocity of the other, relative to this one [m/s].
        foresight: dt [s].
        strength: V0 [m^2/s^2].
        reach: sigma [m].

    Returns:
        Acceleration [m/s^2], - V0 grad exp(-b / sigma).
    """
    sx, sy = vx * foresight, vy * foresight
    qx, qy = rx - sx, ry - sy
    one, two = math.sqrt(rx * rx + ry * ry), max(math.sqrt(qx * qx + qy * qy), NEAREST)
    both = one + two
    b = 0.5 * math.sqrt(max(both * both - sx * sx - sy * sy, NEAREST * NEAREST))
    if b > FAR * reach:
        return 0.0, 0.0
    size = strength / reach * math.exp(-b / reach) * both / (4.0 * b)
    return size * (rx / one + qx / two), size * (ry / one + qy / two)


@kernel(allocates=True)
def _sight(ex, ey, fx, fy, row):  # type: ignore[no-untyped-def]
    """The weight (8) of a force on a walker that looks along e: 1, or less from behind."""
    seen = -(ex * fx + ey * fy) >= row[at.VIEW] * math.sqrt(fx * fx + fy * fy)
    return 1.0 if seen else row[at.BEHIND]


@kernel(allocates=True)
def _from_bodies(k, ex, ey, bodies, marks, first, speeds, row):  # type: ignore[no-untyped-def]
    """The forces of all other bodies on walker k: walkers, obstacles, robots."""
    ax, ay = 0.0, 0.0
    for j in range(bodies.shape[0]):
        if j == k or bodies[j, 5] <= 0.0:
            continue
        rx, ry = bodies[k, 0] - bodies[j, 0], bodies[k, 1] - bodies[j, 1]
        if j < first:
            vx, vy = marks[j, at.VX], marks[j, at.VY]
        else:
            vx, vy = speeds[j - first, 0], speeds[j - first, 1]
        vx, vy = vx - marks[k, at.VX], vy - marks[k, at.VY]
        near = bodies[k, 5] + bodies[j, 5]
        far = near + FAR * row[at.RANGE] + math.sqrt(vx * vx + vy * vy) * row[at.FORESIGHT]
        away2 = rx * rx + ry * ry
        if away2 > far * far or away2 == 0.0:
            continue
        away = math.sqrt(away2)
        share = max(away - near, NEAREST) / away
        fx, fy = repulsion(
            rx * share, ry * share, vx, vy, row[at.FORESIGHT], row[at.REPULSION], row[at.RANGE]
        )
        weight = _sight(ex, ey, fx, fy, row)
        ax, ay = ax + weight * fx, ay + weight * fy
    return ax, ay


@kernel(allocates=True)
def _from_walls(x, y, radius, walls, distances, row):  # type: ignore[no-untyped-def]
    """The forces (5) of the nearest point of each wall, and of the static map."""
    ax, ay, reach = 0.0, 0.0, row[at.WALL_RANGE]
    far = radius + FAR * reach
    for w in range(walls.shape[0]):
        px, py = on_wall(x, y, walls[w])
        ox, oy = x - px, y - py
        away2 = ox * ox + oy * oy
        if 0.0 < away2 < far * far:
            away = math.sqrt(away2)
            size = row[at.WALL_REPULSION] / reach * math.exp(-max(away - radius, 0.0) / reach)
            ax, ay = ax + size * ox / away, ay + size * oy / away
    away = map_distance(x, y, distances)
    if away < far:
        nx, ny = map_direction(x, y, distances)
        size = row[at.WALL_REPULSION] / reach * math.exp(-max(away - radius, 0.0) / reach)
        ax, ay = ax - size * nx, ay - size * ny
    return ax, ay


@kernel(allocates=True)
def _new_goal(mark, k, scene, seed, counter, step, period):  # type: ignore[no-untyped-def]
    """Draws where walker k goes next; the last draw stands if none is free."""
    bodies, _, half, _ = scene
    x, y, radius = bodies[k, 0], bodies[k, 1], bodies[k, 5]
    wide, deep = max(half[0] - radius - ROOM, 0.0), max(half[1] - radius - ROOM, 0.0)
    for i in range(TRIES):
        gx = (2.0 * random.uniform(seed, random.MOTION_STREAM, counter + 2 * i) - 1.0) * wide
        gy = (2.0 * random.uniform(seed, random.MOTION_STREAM, counter + 2 * i + 1) - 1.0) * deep
        mark[at.GOAL_X], mark[at.GOAL_Y] = gx, gy
        if math.hypot(gx - x, gy - y) >= LEAST_WALK:
            free, _, _ = clearance(gx, gy, k, scene)
            if free >= radius + ROOM:
                break
    way = math.hypot(mark[at.GOAL_X] - x, mark[at.GOAL_Y] - y)
    mark[at.UNTIL] = step + (2.0 * way / mark[at.SPEED] + PATIENCE) / period


@kernel(allocates=True)
def walk(marks, k, scene, first, speeds, row, seed, counter, step, period):  # type: ignore[no-untyped-def]
    """The velocity that walker k takes up, and its goal in its row of marks.

    Args:
        marks: (K, F) of this world, columns as in `motion_layout`.
        scene, first, speeds: see `separation_kernels`.
        row: (P,) the walker's plan.
        seed, counter: of the random draws; it takes fewer than 64.
        step: periods since the reset.
        period: [s].

    Returns:
        vx, vy in `map` [m/s].
    """
    bodies, walls, _, distances = scene
    mark, x, y = marks[k], bodies[k, 0], bodies[k, 1]
    away = math.hypot(mark[at.GOAL_X] - x, mark[at.GOAL_Y] - y)
    if step >= mark[at.UNTIL] or away < ARRIVED:
        _new_goal(mark, k, scene, seed, counter + 4, step, period)
        away = math.hypot(mark[at.GOAL_X] - x, mark[at.GOAL_Y] - y)
    ex, ey = 0.0, 0.0
    if away > 0.0:
        ex, ey = (mark[at.GOAL_X] - x) / away, (mark[at.GOAL_Y] - y) / away
    ax, ay = _from_bodies(k, ex, ey, bodies, marks, first, speeds, row)
    bx, by = _from_walls(x, y, bodies[k, 5], walls, distances, row)
    ax += bx + (mark[at.SPEED] * ex - mark[at.VX]) / row[at.RELAXATION]
    ay += by + (mark[at.SPEED] * ey - mark[at.VY]) / row[at.RELAXATION]
    if row[at.FLUCTUATION] > 0.0:
        ax += row[at.FLUCTUATION] * random.normal(seed, random.MOTION_STREAM, counter // 2)
        ay += row[at.FLUCTUATION] * random.normal(seed, random.MOTION_STREAM, counter // 2 + 1)
    size = math.hypot(ax, ay)
    share = period * min(1.0, STRONGEST / size) if size > 0.0 else 0.0
    vx, vy = mark[at.VX] + share * ax, mark[at.VY] + share * ay
    fast = math.hypot(vx, vy)
    if fast > row[at.SPEED_HIGH]:
        vx, vy = vx * row[at.SPEED_HIGH] / fast, vy * row[at.SPEED_HIGH] / fast
    return vx, vy
