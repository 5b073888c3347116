"""Compiled inner loops of the simulator: motion, and the step of some worlds.

A world is bit-identical in any batch, part or thread: nothing is summed over worlds, and what is
drawn at random is drawn by the world's own seed and counter.
"""

import math
from typing import Any

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import cell_kernels as cells
from nics_drl_bridge.lidar.baked_kernels import LidarArrays
from nics_drl_bridge.lidar.fixture_kernels import cells_of, walls_of
from nics_drl_bridge.robot.kernels import bend, delayed, run, with_coefficients, wrap
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

TOGETHER = 48  # Robots whose scans, with their faults, are made together: they stay in the L2 cache


@kernel(view=True)
def surroundings_of(n: int, members: Members) -> Surroundings:
    """Returns all that stands in world n of the simulation."""
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
def _send(history: Array, commands: Array, begin: int, curves: Array) -> None:
    for i in range(commands.shape[0]):
        for m in range(commands.shape[1]):
            for h in range(history.shape[2] - 1, 0, -1):
                for c in range(commands.shape[2]):
                    history[begin + i, m, h, c] = history[begin + i, m, h - 1, c]
            for c in range(commands.shape[2]):
                history[begin + i, m, 0, c] = bend(commands[i, m, c], curves[c])


@kernel
def move_freely(
    begin: int, end: int, state: State, motion: Dynamics, lanes: Lanes
) -> None:
    """Moves robot m of world n of [begin, end) one period freely, in lane (n - begin) M + m."""
    robots = state.pose.shape[1]
    size = state.state.shape[2]
    substeps = motion.substeps
    history = state.history
    where = lanes.pose
    x = lanes.x
    late = lanes.late
    for n in range(begin, end):
        for m in range(robots):
            i = (n - begin) * robots + m
            heading = state.pose[n, m, 2]
            where[0, i], where[1, i] = state.pose[n, m, 0], state.pose[n, m, 1]
            where[2, i], where[3, i] = math.cos(heading), math.sin(heading)
            where[4, i] = heading
            where[5, i] = 0.0
            for s in range(size):
                x[s, i] = state.state[n, m, s]
            for t in range(lanes.coefficient.shape[0]):
                lanes.coefficient[t, i] = state.coefficient[n, m, t]
            for c in range(late.shape[0]):  # each command changes once, after this many
                late[c, i] = (state.delay[n, m] + motion.terms.late[c]) % substeps
    terms = with_coefficients(motion.terms, lanes.coefficient)
    at = 0
    used = (end - begin) * robots
    while at < substeps:
        until = substeps
        for c in range(late.shape[0]):
            for i in range(used):
                if late[c, i] > at:
                    until = min(until, late[c, i])
                if late[c, i] == at or at == 0:
                    n = begin + i // robots
                    m = i % robots
                    delay = state.delay[n, m] + motion.terms.late[c]
                    row = delayed(at, delay, substeps, history.shape[2])
                    x[size + c, i] = history[n, m, row, c]
        run(where, x, lanes.dq, terms, motion.series, motion.dt, until - at)
        at = until


