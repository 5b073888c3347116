"""Compiled motion of obstacles, each a circle: one call at reset, and one per world and period.

Columns of `marks`, plans: `separation_kernels`. Draws depend on seed, step and k alone. Pedestrians
move by the social force model of Helbing and Molnar (1995), Phys. Rev. E 51, 4282, whose equation
numbers are used: a drive towards the goal (2), repulsion by others along ellipses that anticipate
their next step (3, 4) and by walls (5), less by what is out of sight (8), and a fluctuation.
Distances are between surfaces. The anticipated step is that of the relative motion (Johansson,
Helbing, Shukla 2007): by the other's alone, a walker pushes against a robot in its way.
"""

import math

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, X, Y
from nics_drl_bridge.robot.kernels import wrap
from nics_drl_bridge.sim import separation_kernels as at
from nics_drl_bridge.sim.collision_kernels import on_wall
from nics_drl_bridge.sim.separation_kernels import Traffic
from nics_drl_bridge.sim.state import State, Surroundings

DRAWS = 64  # Maximum number of draws per obstacle and period
MOST = 10_000  # Obstacles of a world at most: draws do not depend on how many there are
TURN = 2.0  # Maximum turn rate of an obstacle [rad/s]
MOST_CORNERS = 32  # Maximum number of waypoints that a patrol passes in a period
# Minimum distance for which a force is computed [m]: at 0 it has no direction
NEAREST = 1e-3
FAR = 8.0  # Forces beyond this many ranges are neglected
STRONGEST = 5.0  # Maximum acceleration [m/s^2]: people reach no more, and the model's is unbounded
ARRIVED = 0.3  # A goal is reached within this distance [m]
ROOM = 0.2  # Free space around a walker at a new goal [m]
LEAST_WALK = 1.0  # Minimum distance of a new goal [m], if such a goal is found
# A goal is given up after twice the time of the straight path plus this [s]
PATIENCE = 5.0
CANDIDATES = 16


@kernel
def _share(seed: int, counter: int) -> float:
    return random.uniform(seed, random.MOTION_STREAM, counter)


@kernel
def reset_marks(n: int, data: State, plans: Array) -> None:
    """Reset the memory of the obstacles of world n for an episode; draw their speeds."""
    seed = data.seeds[n]
    bodies = data.bodies
    for k in range(plans.shape[0]):
        mark = data.marks[n, k]
        row = plans[k]
        mark[:] = 0.0
        if row[at.KIND] == at.STILL:
            continue
        low = row[at.SPEED_LOW]
        high = row[at.SPEED_HIGH]
        mark[at.SPEED] = low + (high - low) * _share(seed, k * DRAWS)
        mark[at.GOAL_X], mark[at.GOAL_Y] = bodies[n, k, X], bodies[n, k, Y]
        mark[at.UNTIL] = -1.0
        mark[at.WAY] = 1.0


@kernel
def steer(
    n: int, data: State, scene: Surroundings, period: float, speeds: Array
) -> None:
    """Set the obstacles' velocities for a period [s]; `speeds` (M, 2) are the robots' [m/s].

    An obstacle stays in the field, off walls and others, and off robots that keep their velocity.
    """
    velocity = data.velocity[n]
    seed = data.seeds[n]
    step = data.steps[n]
    movers = scene.movers
    count = velocity.shape[0]
    plans = movers.plans
    bodies = data.bodies[n]
    traffic = at.Traffic(
        bodies, count, speeds, plans, scene.walls, movers.bounds, scene.grid, period
    )
    draws = (step + 1) * MOST
    # walkers first: they react to the velocities of the last period
    for k in range(count):
        velocity[k, :] = 0.0
        if plans[k, at.KIND] == at.PEDESTRIAN and bodies[k, RADIUS] > 0.0:
            velocity[k, 0], velocity[k, 1] = _walk(
                data.marks[n], k, traffic, seed, (draws + k) * DRAWS, step
            )
    for k in range(count):
        kind = plans[k, at.KIND]
        mark = data.marks[n, k]
        body = bodies[k]
        if kind == at.STILL or body[RADIUS] <= 0.0:
            continue
        dx = velocity[k, 0] * period
        dy = velocity[k, 1] * period
        if kind == at.PATROL:
            dx, dy = _follow(mark, body, plans[k], movers.waypoints, period, False)
        wished_x = dx
        wished_y = dy
        dx, dy = at.restrain(dx, dy, k, traffic, kind != at.PATROL)
        if kind == at.PATROL and dx == wished_x and dy == wished_y:
            _follow(mark, body, plans[k], movers.waypoints, period, True)
        mark[at.VX] = dx / period
        mark[at.VY] = dy / period
        velocity[k, 0], velocity[k, 1] = mark[at.VX], mark[at.VY]
        if dx != 0.0 or dy != 0.0:  # it faces the direction of motion
            turn = wrap(math.atan2(dy, dx) - body[HEADING]) / period
            velocity[k, 2] = min(max(turn, -TURN), TURN)


