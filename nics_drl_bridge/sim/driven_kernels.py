"""Compiled step of worlds whose robots are moved from outside, in two halves.

What obstacles do and what robots sense are the functions of the fast simulator's own step, so that
both are the same in a world whose robots another physics moves. Shapes are those of `kernels`.
"""

from __future__ import annotations

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim import cell_kernels as crowd
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim import sight_kernels as sight
from nics_drl_bridge.sim.contact_kernels import put_body
from nics_drl_bridge.sim.kernels import steer_world


@kernel(allocates=True)
def begin_period(packed):  # type: ignore[no-untyped-def]
    """Sets the velocities of the obstacles for the period that begins.

    Args:
        packed: see `kernels.step_worlds`; the robots stand where the period begins.
    """
    fields, scene, _, motion, room = packed.content
    pose, bodies, odom, twist = fields[0], fields[3], fields[4], fields[5]
    steps, seeds, velocity, past, marks = fields[8], fields[9], fields[15], fields[16], fields[17]
    walls, movers, (dt, substeps) = scene[0], scene[5], motion[4]
    for n in range(pose.shape[0]):
        if movers[0]:
            steer_world(
                n, velocity, marks, bodies, pose, past, steps[n], walls, movers, seeds[n],
                dt * substeps, room[2][4],
            )  # fmt: skip
        for m in range(pose.shape[1]):
            if steps[n] == 0:
                sensing.begin(past, n, m, pose, odom, twist)


@kernel(allocates=True)
def end_period(packed, true, before, wheels, counted):  # type: ignore[no-untyped-def]
    """Measures what the robots sense at the end of a period.

    Args:
        packed: see `kernels.step_worlds`; robots and obstacles stand where the period ends.
        true: (N, M, 3) true twist at its end.
        before: (N, M, 3) pose by the wheels alone at its beginning.
        wheels: (N, M, 3) the same at its end.
        counted: (N, M, 3) twist by the wheels at its end.
    """
    fields, scene, view, motion, room = packed.content
    (
        pose, _, _, bodies, odom, twist, ranges, _, steps, seeds, faults, _, _, age, noise,
        velocity, past, _,
    ) = fields  # fmt: skip
    walls, crowded, scattered = scene[0], scene[3], scene[4]
    series, (dt, substeps) = motion[3], motion[4]
    sensors, crowding = room[4], room[3]
    robots, first, together = pose.shape[1], velocity.shape[1], 0
    for n in range(pose.shape[0]):
        steps[n] += 1
        row = past[n, :, steps[n] % past.shape[2]]
        for m in range(robots):
            put_body(bodies, n, first + m, pose[n, m])
            sensing.measure(
                odom, twist, past, before[n, m], wheels, n, m, counted[n, m], noise, steps[n],
                seeds[n], steps[n] * robots + m, age[n, m], dt, substeps, series,
            )  # fmt: skip
            for i in range(3):  # where the wheels think that it is, is not where its lidar is
                row[m, sensing.POSE + i] = pose[n, m, i]
                row[m, sensing.TWIST + i] = true[n, m, i]
        if crowded:
            crowd.sort_bodies(bodies, n, crowding[0])
        together = sight.look_or_wait(
            n, together, pose, bodies, ranges, steps, faults, age, velocity, past, walls,
            scattered, view, sensors, crowding, dt, substeps,
        )  # fmt: skip
    sight.look_together(together, pose, bodies, ranges, first, walls, view, sensors)
    sight.distort(0, pose.shape[0], ranges, faults, steps, seeds, view)
