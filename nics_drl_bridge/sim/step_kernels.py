"""Compiled inner loops of the simulator: motion, and the step of some worlds.

`_step` is one control period: queue the commands, steer what moves by itself, move all robots as if
nothing were there, redo those that meet something carefully, measure odometry, scan.

A world is bit-identical in any batch, part or thread: nothing is summed over worlds, and random
numbers depend on the world's own seed and counter alone.
"""

import math
from typing import Any

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import cell_kernels as cells
from nics_drl_bridge.lidar.baked_kernels import LidarArrays
from nics_drl_bridge.lidar.fixture_kernels import cells_of, walls_of
from nics_drl_bridge.robot.kernels import (
    apply_curve,
    find_delayed_command,
    replace_coefficients,
    run,
    wrap,
)
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import obstacle_kernels as obstacles
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim import state as records
from nics_drl_bridge.sim.careful_kernels import (
    drift_carefully,
    move_carefully,
    rates_at,
)
from nics_drl_bridge.sim.state import (
    Array,
    Dynamics,
    Lanes,
    Members,
    Scratch,
    State,
    Surroundings,
)

# Robots that are scanned together, and their scans then distorted: these stay in the L2 cache.
TOGETHER = 48


@kernel(view=True)
def surroundings_of(n: int, members: Members) -> Surroundings:
    """Return all that stands in world n of the simulation."""
    p = members.fixtures.member[n]
    frame = members.fixtures.frames[p]
    distances = cells_of(members.distances, members.fields[p])
    grid = records.MapField(distances, frame[0], frame[1], frame[2], frame[3], frame[4])
    movers = records.Movers(
        members.moves, members.plans[p], members.waypoints, members.field[p]
    )
    return Surroundings(
        walls_of(n, members.fixtures),
        grid,
        members.outlines,
        members.crowded,
        members.standing,
        movers,
    )


@kernel
def _queue_commands(history: Array, commands: Array, begin: int, curves: Array) -> None:
    """Put commands (n, M, C), by their input curves, in front of the latest ones (N, M, H, C)."""
    for i in range(commands.shape[0]):
        for m in range(commands.shape[1]):
            for h in range(history.shape[2] - 1, 0, -1):
                for c in range(commands.shape[2]):
                    history[begin + i, m, h, c] = history[begin + i, m, h - 1, c]
            for c in range(commands.shape[2]):
                history[begin + i, m, 0, c] = apply_curve(commands[i, m, c], curves[c])


@kernel
def move_freely(
    begin: int, end: int, state: State, motion: Dynamics, lanes: Lanes
) -> None:
    """Move the robots of worlds [begin, end) for one period, as if nothing stood in their way.

    The result stands in the lanes: robot m of world n is in lane (n - begin) M + m. A command takes
    effect after its delay, so that the period is integrated from one change to the next.
    """
    robots = state.pose.shape[1]
    size = state.state.shape[2]
    substeps = motion.substeps
    history = state.history
    lane_pose = lanes.pose
    x = lanes.x
    change = lanes.late
    for n in range(begin, end):
        for m in range(robots):
            lane = (n - begin) * robots + m
            heading = state.pose[n, m, 2]
            lane_pose[0, lane] = state.pose[n, m, 0]
            lane_pose[1, lane] = state.pose[n, m, 1]
            lane_pose[2, lane] = math.cos(heading)
            lane_pose[3, lane] = math.sin(heading)
            lane_pose[4, lane] = heading
            lane_pose[5, lane] = 0.0
            for s in range(size):
                x[s, lane] = state.state[n, m, s]
            for t in range(lanes.coefficient.shape[0]):
                lanes.coefficient[t, lane] = state.coefficient[n, m, t]
            # Each command changes once in a period, at this substep.
            for c in range(change.shape[0]):
                change[c, lane] = (state.delay[n, m] + motion.terms.late[c]) % substeps
    terms = replace_coefficients(motion.terms, lanes.coefficient)
    lane_count = (end - begin) * robots
    substep = 0
    while substep < substeps:
        next_change = substeps
        for c in range(change.shape[0]):
            for lane in range(lane_count):
                if change[c, lane] > substep:
                    next_change = min(next_change, change[c, lane])
                if change[c, lane] == substep or substep == 0:
                    n = begin + lane // robots
                    m = lane % robots
                    delay = state.delay[n, m] + motion.terms.late[c]
                    row = find_delayed_command(
                        substep, delay, substeps, history.shape[2]
                    )
                    x[size + c, lane] = history[n, m, row, c]
        run(
            lane_pose,
            x,
            lanes.dq,
            terms,
            motion.series,
            motion.dt,
            next_change - substep,
        )
        substep = next_change


