"""Compiled contacts: find the robots that may touch something, and move these.

A robot whose bounding circle cannot touch anything within the period moves freely. For
the other robots, `near` lists the bodies to test in each substep. If bodies are sorted
into cells, a robot tests only those around it. In a crowd all bodies are sorted in each
period; otherwise static obstacles are sorted once per episode.

All robots that may touch something are advanced together (conservative advancement): a
step is the clearance, but at least `FLOOR`, divided by the maximum closing speed.
Within the `SKIN` around a robot, its motion is deflected so that no near point
approaches: it slides, turns and leaves. A step that would still end in an overlap is
rejected: the robot only turns, or if that does not help, stops for the rest of the
substep. An obstacle that runs into a robot stops for the rest of the period.

Shared arguments: m is a robot; `begin` is a time within the period, `time` and `end`
are times within the interval that starts there [s]. A speed of 0 gives a time of inf:
never.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SIN, X, Y
from nics_drl_bridge.robot.kernels import move, wrap
from nics_drl_bridge.sim import collision_kernels as collision
from nics_drl_bridge.sim.state import (
    Array,
    BodyCells,
    ContactScratch,
    Integers,
    Record,
    Surroundings,
)

# Bit flags for what a robot may touch
FREE = 0
BODIES = 1
WALLS = 2
MAP = 4
# What a robot may do in the rest of an interval
MOVE = 0
TURN_ONLY = 1
STAND = 2
# Maximum number of bodies listed near a robot; if there are more, all are tested
SEVERAL = 32
FLOOR = 4e-4  # Minimum distance by which a step brings two bodies closer [m]
SKIN = 2.0 * FLOOR  # Bodies nearer than this are in contact if they approach [m]
# Speed at which a body in contact is pushed to a clearance of FLOOR, as a fraction of
# its own speed
SPRING = 0.1
APPROACH = 1e-6  # An approach slower than this fraction of the speed is due to rounding
SWEEPS = 20  # Maximum number of passes over a robot's touches to deflect its motion
# Bounds on the speed of any point of a deflected robot, as multiples of its own speed
ROUND_HEADROOM = 1.2
CORNERED_HEADROOM = 1.7


class ContactWorld(NamedTuple):
    """One world with robots that may touch something in the period."""

    bodies: Array  # (K + M, 7) obstacles, then robots, at their current poses
    velocity: Array  # (K, 3) of the obstacles
    first: int  # index of the first robot
    scene: Surroundings
    scratch: ContactScratch
    touched: Array  # (M,) 1 for robots that have touched something in this episode
    series: Array  # see `robot.kernels`
    period: float  # [s]


@kernel(inline=True)
def find_near(
    n: int,
    m: int,
    bodies: Array,
    scene: Surroundings,
    near: Integers,
    reach: Array,
    cells: BodyCells,
) -> int:
    """Return flags for what robot m of world n may touch; write row m of `near`."""
    walls = scene.walls
    me = bodies.shape[1] - len(near) + m
    x = bodies[n, me, X]
    y = bodies[n, me, Y]
    own_reach = reach[me]
    count = 0
    standing_count = bodies.shape[1] - len(near) if scene.standing else 0
    for f in range(collision.find_around(n, x, y, own_reach, cells)):
        k = cells.found[f]
        other_reach = bodies[n, k, RADIUS] if k < standing_count else reach[k]
        dx = bodies[n, k, X] - x
        dy = bodies[n, k, Y] - y
        far = own_reach + other_reach
        if dx * dx + dy * dy <= far * far and k != me and other_reach > 0.0:
            # in order of the bodies, with cells or without: the bits of a contact depend on it
            i = min(count, SEVERAL)
            while count < SEVERAL and i > 0 and near[m, i] > k:
                near[m, 1 + i] = near[m, i]
                i -= 1
            if count < SEVERAL:
                near[m, 1 + i] = k
            count += 1
    near[m, 0] = count
    may_touch = BODIES if count > 0 else FREE
    for w in range(len(walls)):
        if collision.wall_distance2(x, y, walls[w]) <= own_reach * own_reach:
            may_touch |= WALLS
            break
    if (
        collision.map_bound(bodies[n, me], scene.grid)
        <= own_reach - bodies[n, me, RADIUS]
    ):
        may_touch |= MAP  # without a map, the bound is inf
    return may_touch


@kernel
def advance(
    begin: float, duration: float, obstacles_move: bool, world: ContactWorld
) -> None:
    """Move the obstacles and the robots that may touch something for a duration [s]."""
    may_touch = world.scratch.may_touch
    motions = world.scratch.motions
    robots = len(may_touch)
    fastest = _find_fastest(obstacles_move, world)
    world.scratch.fastest[0] = fastest
    # Robots that are due at nearly the same time are judged together: there are fewer steps.
    tolerance = np.inf
    for m in range(robots):
        if may_touch[m] != FREE:
            speed = motions[m].bound + fastest
            # An earlier interval may have left more clearance than this one can use up.
            is_far = motions[m].room > speed * duration
            motions[m].safe_until = np.inf if is_far else 0.0
            motions[m].room -= speed * duration
            tolerance = min(tolerance, 0.5 * FLOOR / speed)
    time = 0.0
    while time < duration:
        end = duration
        for m in range(robots):
            if may_touch[m] != FREE:
                if motions[m].safe_until <= time + tolerance:
                    _choose_motion(m, begin, time, duration - time, world)
                end = min(end, motions[m].safe_until)
        if obstacles_move:
            place_obstacles(begin + end, world)
        for m in range(robots):
            if may_touch[m] != FREE:
                _place_robot(motions[m], world.bodies[world.first + m], end, world)
        is_halted = True
        while is_halted:  # robots that would overlap something
            is_halted = False
            for m in range(robots):
                if may_touch[m] != FREE and motions[m].is_close:
                    is_halted |= _halt(m, begin, time, end, world)
        time = end


@kernel
def _find_fastest(obstacles_move: bool, world: ContactWorld) -> float:
    """Bound on the speed of anything that a robot may touch [m/s].

    A single robot only touches obstacles; one of several may also touch another robot.
    """
    may_touch = world.scratch.may_touch
    fastest = 0.0
    for k in range(world.first if obstacles_move else 0):
        vx = world.velocity[k, 0]
        vy = world.velocity[k, 1]
        rim = abs(world.velocity[k, 2]) * world.bodies[k, RADIUS]
        fastest = max(fastest, math.sqrt(vx * vx + vy * vy) + rim)
    for m in range(len(may_touch) if len(may_touch) > 1 else 0):
        if may_touch[m] != FREE:
            fastest = max(fastest, world.scratch.motions[m].bound)
    return fastest


@kernel
def find_contacts(
    m: int, limit: float, skin: float, world: ContactWorld
) -> tuple[float, int]:
    """Return a robot's clearance, up to `limit` [m], and the nearest body or -1.

    Touches within `skin` [m] are listed in `world.scratch.listed`.
    """
    scene = world.scene
    near = world.scratch.near
    may_touch = world.scratch.may_touch[m]
    listed = world.scratch.listed
    me = world.first + m
    body = collision.solid_of(me, world.bodies[me], scene.outlines)
    least = limit
    whom = -1
    listed.number[0] = 0
    if may_touch & BODIES:
        is_listed = near[m, 0] <= SEVERAL
        for i in range(near[m, 0] if is_listed else len(world.bodies)):
            k = near[m, 1 + i] if is_listed else i
            if k == me or world.bodies[k, RADIUS] <= 0.0:
                continue
            other = collision.solid_of(k, world.bodies[k], scene.outlines)
            gap = collision.find_gap(body, other, least, skin, listed)
            if gap < least:
                least = gap
                whom = k
    to_bodies = least
    if may_touch & WALLS:
        least = collision.wall_gap(body, scene.walls, least, skin, listed)
    if may_touch & MAP:
        least = collision.map_gap(body, scene.grid, least, skin, listed)
    return least, whom if least == to_bodies else -1


@kernel
def start_motion(
    m: int, vx: float, vy: float, turn: float, world: ContactWorld
) -> None:
    """Start the motion of a robot with a twist, at the beginning of an interval."""
    motion = world.scratch.motions[m]
    body = world.bodies[world.first + m]
    motion.wish_x = vx
    motion.wish_y = vy
    motion.wish_turn = turn
    motion.bound = _bound_speed(body, vx, vy, turn, world)
    motion.is_close = False
    motion.freedom = MOVE
    _change_twist(motion, body, 0.0, vx, vy, turn)


@kernel
def _bound_speed(
    body: Array, vx: float, vy: float, turn: float, world: ContactWorld
) -> float:
    """Bound on the speed of any point of a robot, even if deflected [m/s]."""
    if collision.is_round(body, world.scene.outlines):
        return ROUND_HEADROOM * math.sqrt(vx * vx + vy * vy)
    rim = turn * body[RADIUS]
    return CORNERED_HEADROOM * math.sqrt(vx * vx + vy * vy + rim * rim)


@kernel
def _change_twist(
    motion: Record,
    body: Array,
    time: float,
    vx: float,
    vy: float,
    turn: float,
) -> None:
    """Continue the motion of a robot with another twist."""
    motion.x = body[X]
    motion.y = body[Y]
    motion.heading = body[HEADING]
    motion.cos = body[COS]
    motion.sin = body[SIN]
    motion.vx = vx
    motion.vy = vy
    motion.turn = turn
    motion.since = time


@kernel
def _place_robot(motion: Record, body: Array, time: float, world: ContactWorld) -> None:
    lasted = time - motion.since
    turned = motion.turn * lasted
    body[X], body[Y], body[COS], body[SIN] = move(
        motion.x,
        motion.y,
        motion.cos,
        motion.sin,
        motion.vx,
        motion.vy,
        turned,
        lasted,
        world.series,
    )
    body[HEADING] = motion.heading + turned


@kernel
def place_obstacles(time: float, world: ContactWorld) -> None:
    """Place the obstacles at their poses at a time in the period."""
    for k in range(world.first):
        lasted = min(time, world.scratch.stops[k])
        _place_obstacle(
            world.bodies[k], world.scratch.start[k], world.velocity[k], lasted
        )


@kernel
def _place_obstacle(body: Array, start: Array, velocity: Array, time: float) -> None:
    body[X] = start[0] + velocity[0] * time
    body[Y] = start[1] + velocity[1] * time
    if velocity[2] != 0.0:
        heading = wrap(start[2] + velocity[2] * time)
        body[HEADING] = heading
        body[COS] = math.cos(heading)
        body[SIN] = math.sin(heading)


@kernel
def _find_approach(time: float, touch: Record, world: ContactWorld) -> float:
    """Velocity of what a robot touches, towards the robot, at a time in the period [m/s]."""
    k = touch.other
    if k < 0:
        return 0.0
    body = world.bodies[k]
    if k < world.first:
        if time >= world.scratch.stops[k]:
            return 0.0
        vx = world.velocity[k, 0]
        vy = world.velocity[k, 1]
        turn = world.velocity[k, 2]
    else:
        motion = world.scratch.motions[k - world.first]
        vx = body[COS] * motion.vx - body[SIN] * motion.vy
        vy = body[SIN] * motion.vx + body[COS] * motion.vy
        turn = motion.turn
    arm = (touch.x - body[X]) * touch.ny - (touch.y - body[Y]) * touch.nx
    return touch.nx * vx + touch.ny * vy + turn * arm  # type: ignore[no-any-return]


@kernel
def _choose_motion(
    m: int, begin: float, time: float, rest: float, world: ContactWorld
) -> None:
    """Choose a robot's further motion, and the time until it may touch something."""
    motion = world.scratch.motions[m]
    fastest = world.scratch.fastest[0]
    _measure_clearance(m, begin, time, rest, world)
    _stop_obstacles(m, begin + time, world)
    if motion.freedom == MOVE:
        _deflect(m, time, world)
    body = world.bodies[world.first + m]
    speed = _bound_speed(body, motion.vx, motion.vy, motion.turn, world)
    motion.safe_until = time + max(motion.gap, FLOOR) / (speed + fastest)
    if world.scratch.listed.number[0] > 0:
        pushed_until = time + FLOOR / (SPRING * motion.bound)
        motion.safe_until = min(motion.safe_until, pushed_until)


