"""A policy that stands still: what every benchmark of driving has to fail with."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.task import Task, discrete_commands, still


class Standing:
    """Stands still, whatever it sees.

    Args:
        task: of the robot.
    """

    def __init__(self, task: Task) -> None:
        robot = task.robot
        rest = still(task.robot)
        if isinstance(task.action_space, gymnasium.spaces.Discrete):
            off = np.abs(discrete_commands(robot) - rest).sum(axis=1)
            self._action = np.asarray(off.argmin())
        else:
            low, high = task.command_limits
            share = (rest - low) / (high - low)
            self._action = (2.0 * share - 1.0).astype(np.float32)

    def act(self, observation: NDArray[np.float32]) -> NDArray[Any]:
        """The same action for every observation (..., O)."""
        lead = observation.shape[:-1]
        return np.broadcast_to(self._action, (*lead, *self._action.shape)).copy()


def standing_action(env: gymnasium.Env[Any, Any]) -> NDArray[Any]:
    """The action of an env by which all its robots stand."""
    still_env: Any = env.unwrapped
    return np.tile(Standing(still_env.task).act(np.empty(0)), still_env.robots)
