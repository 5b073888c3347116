"""Compiled simulation step: advances the worlds of a part by one control period.

`step_worlds` queues the commands, then takes the worlds in blocks, one lane for each robot:

1. `_begin_period_of_world` saves the robots' poses and chooses the obstacles'
   velocities.
2. `move_freely` moves all robots of the block side by side and ignores contacts.
3. `_move_world` keeps that motion for robots that cannot touch anything, adds their
   drift, and moves the obstacles. If a robot may touch something, `_move_carefully`
   moves and drifts it instead, from its old pose, see `contact_kernels`.
4. `_measure_world` measures the odometry.
5. Each robot scans, and its lidar's faults are applied, see `sensing_kernels`.

`begin_episodes` takes the first scans, once robots and obstacles are in place. `begin_period` and
`end_period` are steps 1, 4 and 5 for worlds whose robots another engine moves.

A world is bit-identical in any batch, part or thread: nothing is summed over worlds,
and random numbers depend only on the world's own seed and counter.

Shared arguments: `packed` is a `state.Part`, packed by `kernels.pack`; n is a world, m a
robot in it; the robot's lane is `first_lane` + m.
"""

import math
from typing import Any

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, X, Y
from nics_drl_bridge.lidar.map_kernels import cells_of, walls_of
from nics_drl_bridge.robot import kernels as robot
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import obstacle_kernels as obstacles
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim.collision_kernels import (
    MOVED,
    put_in_order,
    sort_into_cells,
)
from nics_drl_bridge.sim.contact_kernels import FREE, ContactWorld
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
    ODOM,
    ODOM_TWIST,
    POSE,
    TRUE_TWIST,
    Array,
    Dynamics,
    Integers,
    Lanes,
    MapField,
    Part,
    Single,
    State,
    Surroundings,
    WorldSetArrays,
)

# Minimum number of robots that are scanned before their scans are distorted; this few
# scans fit into the L2 cache.
ROBOTS_PER_BATCH = 48


@kernel(allocates=True)
def step_worlds(packed: Any, commands: Array, first_world: int) -> None:
    """Step the worlds of a part from `first_world` on, one for each row of commands (n, M, C)."""
    _step_part(packed.content, commands, first_world)


@kernel(allocates=True)
def begin_episodes(packed: Any, chosen: Integers) -> None:
    """Take the first scans in worlds `chosen` (n,), where everything is in place and at rest."""
    part = packed.content
    for i in range(len(chosen)):
        n = chosen[i]
        part.scans.waiting[i] = n
        scene = get_surroundings(n, part.world_set)
        if part.world_set.moves:
            obstacles.reset_marks(n, part.data, scene.plans)
        _sort_bodies(n, scene, part)
    sensing.scan_together(len(chosen), part)
    for n in chosen:
        sensing.distort_scans(n, n + 1, part)


@kernel(allocates=True)
def sort_worlds(packed: Any, first_world: int, end_world: int) -> None:
    """Sort the bodies of worlds [first_world, end_world) into cells."""
    part = packed.content
    for n in range(first_world, end_world):
        _sort_bodies(n, get_surroundings(n, part.world_set), part)


@kernel(allocates=True)
def begin_period(packed: Any) -> None:
    """Begin a period of worlds whose robots another engine moves."""
    part = packed.content
    for n in range(len(part.data.pose)):
        _begin_period_of_world(n, 0, part)


