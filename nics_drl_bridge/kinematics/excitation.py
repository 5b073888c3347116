"""Excitation: which inputs a drive moved, and which of them it moved apart from each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from nics_drl_bridge.kinematics.recording import Samples
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]

STILL = 1e-3
"""A variable whose spread is below this share of its range did not move."""
NOISE_ONLY = 1.5
"""Nor did a measured state whose spread is below this multiple of its noise."""
DEPENDENT = 1e-7
"""A standardised feature whose part orthogonal to the others is below this is a copy."""
TOGETHER = 1e-3
"""Commands move together where less than this share of one's spread is its own."""
DIFFERENCE = 6
DIFFERENCE_GAIN = np.sqrt(924.0)  # white noise grows by this in a sixth difference
GAUSSIAN_MAD = 0.6745


def unmoved_variables(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Names of the variables of X that stayed where they were for the whole drive.

    A state whose command never moved did not move either if all that it shows is noise.
    """
    limits = np.array([v.max - v.min for v in (*spec.state, *spec.command)])
    spread = samples.x.std(axis=0)
    still = spread < STILL * limits
    noise_only = spread < NOISE_ONLY * white_noise(samples.x)
    named = dict(zip(spec.variable_names, still, strict=True))
    for i, variable in enumerate(spec.state):
        followed = [variable.follows] if variable.follows else [c.name for c in spec.command]
        still[i] |= noise_only[i] and all(named[name] for name in followed)
    return tuple(n for n, s in zip(spec.variable_names, still, strict=True) if s)


def white_noise(x: Array) -> Array:
    """Standard deviation (V,) of white noise on series (T, V), from their sixth differences."""
    rest = np.diff(x, DIFFERENCE, axis=0) / DIFFERENCE_GAIN
    if len(rest) < DIFFERENCE:
        return np.zeros(x.shape[1])
    return np.asarray(np.median(np.abs(rest), axis=0) / GAUSSIAN_MAD)


def commands_together(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Names of the commands that moved, but of which one is always made of the others."""
    moved = [
        i
        for i, c in enumerate(spec.command, start=len(spec.state))
        if samples.x[:, i].std() >= STILL * (c.max - c.min)
    ]
    if len(moved) < 2:
        return ()
    unit = samples.x[:, moved] - samples.x[:, moved].mean(axis=0)
    unit = unit / np.linalg.norm(unit, axis=0)
    size, axes = np.linalg.svd(unit, full_matrices=False)[1:]
    if size[-1] > TOGETHER:
        return ()
    part_of = np.abs(axes[size <= TOGETHER]).max(axis=0) > 0.1
    return tuple(spec.variable_names[i] for i, p in zip(moved, part_of, strict=True) if p)


def levels(samples: Samples, spec: RobotSpec) -> dict[str, int]:
    """How many different values each command took; more than ten count as ten."""
    first = len(spec.state)
    return {
        c.name: min(10, len(np.unique(np.round(samples.x[:, first + i], 9))))
        for i, c in enumerate(spec.command)
    }


def independent_columns(chi: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Splits columns into an independent set and copies; low orders are kept first."""
    unit = chi / np.linalg.norm(chi, axis=0)
    independent: list[int] = []
    dependent: list[int] = []
    r = np.abs(np.diag(qr(unit, mode="r")[0]))  # without pivoting: each against those before it
    for k in range(chi.shape[1]):
        (independent if k < len(r) and r[k] > DEPENDENT else dependent).append(k)
    return np.array(independent, dtype=np.intp), np.array(dependent, dtype=np.intp)