@kernel
def _measure_clearance(
    m: int, begin: float, time: float, rest: float, world: ContactWorld
) -> None:
    """Measure the clearance of a robot, and list what it touches.

    The clearance is measured as far as the robot may get in the rest of the period, so
    that `room` may show that it need not be judged in later intervals.
    """
    motion = world.scratch.motions[m]
    speed = motion.bound + world.scratch.fastest[0]
    limit = max(speed * max(rest, world.period - begin - time), SKIN)
    gap, whom = find_contacts(m, limit, SKIN, world)
    if gap < -collision.OVERLAP:
        _mark(m, whom, world)
    motion.gap = gap
    motion.room = gap - speed * rest
    motion.is_close = gap < FLOOR


@kernel
def _stop_obstacles(m: int, time: float, world: ContactWorld) -> None:
    """Stop obstacles that run into a robot; record how fast touched objects recede.

    Nothing pushes a robot: an obstacle stops, and another robot deflects its own motion.
    """
    listed = world.scratch.listed
    for touch in listed.touches[: listed.number[0]]:
        approach = _find_approach(time, touch, world)
        if 0 <= touch.other < world.first and approach > 0.0:
            world.scratch.stops[touch.other] = time
            _mark(m, touch.other, world)
        touch.other_speed = min(approach, 0.0)


