"""The least that a policy must beat: straight to the goal, and actions at random."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation

FULL_TURN_RAD = 0.8
"""From this bearing of the goal on, a robot turns as fast as it can."""
CREEP = 0.3
"""Share of the greatest speed of a robot that can't turn on the spot and has its goal behind."""


@dataclass(frozen=True)
class StraightToGoal:
    """Turns to the goal and drives there, whatever stands in between.

    Attributes:
        task: whose observations and actions it speaks.
    """

    task: Navigation

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action (C,) for an observation (O,); or (N, C) for (N, O)."""
        robot, first = self.task.robot, self.task.scan_parts + 1
        cosine, sine = np.moveaxis(observation[..., first : first + 2].astype(float), -1, 0)
        turn = np.clip(np.arctan2(sine, cosine) / FULL_TURN_RAD, -1.0, 1.0)
        steers = any(one.cmd_vel == "angular.z" and one.unit == "rad" for one in robot.command)
        ahead = np.maximum(cosine, CREEP if steers else 0.0)
        shares = {"linear.x": ahead, "angular.z": turn}
        wanted = np.zeros((*cosine.shape, len(robot.command)))
        for i, one in enumerate(robot.command):
            if one.cmd_vel in shares:
                wanted[..., i] = shares[one.cmd_vel] * one.max
        low, high = robot.command_low, robot.command_high
        return np.clip(2.0 * (wanted - low) / (high - low) - 1.0, -1.0, 1.0).astype(np.float32)


@dataclass(frozen=True)
class RandomActions:
    """Draws each action anew, whatever it sees.

    Attributes:
        task: whose actions it speaks.
        seed: of the draws.
    """

    task: Navigation
    seed: int = 0
    _rng: list[np.random.Generator] = field(default_factory=list, repr=False)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """An action (C,); or (N, C) for (N, O)."""
        if not self._rng:
            self._rng.append(np.random.default_rng(self.seed))
        shape = (*observation.shape[:-1], len(self.task.robot.command))
        return self._rng[0].uniform(-1.0, 1.0, shape).astype(np.float32)
