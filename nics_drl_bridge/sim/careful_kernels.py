"""Compiled motion of the robots of one world in tight spots, up to their contacts.

All bodies move at the same time. At the first contact, each body that approached the other stops: a
robot until the end of the substep, an obstacle until the end of the period. Then the next contact
is sought. A robot that was already in contact does not stop but is deflected: it loses the velocity
component that would bring it nearer, and keeps sliding and turning. Shared arguments: m is a robot,
until and time are in the substep [s].
"""

import math

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SHAPE, SIN, X, Y
from nics_drl_bridge.robot import kernels as robot
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import impact_kernels as impact
from nics_drl_bridge.sim.impact_kernels import (
    AFTER,
    DEPTH,
    STOP,
    TIME,
    TURN,
    VX,
    VY,
    Moving,
)
from nics_drl_bridge.sim.state import (
    DRIFT_STATE,
    DRIFT_X,
    Array,
    Dynamics,
    Nearby,
    Single,
    State,
    Surroundings,
)

SHARE = 1e-3  # A body that contributes less than this fraction of the closing speed is not stopped
SMALL = 0.1  # step, in radii, to test whether an overlapping robot moves out
MOST_MOVES = 1000


@kernel
def compute_rates(
    n: int, m: int, j: int, data: State, motion: Dynamics, single: Single
) -> None:
    """Write to `single.dq` the rates of robot m in substep j, by the command then in effect."""
    size = data.state.shape[2]
    sent = data.history.shape[2]
    for s in range(size):
        single.x[s] = data.state[n, m, s]
    for c in range(data.history.shape[3]):
        delay = data.delay[n, m] + motion.terms.late[c]
        row = robot.find_delayed_command(j, delay, motion.substeps, sent)
        single.x[size + c] = data.history[n, m, row, c]
    robot.rates(
        single.dq,
        single.x,
        robot.replace_coefficients(motion.terms, data.coefficient[n, m]),
    )


@kernel
def _fly(body: Array, base: Array, flight: Array, time: float, series: Array) -> None:
    turn = flight[TURN] * time
    body[X], body[Y], body[COS], body[SIN] = robot.move(
        base[X],
        base[Y],
        base[COS],
        base[SIN],
        flight[VX],
        flight[VY],
        turn,
        time,
        series,
    )
    body[HEADING] = base[HEADING] + turn
    body[RADIUS], body[SHAPE] = base[RADIUS], base[SHAPE]


@kernel
def _first_touch(
    m: int,
    begin: float,
    until: float,
    scene: Surroundings,
    nearby: Nearby,
    events: Array,
    moving: Moving,
) -> None:
    near = nearby.near
    world = moving.world
    meets = nearby.meets[m]
    event = events[m]
    me = moving.first + m
    event[TIME] = until
    if meets & contacts.BODIES and event[DEPTH] >= 0.0:
        listed = near[m, 0] <= contacts.SEVERAL
        for i in range(near[m, 0] if listed else world.shape[0]):
            k = near[m, 1 + i] if listed else i
            if k != me and world[k, RADIUS] > 0.0:
                impact.touch_body(event, me, k, begin, moving)
    for w in range(
        scene.walls.shape[0] if meets & contacts.WALLS and event[DEPTH] >= 0.0 else 0
    ):
        wall = scene.walls[w]
        side = impact.Edge(wall[0], wall[1], wall[2], wall[3])
        impact.touch_edge(event, me, -1, side, 0.0, begin, moving)
    if meets & contacts.MAP and event[DEPTH] >= 0.0:
        impact.touch_map(event, me, scene.grid, begin, moving)


@kernel
def _leave(
    m: int,
    until: float,
    scene: Surroundings,
    nearby: Nearby,
    single: Single,
    moving: Moving,
) -> None:
    world = moving.world
    events = single.events
    me = moving.first + m
    flight = moving.flights[me]
    path = (
        math.sqrt(flight[VX] ** 2 + flight[VY] ** 2)
        + abs(flight[TURN]) * world[me, RADIUS]
    )
    moves = int(
        min(max(math.ceil(path * until / (SMALL * world[me, RADIUS])), 1), MOST_MOVES)
    )
    flight[STOP], events[m, AFTER] = 0.0, events[m, DEPTH]
    for i in range(1, moves + 1):
        time = until if i == moves else until * i / moves
        _fly(single.trial, world[me], flight, time, moving.series)
        depth, _ = contacts.contact(
            single.trial, m, world, scene, nearby, single.spare, 0.0
        )
        if depth < events[m, AFTER]:
            break
        events[m, AFTER] = depth
        flight[STOP] = time


