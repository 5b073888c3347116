"""Compiled step of the simulator: the worlds of a part, by one control period.

`step_worlds` queues the commands, then takes the worlds in blocks, one lane for each robot:

1. `_begin_period_of_block` saves the robots' poses, and chooses the velocities of the obstacles.
2. `move_freely` moves all robots of the block side by side, as if nothing stood in their way.
3. `move_world` takes that motion for robots that can meet nothing, and moves the obstacles. A robot
   that may meet something is moved carefully instead, from where it stood, see `contact_kernels`.
   All robots then drift.
4. `_measure_world` measures the odometry.
5. Each robot scans, and its lidar's faults are applied, see `sensing_kernels`.

`begin_episodes` resets worlds whose robots and obstacles are in place. `begin_period` and
`end_period` are steps 1, 4 and 5 for worlds whose robots another engine moves.

A world is bit-identical in any batch, part or thread: nothing is summed over worlds, and random
numbers depend on the world's own seed and counter alone.

Shared arguments: `packed` is a `state.Part`, packed by `kernels.pack`; n is a world, m a
robot in it; the robot's lane is `first_lane` + m.
"""

import math
from typing import Any

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import RADIUS
from nics_drl_bridge.lidar.map_kernels import cells_of, walls_of
from nics_drl_bridge.lidar.scan_kernels import LidarArrays
from nics_drl_bridge.robot import kernels as robot
from nics_drl_bridge.robot.kernels import apply_curve
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import obstacle_kernels as obstacles
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim.collision_kernels import (
    MOVED,
    is_round,
    put_in_order,
    sort_into_cells,
)
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
    POSE,
    TRUE_TWIST,
    Array,
    Dynamics,
    Integers,
    Lanes,
    MapField,
    Movers,
    Scratch,
    Single,
    State,
    Surroundings,
    WorldSetArrays,
)

# At least so many robots are scanned before their scans are distorted. So few scans stay in the L2
# cache.
SCANNED_TOGETHER = 48


@kernel(allocates=True)
def step_worlds(packed: Any, commands: Array, first_world: int) -> None:
    """Step n worlds of a part, from `first_world` on, under commands (n, M, C) for one period."""
    part = packed.content
    _step_unpacked(
        part.data,
        part.world_set,
        part.lidar,
        part.motion,
        part.scratch,
        commands,
        first_world,
    )


@kernel(allocates=True)
def begin_episodes(packed: Any, chosen: Integers) -> None:
    """Begin episodes in the worlds `chosen` (n,), where everything is in place and stands still."""
    part = packed.content
    data = part.data
    waiting = part.scratch.scans.waiting
    for i in range(chosen.shape[0]):
        waiting[i] = chosen[i]
        scene = get_surroundings(chosen[i], part.world_set)
        if part.world_set.moves:
            obstacles.reset_marks(chosen[i], data, scene.movers.plans)
        _sort_bodies(chosen[i], data, scene, part.scratch)
    sensing.scan_together(
        chosen.shape[0], data, part.world_set, part.lidar, part.scratch
    )
    for n in chosen:
        sensing.distort_scans(n, n + 1, data, part.lidar)


@kernel(allocates=True)
def sort_worlds(packed: Any, first_world: int, end_world: int) -> None:
    """Sort the bodies of worlds [first_world, end_world) of a part into cells, as they stand."""
    part = packed.content
    for n in range(first_world, end_world):
        scene = get_surroundings(n, part.world_set)
        _sort_bodies(n, part.data, scene, part.scratch)


