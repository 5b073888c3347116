"""Prediction: where commands are expected to lead a robot that no model is known of yet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.textbook import textbook

Array = NDArray[np.float64]

TWIST_UNITS = {"linear.x": "m/s", "linear.y": "m/s", "angular.z": "rad/s"}


@dataclass(frozen=True)
class Motion:
    """How a robot is expected to move.

    Attributes:
        size: S of the state.
        respond: the state (K, S) after a command (K, C) was held for some time [s].
        twist: body twist (K, 3) of state (K, S) and command (K, C).
    """

    size: int
    respond: Callable[[Array, Array, float], Array]
    twist: Callable[[Array, Array], Array]

    def roll(self, pose: Array, state: Array, command: Array, period: float) -> tuple[Array, Array]:
        """Where commands lead, by one arc for each at the state in the middle of its period.

        Args:
            pose: (K, 3).
            state: (K, S).
            command: (K, T, C), each held for a period.
            period: [s].

        Returns:
            Poses (K, T + 1, 3) and states (K, T + 1, S), the given ones first.
        """
        poses, states = [pose], [state]
        for n in range(command.shape[1]):
            now = command[:, n]
            middle = self.respond(state, now, period / 2.0)
            pose = geometry.compose(pose, geometry.exp(self.twist(middle, now) * period))
            state = self.respond(state, now, period)
            poses.append(pose)
            states.append(state)
        return np.stack(poses, axis=1), np.stack(states, axis=1)


def expected_motion(spec: RobotSpec) -> Motion:
    """The motion of a robot's textbook kinematics, or that its `cmd_vel` is its body twist.

    Raises:
        ConfigError: it names no textbook, and a command is no part of a twist.
    """
    if spec.textbook is not None:
        book = textbook(spec)
        return Motion(
            len(spec.state),
            lambda state, command, t: book.respond(state, book.target(command), t),
            lambda state, _: book.twist(state),
        )
    for command in spec.command:
        if command.cmd_vel is None or TWIST_UNITS[command.cmd_vel] != command.unit:
            raise ConfigError(
                f"robot {spec.name!r}: where {command.name!r} in {command.unit} leads can't be "
                "predicted; add `textbook:` and its `parameters:` to the robot's YAML file."
            )
    return Motion(
        len(spec.state), lambda state, *_: state, lambda _, command: spec.to_cmd_vel(command)
    )