@kernel(allocates=True)
def end_period(
    packed: Any,
    true_twist: Array,
    wheel_start: Array,
    wheel_end: Array,
    wheel_twist: Array,
) -> None:
    """Measure what the robots sense at the end of a period in which another engine moved them.

    Args:
        packed: the part, with robots and obstacles at their poses at the end of the
            period.
        true_twist: (N, M, 3) body twist at the end of the period.
        wheel_start: (N, M, 3) pose by wheel odometry without noise, at the start of the
            period.
        wheel_end: (N, M, 3) the same pose at the end.
        wheel_twist: (N, M, 3) body twist by the wheels at the end.
    """
    part = packed.content
    data = part.data
    waiting_count = 0
    for n in range(len(data.pose)):
        data.steps[n] += 1
        for m in range(data.pose.shape[1]):
            start = wheel_start[n, m]
            end = wheel_end[n, m]
            contacts.put_body(
                data.bodies[n, data.velocity.shape[1] + m], data.pose[n, m]
            )
            sensing.measure_odometry(
                n, m, start, end, wheel_twist[n, m], data, part.motion
            )
            # The lidar moves with the true pose, not with wheel odometry.
            sensing.record_truth(n, m, data.pose[n, m], true_twist[n, m], data)
        _sort_bodies(n, get_surroundings(n, part.world_set), part)
        waiting_count = sensing.scan_or_wait(n, waiting_count, part)
    sensing.scan_together(waiting_count, part)
    sensing.distort_scans(0, len(data.pose), part)


@kernel
def _step_part(part: Part, commands: Array, first_world: int) -> None:
    """Step some worlds, see `step_worlds`.

    Several worlds are scanned together, because a single scan is too short to keep the
    processor busy. This function is separate from `step_worlds`, where numba would
    count references to the part's arrays, which takes longer than the step.
    """
    data = part.data
    robots = data.pose.shape[1]
    end_world = first_world + len(commands)
    _queue_commands(data.history, commands, first_world, part.motion.terms.curves)
    # A block fills the lanes. In a shorter last block, the other lanes are moved to no effect.
    worlds_per_block = part.lanes.pose.shape[1] // robots
    for block_begin in range(first_world, end_world, worlds_per_block):
        block_end = min(block_begin + worlds_per_block, end_world)
        for n in range(block_begin, block_end):
            _begin_period_of_world(n, (n - block_begin) * robots, part)
        move_freely(block_begin, block_end, data, part.motion, part.lanes)
        waiting_count = np.int64(0)
        first_to_distort = block_begin
        for n in range(block_begin, block_end):
            data.steps[n] += 1
            first_lane = (n - block_begin) * robots
            scene = get_surroundings(n, part.world_set)
            _move_world(n, first_lane, scene, part)
            _measure_world(n, first_lane, scene, part)
            waiting_count = sensing.scan_or_wait(n, waiting_count, part)
            is_last = n + 1 == block_end
            if is_last or (n + 1 - first_to_distort) * robots >= ROBOTS_PER_BATCH:
                sensing.scan_together(waiting_count, part)
                sensing.distort_scans(first_to_distort, n + 1, part)
                waiting_count = np.int64(0)
                first_to_distort = n + 1


@kernel
def _queue_commands(
    history: Array, commands: Array, first_world: int, curves: Array
) -> None:
    """Put the effects of commands (n, M, C) in front of the earlier ones, history (N, M, H, C)."""
    for i in range(len(commands)):
        for m in range(commands.shape[1]):
            queue = history[first_world + i, m]
            for h in range(len(queue) - 1, 0, -1):
                for c in range(commands.shape[2]):
                    queue[h, c] = queue[h - 1, c]
            for c in range(commands.shape[2]):
                queue[0, c] = robot.apply_curve(commands[i, m, c], curves[c])


@kernel(inline=True)
def _begin_period_of_world(n: int, first_lane: int, part: Part) -> None:
    """Save the robots' poses; choose the velocities of the obstacles.

    If an episode begins, also record its start, with the robots at rest.
    """
    data = part.data
    speeds = part.contact.speeds
    newest = data.steps[n] % data.past.shape[2]
    for m in range(data.pose.shape[1]):
        pose = data.pose[n, m]
        for i in range(3):
            part.scans.start_poses[first_lane + m, i] = pose[i]
        row = data.past[n, m, newest]
        if data.steps[n] == 0:
            for i in range(3):
                row[POSE + i] = pose[i]
                row[TRUE_TWIST + i] = 0.0
                row[ODOM + i] = data.odom[n, m, i]
                row[ODOM_TWIST + i] = data.twist[n, m, i]
        if part.world_set.moves:
            vx = row[TRUE_TWIST]
            vy = row[TRUE_TWIST + 1]
            c = math.cos(pose[2])
            s = math.sin(pose[2])
            speeds[m, 0] = c * vx - s * vy
            speeds[m, 1] = s * vx + c * vy
    if part.world_set.moves:
        scene = get_surroundings(n, part.world_set)
        obstacles.steer(n, data, scene, part.motion.dt * part.motion.substeps, speeds)


