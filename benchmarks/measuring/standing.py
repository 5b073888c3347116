"""The action of an env by which its robots stand."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.actions import still


def standing_action(env: gymnasium.Env[Any, Any]) -> NDArray[np.float32]:
    """That of continuous actions: limits need not lie about zero."""
    robot, robots = env.unwrapped.model.robot, env.unwrapped.robots
    low, high = robot.command_low, robot.command_high
    shares = (still(robot) - low) / (high - low)
    return np.tile(2.0 * shares - 1.0, robots).astype(np.float32)