@kernel
def _follow(
    mark: Array, body: Array, row: Array, waypoints: Array, period: float, keep: bool
) -> tuple[float, float]:
    """Displacement of a patrol along its path in a period; `keep` stores its progress."""
    index = int(mark[at.INDEX])
    way = mark[at.WAY]
    rest = mark[at.REST]
    x = body[X]
    y = body[Y]
    left = period
    for _ in range(MOST_CORNERS):
        pause = min(rest, left)
        rest = rest - pause
        left = left - pause
        if left <= 0.0:
            break
        goal = waypoints[int(row[at.FIRST]) + index]
        away = math.hypot(goal[0] - x, goal[1] - y)
        reach = mark[at.SPEED] * left
        if away > reach:
            x = x + (goal[0] - x) * reach / away
            y = y + (goal[1] - y) * reach / away
            break
        x = goal[0]
        y = goal[1]
        left = left - away / mark[at.SPEED]
        rest = row[at.PAUSE]
        if row[at.LOOP] != 0.0:
            index = (index + 1) % int(row[at.COUNT])
        else:
            way = way if 0 <= index + way < int(row[at.COUNT]) else -way
            index += int(way)
    if keep:
        mark[at.INDEX] = index
        mark[at.WAY] = way
        mark[at.REST] = rest
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


@kernel
def _from_bodies(
    k: int, ex: float, ey: float, marks: Array, traffic: Traffic
) -> tuple[float, float]:
    bodies = traffic.bodies
    first = traffic.first
    row = traffic.plans[k]
    ax = 0.0
    ay = 0.0
    for j in range(bodies.shape[0]):
        if j == k or bodies[j, RADIUS] <= 0.0:
            continue
        rx = bodies[k, X] - bodies[j, X]
        ry = bodies[k, Y] - bodies[j, Y]
        if j < first:
            vx = marks[j, at.VX]
            vy = marks[j, at.VY]
        else:
            vx = traffic.speeds[j - first, 0]
            vy = traffic.speeds[j - first, 1]
        vx = vx - marks[k, at.VX]
        vy = vy - marks[k, at.VY]
        near = bodies[k, RADIUS] + bodies[j, RADIUS]
        far = (
            near
            + FAR * row[at.RANGE]
            + math.sqrt(vx * vx + vy * vy) * row[at.FORESIGHT]
        )
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
            row[at.FORESIGHT],
            row[at.REPULSION],
            row[at.RANGE],
        )
        # Less (8) from outside the angle of sight of a walker that looks along e.
        seen = -(ex * fx + ey * fy) >= row[at.VIEW] * math.sqrt(fx * fx + fy * fy)
        weight = 1.0 if seen else row[at.BEHIND]
        ax = ax + weight * fx
        ay = ay + weight * fy
    return ax, ay