@kernel(inline=True)
def _measure_world(n: int, first_lane: int, scene: Surroundings, part: Part) -> None:
    """Put the robots' bodies at their present poses, and measure their odometry.

    In a crowd, the cells also record how far a body moved.
    """
    data = part.data
    motion = part.motion
    single = part.single
    frame = part.cells.frame
    for m in range(data.pose.shape[1]):
        pose = data.pose[n, m]
        start = part.scans.start_poses[first_lane + m]
        contacts.put_body(data.bodies[n, data.velocity.shape[1] + m], pose)
        # the twist at the end of the period
        compute_rates(n, m, motion.substeps - 1, data, motion, single)
        sensing.measure_odometry(n, m, start, pose, single.dq, data, motion)
        sensing.record_truth(n, m, pose, single.dq, data)
        # The cells must know how far any body may have moved since it was sorted.
        if scene.crowded:
            dx = pose[0] - start[0]
            dy = pose[1] - start[1]
            moved = math.sqrt(dx * dx + dy * dy)
            frame[n, MOVED] = max(frame[n, MOVED], moved)


@kernel
def _sort_bodies(n: int, scene: Surroundings, part: Part) -> None:
    """Sort the bodies of world n into cells, or its static obstacles by cell."""
    bodies = part.data.bodies[n]
    cells = part.cells
    if scene.crowded:
        sort_into_cells(n, bodies, len(bodies), cells)
    elif scene.standing:
        spare = part.scans.bodies
        put_in_order(n, bodies, part.data.velocity.shape[1], spare, cells)


@kernel(view=True)
def get_surroundings(n: int, world_set: WorldSetArrays) -> Surroundings:
    """Return the walls, map and motions of world n, from the member that it copies."""
    member = world_set.fixtures.member[n]
    frame = world_set.fixtures.frames[member]
    distances = cells_of(world_set.distances, world_set.map_places[member])
    grid = MapField(distances, frame[0], frame[1], frame[2], frame[3], frame[4])
    return Surroundings(
        walls_of(n, world_set.fixtures),
        grid,
        world_set.outlines,
        world_set.crowded,
        world_set.standing,
        world_set.plans[member],
        world_set.waypoints,
        world_set.bounds[member],
    )


@kernel(inline=True)
def _move_world(n: int, first_lane: int, scene: Surroundings, part: Part) -> None:
    """Move robots and obstacles of world n, after `move_freely`; let the robots drift."""
    data = part.data
    motion = part.motion
    lanes = part.lanes
    start = part.contact.start
    obstacles_move = _find_what_is_near(n, first_lane, scene, part)
    if obstacles_move:
        for k in range(len(start)):
            for i in range(3):
                start[k, i] = data.bodies[n, k, i]
    any_may_touch = False
    for m in range(data.pose.shape[1]):
        if part.contact.may_touch[m] != FREE:
            any_may_touch = True
            continue
        lane = first_lane + m
        pose = data.pose[n, m]
        pose[0] = lanes.pose[LANE_X, lane]
        pose[1] = lanes.pose[LANE_Y, lane]
        pose[2] = robot.wrap(lanes.pose[LANE_HEADING, lane])
        for i in range(data.state.shape[2]):
            data.state[n, m, i] = lanes.x[i, lane]
        ahead, left, turn = apply_drift(n, m, data, motion)
        if ahead != 0.0 or left != 0.0 or turn != 0.0:
            c = math.cos(pose[2])
            s = math.sin(pose[2])
            pose[0], pose[1], _, _ = robot.move(
                pose[0], pose[1], c, s, ahead, left, turn, 1.0, motion.series
            )
            pose[2] = robot.wrap(pose[2] + turn)
    if any_may_touch:
        _move_carefully(n, obstacles_move, scene, part)
    elif obstacles_move:
        period = motion.dt * motion.substeps
        contacts.move_obstacles(data.bodies, start, data.velocity, n, period)


