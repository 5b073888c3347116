"""Compiled motion of obstacles: one call at reset, and one per world and control period.

Shared arguments: `marks` (N, K, F) what obstacles remember, and `plans`, the rows (K, P) and
waypoints (Q, 2) of `motion.plan_arrays`; the columns of both are in `motion_layout`. `bodies`
(N, K + M, 7), obstacles, then from index `first` the robots, see `lidar.shapes.BODY`. Of each
obstacle counts the circle that holds it. All draws are fixed by seed, step and k alone.
"""

from __future__ import annotations

import math

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim import motion_layout as at
from nics_drl_bridge.sim.pedestrian_kernels import walk
from nics_drl_bridge.sim.separation_kernels import clearance, restrain

DRAWS = 64
"""So many draws may an obstacle take in a period."""
TURN = 2.0
"""Greatest turn rate of an obstacle [rad/s]."""
LOOK = 1.0
"""A wandering obstacle looks ahead by the way of so many seconds, and its radius."""
MARGIN = 0.1
"""Free space that it keeps at its sides [m]."""
TRIES = 8
"""So many directions it looks into in one period."""
MOST_CORNERS = 32
"""More waypoints than a patrol passes in a period."""


@kernel(allocates=True)
def _wrap(angle):  # type: ignore[no-untyped-def]
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel(allocates=True)
def _share(seed, counter):  # type: ignore[no-untyped-def]
    return random.uniform(seed, random.MOTION_STREAM, counter)


@kernel(allocates=True)
def begin(marks, n, bodies, plans, half, seed):  # type: ignore[no-untyped-def]
    """Begins an episode of world n: draws the speed and the first direction of each obstacle.

    Args:
        half: (2,) half the size of the field [m].
        seed: of the episode.
    """
    rows, _ = plans
    for k in range(marks.shape[1]):
        mark, row, counter = marks[n, k], rows[k], k * DRAWS
        mark[:] = 0.0
        if row[at.KIND] == at.STILL:
            continue
        low, high = row[at.SPEED_LOW], row[at.SPEED_HIGH]
        mark[at.SPEED] = low + (high - low) * _share(seed, counter)
        mark[at.DIRECTION] = (2.0 * _share(seed, counter + 1) - 1.0) * math.pi
        mark[at.AIM] = mark[at.DIRECTION]
        mark[at.GOAL_X], mark[at.GOAL_Y] = bodies[n, k, 0], bodies[n, k, 1]
        mark[at.UNTIL], mark[at.WAY] = -1.0, 1.0


@kernel(allocates=True)
def steer(velocity, marks, n, bodies, first, speeds, plans, walls, half, seed, step, period, distances):  # type: ignore[no-untyped-def]  # fmt: skip  # noqa: E501
    """The velocities of the obstacles of world n for one control period.

    An obstacle that moves by its velocity for the period leaves neither the field nor its side
    of a wall, and touches no other obstacle; it does not run into a robot that keeps its velocity.

    Args:
        velocity: (N, K, 3) result [m/s, m/s, rad/s] in `map`; 0 of those that stand still.
        speeds: (M, 2) velocity of its robots in `map` [m/s].
        walls: (W, 4).
        half: (2,) half the size of the field [m].
        seed: of the episode.
        step: control periods since the reset, from 0 or 1.
        period: [s].
        distances: of a static map, see `motion.distance_arrays`.
    """
    rows, waypoints = plans
    count = velocity.shape[1]
    scene = (bodies[n], walls, half, distances)
    draws = (step + 1) * count
    for k in range(count):  # walkers first: they see the velocities of the period before
        velocity[n, k, :] = 0.0
        if rows[k, at.KIND] == at.PEDESTRIAN and bodies[n, k, 5] > 0.0:
            velocity[n, k, 0], velocity[n, k, 1] = walk(
                marks[n], k, scene, first, speeds, rows[k], seed, (draws + k) * DRAWS, step,
                period,
            )  # fmt: skip
    for k in range(count):
        kind, mark = rows[k, at.KIND], marks[n, k]
        if kind == at.STILL or bodies[n, k, 5] <= 0.0:
            continue
        dx, dy = velocity[n, k, 0] * period, velocity[n, k, 1] * period
        if kind == at.WANDER:
            dx, dy = _wander(mark, k, scene, seed, (draws + k) * DRAWS, period)
        elif kind == at.PATROL:
            dx, dy = _follow(mark, bodies[n, k], rows[k], waypoints, period, False)
        wished_x, wished_y = dx, dy
        dx, dy = restrain(dx, dy, k, scene, first, speeds, rows, period, kind != at.PATROL)
        if kind == at.PATROL and dx == wished_x and dy == wished_y:
            _follow(mark, bodies[n, k], rows[k], waypoints, period, True)
        mark[at.VX], mark[at.VY] = dx / period, dy / period
        velocity[n, k, 0], velocity[n, k, 1] = mark[at.VX], mark[at.VY]
        if dx != 0.0 or dy != 0.0:  # it looks where it goes
            turn = _wrap(math.atan2(dy, dx) - bodies[n, k, 2]) / period
            velocity[n, k, 2] = min(max(turn, -TURN), TURN)


