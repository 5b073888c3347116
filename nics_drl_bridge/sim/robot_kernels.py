"""Compiled motion of robots for one period: freely, and carefully in tight spots.

Shapes are those of `kernels`.
"""

from __future__ import annotations

import math

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.kernels import delayed, run, wrap
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import contact_kernels as crowd
from nics_drl_bridge.sim.careful_kernels import drift_carefully, move_carefully
from nics_drl_bridge.sim.sensing_kernels import most_drift


@kernel
def move_freely(begin, end, pose, state, history, coefficient, delay, lanes, motion):  # type: ignore[no-untyped-def]
    """Moves the robots of the worlds [begin, end) for one period as if nothing were in the way.

    Args:
        begin, end: range of the worlds.
        pose: (N, M, 3).
        state: (N, M, S).
        history: (N, M, H, C) commands, newest first.
        coefficient: (N, M, T) of the kinematic terms.
        delay: (N, M) of the commands [substeps].
        lanes: pose (6, L), x (V + 1, L), dq (D, L) of `robot.kernels.run`, coefficient
            (T, L) and late (L,), L >= n M; they hold the result.
        motion: dof, factors, count of the terms, series, (step [s], substeps per period).
    """
    where, x, dq, own, late = lanes
    dof, factors, count, series, (dt, substeps) = motion
    robots, size = pose.shape[1], state.shape[2]
    for n in range(begin, end):
        for m in range(robots):
            i = (n - begin) * robots + m
            where[0, i], where[1, i], where[4, i] = pose[n, m, 0], pose[n, m, 1], pose[n, m, 2]
            where[2, i], where[3, i] = math.cos(pose[n, m, 2]), math.sin(pose[n, m, 2])
            where[5, i] = 0.0
            for s in range(size):
                x[s, i] = state[n, m, s]
            for t in range(own.shape[0]):
                own[t, i] = coefficient[n, m, t]
            late[i] = delay[n, m] % substeps  # substep in which its command changes, once
    at, used = 0, (end - begin) * robots
    while at < substeps:
        until = substeps
        for i in range(used):
            if late[i] > at:
                until = min(until, late[i])
            if late[i] == at or at == 0:
                n, m = begin + i // robots, i % robots
                row = delayed(at, delay[n, m], substeps, history.shape[2])
                for c in range(history.shape[3]):
                    x[size + c, i] = history[n, m, row, c]
        run(where, x, dq, (dof, own, factors, count), series, dt, until - at)
        at = until


@kernel
def move_world(  # type: ignore[no-untyped-def]
    n, skip, pose, state, history, coefficient, delay, bodies, velocity, walls, grid, collided,
    crowded, outlines, lanes, motion, cells, found, robot, room, noise, seed, step,
):  # fmt: skip
    """Moves obstacles and robots of one world: freely, and carefully in tight spots.

    Args:
        n: index of the world.
        skip: the lane of its first robot.
        crowded: whether its bodies are to be sorted into cells.
        cells, found: see `cell_kernels`.
        robot: near (M, 1 + SEVERAL), meets (M,), way (M,), reach (K + M,), and one more: scratch.
        noise, seed, step: for the drift, see `careful_kernels.drift_carefully`.
        pose and others: see the functions above.
    """
    where, x = lanes[0], lanes[1]
    near, meets, way, reach, _ = robot
    start, began = room[4], room[5]
    dt, substeps = motion[4]
    robots, size, first = pose.shape[1], state.shape[2], velocity.shape[1]
    for m in range(robots):
        way[m] = where[5, skip + m] + most_drift(noise, n, m, dt * substeps)
    longest, moving = contacts.reaches(reach, bodies, velocity, way, n, dt * substeps)
    if crowded:
        crowd.sort_bodies(bodies, n, cells)
        cells[3][crowd.MOVED] = longest
    tight = False
    for m in range(robots):
        meets[m] = contacts.find_near(near, m, reach, bodies, n, walls, grid, crowded, cells, found)
        tight = tight or meets[m] != contacts.FREE
    for m in range(robots):
        if meets[m] == contacts.FREE:
            i = skip + m
            pose[n, m, 0], pose[n, m, 1], pose[n, m, 2] = where[0, i], where[1, i], where[4, i]
            for s in range(size):
                state[n, m, s] = x[s, i]
    if moving:
        for k in range(first):
            for i in range(3):
                start[k, i] = began[k, i] = bodies[n, k, i]
    if tight:
        move_carefully(
            n, meets, near, state, history, coefficient, delay, bodies, velocity, moving, walls,
            grid, collided, pose, outlines, motion, room,
        )  # fmt: skip
    elif moving:
        contacts.move_obstacles(bodies, start, velocity, n, substeps * dt)
    for m in range(robots):
        pose[n, m, 2] = wrap(pose[n, m, 2])
    drift_carefully(
        n, meets, near, state, noise, seed, step, bodies, walls, grid, collided, pose, outlines,
        motion, room,
    )  # fmt: skip


@kernel
def propagate_in_place(covariance, before, after, added):  # type: ignore[no-untyped-def]
    """Computes P = F P F^T + Q of each robot in place; see `device.propagate`."""
    for m in range(len(covariance)):
        p = covariance[m]
        u, v = before[m, 1] - after[m, 1], after[m, 0] - before[m, 0]
        # F differs from the identity only in its last column, (u, v, 1).
        for j in range(3):
            p[0, j] += u * p[2, j]
            p[1, j] += v * p[2, j]
        for i in range(3):
            p[i, 0] += u * p[i, 2]
            p[i, 1] += v * p[i, 2]
        for i in range(3):
            for j in range(3):
                p[i, j] += added[i, j]
