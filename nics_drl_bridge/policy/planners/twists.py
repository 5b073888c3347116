"""Commands of a robot, the steady twists to which they lead, and the actions that send them."""

import itertools

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.robot.spec import RobotSpec

SETTLED_S = 5.0  # time to the steady twist of a held command


def list_commands(robot: RobotSpec) -> Array:
    """Returns a grid of commands (K, C) over the full range of each, including rest."""
    counts = {1: (15,), 2: (7, 15), 3: (7, 7, 5)}.get(len(robot.command))
    axes = [
        np.unique(
            np.append(
                np.linspace(command.min, command.max, count),
                np.clip(0, command.min, command.max),
            )
        )
        for command, count in zip(
            robot.command, counts or [3] * len(robot.command), strict=True
        )
    ]
    return np.array(list(itertools.product(*axes)))


def find_steady_twists(
    task: Navigation, commands: Array, model: SimulatorModel | None
) -> Array:
    """Returns the steady body twists (K, 3) of held commands (K, C).

    Uses the model if the robot does not take `cmd_vel`, whose kind is only approximate, or if its
    motors distort commands, which no kind describes.
    """
    if model is None or (task.robot.takes_cmd_vel and model.kinematics.is_plain):
        return compute_steady_twist(task.robot, commands)
    kinematics = model.kinematics
    start = np.zeros((len(commands), 3))
    state = np.zeros((len(commands), kinematics.state_size))
    moved = start
    low = kinematics.low[: state.shape[1]]
    high = kinematics.high[: state.shape[1]]
    for _ in range(round(SETTLED_S / kinematics.dt)):
        moved, state = kinematics.step(start, state, commands)
        state = np.clip(state, low, high)
    return geometry.log(moved) / kinematics.dt


def scale_to_actions(task: Navigation, commands: Array) -> Singles:
    """Returns the continuous actions (..., C) for commands (..., C), clamped to [-1, 1]."""
    low, high = task.command_limits
    return np.clip(2.0 * (commands - low) / (high - low) - 1.0, -1.0, 1.0).astype(
        np.float32
    )