@kernel
def _move_world(
    n: int,
    skip: int,
    state: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    lanes = scratch.lanes
    nearby = scratch.nearby
    single = scratch.single
    pose = state.pose
    period = motion.dt * motion.substeps
    robots = pose.shape[1]
    first = state.velocity.shape[1]
    for m in range(robots):
        drift = math.sqrt(3.0 * period) * (state.noise[n, m, 2] + state.noise[n, m, 3])
        nearby.way[m] = lanes.pose[5, skip + m] + drift
    longest, moving = contacts.reaches(n, state, scene, nearby, period)
    if scene.crowded:
        cells.sort(n, state.bodies[n], state.bodies.shape[1], scratch.cells)
        scratch.cells.frame[n, cells.MOVED] = longest
    tight = False
    for m in range(robots):
        nearby.meets[m] = contacts.find_near(
            n, m, state.bodies, scene, nearby, scratch.cells
        )
        tight = tight or nearby.meets[m] != contacts.FREE
    for m in range(robots):
        if nearby.meets[m] == contacts.FREE:
            i = skip + m
            pose[n, m, 0], pose[n, m, 1] = lanes.pose[0, i], lanes.pose[1, i]
            pose[n, m, 2] = lanes.pose[4, i]
            for s in range(state.state.shape[2]):
                state.state[n, m, s] = lanes.x[s, i]
    if moving:
        for k in range(first):
            for i in range(3):
                single.start[k, i] = single.began[k, i] = state.bodies[n, k, i]
    if tight:
        move_carefully(n, moving, state, scene, motion, nearby, single)
    elif moving:
        contacts.move_obstacles(state.bodies, single.start, state.velocity, n, period)
    for m in range(robots):
        pose[n, m, 2] = wrap(pose[n, m, 2])
    drift_carefully(n, state, scene, motion, nearby, single)


@kernel(allocates=True)
def step_worlds(packed: Any, commands: Array, begin: int) -> None:
    """Steps the worlds of a part, from `begin` on, under commands (n, M, C) for a period."""
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
    """See `step_worlds`; without reference counts, which took longer than the step."""
    many = state.pose.shape[1]
    end = begin + commands.shape[0]
    _send(state.history, commands, begin, motion.terms.curves)
    block = scratch.lanes.pose.shape[1] // many
    for low in range(begin, end, block):
        high = min(low + block, end)
        _begin_period(low, high, state, members, motion, scratch)
        move_freely(low, high, state, motion, scratch.lanes)
        waiting = np.int64(0)
        scanned = low
        for n in range(low, high):
            state.steps[n] += 1
            skip = (n - low) * many
            scene = surroundings_of(n, members)
            _move_world(n, skip, state, scene, motion, scratch)
            _measure(n, skip, state, scene, motion, scratch)
            waiting = sensing.scan_or_wait(
                n, waiting, state, members, lidar, motion, scratch
            )
            if n + 1 == high or (n + 1 - scanned) * many >= TOGETHER:
                sensing.scan_together(waiting, state, members, lidar, scratch)
                sensing.distort(scanned, n + 1, state, lidar)
                waiting = np.int64(0)
                scanned = n + 1


@kernel(inline=True)
def _begin_period(
    low: int,
    high: int,
    state: State,
    members: Members,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    pose = state.pose
    before = scratch.scans.before
    speeds = scratch.nearby.speeds
    for n in range(low, high):
        for m in range(pose.shape[1]):
            i = (n - low) * pose.shape[1] + m
            row = state.steps[n] % state.past.shape[2]
            before[i, 0], before[i, 1], before[i, 2] = (
                pose[n, m, 0],
                pose[n, m, 1],
                pose[n, m, 2],
            )
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
    skip: int,
    state: State,
    scene: Surroundings,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    frame = scratch.cells.frame
    pose = state.pose
    first = state.velocity.shape[1]
    for m in range(pose.shape[1]):
        contacts.put_body(state.bodies, n, first + m, pose[n, m])
        rates_at(n, m, motion.substeps - 1, state, motion, scratch.single)
        before = scratch.scans.before[skip + m]
        sensing.measure(n, m, state, pose, before, scratch.single.dq, motion)
        if scene.crowded:  # the cells count how far the robots came, drift included
            dx = pose[n, m, 0] - before[0]
            dy = pose[n, m, 1] - before[1]
            frame[n, cells.MOVED] = max(
                frame[n, cells.MOVED], math.sqrt(dx * dx + dy * dy)
            )


@kernel
def sort(n: int, state: State, scene: Surroundings, scratch: Scratch) -> None:
    """Sorts the bodies of a world into its cells, if there are any."""
    if scene.crowded:
        cells.sort(n, state.bodies[n], state.bodies.shape[1], scratch.cells)
    elif scene.standing:
        first = state.velocity.shape[1]
        spare = scratch.scans.seen
        cells.put_in_order(n, state.bodies[n], first, spare, scratch.cells)


@kernel(allocates=True)
def sort_worlds(packed: Any, begin: int, end: int) -> None:
    """Sorts the bodies of the worlds [begin, end) of a part into cells, as they stand."""
    part = packed.content
    for n in range(begin, end):
        sort(n, part.state, surroundings_of(n, part.members), part.scratch)


@kernel(allocates=True)
def begin(packed: Any, chosen: records.Integers) -> None:
    """Begins episodes in the worlds `chosen` (n,): all is in place and stands still."""
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
    """Begins a period of worlds whose robots are moved from outside, from where they stand."""
    part = packed.content
    count = part.state.pose.shape[0]
    _begin_period(0, count, part.state, part.members, part.motion, part.scratch)


@kernel(allocates=True)
def end_period(
    packed: Any, true: Array, before: Array, wheels: Array, counted: Array
) -> None:
    """Measures what the robots sense at the end of a period in which they were moved from outside.

    Robots and obstacles stand where the period ends. All others are (N, M, 3): the true twist at
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
    """Propagates covariances in place, see `device.propagate`: P' = F P F^T + Q."""
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