@kernel
def _within(p: int, b: int, until: float, moving: Moving) -> bool:
    world = moving.world
    flights = moving.flights
    a = moving.first + p
    dx = world[a, X] - world[b, X]
    dy = world[a, Y] - world[b, Y]
    paths = impact.speed_at(a, -1.0, flights) + impact.speed_at(b, -1.0, flights)
    far = world[a, RADIUS] + world[b, RADIUS] + paths * until + impact.SLACK
    return dx * dx + dy * dy <= far * far  # type: ignore[no-any-return]


@kernel
def _hold(
    m: int,
    nx: float,
    ny: float,
    px: float,
    py: float,
    time: float,
    events: Array,
    moving: Moving,
) -> None:
    """Stop the point (px, py) of robot m from moving against n, where it approaches something."""
    flight = moving.flights[moving.first + m]
    event = events[m]
    slides = (
        event[impact.PRESSED] != 0.0
        and event[DEPTH] >= 0.0
        and (nx != 0.0 or ny != 0.0)
    )
    if slides and flight[impact.HOLDS] < impact.MOST_HOLDS:
        impact.hold(moving.first + m, nx, ny, px, py, time, moving)
    else:
        flight[STOP] = min(flight[STOP], time)


@kernel
def _settle(
    until: float,
    scene: Surroundings,
    nearby: Nearby,
    events: Array,
    touched: Array,
    moving: Moving,
) -> None:
    """Stop bodies at their contacts within a substep, in order of time; mark `touched` (M,)."""
    flights = moving.flights
    first = moving.first
    meets = nearby.meets
    robots = events.shape[0]
    for m in range(robots):
        events[m, TIME] = until
        if meets[m] != contacts.FREE:
            _first_touch(m, 0.0, until, scene, nearby, events, moving)
    for _ in range(2 * moving.world.shape[0] + 2 + impact.MOST_HOLDS * robots):
        m = 0
        for p in range(1, robots):
            if events[p, TIME] < events[m, TIME]:
                m = p
        time = events[m, TIME]
        k = int(events[m, impact.WITH])
        if time >= until:
            return
        own_rate = -events[m, impact.OWN]
        other_rate = -events[m, impact.OTHERS]
        touched[m] = 1
        if k >= first:
            touched[k - first] = 1
        touch = events[m]
        nx = touch[impact.NX]
        ny = touch[impact.NY]
        if own_rate >= SHARE * (own_rate + other_rate):
            px = touch[impact.OWN_X]
            py = touch[impact.OWN_Y]
            _hold(m, nx, ny, px, py, time, events, moving)
        if k >= 0 and other_rate >= SHARE * (own_rate + other_rate):
            if k >= first:
                px = touch[impact.OTHERS_X]
                py = touch[impact.OTHERS_Y]
                _hold(k - first, -nx, -ny, px, py, time, events, moving)
            else:
                flights[k, STOP] = min(flights[k, STOP], time)
        for p in range(robots):
            if meets[p] != contacts.FREE and (
                p == m
                or _within(p, first + m, until, moving)
                or (k >= 0 and _within(p, k, until, moving))
            ):
                _first_touch(p, time, until, scene, nearby, events, moving)


