"""Compiled motion: the pruned model's rates, and the exact arc of a body twist.

What one robot does is a scalar function; simulator, estimator and fit call the same ones.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nics_drl_bridge.kinematics.model import TaylorModel

Array = NDArray[np.float64]


def term_arrays(model: TaylorModel) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """The kept terms as `rates` takes them: dof (T,), coefficient (T,), factors (T, order)."""
    one = len(model.variables)
    order = max(1, int(model.powers.sum(axis=1).max(initial=1)))
    dofs, places = np.nonzero(model.coefficients)
    factors = np.full((len(dofs), order), one, dtype=np.int64)
    for row, k in enumerate(places):
        used = np.repeat(np.arange(one), model.powers[k])
        factors[row, : len(used)] = used
    return dofs.astype(np.int64), model.coefficients[dofs, places], factors


def scratch(model: TaylorModel) -> tuple[Array, Array]:
    """Room for X = [state, command, 1] and dQ/dt, as `rates` takes it."""
    x = np.zeros(len(model.variables) + 1)
    x[-1] = 1.0
    return x, np.zeros(len(model.dofs))


@njit(cache=True)
def rates(dq, x, terms):  # type: ignore[no-untyped-def]
    """dQ/dt (3 + S) of X = [state, command, 1] (V + 1): only the kept terms cost time.

    Args:
        dq: (3 + S,) result.
        x: (V + 1,) state and command, with 1 at the end.
        terms: dof (T,), coefficient (T,), factors (T, order): places in x.
    """
    dof, coefficient, factors = terms
    dq[:] = 0.0
    for k in range(dof.shape[0]):
        product = coefficient[k]
        for factor in range(factors.shape[1]):
            product *= x[factors[k, factor]]
        dq[dof[k]] += product


@njit(cache=True)
def advance(pose, twist, duration):  # type: ignore[no-untyped-def]
    """Moves a pose (3,) in place along the exact arc of a constant body twist (3,)."""
    turn = twist[2] * duration
    if abs(turn) < 1e-4:
        a, b = 1.0 - turn * turn / 6.0, turn / 2.0
    else:
        a, b = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
    x = (a * twist[0] - b * twist[1]) * duration
    y = (b * twist[0] + a * twist[1]) * duration
    c, s = math.cos(pose[2]), math.sin(pose[2])
    pose[0] += c * x - s * y
    pose[1] += s * x + c * y
    heading = pose[2] + turn
    pose[2] = heading - 2.0 * math.pi * math.floor((heading + math.pi) / (2.0 * math.pi))


@njit(cache=True)
def delayed(history, substep, delay, substeps):  # type: ignore[no-untyped-def]
    """Row of the history (H, C), newest first, that is in effect in a substep of this period."""
    if delay <= substep:
        return 0
    return min((delay - substep + substeps - 1) // substeps, history.shape[0] - 1)


@njit(cache=True)
def rollout(poses, states, commands, terms, dt):  # type: ignore[no-untyped-def]
    """Moves robots open-loop by the steps of their commands.

    Args:
        poses: (W, T + 1, 3), the first given, the others written.
        states: (W, T + 1, S), likewise.
        commands: (W, T, C), one row per step.
        terms: see `rates`.
        dt: length of a step [s].
    """
    size, width = states.shape[2], commands.shape[2]
    x, dq = np.ones(size + width + 1), np.zeros(3 + size)
    for w in range(poses.shape[0]):
        for n in range(commands.shape[1]):
            for i in range(size):
                x[i] = states[w, n, i]
            for i in range(width):
                x[size + i] = commands[w, n, i]
            rates(dq, x, terms)
            poses[w, n + 1] = poses[w, n]
            advance(poses[w, n + 1], dq, dt)
            for i in range(size):
                states[w, n + 1, i] = states[w, n, i] + dq[3 + i] * dt
