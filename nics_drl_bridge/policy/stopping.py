"""How planners assume a robot to stop: by its model, as its shield does."""

import math

import numpy as np

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.braking import Braking, find_braking


def braking_for(task: Navigation, model: SimulatorModel | None) -> Braking:
    """Returns the bound of a robot's stops from all that its task allows.

    Without a model it is the slowest lag of its kind. Raises ConfigError for a model that does not
    come to rest.
    """
    robot = task.robot
    if model is None:
        lags = [
            value for name, value in robot.parameters.items() if name.endswith("_lag")
        ]
        return Braking(max(lags, default=0.0), math.inf)
    return find_braking(robot, model.kinematics, *task.command_limits)


def longest_stop_s(braking: Braking, twists: Array) -> float:
    """Returns the longest time to rest from any of twists (K, 3) [s]."""
    return float(np.max(braking.time_s(twists), initial=0.0))