@kernel
def _deflect(m: int, time: float, world: ContactWorld) -> None:
    """Deflect the motion of a robot so that it does not approach what it touches.

    Each pass removes the approach at one touch after another, by the impulse that would
    stop a ring of the robot's radius there: the robot slides without friction, and a touched
    corner turns it.
    """
    motion = world.scratch.motions[m]
    body = world.bodies[world.first + m]
    c = body[COS]
    s = body[SIN]
    vx = c * motion.wish_x - s * motion.wish_y
    vy = s * motion.wish_x + c * motion.wish_y
    turn = motion.wish_turn
    inertia = body[RADIUS] * body[RADIUS]
    is_bent = False
    listed = world.scratch.listed
    for sweep in range(SWEEPS):
        is_done = True
        for touch in listed.touches[: listed.number[0]]:
            arm = (touch.x - body[X]) * touch.ny - (touch.y - body[Y]) * touch.nx
            separation_speed = (
                touch.nx * vx + touch.ny * vy + arm * turn - touch.other_speed
            )
            if sweep == 0 and separation_speed < -APPROACH * motion.bound:
                _mark(m, touch.other, world)
            missing_speed = (
                SPRING * motion.bound * (1.0 - touch.gap / FLOOR) - separation_speed
            )
            if missing_speed > APPROACH * motion.bound:
                push = missing_speed / (1.0 + arm * arm / inertia)
                vx += push * touch.nx
                vy += push * touch.ny
                turn += push * arm / inertia
                is_done = False
                is_bent = True
        if is_done:
            break
    if is_bent:
        _change_twist(motion, body, time, c * vx + s * vy, c * vy - s * vx, turn)
    elif (
        motion.vx != motion.wish_x
        or motion.vy != motion.wish_y
        or motion.turn != motion.wish_turn
    ):
        _change_twist(
            motion, body, time, motion.wish_x, motion.wish_y, motion.wish_turn
        )


