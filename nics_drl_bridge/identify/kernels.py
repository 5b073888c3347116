"""Compiled sensitivities: poses at the ends of windows, and their derivatives by coefficients."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.kernels import bounds_of, emf_of, next_state

SMALL_TURN = 0.3  # below this angle the series of sin(a)/a is exact to the last digits [rad]


@kernel(allocates=True)
def _product(row, factors, count):  # type: ignore[no-untyped-def]
    value = 1.0
    for f in range(count):
        value *= row[factors[f]]
    return value


@kernel
def _sinc(half):  # type: ignore[no-untyped-def]
    if abs(half) > SMALL_TURN:
        return math.sin(half) / half
    square = half * half
    return 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))


@kernel(allocates=True, inline=True)
def _follow_derivatives(now, values, dof, free, dx, dy, turn, along_x, along_y, dt):  # type: ignore[no-untyped-def]
    """Propagates the derivatives (3, P) of a pose along one arc: (dx, dy, turn)."""
    for p in range(now.shape[1]):
        value, d = values[free[p]], dof[free[p]]
        lean = now[2, p]
        if d == 2:
            lean += 0.5 * dt * value
        now[0, p] -= lean * dy
        now[1, p] += lean * dx
        if d == 0:
            now[0, p] += along_x * value
            now[1, p] += along_y * value
        elif d == 1:
            now[0, p] -= along_y * value
            now[1, p] += along_x * value
        else:
            shorter = -turn / 12.0 * dt * value
            now[0, p] += shorter * dx
            now[1, p] += shorter * dy
            now[2, p] += dt * value


@kernel(allocates=True)
def follow(ends, moved, x, steps, share, terms, free, dt):  # type: ignore[no-untyped-def]
    """Writes end poses (W, 3), and derivatives (W, 3, P) by the `free` (P,) of `terms`."""
    # Of body twists along courses of X (W, T, V + 1), with a last entry of 1, integrated as in
    # the simulator: whole `steps` (W,) of `dt` [s] and a `share` (W,) of one more; headings are
    # unwrapped.
    dof, coefficient = terms.dof, terms.coefficient
    factors, count = terms.factors, terms.degree
    params = moved.shape[2]
    values = np.empty(dof.shape[0])
    now, before = np.zeros((3, params)), np.zeros((3, params))
    for w in range(x.shape[0]):
        px, py, heading = 0.0, 0.0, 0.0
        qx, qy, old = 0.0, 0.0, 0.0
        now[:], last = 0.0, steps[w] + (1 if share[w] > 0.0 else 0)
        for n in range(last):
            if n == steps[w]:
                qx, qy, old = px, py, heading
                before[:] = now
            vx, vy, wz = 0.0, 0.0, 0.0
            for k in range(dof.shape[0]):
                values[k] = _product(x[w, n], factors[k], count[k])
                rate = coefficient[k] * values[k]
                if dof[k] == 0:
                    vx += rate
                elif dof[k] == 1:
                    vy += rate
                else:
                    wz += rate
            turn = wz * dt
            sinc = _sinc(turn / 2.0)
            c, s = math.cos(heading + turn / 2.0), math.sin(heading + turn / 2.0)
            along = dt * sinc
            dx, dy = along * (c * vx - s * vy), along * (s * vx + c * vy)
            _follow_derivatives(now, values, dof, free, dx, dy, turn, along * c, along * s, dt)
            px, py, heading = px + dx, py + dy, heading + turn
        if share[w] > 0.0:
            a, b = 1.0 - share[w], share[w]
            ends[w, 0], ends[w, 1] = a * qx + b * px, a * qy + b * py
            ends[w, 2] = a * old + b * heading
            moved[w] = a * before + b * now
        else:
            ends[w, 0], ends[w, 1], ends[w, 2] = px, py, heading
            moved[w] = now


class Shot(NamedTuple):
    """Windows to predict from their first states: inputs of `shoot`, and what it writes."""

    state: Array  # (W, S) at the start
    first: NDArray[np.intp]  # (W,) rows of `command` (T, C) at the start
    command: Array
    stop: NDArray[np.intp]  # (W, H) steps after which poses are wanted; 0: not wanted
    end: Array  # (W, H, 3) poses then from those at the start; headings unwrapped
    slope: Array  # (W, H, 3, P) their derivatives by the free coefficients


class Tangent(NamedTuple):
    """Scratch memory of a window: values now, and their derivatives by the free coefficients."""

    x: Array  # (S + C + 1,) X and a last entry of 1
    value: Array  # (K,) of each term without its coefficient
    rate: Array  # (3 + S,)
    jacobian: Array  # (3 + S, S) of the rates by the state
    state: Array  # (S, P)
    before: Array  # (S, P) a step earlier
    twist: Array  # (3, P)
    pose: Array  # (3, P)


def tangent(states: int, commands: int, terms: int, free: int) -> Tangent:
    """Returns scratch memory for `shoot`."""
    shapes = ((states + commands + 1,), (terms,), (3 + states,), (3 + states, states),
              (states, free), (states, free), (3, free), (3, free))  # fmt: skip
    return Tangent(*map(np.zeros, shapes))


@kernel
def shoot(shot, terms, free, dt, scratch):  # type: ignore[no-untyped-def]
    """Predicts windows in steps of dt [s], and the derivatives by the `free` (P,) of `terms`."""
    for w in range(shot.state.shape[0]):
        _begin(shot.state[w], scratch)
        at_x, at_y, heading = 0.0, 0.0, 0.0
        last = 0
        for h in range(shot.stop.shape[1]):
            last = max(last, shot.stop[w, h])
        for n in range(last):
            for i in range(shot.command.shape[1]):
                scratch.x[shot.state.shape[1] + i] = shot.command[shot.first[w] + n, i]
            _linearise(terms, scratch)
            _follow_twist(terms, free, scratch)
            turn = scratch.rate[2] * dt
            along = dt * _sinc(turn / 2.0)
            c, s = math.cos(heading + turn / 2.0), math.sin(heading + turn / 2.0)
            dx = along * (c * scratch.rate[0] - s * scratch.rate[1])
            dy = along * (s * scratch.rate[0] + c * scratch.rate[1])
            _follow_pose(scratch, dx, dy, along * c, along * s, dt)
            at_x, at_y, heading = at_x + dx, at_y + dy, heading + turn
            _follow_state(terms, free, scratch, dt)
            for h in range(shot.stop.shape[1]):
                if shot.stop[w, h] == n + 1:
                    end, slope = shot.end[w, h], shot.slope[w, h]
                    end[0], end[1], end[2] = at_x, at_y, heading
                    for d in range(3):
                        for p in range(free.shape[0]):
                            slope[d, p] = scratch.pose[d, p]


@kernel
def _begin(state, scratch):  # type: ignore[no-untyped-def]
    scratch.x[-1] = 1.0
    for i in range(state.shape[0]):
        scratch.x[i] = state[i]
    scratch.state[:] = 0.0
    scratch.pose[:] = 0.0


@kernel
def _linearise(terms, scratch):  # type: ignore[no-untyped-def]
    """Computes the terms, the rates, and their derivatives by the state."""
    states = scratch.state.shape[0]
    scratch.rate[:] = 0.0
    scratch.jacobian[:] = 0.0
    for k in range(terms.dof.shape[0]):
        d, coefficient, value = terms.dof[k], terms.coefficient[k], 1.0
        for f in range(terms.degree[k]):
            value *= scratch.x[terms.factors[k, f]]
            if terms.factors[k, f] < states:
                rest = coefficient
                for other in range(terms.degree[k]):
                    if other != f:
                        rest *= scratch.x[terms.factors[k, other]]
                scratch.jacobian[d, terms.factors[k, f]] += rest
        scratch.value[k] = value
        scratch.rate[d] += coefficient * value
    for i in range(terms.emf.shape[0]):
        braking = emf_of(i, scratch.x, terms)
        scratch.rate[3 + i] -= braking * scratch.x[i]
        scratch.jacobian[3 + i, i] -= braking


@kernel
def _follow_twist(terms, free, scratch):  # type: ignore[no-untyped-def]
    for d in range(3):
        for p in range(free.shape[0]):
            scratch.twist[d, p] = 0.0
        for j in range(scratch.state.shape[0]):
            slope = scratch.jacobian[d, j]
            if slope != 0.0:
                for p in range(free.shape[0]):
                    scratch.twist[d, p] += slope * scratch.state[j, p]
    for p in range(free.shape[0]):
        if terms.dof[free[p]] < 3:
            scratch.twist[terms.dof[free[p]], p] += scratch.value[free[p]]


@kernel
def _follow_pose(scratch, dx, dy, along_x, along_y, dt):  # type: ignore[no-untyped-def]
    pose, twist = scratch.pose, scratch.twist
    for p in range(pose.shape[1]):
        lean = pose[2, p] + 0.5 * dt * twist[2, p]
        pose[0, p] += along_x * twist[0, p] - along_y * twist[1, p] - lean * dy
        pose[1, p] += along_y * twist[0, p] + along_x * twist[1, p] + lean * dx
        pose[2, p] += dt * twist[2, p]


@kernel
def _follow_state(terms, free, scratch, dt):  # type: ignore[no-untyped-def]
    states, count, before = scratch.state.shape[0], scratch.state.shape[1], scratch.before
    for i in range(states):
        for p in range(count):
            before[i, p] = scratch.state[i, p]
    for i in range(states):
        if _is_limited(terms, i, scratch):
            continue
        for j in range(states):
            slope = dt * scratch.jacobian[3 + i, j]
            if slope != 0.0:
                for p in range(count):
                    scratch.state[i, p] += slope * before[j, p]
    for p in range(count):
        d = terms.dof[free[p]]
        if d >= 3 and not _is_limited(terms, d - 3, scratch):
            scratch.state[d - 3, p] += dt * scratch.value[free[p]]
    for i in range(states):
        bounds, rate = bounds_of(terms, i), scratch.rate[3 + i]
        moved = next_state(scratch.x[i], rate, dt, bounds)
        unheld = scratch.x[i] + dt * min(max(rate, bounds.fall), bounds.rise)
        slower = 1.0 + dt * bounds.drag * abs(unheld)
        if slower > 1.0:
            unheld /= slower
            for p in range(count):
                scratch.state[i, p] /= slower * slower
        unheld -= math.copysign(dt * bounds.friction, unheld)
        if moved != unheld:  # it sticks, or is held in its box
            scratch.state[i] = 0.0
        scratch.x[i] = moved


@kernel
def _is_limited(terms, i, scratch):  # type: ignore[no-untyped-def]
    rate = scratch.rate[3 + i]
    return not terms.fall[i] <= rate <= terms.rise[i]


@kernel
def limp(states, targets, share, fall, rise):  # type: ignore[no-untyped-def]
    """Follows targets (T,) from the first state (T,) by a share of what is left, within limits."""
    for k in range(1, states.shape[0]):
        change = share * (targets[k - 1] - states[k - 1])
        states[k] = states[k - 1] + min(max(change, fall), rise)
