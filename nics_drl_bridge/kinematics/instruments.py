"""Instrumental variables: a fit to measured states that are themselves noisy.

The noise of a state stands both in X and in its rate, so that least squares would take it for
a fast decay. The state one step earlier has noise of its own: what it tells of X is free of the
noise in dQ. Soederstroem, Stoica: Instrumental variable methods for system identification,
1983; two-stage least squares.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kinematics import features
from nics_drl_bridge.kinematics.dof import DofFit
from nics_drl_bridge.kinematics.excitation import white_noise
from nics_drl_bridge.kinematics.recording import Samples
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.statistics import long_run

Array = NDArray[np.float64]

NOISY = 5e-4
"""A measured state is noisy from this share of its range on."""
SAME_STEP, ROUNDING_S = 1e-3, 1e-6
WEAK = 1e4
"""Instruments whose products with the features are conditioned worse tell too little."""


def states_are_noisy(samples: Samples, spec: RobotSpec) -> bool:
    """Whether the noise of a measured state would bend a fit."""
    if not spec.state:
        return False
    size = len(spec.state)
    width = np.array([v.max - v.min for v in spec.state])
    return bool((white_noise(samples.x[:, :size]) > NOISY * width).any())


def reestimated(
    part: DofFit, dof: int, samples: Samples, powers: NDArray[np.int64], states: int
) -> DofFit:
    """A rate of the state with its kept coefficients estimated by instruments.

    Args:
        part: the fit by least squares; its terms stay.
        dof: its place in dQ.
        samples: (T,) rows that it was made of.
        powers: (K, V) of the features.
        states: S, how many of X are measured.

    Returns:
        The same with other values; unchanged where the instruments tell too little.
    """
    kept = np.flatnonzero(part.coefficients)
    follows = np.abs(np.diff(samples.t) - samples.dt) < SAME_STEP * samples.dt + ROUNDING_S
    now = np.flatnonzero(follows & part.inliers[1:] & part.inliers[:-1]) + 1
    if len(kept) == 0 or len(now) <= len(kept):
        return part
    earlier = samples.x[now].copy()
    earlier[:, :states] = samples.x[now - 1, :states]
    chi, told = (features.evaluate(x, powers[kept]) for x in (samples.x[now], earlier))
    scale, size = np.linalg.norm(chi, axis=0), np.linalg.norm(told, axis=0)
    bread = (told / size).T @ (chi / scale)
    if not np.linalg.cond(bread) < WEAK:
        return part
    target = samples.dq[now, dof]
    inverse = np.linalg.inv(bread)
    beta = inverse @ ((told / size).T @ target)
    middle = long_run(told / size, target - chi / scale @ beta)
    spread = np.sqrt(np.diag(inverse @ middle @ inverse.T))
    coefficients, errors = part.coefficients.copy(), part.errors.copy()
    coefficients[kept], errors[kept] = beta / scale, spread / scale
    return replace(part, coefficients=coefficients, errors=errors)
