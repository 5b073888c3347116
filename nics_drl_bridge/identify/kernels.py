"""Compiled sensitivities: end poses of known courses of X, and their derivatives."""

import math

import numpy as np

from nics_drl_bridge.kernels import kernel

SMALL_TURN = 0.3  # below this angle the series of sin(a)/a is exact to the last digits [rad]


@kernel(allocates=True)
def _product(row, factors, count):  # type: ignore[no-untyped-def]
    value = 1.0
    for f in range(count):
        value *= row[factors[f]]
    return value


@kernel(allocates=True)
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
