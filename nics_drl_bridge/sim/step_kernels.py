"""Compiled step of the simulator: the worlds of a part, by one control period.

`step_worlds` queues the commands, then takes the worlds in blocks, one lane for each robot:

1. `_begin_period_of_block` saves the robots' poses, and chooses the velocities of the obstacles.
2. `move_freely` moves all robots of the block side by side, as if nothing stood in their way.
3. `_move_world` moves the obstacles. A robot that may meet something is moved carefully instead,
   from where it stood. All robots then drift.
4. `_measure_world` measures the odometry.
5. Each robot scans, and its lidar's faults are applied, see `sensing_kernels`.

`begin_episodes` resets worlds whose robots and obstacles are in place. `begin_period` and
`end_period` are steps 1, 4 and 5 for worlds whose robots another engine moves.

A world is bit-identical in any batch, part or thread: nothing is summed over worlds, and random
numbers depend on the world's own seed and counter alone.

Shared arguments: `packed` is a `state.Part`, packed by `packing_kernels.pack`; n is a world, m a
robot in it; the robot's lane is `first_lane` + m.
"""

import math
from typing import Any

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.map_kernels import cells_of, walls_of
from nics_drl_bridge.lidar.scan_kernels import LidarArrays
from nics_drl_bridge.robot.kernels import apply_curve
from nics_drl_bridge.sim import cell_kernels as cells
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import obstacle_kernels as obstacles
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim.motion_kernels import compute_rates, move_freely, move_world
from nics_drl_bridge.sim.state import (
    POSE,
    TRUE_TWIST,
    Array,
    Dynamics,
    Integers,
    MapField,
    Movers,
    Scratch,
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
            frame[n, cells.MOVED] = max(frame[n, cells.MOVED], moved)


@kernel
def _sort_bodies(n: int, data: State, scene: Surroundings, scratch: Scratch) -> None:
    """Sort the bodies of world n into its cells, or its standing obstacles by cells."""
    if scene.crowded:
        cells.sort(n, data.bodies[n], data.bodies.shape[1], scratch.cells)
    elif scene.standing:
        obstacle_count = data.velocity.shape[1]
        spare = scratch.scans.bodies
        cells.put_in_order(n, data.bodies[n], obstacle_count, spare, scratch.cells)


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