@kernel
def _from_walls(k: int, traffic: Traffic) -> tuple[float, float]:
    body = traffic.bodies[k]
    row = traffic.plans[k]
    walls = traffic.walls
    ax = 0.0
    ay = 0.0
    x = body[X]
    y = body[Y]
    radius = body[RADIUS]
    reach = row[at.WALL_RANGE]
    far = radius + FAR * reach
    for w in range(walls.shape[0]):
        px, py = on_wall(x, y, walls[w])
        ox = x - px
        oy = y - py
        away2 = ox * ox + oy * oy
        if 0.0 < away2 < far * far:
            away = math.sqrt(away2)
            size = (
                row[at.WALL_REPULSION]
                / reach
                * math.exp(-max(away - radius, 0.0) / reach)
            )
            ax = ax + size * ox / away
            ay = ay + size * oy / away
    away = at.map_distance(x, y, traffic.grid)
    if away < far:
        nx, ny = at.map_direction(x, y, traffic.grid)
        size = (
            row[at.WALL_REPULSION] / reach * math.exp(-max(away - radius, 0.0) / reach)
        )
        ax = ax - size * nx
        ay = ay - size * ny
    return ax, ay


@kernel
def _new_goal(
    mark: Array, k: int, traffic: Traffic, seed: int, counter: int, step: int
) -> None:
    body = traffic.bodies[k]
    field = traffic.field
    x = body[X]
    y = body[Y]
    radius = body[RADIUS]
    middle_x = (field[0] + field[2]) / 2.0
    middle_y = (field[1] + field[3]) / 2.0
    wide = max((field[2] - field[0]) / 2.0 - radius - ROOM, 0.0)
    deep = max((field[3] - field[1]) / 2.0 - radius - ROOM, 0.0)
    for i in range(CANDIDATES):
        gx = middle_x + (2.0 * _share(seed, counter + 2 * i) - 1.0) * wide
        gy = middle_y + (2.0 * _share(seed, counter + 2 * i + 1) - 1.0) * deep
        mark[at.GOAL_X] = gx
        mark[at.GOAL_Y] = gy
        if math.hypot(gx - x, gy - y) >= LEAST_WALK:
            free = at.clearance(gx, gy, k, traffic)
            if free >= radius + ROOM:
                break
    way = math.hypot(mark[at.GOAL_X] - x, mark[at.GOAL_Y] - y)
    mark[at.UNTIL] = step + (2.0 * way / mark[at.SPEED] + PATIENCE) / traffic.period


@kernel
def _walk(
    marks: Array, k: int, traffic: Traffic, seed: int, counter: int, step: int
) -> tuple[float, float]:
    """Return the next velocity of walker k in `map` [m/s], after fewer than `DRAWS` draws."""
    mark = marks[k]
    row = traffic.plans[k]
    body = traffic.bodies[k]
    period = traffic.period
    x = body[X]
    y = body[Y]
    away = math.hypot(mark[at.GOAL_X] - x, mark[at.GOAL_Y] - y)
    if step >= mark[at.UNTIL] or away < ARRIVED:
        _new_goal(mark, k, traffic, seed, counter + 4, step)
        away = math.hypot(mark[at.GOAL_X] - x, mark[at.GOAL_Y] - y)
    ex = 0.0
    ey = 0.0
    if away > 0.0:
        ex = (mark[at.GOAL_X] - x) / away
        ey = (mark[at.GOAL_Y] - y) / away
    ax, ay = _from_bodies(k, ex, ey, marks, traffic)
    bx, by = _from_walls(k, traffic)
    ax += bx + (mark[at.SPEED] * ex - mark[at.VX]) / row[at.RELAXATION]
    ay += by + (mark[at.SPEED] * ey - mark[at.VY]) / row[at.RELAXATION]
    if row[at.FLUCTUATION] > 0.0:
        ax += row[at.FLUCTUATION] * random.normal(
            seed, random.MOTION_STREAM, counter // 2
        )
        ay += row[at.FLUCTUATION] * random.normal(
            seed, random.MOTION_STREAM, counter // 2 + 1
        )
    size = math.hypot(ax, ay)
    share = period * min(1.0, STRONGEST / size) if size > 0.0 else 0.0
    vx = mark[at.VX] + share * ax
    vy = mark[at.VY] + share * ay
    fast = math.hypot(vx, vy)
    if fast > row[at.SPEED_HIGH]:
        vx = vx * row[at.SPEED_HIGH] / fast
        vy = vy * row[at.SPEED_HIGH] / fast
    return vx, vy
