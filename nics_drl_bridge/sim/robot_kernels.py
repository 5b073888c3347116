"""Compiled motion of robots over one period: freely, and carefully in tight spots.

Shapes are those of `state`.
"""

from __future__ import annotations

import math

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.kernels import Terms, delayed, run, wrap
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim.careful_kernels import drift_carefully, move_carefully
from nics_drl_bridge.sim.sensing_kernels import most_drift
from nics_drl_bridge.sim.state import Array, Dynamics, Lanes, Scratch, State, Surroundings


@kernel
def move_freely(begin: int, end: int, state: State, motion: Dynamics, lanes: Lanes) -> None:
    """Moves the robots of the worlds [begin, end) over one period as if nothing were in the way.

    The results stay in the lanes: robot m of world n is in lane (n - begin) M + m.
    """
    robots, size = state.pose.shape[1], state.state.shape[2]
    substeps, history = motion.substeps, state.history
    where, x, late = lanes.pose, lanes.x, lanes.late
    for n in range(begin, end):
        for m in range(robots):
            i, heading = (n - begin) * robots + m, state.pose[n, m, 2]
            where[0, i], where[1, i], where[4, i] = (
                state.pose[n, m, 0],
                state.pose[n, m, 1],
                heading,
            )
            where[2, i], where[3, i], where[5, i] = math.cos(heading), math.sin(heading), 0.0
            for s in range(size):
                x[s, i] = state.state[n, m, s]
            for t in range(lanes.coefficient.shape[0]):
                lanes.coefficient[t, i] = state.coefficient[n, m, t]
            late[i] = state.delay[n, m] % substeps  # its command changes once, after this many
    terms = Terms(motion.terms.dof, lanes.coefficient, motion.terms.factors, motion.terms.degree)
    at, used = 0, (end - begin) * robots
    while at < substeps:
        until = substeps
        for i in range(used):
            if late[i] > at:
                until = min(until, late[i])
            if late[i] == at or at == 0:
                n, m = begin + i // robots, i % robots
                row = delayed(at, state.delay[n, m], substeps, history.shape[2])
                for c in range(history.shape[3]):
                    x[size + c, i] = history[n, m, row, c]
        run(where, x, lanes.dq, terms, motion.series, motion.dt, until - at)
        at = until


@kernel
def move_world(
    n: int, skip: int, state: State, scene: Surroundings, motion: Dynamics, scratch: Scratch
) -> None:
    """Moves obstacles and robots of one world: freely, and carefully in tight spots.

    Args:
        n: index of the world.
        skip: the lane of its first robot, which `move_freely` has moved.
        state, scene, motion, scratch: see `state`.
    """
    lanes, nearby, single = scratch.lanes, scratch.nearby, scratch.single
    pose, period = state.pose, motion.dt * motion.substeps
    robots, first = pose.shape[1], state.velocity.shape[1]
    for m in range(robots):
        nearby.way[m] = lanes.pose[5, skip + m] + most_drift(state.noise, n, m, period)
    longest, moving = contacts.reaches(n, state, nearby, period)
    if scene.crowded:
        contacts.sort_bodies(state.bodies, n, scratch.cells)
        scratch.cells.frame[contacts.MOVED] = longest
    tight = False
    for m in range(robots):
        nearby.meets[m] = contacts.find_near(n, m, state.bodies, scene, nearby, scratch.cells)
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


@kernel
def propagate_in_place(covariance: Array, before: Array, after: Array, added: Array) -> None:
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
