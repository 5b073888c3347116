"""How planners expect a robot to stop: by its model, like the shield."""

import math

import numpy as np

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.braking import Braking, find_braking


def braking_for(task: Navigation, model: SimulatorModel | None) -> Braking:
    """Returns a bound on a robot's stops from any command that its task allows.

    Without a model it uses the slowest lag of the robot's kind. Raises ConfigError for a model that
    never comes to rest.
    """
    robot = task.robot
    if model is None:
        lags = [
            value for name, value in robot.parameters.items() if name.endswith("_lag")
        ]
        return Braking(max(lags, default=0.0), math.inf)
    return find_braking(robot, model.kinematics, *task.command_limits)


def longest_stop_s(braking: Braking, twists: Array) -> float:
    """Returns the maximum time to stop from any of the twists (K, 3) [s]."""
    return float(np.max(braking.time_s(twists), initial=0.0))