@kernel(allocates=True)
def begin_period(packed: Any) -> None:
    """Begin a period of worlds whose robots another engine moves."""
    part = packed.content
    speeds = part.scratch.nearby.speeds
    for n in range(part.data.pose.shape[0]):
        _begin_period_of_world(n, part.data, part.world_set, part.motion, speeds)


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
        packed: the part, whose robots and obstacles stand where the period ends.
        true_twist: (N, M, 3) body twist at the end of the period.
        wheel_start: (N, M, 3) pose by the wheels alone at the start of the period.
        wheel_end: (N, M, 3) pose by the wheels alone at the end.
        wheel_twist: (N, M, 3) body twist by the wheels at the end.
    """
    part = packed.content
    data = part.data
    world_set = part.world_set
    motion = part.motion
    scratch = part.scratch
    first_robot = data.velocity.shape[1]
    waiting_count = 0
    for n in range(data.pose.shape[0]):
        data.steps[n] += 1
        past = data.past[n, :, data.steps[n] % data.past.shape[2]]
        for m in range(data.pose.shape[1]):
            contacts.put_body(data.bodies, n, first_robot + m, data.pose[n, m])
            sensing.measure_odometry(
                n,
                m,
                data,
                wheel_start[n, m],
                wheel_end[n, m],
                wheel_twist[n, m],
                motion,
            )
            # The lidar is where the robot truly is, not where the wheels say.
            for i in range(3):
                past[m, POSE + i] = data.pose[n, m, i]
                past[m, TRUE_TWIST + i] = true_twist[n, m, i]
        _sort_bodies(n, data, get_surroundings(n, world_set), scratch)
        waiting_count = sensing.scan_or_wait(
            n, waiting_count, data, world_set, part.lidar, motion, scratch
        )
    sensing.scan_together(waiting_count, data, world_set, part.lidar, scratch)
    sensing.distort_scans(0, data.pose.shape[0], data, part.lidar)


@kernel
def _step_unpacked(
    data: State,
    world_set: WorldSetArrays,
    lidar: LidarArrays,
    motion: Dynamics,
    scratch: Scratch,
    commands: Array,
    first_world: int,
) -> None:
    """Step some worlds, see `step_worlds`.

    Scans of several worlds are made together, because one lidar's scan is too short to keep the
    processor busy. This is not done in `step_worlds` itself: there numba would count references to
    the part's arrays, which takes longer than the step.
    """
    robots = data.pose.shape[1]
    end_world = first_world + commands.shape[0]
    _queue_commands(data.history, commands, first_world, motion.terms.curves)
    worlds_per_block = scratch.lanes.pose.shape[1] // robots
    for block_begin in range(first_world, end_world, worlds_per_block):
        block_end = min(block_begin + worlds_per_block, end_world)
        _begin_period_of_block(block_begin, block_end, data, world_set, motion, scratch)
        move_freely(block_begin, block_end, data, motion, scratch.lanes)
        waiting_count = np.int64(0)
        first_to_distort = block_begin
        for n in range(block_begin, block_end):
            data.steps[n] += 1
            first_lane = (n - block_begin) * robots
            scene = get_surroundings(n, world_set)
            move_world(n, first_lane, data, scene, motion, scratch)
            _measure_world(n, first_lane, data, scene, motion, scratch)
            waiting_count = sensing.scan_or_wait(
                n, waiting_count, data, world_set, lidar, motion, scratch
            )
            is_last = n + 1 == block_end
            if is_last or (n + 1 - first_to_distort) * robots >= SCANNED_TOGETHER:
                sensing.scan_together(waiting_count, data, world_set, lidar, scratch)
                sensing.distort_scans(first_to_distort, n + 1, data, lidar)
                waiting_count = np.int64(0)
                first_to_distort = n + 1


@kernel
def _queue_commands(
    history: Array, commands: Array, first_world: int, curves: Array
) -> None:
    """Put the effects of commands (n, M, C) in front of the earlier ones, history (N, M, H, C)."""
    for i in range(commands.shape[0]):
        for m in range(commands.shape[1]):
            queue = history[first_world + i, m]
            for h in range(queue.shape[0] - 1, 0, -1):
                for c in range(commands.shape[2]):
                    queue[h, c] = queue[h - 1, c]
            for c in range(commands.shape[2]):
                queue[0, c] = apply_curve(commands[i, m, c], curves[c])


@kernel(inline=True)
def _begin_period_of_block(
    first_world: int,
    end_world: int,
    data: State,
    world_set: WorldSetArrays,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    """Keep the robots' poses in worlds [first_world, end_world), and steer the obstacles."""
    robots = data.pose.shape[1]
    start_poses = scratch.scans.start_poses
    for n in range(first_world, end_world):
        for m in range(robots):
            lane = (n - first_world) * robots + m
            for i in range(3):
                start_poses[lane, i] = data.pose[n, m, i]
        _begin_period_of_world(n, data, world_set, motion, scratch.nearby.speeds)