@kernel
def _move_world(
    n: int,
    first_lane: int,
    state: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    """Move robots and obstacles of world n, after `move_freely`.

    A robot that can meet nothing in this period takes its free motion from the lanes. If any robot
    may meet something, these robots and the obstacles are moved carefully, from contact to contact.
    """
    lanes = scratch.lanes
    nearby = scratch.nearby
    single = scratch.single
    pose = state.pose
    period = motion.dt * motion.substeps
    robots = pose.shape[1]
    obstacle_count = state.velocity.shape[1]
    for m in range(robots):
        drift = math.sqrt(3.0 * period) * (state.noise[n, m, 2] + state.noise[n, m, 3])
        nearby.way[m] = lanes.pose[5, first_lane + m] + drift
    longest, obstacles_move = contacts.reaches(n, state, scene, nearby, period)
    if scene.crowded:
        cells.sort(n, state.bodies[n], state.bodies.shape[1], scratch.cells)
        scratch.cells.frame[n, cells.MOVED] = longest
    any_meets = False
    for m in range(robots):
        nearby.meets[m] = contacts.find_near(
            n, m, state.bodies, scene, nearby, scratch.cells
        )
        any_meets = any_meets or nearby.meets[m] != contacts.FREE
    for m in range(robots):
        if nearby.meets[m] == contacts.FREE:
            lane = first_lane + m
            pose[n, m, 0] = lanes.pose[0, lane]
            pose[n, m, 1] = lanes.pose[1, lane]
            pose[n, m, 2] = lanes.pose[4, lane]
            for s in range(state.state.shape[2]):
                state.state[n, m, s] = lanes.x[s, lane]
    if obstacles_move:
        for k in range(obstacle_count):
            for i in range(3):
                single.start[k, i] = single.began[k, i] = state.bodies[n, k, i]
    if any_meets:
        move_carefully(n, obstacles_move, state, scene, motion, nearby, single)
    elif obstacles_move:
        contacts.move_obstacles(state.bodies, single.start, state.velocity, n, period)
    for m in range(robots):
        pose[n, m, 2] = wrap(pose[n, m, 2])
    drift_carefully(n, state, scene, motion, nearby, single)


@kernel(allocates=True)
def step_worlds(packed: Any, commands: Array, begin: int) -> None:
    """Step n worlds of a part, from world `begin` on, under commands (n, M, C) for one period."""
    part = packed.content
    _step(
        part.state, part.members, part.lidar, part.motion, part.scratch, commands, begin
    )


@kernel
def _step(
    state: State,
    members: Members,
    lidar: LidarArrays,
    motion: Dynamics,
    scratch: Scratch,
    commands: Array,
    begin: int,
) -> None:
    """Step some worlds, see `step_worlds`.

    Worlds go through the period in blocks, as many as the lanes hold robots. Scans of several
    worlds are made together, because one lidar's scan is too short to keep the processor busy.
    A separate function from `step_worlds`: numba would count references to the part's arrays here,
    which took longer than the step.
    """
    robots = state.pose.shape[1]
    end = begin + commands.shape[0]
    _queue_commands(state.history, commands, begin, motion.terms.curves)
    worlds_per_block = scratch.lanes.pose.shape[1] // robots
    for block_begin in range(begin, end, worlds_per_block):
        block_end = min(block_begin + worlds_per_block, end)
        _begin_period(block_begin, block_end, state, members, motion, scratch)
        move_freely(block_begin, block_end, state, motion, scratch.lanes)
        worlds_to_scan = np.int64(0)
        first_to_distort = block_begin
        for n in range(block_begin, block_end):
            state.steps[n] += 1
            first_lane = (n - block_begin) * robots
            scene = surroundings_of(n, members)
            _move_world(n, first_lane, state, scene, motion, scratch)
            _measure(n, first_lane, state, scene, motion, scratch)
            worlds_to_scan = sensing.scan_or_wait(
                n, worlds_to_scan, state, members, lidar, motion, scratch
            )
            is_last = n + 1 == block_end
            if is_last or (n + 1 - first_to_distort) * robots >= TOGETHER:
                sensing.scan_together(worlds_to_scan, state, members, lidar, scratch)
                sensing.distort(first_to_distort, n + 1, state, lidar)
                worlds_to_scan = np.int64(0)
                first_to_distort = n + 1


@kernel(inline=True)
def _begin_period(
    begin: int,
    end: int,
    state: State,
    members: Members,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    """Keep the poses of worlds [begin, end) before the period, and steer what moves by itself."""
    pose = state.pose
    before = scratch.scans.before
    for n in range(begin, end):
        for m in range(pose.shape[1]):
            lane = (n - begin) * pose.shape[1] + m
            before[lane, 0] = pose[n, m, 0]
            before[lane, 1] = pose[n, m, 1]
            before[lane, 2] = pose[n, m, 2]
        _begin_world(n, state, members, motion, scratch.nearby.speeds)


@kernel(inline=True)
def _begin_world(
    n: int, state: State, members: Members, motion: Dynamics, speeds: Array
) -> None:
    """Record the start of world n's episode, if it begins, and steer what moves by itself."""
    pose = state.pose
    row = state.steps[n] % state.past.shape[2]
    for m in range(pose.shape[1]):
        if state.steps[n] == 0:
            sensing.begin(n, m, state)
        if members.moves:
            twist = state.past[n, m, row, sensing.TWIST : sensing.TWIST + 2]
            c = math.cos(pose[n, m, 2])
            s = math.sin(pose[n, m, 2])
            speeds[m, 0] = c * twist[0] - s * twist[1]
            speeds[m, 1] = s * twist[0] + c * twist[1]
    if members.moves:
        scene = surroundings_of(n, members)
        obstacles.steer(n, state, scene, motion.dt * motion.substeps, speeds)


@kernel(inline=True)
def _measure(
    n: int,
    first_lane: int,
    state: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    """Put the robots' bodies at their present poses, and measure their odometry."""
    frame = scratch.cells.frame
    pose = state.pose
    obstacle_count = state.velocity.shape[1]
    for m in range(pose.shape[1]):
        contacts.put_body(state.bodies, n, obstacle_count + m, pose[n, m])
        rates_at(n, m, motion.substeps - 1, state, motion, scratch.single)
        before = scratch.scans.before[first_lane + m]
        sensing.measure(n, m, state, pose, before, scratch.single.dq, motion)
        # The cells must know how far any body may be from where it was sorted.
        if scene.crowded:
            dx = pose[n, m, 0] - before[0]
            dy = pose[n, m, 1] - before[1]
            frame[n, cells.MOVED] = max(
                frame[n, cells.MOVED], math.sqrt(dx * dx + dy * dy)
            )


@kernel
def sort(n: int, state: State, scene: Surroundings, scratch: Scratch) -> None:
    """Sort the bodies of a world into its cells, if it has any."""
    if scene.crowded:
        cells.sort(n, state.bodies[n], state.bodies.shape[1], scratch.cells)
    elif scene.standing:
        first = state.velocity.shape[1]
        spare = scratch.scans.seen
        cells.put_in_order(n, state.bodies[n], first, spare, scratch.cells)


@kernel(allocates=True)
def sort_worlds(packed: Any, begin: int, end: int) -> None:
    """Sort the bodies of the worlds [begin, end) of a part into cells, as they stand."""
    part = packed.content
    for n in range(begin, end):
        sort(n, part.state, surroundings_of(n, part.members), part.scratch)


@kernel(allocates=True)
def begin(packed: Any, chosen: records.Integers) -> None:
    """Begin episodes in the worlds `chosen` (n,), where everything is in place and stands still."""
    part = packed.content
    state = part.state
    waiting = part.scratch.scans.waiting
    for i in range(chosen.shape[0]):
        waiting[i] = chosen[i]
        scene = surroundings_of(chosen[i], part.members)
        if part.members.moves:
            obstacles.begin(chosen[i], state, scene.movers.plans)
        sort(chosen[i], state, scene, part.scratch)
    sensing.scan_together(
        chosen.shape[0], state, part.members, part.lidar, part.scratch
    )
    for n in chosen:
        sensing.distort(n, n + 1, state, part.lidar)


@kernel(allocates=True)
def begin_period(packed: Any) -> None:
    """Begin a period of worlds whose robots another engine moves."""
    part = packed.content
    speeds = part.scratch.nearby.speeds
    for n in range(part.state.pose.shape[0]):
        _begin_world(n, part.state, part.members, part.motion, speeds)


@kernel(allocates=True)
def end_period(
    packed: Any, true: Array, before: Array, wheels: Array, counted: Array
) -> None:
    """Measure what the robots sense at the end of a period in which another engine moved them.

    Robots and obstacles stand where the period ends. The arguments are (N, M, 3): the true twist at
    the end, the pose by the wheels alone before and after, and the twist by the wheels at the end.
    """
    part = packed.content
    state = part.state
    members = part.members
    motion = part.motion
    scratch = part.scratch
    first = state.velocity.shape[1]
    waiting = 0
    for n in range(state.pose.shape[0]):
        state.steps[n] += 1
        row = state.past[n, :, state.steps[n] % state.past.shape[2]]
        for m in range(state.pose.shape[1]):
            contacts.put_body(state.bodies, n, first + m, state.pose[n, m])
            sensing.measure(n, m, state, wheels, before[n, m], counted[n, m], motion)
            for i in range(3):  # the pose by the wheels is not where the lidar is
                row[m, sensing.POSE + i] = state.pose[n, m, i]
                row[m, sensing.TWIST + i] = true[n, m, i]
        sort(n, state, surroundings_of(n, members), scratch)
        waiting = sensing.scan_or_wait(
            n, waiting, state, members, part.lidar, motion, scratch
        )
    sensing.scan_together(waiting, state, members, part.lidar, scratch)
    sensing.distort(0, state.pose.shape[0], state, part.lidar)


@kernel
def propagate(covariance: Array, before: Array, after: Array, added: Array) -> None:
    """Propagate covariances in place, see `device.propagate`: P' = F P F^T + Q."""
    for m in range(covariance.shape[0]):
        p = covariance[m]
        # F differs from the identity only in its last column.
        turned = before[m, 1] - after[m, 1], after[m, 0] - before[m, 0]
        for i in range(2):
            for j in range(3):
                p[i, j] += turned[i] * p[2, j]
        for j in range(2):
            for i in range(3):
                p[i, j] += turned[j] * p[i, 2]
        for i in range(3):
            for j in range(3):
                p[i, j] += added[i, j]