@kernel(allocates=True)
def _blocked(x, y, angle, reach, here, room, k, scene):  # type: ignore[no-untyped-def]
    """Whether something is near the way ahead, and nearer than at the outset."""
    for part in (0.5, 1.0):
        way = part * reach
        free, _, _ = clearance(x + way * math.cos(angle), y + way * math.sin(angle), k, scene)
        if free < room and free < here:
            return True
    return False


@kernel(allocates=True)
def _wander(mark, k, scene, seed, counter, period):  # type: ignore[no-untyped-def]
    """Displacement of a wandering obstacle: ahead, and turning to a free direction if need be."""
    body, speed = scene[0][k], mark[at.SPEED]
    x, y, radius = body[0], body[1], body[5]
    here, nx, ny = clearance(x, y, k, scene)
    reach = LOOK * speed + radius
    aim, near = mark[at.AIM], here < reach + radius + MARGIN
    if near and _blocked(x, y, aim, reach, here, radius + MARGIN, k, scene):
        away = math.atan2(-ny, -nx)
        for i in range(TRIES):
            aim = away + (_share(seed, counter + i) - 0.5) * math.pi
            if not _blocked(x, y, aim, reach, here, radius + MARGIN, k, scene):
                break
        mark[at.AIM] = aim
    turn = _wrap(aim - mark[at.DIRECTION])
    mark[at.DIRECTION] = _wrap(mark[at.DIRECTION] + min(max(turn, -TURN * period), TURN * period))
    # It slows down to turn, so that it does not run where it did not mean to.
    way = speed * period * max(math.cos(aim - mark[at.DIRECTION]), 0.0)
    return way * math.cos(mark[at.DIRECTION]), way * math.sin(mark[at.DIRECTION])


@kernel(allocates=True)
def _follow(mark, body, row, waypoints, period, keep):  # type: ignore[no-untyped-def]
    """Displacement of a patrol along its path, by the arc length of a period.

    Args:
        keep: whether the waypoints that it passes are behind it for good.
    """
    index, way, rest = int(mark[at.INDEX]), mark[at.WAY], mark[at.REST]
    x, y, left = body[0], body[1], period
    for _ in range(MOST_CORNERS):
        pause = min(rest, left)
        rest, left = rest - pause, left - pause
        if left <= 0.0:
            break
        goal = waypoints[int(row[at.FIRST]) + index]
        away, reach = math.hypot(goal[0] - x, goal[1] - y), mark[at.SPEED] * left
        if away > reach:
            x, y = x + (goal[0] - x) * reach / away, y + (goal[1] - y) * reach / away
            break
        x, y, left, rest = goal[0], goal[1], left - away / mark[at.SPEED], row[at.PAUSE]
        index, way = _after(index, way, row)
    if keep:
        mark[at.INDEX], mark[at.WAY], mark[at.REST] = index, way, rest
    return x - body[0], y - body[1]


@kernel(allocates=True)
def _after(index, way, row):  # type: ignore[no-untyped-def]
    """The waypoint after a waypoint, and the way along the list: 1, or -1 backwards."""
    count = int(row[at.COUNT])
    if row[at.LOOP] != 0.0:
        return (index + 1) % count, 1.0
    if not 0 <= index + way < count:
        way = -way
    return index + int(way), way