@kernel
def _arrive(
    n: int,
    any_moves: bool,
    motion: Dynamics,
    data: State,
    nearby: Nearby,
    single: Single,
    moving: Moving,
) -> None:
    bodies = data.bodies[n]
    velocity = data.velocity[n]
    origin = single.origin
    for m in range(nearby.meets.shape[0]):
        if nearby.meets[m] != contacts.FREE:
            me = velocity.shape[0] + m
            body = bodies[me]
            flight = moving.flights[me]
            x, y, c, s = impact.pose_at(me, flight[STOP], moving)
            body[HEADING] += flight[TURN] * (flight[STOP] - flight[impact.FROM])
            body[X] = x
            body[Y] = y
            body[COS] = c
            body[SIN] = s
            if flight[STOP] < motion.dt or flight[impact.HOLDS] > 0.0:
                single.events[m, impact.PRESSED] = 1.0
            if single.events[m, DEPTH] < 0.0:
                single.events[m, DEPTH] = single.events[m, AFTER]
    for k in range(velocity.shape[0] if any_moves else 0):
        stop = single.flights[k, STOP]
        if stop < motion.dt:
            origin[k, 0] = bodies[k, X] + velocity[k, 0] * stop
            origin[k, 1] = bodies[k, Y] + velocity[k, 1] * stop
            origin[k, 2] = robot.wrap(bodies[k, HEADING] + velocity[k, 2] * stop)
            contacts.put_body(data.bodies, n, k, origin[k])
            velocity[k, :] = 0.0


@kernel
def move_carefully(
    n: int,
    any_moves: bool,
    data: State,
    scene: Surroundings,
    motion: Dynamics,
    nearby: Nearby,
    single: Single,
) -> None:
    """Move the robots of one world that may meet something by one period, up to their contacts.

    A robot in contact is marked and stops for the rest of the substep. Later it slides and
    turns along what it touches, as far as possible. A robot that already overlaps something gets
    no deeper. Without contact a robot moves exactly as in `step_kernels.move_freely`. An obstacle
    stopped by a robot keeps its mean velocity over the period; `any_moves` is true if any obstacle
    moves.
    """
    events = single.events
    touched = data.collided[n]
    dt = motion.dt
    first = data.velocity.shape[1]
    meets = nearby.meets
    moving = Moving(
        data.bodies[n], single.flights, first, scene.outlines, motion.series
    )
    for m in range(meets.shape[0]):
        single.flights[first + m, :] = 0.0
        if meets[m] != contacts.FREE:
            contacts.put_body(data.bodies, n, first + m, data.pose[n, m])
            _check_overlap(m, scene, nearby, single, touched, moving)
    for j in range(motion.substeps):
        if any_moves:
            contacts.move_obstacles(
                data.bodies, single.origin, data.velocity, n, j * dt
            )
        for k in range(first):
            for i in range(3):
                single.flights[k, VX + i] = data.velocity[n, k, i]
            single.flights[k, STOP] = dt
        for m in range(meets.shape[0]):
            if meets[m] != contacts.FREE:
                compute_rates(n, m, j, data, motion, single)
                flight = single.flights[first + m]
                dq = single.dq
                flight[VX], flight[VY], flight[TURN], flight[STOP] = (
                    dq[0],
                    dq[1],
                    dq[2],
                    dt,
                )
                flight[impact.FROM] = flight[impact.HOLDS] = 0.0
                for s in range(data.state.shape[2]):
                    now = data.state[n, m, s]
                    bounds = robot.get_bounds(motion.terms, s)
                    data.state[n, m, s] = robot.advance_state(
                        now, dq[3 + s], dt, bounds
                    )
                if events[m, DEPTH] < 0.0:
                    _leave(m, dt, scene, nearby, single, moving)
        _settle(dt, scene, nearby, events, touched, moving)
        _arrive(n, any_moves, motion, data, nearby, single, moving)
    if any_moves:
        period = motion.substeps * dt
        contacts.move_obstacles(data.bodies, single.origin, data.velocity, n, period)
        _average_velocities(n, period, data, single)
    for m in range(meets.shape[0]):
        if meets[m] != contacts.FREE:
            for i in range(3):
                data.pose[n, m, i] = data.bodies[n, first + m, i]


@kernel
def _check_overlap(
    m: int,
    scene: Surroundings,
    nearby: Nearby,
    single: Single,
    touched: Array,
    moving: Moving,
) -> None:
    events = single.events
    body = moving.world[moving.first + m]
    depth, whom = contacts.contact(
        body, m, moving.world, scene, nearby, single.spare, 4.0 * impact.SLACK
    )
    events[m, impact.PRESSED] = depth <= 2.0 * impact.SLACK
    events[m, DEPTH] = (
        min(depth, -np.finfo(np.float64).tiny) if depth <= impact.NOTHING else 0.0
    )
    if depth < 0.0:
        touched[m] = 1
        if whom >= moving.first:
            touched[whom - moving.first] = 1