@kernel(inline=True)
def _find_what_is_near(
    n: int, first_lane: int, scene: Surroundings, part: Part
) -> bool:
    """Find what each robot may touch; return True if an obstacle moves."""
    data = part.data
    lane_poses = part.lanes.pose
    contact = part.contact
    reach = contact.reach
    cells = part.cells
    first = data.velocity.shape[1]
    period = part.motion.dt * part.motion.substeps
    longest = 0.0  # path of any body
    obstacles_move = False
    for k in range(0 if scene.standing else first):
        reach[k] = data.bodies[n, k, RADIUS]
        vx = data.velocity[n, k, 0]
        vy = data.velocity[n, k, 1]
        moves = vx != 0.0 or vy != 0.0 or data.velocity[n, k, 2] != 0.0
        if moves and reach[k] > 0.0:
            moved = math.sqrt(vx * vx + vy * vy) * period
            reach[k] += moved
            longest = max(longest, moved)
            obstacles_move = True
    for m in range(data.pose.shape[1]):
        # Each component is uniform, hence at most sqrt(3) standard deviations.
        sum_of_deviations = data.noise[n, m, DRIFT_X] + data.noise[n, m, DRIFT_Y]
        path = lane_poses[LANE_PATH, first_lane + m]
        path += math.sqrt(3.0 * period) * sum_of_deviations
        reach[first + m] = data.bodies[n, first + m, RADIUS] + path
        longest = max(longest, path)
    if scene.crowded:
        sort_into_cells(n, data.bodies[n], data.bodies.shape[1], cells)
        cells.frame[n, MOVED] = longest
    for m in range(data.pose.shape[1]):
        contact.may_touch[m] = contacts.find_near(
            n, m, data.bodies, scene, contact.near, reach, cells
        )
    return obstacles_move


@kernel(inline=True)
def _move_carefully(
    n: int, obstacles_move: bool, scene: Surroundings, part: Part
) -> None:
    """Move the obstacles of a world and the robots that may touch something.

    These robots also drift. Without contact, such a robot moves exactly as in
    `move_freely`.
    """
    data = part.data
    motion = part.motion
    single = part.single
    contact = part.contact
    may_touch = contact.may_touch
    stops = contact.stops
    period = motion.dt * motion.substeps
    world = ContactWorld(
        data.bodies[n],
        data.velocity[n],
        data.velocity.shape[1],
        scene,
        contact,
        data.collided[n],
        motion.series,
        period,
    )
    stops[:] = period
    for m in range(len(may_touch)):
        if may_touch[m] != FREE:
            contacts.put_body(world.bodies[world.first + m], data.pose[n, m])
            contact.motions[m].room = 0.0
    for j in range(motion.substeps):
        for m in range(len(may_touch)):
            if may_touch[m] != FREE:
                compute_rates(n, m, j, data, motion, single)
                dq = single.dq
                contacts.start_motion(m, dq[0], dq[1], dq[2], world)
                for s in range(data.state.shape[2]):
                    now = data.state[n, m, s]
                    bounds = robot.get_bounds(motion.terms, s)
                    data.state[n, m, s] = robot.advance_state(
                        now, dq[3 + s], motion.dt, bounds
                    )
        contacts.advance(j * motion.dt, motion.dt, obstacles_move, world)
    drifts = False
    for m in range(len(may_touch)):
        if may_touch[m] != FREE:
            ahead, left, turn = apply_drift(n, m, data, motion)
            contacts.start_motion(m, ahead, left, turn, world)
            drifts = drifts or ahead != 0.0 or left != 0.0 or turn != 0.0
    if drifts:  # the drift is applied as a twist over one second; the obstacles stay
        contacts.advance(motion.substeps * motion.dt, 1.0, False, world)
    for m in range(len(may_touch)):
        if may_touch[m] != FREE:
            body = world.bodies[world.first + m]
            data.pose[n, m, 0] = body[X]
            data.pose[n, m, 1] = body[Y]
            data.pose[n, m, 2] = robot.wrap(body[HEADING])
    # An obstacle that stopped gets its mean velocity over the period.
    for k in range(world.first if obstacles_move else 0):
        if stops[k] < period:
            for i in range(3):
                data.velocity[n, k, i] *= stops[k] / period


