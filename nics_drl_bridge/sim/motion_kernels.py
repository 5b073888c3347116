"""Compiled motion of the robots and obstacles of some worlds by one control period.

`move_freely` moves all robots of a block of worlds side by side, as if nothing stood in their way.
`move_world` takes that motion for robots that can meet nothing. The others are moved from where
they stood, see `contact_kernels`. Then all robots drift.
"""

import math

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import RADIUS
from nics_drl_bridge.robot import kernels as robot
from nics_drl_bridge.sim import cell_kernels as cells
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim.collision_kernels import is_round
from nics_drl_bridge.sim.contact_kernels import FREE, World
from nics_drl_bridge.sim.state import (
    DRIFT_STATE,
    DRIFT_X,
    DRIFT_Y,
    LANE_COS,
    LANE_HEADING,
    LANE_PATH,
    LANE_SIN,
    LANE_X,
    LANE_Y,
    Dynamics,
    Lanes,
    Scratch,
    Single,
    State,
    Surroundings,
)


@kernel
def move_world(
    n: int,
    first_lane: int,
    data: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    """Move robots and obstacles of world n, after `move_freely`."""
    meets = scratch.nearby.meets
    start = scratch.tight.start
    period = motion.dt * motion.substeps
    obstacles_move = _find_what_is_near(n, first_lane, data, scene, motion, scratch)
    if obstacles_move:
        for k in range(data.velocity.shape[1]):
            for i in range(3):
                start[k, i] = data.bodies[n, k, i]
    any_meets = False
    for m in range(data.pose.shape[1]):
        if meets[m] == FREE:
            _take_free_motion(n, m, first_lane + m, data, scratch.lanes)
            _drift_freely(n, m, data, motion)
        else:
            any_meets = True
    if any_meets:
        _move_carefully(n, obstacles_move, data, scene, motion, scratch)
    elif obstacles_move:
        contacts.move_obstacles(data.bodies, start, data.velocity, n, period)


@kernel(inline=True)
def _find_what_is_near(
    n: int,
    first_lane: int,
    data: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> bool:
    """Find what each robot may meet in the period; return True if an obstacle moves."""
    lanes = scratch.lanes
    nearby = scratch.nearby
    robots = data.pose.shape[1]
    period = motion.dt * motion.substeps
    for m in range(robots):
        # Each component is uniform, so at most sqrt(3) of its standard deviations.
        sum_of_deviations = data.noise[n, m, DRIFT_X] + data.noise[n, m, DRIFT_Y]
        longest_drift = math.sqrt(3.0 * period) * sum_of_deviations
        path = lanes.pose[LANE_PATH, first_lane + m]
        body = data.bodies[n, data.velocity.shape[1] + m]
        if not is_round(body, scene.outlines):
            # Where a corner touches something, a turn moves the robot away.
            turned = lanes.pose[LANE_HEADING, first_lane + m] - data.pose[n, m, 2]
            path += abs(turned) * body[RADIUS]
        nearby.path[m] = path + longest_drift
    longest_path, obstacles_move = contacts.compute_reaches(
        n, data, scene, nearby, period
    )
    if scene.crowded:
        cells.sort(n, data.bodies[n], data.bodies.shape[1], scratch.cells)
        scratch.cells.frame[n, cells.MOVED] = longest_path
    for m in range(robots):
        nearby.meets[m] = contacts.find_near(
            n, m, data.bodies, scene, nearby, scratch.cells
        )
    return obstacles_move  # type: ignore[no-any-return]


@kernel
def _move_carefully(
    n: int,
    obstacles_move: bool,
    data: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    """Move the obstacles of one world, and the robots that may meet something; let these drift.

    Without contact, such a robot moves exactly as in `move_freely`.
    """
    meets = scratch.nearby.meets
    stops = scratch.tight.stops
    dq = scratch.single.dq
    period = motion.dt * motion.substeps
    world = World(
        data.bodies[n],
        data.velocity[n],
        data.velocity.shape[1],
        scene,
        scratch.nearby,
        scratch.tight,
        data.collided[n],
        motion.series,
        period,
    )
    stops[:] = period
    for m in range(meets.shape[0]):
        if meets[m] != FREE:
            contacts.put_body(data.bodies, n, world.first + m, data.pose[n, m])
            scratch.tight.motions[m].room = 0.0
    for j in range(motion.substeps):
        for m in range(meets.shape[0]):
            if meets[m] != FREE:
                compute_rates(n, m, j, data, motion, scratch.single)
                contacts.start_motion(m, dq[0], dq[1], dq[2], world)
                for s in range(data.state.shape[2]):
                    now = data.state[n, m, s]
                    bounds = robot.get_bounds(motion.terms, s)
                    data.state[n, m, s] = robot.advance_state(
                        now, dq[3 + s], motion.dt, bounds
                    )
        contacts.advance(j * motion.dt, motion.dt, obstacles_move, world)
    _drift_carefully(n, data, motion, world)
    for m in range(meets.shape[0]):
        if meets[m] != FREE:
            for i in range(3):
                data.pose[n, m, i] = world.bodies[world.first + m, i]
            data.pose[n, m, 2] = robot.wrap(data.pose[n, m, 2])
    for k in range(world.first if obstacles_move else 0):
        if stops[k] < period:
            for i in range(3):
                data.velocity[n, k, i] *= stops[k] / period


@kernel
def _drift_carefully(n: int, data: State, motion: Dynamics, world: World) -> None:
    meets = world.nearby.meets
    drifts = False
    for m in range(meets.shape[0]):
        if meets[m] != FREE:
            ahead, left, turn = draw_drift(n, m, data, motion)
            contacts.start_motion(m, ahead, left, turn, world)
            drifts = drifts or ahead != 0.0 or left != 0.0 or turn != 0.0
    if drifts:
        contacts.advance(motion.substeps * motion.dt, 1.0, False, world)


@kernel
def _drift_freely(n: int, m: int, data: State, motion: Dynamics) -> None:
    """Let a robot drift that can meet nothing; wrap its heading."""
    pose = data.pose[n, m]
    pose[2] = robot.wrap(pose[2])
    ahead, left, turn = draw_drift(n, m, data, motion)
    if ahead != 0.0 or left != 0.0 or turn != 0.0:
        c = math.cos(pose[2])
        s = math.sin(pose[2])
        pose[0], pose[1], _, _ = robot.move(
            pose[0], pose[1], c, s, ahead, left, turn, 1.0, motion.series
        )
        pose[2] = robot.wrap(pose[2] + turn)


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
def draw_drift(
    n: int, m: int, data: State, motion: Dynamics
) -> tuple[float, float, float]:
    """Draw the drift of robot m in a period: ahead, left [m] and turn [rad]; move its state.

    The drift grows with root time. Draws are uniform, up to sqrt(3) standard deviations, because
    that is cheap; over some periods they add up to a normal distribution. The state stays within
    the bounds of the model. A robot that touches something does not drift.
    """
    if data.collided[n, m] != 0:
        return 0.0, 0.0, 0.0
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


@kernel
def move_freely(
    first_world: int, end_world: int, data: State, motion: Dynamics, lanes: Lanes
) -> None:
    """Move the robots of worlds [first_world, end_world) for one period, as if nothing stood there.

    The result is in the lanes: robot m of world n is in lane (n - first_world) M + m. The period is
    integrated from one change of a command to the next.
    """
    _fill_lanes(first_world, end_world, data, motion, lanes)
    terms = robot.replace_coefficients(motion.terms, lanes.coefficient)
    lane_count = (end_world - first_world) * data.pose.shape[1]
    substep = 0
    while substep < motion.substeps:
        next_change = _apply_commands(
            substep, first_world, lane_count, data, motion, lanes
        )
        robot.run(
            lanes.pose,
            lanes.x,
            lanes.dq,
            terms,
            motion.series,
            motion.dt,
            next_change - substep,
        )
        substep = next_change


@kernel(inline=True)
def _fill_lanes(
    first_world: int, end_world: int, data: State, motion: Dynamics, lanes: Lanes
) -> None:
    """Copy poses, states and coefficients of robots to the lanes; note when commands change."""
    robots = data.pose.shape[1]
    pose = lanes.pose
    for n in range(first_world, end_world):
        for m in range(robots):
            lane = (n - first_world) * robots + m
            heading = data.pose[n, m, 2]
            pose[LANE_X, lane] = data.pose[n, m, 0]
            pose[LANE_Y, lane] = data.pose[n, m, 1]
            pose[LANE_COS, lane] = math.cos(heading)
            pose[LANE_SIN, lane] = math.sin(heading)
            pose[LANE_HEADING, lane] = heading
            pose[LANE_PATH, lane] = 0.0
            for s in range(data.state.shape[2]):
                lanes.x[s, lane] = data.state[n, m, s]
            for t in range(lanes.coefficient.shape[0]):
                lanes.coefficient[t, lane] = data.coefficient[n, m, t]
            # Each command changes once in a period, at this substep.
            for c in range(lanes.change.shape[0]):
                delay = data.delay[n, m] + motion.terms.late[c]
                lanes.change[c, lane] = delay % motion.substeps


@kernel(inline=True)
def _apply_commands(
    substep: int,
    first_world: int,
    lane_count: int,
    data: State,
    motion: Dynamics,
    lanes: Lanes,
) -> int:
    """Put the commands that take effect at a substep into the lanes; return the next such substep.

    If no command changes any more, that is the end of the period.
    """
    robots = data.pose.shape[1]
    size = data.state.shape[2]
    substeps = motion.substeps
    change = lanes.change
    next_change = substeps
    for c in range(change.shape[0]):
        for lane in range(lane_count):
            if change[c, lane] > substep:
                next_change = min(next_change, change[c, lane])
            if change[c, lane] == substep or substep == 0:
                n = first_world + lane // robots
                m = lane % robots
                delay = data.delay[n, m] + motion.terms.late[c]
                row = robot.find_delayed_command(
                    substep, delay, substeps, data.history.shape[2]
                )
                lanes.x[size + c, lane] = data.history[n, m, row, c]
    return next_change


@kernel(inline=True)
def _take_free_motion(n: int, m: int, lane: int, data: State, lanes: Lanes) -> None:
    """Copy pose and state of a robot from its lane."""
    data.pose[n, m, 0] = lanes.pose[LANE_X, lane]
    data.pose[n, m, 1] = lanes.pose[LANE_Y, lane]
    data.pose[n, m, 2] = lanes.pose[LANE_HEADING, lane]
    for s in range(data.state.shape[2]):
        data.state[n, m, s] = lanes.x[s, lane]
