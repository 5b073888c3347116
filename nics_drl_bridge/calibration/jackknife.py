"""Uncertainty of a mounting by the delete-one-block jackknife.

Efron, Tibshirani: An Introduction to the Bootstrap, ch. 11. It sees what formulas of least squares
do not: wheels that slip alike for seconds, and errors of the regressors themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.calibration.mounting import Mounting
from nics_drl_bridge.calibration.noise import Motion
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.kinematics.recording import Recording

Array = NDArray[np.float64]

BLOCKS = 8
Estimate = Callable[[Recording, Motion], Mounting | None]


def jackknifed(
    recording: Recording, twists: Motion, offset: float, estimate: Estimate
) -> Mounting | None:
    """A mounting, its uncertainty at least that of leaving out blocks of the drive in turn.

    Args:
        recording: the drive.
        twists: of the tracked body.
        offset: of the pose's clock, as in `Calibration` [s].
        estimate: of a drive and its twists.

    Returns:
        The mounting of the whole drive; None if it shows none.
    """
    whole = estimate(recording, twists)
    if whole is None:
        return None
    edges = np.linspace(twists.start[0], twists.end[-1], BLOCKS + 1)
    parts = [
        estimate(*_without(recording, twists, offset, begin, end)) for begin, end in pairwise(edges)
    ]
    found = [part for part in parts if part is not None]
    if len(found) < BLOCKS:
        return whole
    rotation = wrap_angle(np.array([p.rotation - whole.rotation for p in found]))
    lever = np.array([p.lever for p in found])
    return replace(
        whole,
        rotation_sigma=max(whole.rotation_sigma, float(_spread(rotation))),
        lever_sigma=np.maximum(whole.lever_sigma, _spread(lever)),
    )


def _spread(values: Array) -> Array:
    """Standard errors (...) of estimates (B, ...) that each left one block out."""
    return np.asarray(np.sqrt((len(values) - 1.0) * values.var(axis=0)))


def _without(
    recording: Recording, twists: Motion, offset: float, begin: float, end: float
) -> tuple[Recording, Motion]:
    """Leaves out the twists and the measured state between two times of the pose's clock."""
    rows = (twists.end <= begin) | (twists.start >= end)
    kept = Motion(twists.start[rows], twists.end[rows], twists.twist[rows])
    state = recording.state
    if state is None:
        return recording, kept
    outside = (state.t < begin + offset) | (state.t > end + offset)
    cut = replace(state, t=state.t[outside], values=state.values[outside])
    return replace(recording, state=cut), kept
