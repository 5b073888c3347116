"""Prediction: where commands lead robots, by the textbook or by a model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.kinematics.kernels import SERIES, rollout, term_arrays
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.textbook import textbook

Array = NDArray[np.float64]
Motion = Callable[[Array, Array, Array], tuple[Array, Array]]
"""Poses (K, T + 1, 3) and states (K, T + 1, S) of pose (K, 3), state (K, S), command (K, T, C)."""

PERIOD_S = 0.05
SUBSTEPS = 2


def textbook_motion(spec: RobotSpec, period: float = PERIOD_S) -> Motion:
    """The textbook's prediction, in steps of half a period."""
    book, h = textbook(spec), period / SUBSTEPS
    decay, half = np.exp(-h / book.lag), np.exp(-h / 2.0 / book.lag)

    def predict(pose: Array, state: Array, command: Array) -> tuple[Array, Array]:
        poses, states = [pose], [state]
        for n in range(command.shape[1]):
            goal = book.target(command[:, n])
            for _ in range(SUBSTEPS):
                middle = goal + (state - goal) * half
                pose = geometry.compose(pose, geometry.exp(book.twist(middle) * h))
                state = goal + (state - goal) * decay
            poses.append(pose)
            states.append(state)
        return np.stack(poses, axis=1), np.stack(states, axis=1)

    return predict


def model_motion(model: TaylorModel, period: float = PERIOD_S) -> Motion:
    """The prediction of a model that was learnt before."""
    terms, steps = term_arrays(model), max(1, round(period / model.dt))

    def predict(pose: Array, state: Array, command: Array) -> tuple[Array, Array]:
        held = np.repeat(command, steps, axis=1)
        poses = np.empty((len(pose), held.shape[1] + 1, 3))
        states = np.empty((*poses.shape[:2], state.shape[1]))
        poses[:, 0], states[:, 0] = pose, state
        rollout(poses, states, held, terms, SERIES, period / steps)
        return poses[:, ::steps], states[:, ::steps]

    return predict