@kernel(inline=True)
def compute_rates(
    n: int,
    m: int,
    j: int,
    data: State,
    motion: Dynamics,
    single: Single,
) -> None:
    """Write to `single.dq` the rates of robot m in substep j, by the command then in effect."""
    size = data.state.shape[2]
    sent = data.history.shape[2]
    for s in range(size):
        single.x[s] = data.state[n, m, s]
    for c in range(data.history.shape[3]):
        delay = data.delay[n, m] + motion.terms.extra_delays[c]
        row = robot.find_delayed_command(j, delay, motion.substeps, sent)
        single.x[size + c] = data.history[n, m, row, c]
    robot.rates(
        single.dq,
        single.x,
        robot.replace_coefficients(motion.terms, data.coefficient[n, m]),
    )


@kernel(inline=True)
def apply_drift(
    n: int, m: int, data: State, motion: Dynamics
) -> tuple[float, float, float]:
    """Disturb the state of robot m; return its drift forward, left [m] and in heading [rad].

    The drift grows with the square root of time. Draws are uniform, within sqrt(3)
    standard deviations, which is cheap; the sum over several periods is close to
    normal. The state stays within the bounds of the model. Once a robot has touched
    something, it no longer drifts in that episode.
    """
    if data.collided[n, m] != 0:
        return 0.0, 0.0, 0.0
    noise = data.noise[n, m]
    seed = data.seeds[n]
    counter = data.steps[n] * data.pose.shape[1] + m
    count = len(noise) - DRIFT_X
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
    first_world: int,
    end_world: int,
    data: State,
    motion: Dynamics,
    lanes: Lanes,
) -> None:
    """Move the robots of worlds [first_world, end_world), ignoring contacts.

    The result is in the lanes: robot m of world n is in lane (n - first_world) M + m.
    The period is integrated piecewise between changes of the commands.
    """
    robots = data.pose.shape[1]
    substeps = motion.substeps
    change = lanes.change
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
            for t in range(len(lanes.coefficient)):
                lanes.coefficient[t, lane] = data.coefficient[n, m, t]
            # Each command changes once in a period, at this substep.
            for c in range(len(change)):
                delay = data.delay[n, m] + motion.terms.extra_delays[c]
                change[c, lane] = delay % substeps
    terms = robot.replace_coefficients(motion.terms, lanes.coefficient)
    substep = 0
    while substep < substeps:
        # If no further command changes, integrate to the end of the period.
        next_change = substeps
        for c in range(len(change)):
            for lane in range((end_world - first_world) * robots):
                if change[c, lane] > substep:
                    next_change = min(next_change, change[c, lane])
                if change[c, lane] == substep or substep == 0:
                    n = first_world + lane // robots
                    m = lane % robots
                    delay = data.delay[n, m] + motion.terms.extra_delays[c]
                    row = robot.find_delayed_command(
                        substep, delay, substeps, data.history.shape[2]
                    )
                    command = data.history[n, m, row, c]
                    lanes.x[data.state.shape[2] + c, lane] = command
        robot.run(
            pose,
            lanes.x,
            lanes.dq,
            terms,
            motion.series,
            motion.dt,
            next_change - substep,
        )
        substep = next_change
