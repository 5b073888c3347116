"""Compiled prediction of the estimator: the simulator's motion with its Jacobian."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nics_drl_bridge.kinematics.kernels import advance, rates


@njit(cache=True)
def rates_jacobian(jacobian, x, terms):  # type: ignore[no-untyped-def]
    """Derivative (3 + S, V) of `rates` by X."""
    dof, coefficient, factors, count = terms
    jacobian[:] = 0.0
    for k in range(dof.shape[0]):
        for f in range(count[k]):
            product = coefficient[k]
            for other in range(count[k]):
                if other != f:
                    product *= x[factors[k, other]]
            jacobian[dof[k], factors[k, f]] += product


@njit(cache=True)
def predict(mean, transition, command, dt, steps, terms, series):  # type: ignore[no-untyped-def]
    """Moves the mean (3 + S) by `steps` steps of `dt` under one command (C,), in place.

    Args:
        transition: (3 + S, 3 + S) multiplied in place by the Jacobian of the motion.
    """
    size, width = mean.shape[0] - 3, command.shape[0]
    x, dq = np.ones(size + width + 1), np.zeros(3 + size)
    jacobian, step = np.zeros((3 + size, size + width)), np.eye(3 + size)
    x[size : size + width] = command
    for _ in range(steps):
        x[:size] = mean[3:]
        rates(dq, x, terms)
        rates_jacobian(jacobian, x, terms)
        # The arc is short, so the derivative at its middle heading is good to second order.
        middle = mean[2] + dq[2] * dt / 2.0
        c, s = math.cos(middle), math.sin(middle)
        step[:] = np.eye(3 + size)
        step[0, 2] = -dt * (s * dq[0] + c * dq[1])
        step[1, 2] = dt * (c * dq[0] - s * dq[1])
        for i in range(size):
            turn = dt / 2.0 * jacobian[2, i]
            step[0, 3 + i] = dt * (c * jacobian[0, i] - s * jacobian[1, i]) + step[0, 2] * turn
            step[1, 3 + i] = dt * (s * jacobian[0, i] + c * jacobian[1, i]) + step[1, 2] * turn
            step[2, 3 + i] = dt * jacobian[2, i]
            for d in range(size):
                step[3 + d, 3 + i] = (1.0 if d == i else 0.0) + dt * jacobian[3 + d, i]
        transition[:] = step @ transition
        advance(mean[:3], dq, dt, series)
        for i in range(size):
            mean[3 + i] += dt * dq[3 + i]


@njit(cache=True)
def twist_of(mean, command, terms):  # type: ignore[no-untyped-def]
    """Body twist (3,) and its derivative (3, 3 + S) at a mean (3 + S) under a command (C,)."""
    size, width = mean.shape[0] - 3, command.shape[0]
    x, dq = np.ones(size + width + 1), np.zeros(3 + size)
    jacobian, derivative = np.zeros((3 + size, size + width)), np.zeros((3, 3 + size))
    x[:size], x[size : size + width] = mean[3:], command
    rates(dq, x, terms)
    rates_jacobian(jacobian, x, terms)
    derivative[:, 3:] = jacobian[:3, :size]
    return dq[:3].copy(), derivative