@kernel(inline=True)
def _begin_period_of_world(
    n: int, data: State, world_set: WorldSetArrays, motion: Dynamics, speeds: Array
) -> None:
    """Record the start of an episode that begins; choose the velocities of the obstacles.

    `speeds` (M, 2) is scratch memory for the velocities of the robots in `map`.
    """
    robots = data.pose.shape[1]
    if data.steps[n] == 0:
        for m in range(robots):
            sensing.record_start(n, m, data)
    if world_set.moves:
        row = data.steps[n] % data.past.shape[2]
        for m in range(robots):
            vx = data.past[n, m, row, TRUE_TWIST]
            vy = data.past[n, m, row, TRUE_TWIST + 1]
            c = math.cos(data.pose[n, m, 2])
            s = math.sin(data.pose[n, m, 2])
            speeds[m, 0] = c * vx - s * vy
            speeds[m, 1] = s * vx + c * vy
        scene = get_surroundings(n, world_set)
        obstacles.steer(n, data, scene, motion.dt * motion.substeps, speeds)


@kernel(inline=True)
def _measure_world(
    n: int,
    first_lane: int,
    data: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    """Put the robots' bodies at their present poses, and measure their odometry."""
    frame = scratch.cells.frame
    first_robot = data.velocity.shape[1]
    for m in range(data.pose.shape[1]):
        pose = data.pose[n, m]
        start = scratch.scans.start_poses[first_lane + m]
        contacts.put_body(data.bodies, n, first_robot + m, pose)
        compute_rates(n, m, motion.substeps - 1, data, motion, scratch.single)
        sensing.measure_odometry(n, m, data, start, pose, scratch.single.dq, motion)
        # The cells must know how far any body may be from where it was sorted.
        if scene.crowded:
            dx = pose[0] - start[0]
            dy = pose[1] - start[1]
            moved = math.sqrt(dx * dx + dy * dy)
            frame[n, MOVED] = max(frame[n, MOVED], moved)


@kernel
def _sort_bodies(n: int, data: State, scene: Surroundings, scratch: Scratch) -> None:
    """Sort the bodies of world n into its cells, or its standing obstacles by cells."""
    if scene.crowded:
        sort_into_cells(n, data.bodies[n], data.bodies.shape[1], scratch.cells)
    elif scene.standing:
        obstacle_count = data.velocity.shape[1]
        spare = scratch.scans.bodies
        put_in_order(n, data.bodies[n], obstacle_count, spare, scratch.cells)


@kernel(view=True)
def get_surroundings(n: int, world_set: WorldSetArrays) -> Surroundings:
    """Return the walls, map and movers of world n: those of the world of the set that it copies."""
    member = world_set.fixtures.member[n]
    frame = world_set.fixtures.frames[member]
    distances = cells_of(world_set.distances, world_set.map_places[member])
    grid = MapField(distances, frame[0], frame[1], frame[2], frame[3], frame[4])
    movers = Movers(
        world_set.moves,
        world_set.plans[member],
        world_set.waypoints,
        world_set.bounds[member],
    )
    return Surroundings(
        walls_of(n, world_set.fixtures),
        grid,
        world_set.outlines,
        world_set.crowded,
        world_set.standing,
        movers,
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
        sort_into_cells(n, data.bodies[n], data.bodies.shape[1], scratch.cells)
        scratch.cells.frame[n, MOVED] = longest_path
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
