"""The Taylor model in compiled code: one robot, one step, as scalar functions (Eq. 1)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def taylor_rates(x: Array, powers: NDArray[np.int64], coefficients: Array, dq: Array) -> None:
    """Writes dQ/dt (D,) at X (V,) into `dq`; powers (K, V), coefficients (D, K)."""
    dq[:] = 0.0
    for k in range(powers.shape[0]):
        term = 1.0
        for v in range(powers.shape[1]):
            for _ in range(powers[k, v]):
                term *= x[v]
        for d in range(coefficients.shape[0]):
            dq[d] += coefficients[d, k] * term


@njit(cache=True)
def move_along_arc(pose: Array, twist: Array, dt: float, out: Array) -> None:
    """Writes into `out` (3,) the pose (3,) after `dt` of a constant body twist (3,)."""
    w = twist[2] * dt
    if abs(w) < 1e-4:
        a, b = 1.0 - w * w / 6.0, w / 2.0
    else:
        a, b = math.sin(w) / w, (1.0 - math.cos(w)) / w
    x = (a * twist[0] - b * twist[1]) * dt
    y = (b * twist[0] + a * twist[1]) * dt
    c, s = math.cos(pose[2]), math.sin(pose[2])
    out[0] = pose[0] + c * x - s * y
    out[1] = pose[1] + s * x + c * y
    out[2] = pose[2] + w


@njit(cache=True)
def rollout(
    pose: Array,
    state: Array,
    command: Array,
    powers: NDArray[np.int64],
    coefficients: Array,
    dt: float,
    poses: Array,
    states: Array,
) -> None:
    """Moves robots open-loop by the steps of their commands.

    Args:
        pose: (W, 3) at the start; the heading is not wrapped on the way.
        state: (W, S) at the start.
        command: (W, N, C), one row per step.
        powers: (K, S + C).
        coefficients: (3 + S, K).
        dt: length of a step [s].
        poses: (W, N + 1, 3), written.
        states: (W, N + 1, S), written.
    """
    size, dq = state.shape[1], np.zeros(coefficients.shape[0])
    x = np.zeros(powers.shape[1])
    for w in range(pose.shape[0]):
        poses[w, 0], states[w, 0] = pose[w], state[w]
        for n in range(command.shape[1]):
            x[:size], x[size:] = states[w, n], command[w, n]
            taylor_rates(x, powers, coefficients, dq)
            move_along_arc(poses[w, n], dq[:3], dt, poses[w, n + 1])
            for i in range(size):
                states[w, n + 1, i] = states[w, n, i] + dq[3 + i] * dt