@kernel
def _average_velocities(n: int, period: float, data: State, single: Single) -> None:
    bodies = data.bodies
    velocity = data.velocity
    origin = single.origin
    start = single.period_start
    for k in range(velocity.shape[1]):
        stopped = origin[k, 0] != start[k, 0] or origin[k, 1] != start[k, 1]
        if stopped or origin[k, 2] != start[k, 2]:
            for i in range(2):
                velocity[n, k, i] = (bodies[n, k, i] - start[k, i]) / period
            velocity[n, k, 2] = robot.wrap(bodies[n, k, HEADING] - start[k, 2]) / period


@kernel
def drift_carefully(
    n: int,
    data: State,
    scene: Surroundings,
    motion: Dynamics,
    nearby: Nearby,
    single: Single,
) -> None:
    """Let the robots of one world drift, one after the other, up to their contacts."""
    pose = data.pose
    collided = data.collided
    meets = nearby.meets
    flights = single.flights
    events = single.events
    first = data.velocity.shape[1]
    moving = Moving(data.bodies[n], flights, first, scene.outlines, motion.series)
    stood = False
    for m in range(pose.shape[1]):
        if collided[n, m] != 0:
            continue
        ahead, aside, turn = draw_drift(n, m, data, motion)
        if ahead == 0.0 and aside == 0.0 and turn == 0.0:
            continue
        stop = 1.0
        if meets[m] != contacts.FREE:
            flight = flights[first + m]
            if not stood:
                flights[:] = 0.0
                stood = True
            contacts.put_body(data.bodies, n, first + m, pose[n, m])
            flight[VX] = ahead
            flight[VY] = aside
            flight[TURN] = turn
            flight[STOP] = 1.0
            events[m, DEPTH] = 0.0
            _first_touch(m, 0.0, 1.0, scene, nearby, events, moving)
            flight[STOP] = 0.0
            if events[m, TIME] < 1.0:
                stop = events[m, TIME]
                collided[n, m] = 1
                if events[m, impact.WITH] >= first:
                    collided[n, int(events[m, impact.WITH]) - first] = 1
        x, y, _, _ = robot.move(
            pose[n, m, 0],
            pose[n, m, 1],
            math.cos(pose[n, m, 2]),
            math.sin(pose[n, m, 2]),
            ahead,
            aside,
            turn * stop,
            stop,
            motion.series,
        )
        pose[n, m, 0], pose[n, m, 1], pose[n, m, 2] = (
            x,
            y,
            robot.wrap(pose[n, m, 2] + turn * stop),
        )
        if meets[m] != contacts.FREE:
            contacts.put_body(data.bodies, n, first + m, pose[n, m])


@kernel
def draw_drift(
    n: int, m: int, data: State, motion: Dynamics
) -> tuple[float, float, float]:
    """Draw the drift of robot m in a period: ahead, left [m] and turn [rad]; move its state.

    The drift grows with root time. Draws are uniform, up to sqrt(3) standard deviations, because
    that is cheap; over some periods they add up to a normal distribution. The state stays within
    the bounds of the model.
    """
    noise = data.noise[n, m]
    seed = data.seeds[n]
    counter = data.steps[n] * data.pose.shape[1] + m
    count = noise.shape[0] - DRIFT_X
    period = motion.dt * motion.substeps
    scale = math.sqrt(12.0 * period)
    ahead = left = turn = 0.0
    for i in range(count):
        std = noise[DRIFT_X + i]
        if std <= 0.0:
            continue
        drawn = random.uniform(seed, random.DRIFT_STREAM, counter * count + i) - 0.5
        drift = scale * std * drawn
        if i == 0:
            ahead = drift
        elif i == 1:
            left = drift
        elif i == 2:
            turn = drift
        else:
            s = DRIFT_X + i - DRIFT_STATE
            low = motion.terms.low[s]
            high = motion.terms.high[s]
            data.state[n, m, s] = min(max(data.state[n, m, s] + drift, low), high)
    return ahead, left, turn