@kernel
def _mark(m: int, k: int, world: ContactWorld) -> None:
    """Mark robot m, and body k if that is a robot, as having touched something."""
    world.touched[m] = 1
    if k >= world.first:
        world.touched[k - world.first] = 1


@kernel
def _halt(m: int, begin: float, time: float, end: float, world: ContactWorld) -> bool:
    """Make a robot that overlaps something at the end of a step only turn, or stop.

    If it stands already, an obstacle that runs into it stops.

    Returns:
        True if robot or obstacle did so.
    """
    motion = world.scratch.motions[m]
    gap, whom = find_contacts(m, 0.0, 0.0, world)
    if gap >= min(motion.gap, 0.0):
        return False
    if motion.freedom == STAND:
        if 0 <= whom < world.first and world.scratch.stops[whom] > begin + time:
            world.scratch.stops[whom] = begin + time
            place_obstacles(begin + end, world)
            return True
        return False
    _mark(m, whom, world)
    body = world.bodies[world.first + m]
    turn = motion.turn if motion.freedom == MOVE else 0.0
    _place_robot(motion, body, time, world)
    _change_twist(motion, body, time, 0.0, 0.0, turn)
    _place_robot(motion, body, end, world)
    motion.freedom = TURN_ONLY if motion.freedom == MOVE else STAND
    return True


@kernel(inline=True)
def move_obstacles(
    bodies: Array,
    start: Array,
    velocity: Array,
    n: int,
    time: float,
) -> None:
    """Move the obstacles of world n to `time` [s] after their poses `start` (K, 3)."""
    for k in range(velocity.shape[1]):
        _place_obstacle(bodies[n, k], start[k], velocity[n, k], time)


@kernel(inline=True)
def put_body(body: Array, pose: Array) -> None:
    """Place a body at a pose (3,)."""
    body[X] = pose[0]
    body[Y] = pose[1]
    body[HEADING] = pose[2]
    body[COS] = math.cos(pose[2])
    body[SIN] = math.sin(pose[2])
