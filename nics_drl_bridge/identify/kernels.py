"""Compiled sensitivities: where a known course of X leads, and how each coefficient moves that."""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel

SMALL_TURN = 0.3
"""Below this the series of sin(a)/a below is exact to the last digits [rad]."""


@kernel(allocates=True)
def _product(row, factors, count):  # type: ignore[no-untyped-def]
    value = 1.0
    for f in range(count):
        value *= row[factors[f]]
    return value


@kernel(allocates=True)
def _sinc(half):  # type: ignore[no-untyped-def]
    """sin(a) / a."""
    if abs(half) > SMALL_TURN:
        return math.sin(half) / half
    square = half * half
    return 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))


@kernel(allocates=True, inline=True)
def _follow_derivatives(now, values, dof, free, arc, along_x, along_y, dt):  # type: ignore[no-untyped-def]
    """Moves the derivatives (3, P) of a pose along one arc: (dx, dy, turn)."""
    dx, dy, turn = arc
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
    """Integrates body twists along courses of X that no coefficient changes.

    Each step is the exact arc of its twist, as in the simulator. Shapes: W windows, T steps, V
    variables, K terms of the twist, P coefficients that may move.

    Args:
        ends: (W, 3) poses at the ends, relative to the starts, headings unwrapped; result.
        moved: (W, 3, P) their derivatives by the free coefficients; result. P = 0 skips them.
        x: (W, T, V) X during each step.
        steps: (W,) whole steps to the end.
        share: (W,) of one more step.
        terms: degree of freedom (K,), coefficient (K,), factors (K, order), their number (K,).
        free: (P,) which of the terms may move.
        dt: length of a step [s].
    """
    dof, coefficient, factors, count = terms
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
            _follow_derivatives(now, values, dof, free, (dx, dy, turn), along * c, along * s, dt)
            px, py, heading = px + dx, py + dy, heading + turn
        if share[w] > 0.0:
            a, b = 1.0 - share[w], share[w]
            ends[w, 0], ends[w, 1] = a * qx + b * px, a * qy + b * py
            ends[w, 2] = a * old + b * heading
            moved[w] = a * before + b * now
        else:
            ends[w, 0], ends[w, 1], ends[w, 2] = px, py, heading
            moved[w] = now
