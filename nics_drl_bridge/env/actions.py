"""Actions: from the output of a policy to the command of a robot."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.env import kernels
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
Actions = Literal["continuous", "discrete"]

DRIVES = ((0, 0, 0), (1, 0, 0), (1, 0, 1), (1, 0, -1), (-1, 0, 0), (-1, 0, 1), (-1, 0, -1))
"""The seven drives of the paper's cars: stop; ahead, ahead to the left, to the right; and back.

They are those of the authors' code (efc-robot/MultiVehicleEnv), as signs of `cmd_vel`: linear.x,
linear.y, angular.z. A robot that can't reverse stays in place, and turns if it can on the spot.
"""
SIDEWAYS = ((0, 1, 0), (0, -1, 0))
"""Two more for a robot that moves sideways."""


def discrete_commands(robot: RobotSpec) -> Array:
    """(A, C) commands of the discrete actions: `DRIVES` at the commands' limits.

    A robot whose commands do not name fields of `cmd_vel` gets a stop, and each command alone at
    its maximum and its minimum.
    """
    if any(command.cmd_vel is None for command in robot.command):
        each = np.eye(len(robot.command), dtype=np.int64)
        signs = np.concatenate([0 * each[:1], each, -each])
    else:
        drives = (*DRIVES, *SIDEWAYS) if robot.moves_sideways else DRIVES
        signs = robot.from_cmd_vel(np.array(drives))
    limits = np.where(signs > 0, robot.command_high, robot.command_low)
    commands: Array = np.where(signs == 0, still(robot), limits)
    return commands


def still(robot: RobotSpec) -> Array:
    """(C,) the command nearest to zero, which stops a robot."""
    nearest: Array = np.clip(0.0, robot.command_low, robot.command_high)
    return nearest


def action_space(robot: RobotSpec, actions: Actions) -> gymnasium.Space[Any]:
    """Action space of one robot: Box [-1, 1] of its commands, or Discrete."""
    if actions == "discrete":
        return gymnasium.spaces.Discrete(len(discrete_commands(robot)))
    return gymnasium.spaces.Box(-1.0, 1.0, (len(robot.command),), np.float32)


def team_space(space: gymnasium.Space[Any], robots: int) -> gymnasium.Space[Any]:
    """Joint space of M robots, concatenated to a vector as algorithms expect it.

    Box (L,) becomes Box (M L,), Discrete becomes MultiDiscrete (M,); one robot's is unchanged.
    """
    if robots == 1:
        return space
    several = gymnasium.vector.utils.batch_space(space, robots)
    if not isinstance(several, gymnasium.spaces.Box):
        return several
    return gymnasium.spaces.Box(several.low.ravel(), several.high.ravel(), dtype=np.float32)


def scaled(action: ArrayLike, robot: RobotSpec) -> Array:
    """Scales continuous actions (..., C), cut to [-1, 1], to commands (..., C)."""
    given = np.ascontiguousarray(action)
    out = np.empty(given.shape)
    width = given.shape[-1]
    kernels.commands(
        out.reshape(-1, width), given.reshape(-1, width), robot.command_low, robot.command_high
    )
    return out


def check_action(action: Any, space: gymnasium.Space[Any], name: str) -> NDArray[Any]:
    """Returns an action as an array of its space's shape.

    Raises:
        gymnasium.error.InvalidAction: not numeric, of another shape, NaN, inf, or no action of
            that number.
    """
    try:
        given = np.asarray(action)
    except ValueError as error:  # a ragged list
        raise gymnasium.error.InvalidAction(f"{name}: {error}") from None
    if given.dtype.kind not in "fiub":
        raise gymnasium.error.InvalidAction(f"{name} of {given.dtype}: must be real numbers.")
    if given.shape != space.shape:
        raise gymnasium.error.InvalidAction(
            f"{name} of shape {given.shape}: must be of shape {space.shape}."
        )
    if isinstance(space, gymnasium.spaces.Box) and space.dtype == np.float32:
        if given.dtype.char not in "fd":
            given = given.astype(np.float64)  # the kernels are compiled for these two
        if not kernels.finite(given.reshape(1, -1)):
            raise gymnasium.error.InvalidAction(f"{name} {given!r}: holds NaN or inf.")
    elif not space.contains(given):
        raise gymnasium.error.InvalidAction(f"{name} {given!r}: is not in {space}.")
    return given


def check_command(command: Any, like: Array) -> Array:
    """Returns a task's command as an array, which must have the shape of `like`.

    Raises:
        ConfigError: it has another shape, or contains NaN or inf.
    """
    made = np.asarray(command, np.float64)
    if made.shape != like.shape or not kernels.finite(made.reshape(1, -1)):
        raise ConfigError(
            f"the task's command {made}: must be finite, of shape {like.shape}; look at its "
            "`command`."
        )
    return made
