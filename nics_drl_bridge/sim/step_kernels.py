"""Compiled inner loops of the simulator: motion, and the step of some worlds.

What one robot does is a scalar function that the batched loops call. Shapes are those of `state`.

A world is bit-identical in any batch, part or thread: nothing is summed over worlds, and what is
drawn at random is drawn by the world's own seed and counter.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.experimental import structref

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import obstacle_kernels as obstacles
from nics_drl_bridge.sim import robot_kernels as robots
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim.careful_kernels import rates_at
from nics_drl_bridge.sim.state import (
    Array,
    Dynamics,
    Integers,
    LidarView,
    Part,
    Scratch,
    State,
    Surroundings,
)


@structref.register
class PackedType(types.StructRef):  # type: ignore[misc]
    """The type of `Packed`."""


class Packed(structref.StructRefProxy):  # type: ignore[misc]
    """A `Part` as one argument: passing a hundred arrays took longer than a step."""


structref.define_proxy(Packed, PackedType, ["part"])


@kernel(allocates=True)
def pack(part: Part) -> Any:
    """Makes one argument of a part."""
    return Packed(part)


@kernel
def _send(history: Array, commands: Array, begin: int) -> None:
    """Puts the commands (n, M, C) of the worlds from `begin` on in front of those sent before."""
    for i in range(commands.shape[0]):
        for m in range(commands.shape[1]):
            for h in range(history.shape[2] - 1, 0, -1):
                for c in range(commands.shape[2]):
                    history[begin + i, m, h, c] = history[begin + i, m, h - 1, c]
            for c in range(commands.shape[2]):
                history[begin + i, m, 0, c] = commands[i, m, c]


@kernel
def _note_paths(n: int, skip: int, pose: Array, scratch: Scratch) -> None:
    """Reports to the cells how far the robots of world n came, drift included."""
    before, frame = scratch.scans.before, scratch.cells.frame
    for m in range(pose.shape[1]):
        dx, dy = pose[n, m, 0] - before[skip + m, 0], pose[n, m, 1] - before[skip + m, 1]
        frame[contacts.MOVED] = max(frame[contacts.MOVED], math.sqrt(dx * dx + dy * dy))


@kernel(allocates=True)
def step_worlds(packed: Any, commands: Array, begin: int) -> None:
    """One control period of the worlds of a part.

    Args:
        packed: the part, see `pack`; its state is updated in place.
        commands: (n, M, C).
        begin: the first world.
    """
    part = packed.part
    _step(part.state, part.scene, part.lidar, part.motion, part.scratch, commands, begin)


@kernel
def _step(
    state: State, scene: Surroundings, view: LidarView, motion: Dynamics, scratch: Scratch,
    commands: Array, begin: int,
) -> None:  # fmt: skip
    """See `step_worlds`; without reference counts, which took longer than the step."""
    many, end = state.pose.shape[1], begin + commands.shape[0]
    _send(state.history, commands, begin)
    block = scratch.lanes.pose.shape[1] // many
    for low in range(begin, end, block):
        high = min(low + block, end)
        _begin_period(low, high, state, scene, motion, scratch)
        robots.move_freely(low, high, state, motion, scratch.lanes)
        waiting = np.int64(0)
        for n in range(low, high):
            state.steps[n] += 1
            skip = (n - low) * many
            robots.move_world(n, skip, state, scene, motion, scratch)
            _measure(n, skip, state, motion, scratch)
            if scene.crowded:
                _note_paths(n, skip, state.pose, scratch)
            waiting = sensing.scan_or_wait(n, waiting, state, scene, view, motion, scratch)
        sensing.scan_together(waiting, state, scene, view, scratch.scans)
        sensing.distort(low, high, state, view)


@kernel(inline=True)
def _begin_period(
    low: int, high: int, state: State, scene: Surroundings, motion: Dynamics, scratch: Scratch
) -> None:
    """Sets the velocities of the obstacles of the worlds [low, high), and notes the poses."""
    pose, before = state.pose, scratch.scans.before
    for n in range(low, high):
        if scene.movers.moves:
            steer_world(n, state, scene, motion.dt * motion.substeps, scratch.nearby.speeds)
        for m in range(pose.shape[1]):
            i = (n - low) * pose.shape[1] + m
            before[i, 0], before[i, 1], before[i, 2] = pose[n, m, 0], pose[n, m, 1], pose[n, m, 2]
            if state.steps[n] == 0:
                sensing.begin(n, m, state)


@kernel(inline=True)
def _measure(n: int, skip: int, state: State, motion: Dynamics, scratch: Scratch) -> None:
    """Puts the bodies of the robots of world n where they are, and reads their wheels."""
    single, first = scratch.single, state.velocity.shape[1]
    for m in range(state.pose.shape[1]):
        contacts.put_body(state.bodies, n, first + m, state.pose[n, m])
        rates_at(n, m, motion.substeps - 1, state, motion, single)
        before = scratch.scans.before[skip + m]
        sensing.measure(n, m, state, state.pose, before, single.dq, motion)


@kernel(allocates=True)
def steer_world(n: int, state: State, scene: Surroundings, period: float, speeds: Array) -> None:
    """Sets the velocities of the obstacles of world n for the period that begins.

    Args:
        n: index of the world.
        state, scene: see `state`.
        period: [s].
        speeds: (M, 2) scratch memory.
    """
    pose, past, step = state.pose, state.past, state.steps[n]
    row = step % past.shape[2]
    for m in range(pose.shape[1]):
        vx = vy = 0.0
        if step > 0:
            vx, vy = past[n, m, row, sensing.TWIST], past[n, m, row, sensing.TWIST + 1]
        c, s = math.cos(pose[n, m, 2]), math.sin(pose[n, m, 2])
        speeds[m, 0], speeds[m, 1] = c * vx - s * vy, s * vx + c * vy
    movers = scene.movers
    obstacles.steer(
        state.velocity, state.marks, n, state.bodies, state.velocity.shape[1], speeds,
        movers.plans, scene.walls, movers.half, state.seeds[n], step, period, movers.distances,
    )  # fmt: skip


@kernel(allocates=True)
def begin(packed: Any, chosen: Integers) -> None:
    """Begins episodes in the worlds `chosen` (n,), whose robots and obstacles are in place.

    Their moving obstacles draw what they need, and the robots take their first scans.
    """
    part = packed.part
    if part.scene.movers.moves:
        for n in chosen:
            obstacles.begin(
                part.state.marks, n, part.state.bodies, part.scene.movers.plans,
                part.scene.movers.half, part.state.seeds[n],
            )  # fmt: skip
    _scan_first(part.state, part.scene, part.lidar, part.scratch, chosen)


@kernel
def _scan_first(
    state: State, scene: Surroundings, view: LidarView, scratch: Scratch, chosen: Integers
) -> None:
    """Scans as the episodes begin: everything stands still, so no scan is older or skewed."""
    for i in range(chosen.shape[0]):
        scratch.scans.waiting[i] = chosen[i]
    sensing.scan_together(chosen.shape[0], state, scene, view, scratch.scans)
    for n in chosen:
        sensing.distort(n, n + 1, state, view)


@kernel(allocates=True)
def begin_period(packed: Any) -> None:
    """Begins a period of worlds whose robots are moved from outside.

    Args:
        packed: see `step_worlds`; the robots stand where the period begins.
    """
    state, scene, motion = packed.part.state, packed.part.scene, packed.part.motion
    for n in range(state.pose.shape[0]):
        if scene.movers.moves:
            speeds = packed.part.scratch.nearby.speeds
            steer_world(n, state, scene, motion.dt * motion.substeps, speeds)
        for m in range(state.pose.shape[1]):
            if state.steps[n] == 0:
                sensing.begin(n, m, state)


@kernel(allocates=True)
def end_period(packed: Any, true: Array, before: Array, wheels: Array, counted: Array) -> None:
    """Measures what the robots sense at the end of a period in which they were moved from outside.

    Args:
        packed: see `step_worlds`; robots and obstacles stand where the period ends.
        true: (N, M, 3) true twist at its end.
        before: (N, M, 3) pose by the wheels alone at its start.
        wheels: (N, M, 3) the same at its end.
        counted: (N, M, 3) twist by the wheels at its end.
    """
    part = packed.part
    state, scene, motion, scratch = part.state, part.scene, part.motion, part.scratch
    first, waiting = state.velocity.shape[1], 0
    for n in range(state.pose.shape[0]):
        state.steps[n] += 1
        row = state.past[n, :, state.steps[n] % state.past.shape[2]]
        for m in range(state.pose.shape[1]):
            contacts.put_body(state.bodies, n, first + m, state.pose[n, m])
            sensing.measure(n, m, state, wheels, before[n, m], counted[n, m], motion)
            for i in range(3):  # the pose by the wheels is not where the lidar is
                row[m, sensing.POSE + i] = state.pose[n, m, i]
                row[m, sensing.TWIST + i] = true[n, m, i]
        if scene.crowded:
            contacts.sort_bodies(state.bodies, n, scratch.cells)
        waiting = sensing.scan_or_wait(n, waiting, state, scene, part.lidar, motion, scratch)
    sensing.scan_together(waiting, state, scene, part.lidar, scratch.scans)
    sensing.distort(0, state.pose.shape[0], state, part.lidar)
