"""Compiled contacts: which robots may touch something within a period, and what they touch.

A robot whose circle cannot meet anything within the period moves freely. For the other robots,
`near` lists the bodies to test in each substep. If bodies are sorted into cells, a robot tests only
those around it. In a crowd all bodies are sorted in each period; otherwise standing obstacles are
sorted once per episode.
"""

import math

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SIN, X, Y
from nics_drl_bridge.robot.kernels import wrap
from nics_drl_bridge.sim import collision_kernels as collision
from nics_drl_bridge.sim.cell_kernels import BodyCells, around
from nics_drl_bridge.sim.state import Array, Nearby, State, Surroundings

# Bit flags of what a robot may meet
FREE = 0
BODIES = 1
WALLS = 2
MAP = 4
# Maximum number of bodies listed near a robot; if there are more, all are tested
SEVERAL = 32


@kernel
def compute_reaches(
    n: int, data: State, scene: Surroundings, nearby: Nearby, period: float
) -> tuple[float, bool]:
    """Write to `nearby.reach` how far each body may reach in a period [s].

    Returns:
        Longest path of a body [m], and True if an obstacle moves.
    """
    reach = nearby.reach
    path = nearby.path
    bodies = data.bodies
    velocity = data.velocity
    longest = 0.0
    moving = False
    obstacles = velocity.shape[1]
    for k in range(0 if scene.standing else obstacles):
        reach[k] = bodies[n, k, RADIUS]
        vx = velocity[n, k, 0]
        vy = velocity[n, k, 1]
        if (vx != 0.0 or vy != 0.0 or velocity[n, k, 2] != 0.0) and reach[k] > 0.0:
            moved = math.sqrt(vx * vx + vy * vy) * period
            reach[k] += moved
            longest = max(longest, moved)
            moving = True
    for m in range(path.shape[0]):
        reach[obstacles + m] = bodies[n, obstacles + m, RADIUS] + path[m]
        longest = max(longest, path[m])
    return longest, moving


@kernel
def find_near(
    n: int, m: int, bodies: Array, scene: Surroundings, nearby: Nearby, cells: BodyCells
) -> int:
    """Return flags of what robot m of world n may meet; write row m of `nearby.near`."""
    near = nearby.near
    reach = nearby.reach
    walls = scene.walls
    me = bodies.shape[1] - near.shape[0] + m
    x = bodies[n, me, X]
    y = bodies[n, me, Y]
    own_reach = reach[me]
    count = 0
    standing = bodies.shape[1] - near.shape[0] if scene.standing else 0
    for i in range(around(n, x, y, own_reach, cells)):
        k = cells.found[i]
        other_reach = bodies[n, k, RADIUS] if k < standing else reach[k]
        dx = bodies[n, k, X] - x
        dy = bodies[n, k, Y] - y
        far = own_reach + other_reach
        if dx * dx + dy * dy <= far * far and k != me and other_reach > 0.0:
            if count < SEVERAL:
                near[m, 1 + count] = k
            count += 1
    near[m, 0] = count
    meets = BODIES if count > 0 else FREE
    for w in range(walls.shape[0]):
        d2 = collision.segment_distance2(
            x, y, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        )
        if d2 <= own_reach * own_reach:
            meets |= WALLS
            break
    if (
        collision.map_bound(bodies[n, me], scene.grid)
        <= own_reach - bodies[n, me, RADIUS]
    ):
        meets |= MAP  # without a map, the bound is inf
    return meets


@kernel
def contact(
    body: Array,
    m: int,
    world: Array,
    scene: Surroundings,
    nearby: Nearby,
    spare: Array,
    limit: float,
) -> tuple[float, int]:
    """Clearance [m], up to `limit`, of robot m placed as `body` (7,), and nearest body or -1."""
    outlines = scene.outlines
    near = nearby.near
    least = limit
    whom = -1
    if nearby.meets[m] & BODIES:
        me = world.shape[0] - near.shape[0] + m
        listed = near[m, 0] <= SEVERAL
        for i in range(near[m, 0] if listed else world.shape[0]):
            k = near[m, 1 + i] if listed else i
            if k == me or world[k, RADIUS] <= 0.0:
                continue
            gap = collision.body_gap(body, world[k], outlines, limit, spare)
            if gap < least:
                least = gap
                whom = k
    if nearby.meets[m] & WALLS:
        for w in range(scene.walls.shape[0]):
            gap = collision.wall_gap(body, scene.walls[w], outlines, limit, spare)
            if gap < least:
                least = gap
                whom = -1
    if nearby.meets[m] & MAP:
        gap = collision.map_gap(body, scene.grid, outlines, limit, spare)
        if gap < least:
            least = gap
            whom = -1
    return least, whom


@kernel
def move_obstacles(
    bodies: Array, start: Array, velocity: Array, n: int, time: float
) -> None:
    """Move the obstacles of world n to `time` [s] after their poses `start` (K, 3)."""
    for k in range(velocity.shape[1]):
        bodies[n, k, X] = start[k, 0] + velocity[n, k, 0] * time
        bodies[n, k, Y] = start[k, 1] + velocity[n, k, 1] * time
        if velocity[n, k, 2] != 0.0:
            heading = wrap(start[k, 2] + velocity[n, k, 2] * time)
            bodies[n, k, HEADING] = heading
            bodies[n, k, COS], bodies[n, k, SIN] = math.cos(heading), math.sin(heading)


@kernel
def put_body(bodies: Array, n: int, k: int, pose: Array) -> None:
    """Place body k of world n at a pose (3,)."""
    bodies[n, k, X], bodies[n, k, Y], bodies[n, k, HEADING] = pose[0], pose[1], pose[2]
    bodies[n, k, COS], bodies[n, k, SIN] = math.cos(pose[2]), math.sin(pose[2])
