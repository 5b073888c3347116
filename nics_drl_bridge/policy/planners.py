"""Planners, policies that need no training: a dynamic window, the best twist for a moment."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.policy import dynamic_window_kernels as kernels
from nics_drl_bridge.robot.kinds import steady_twist

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DynamicWindow:
    """The dynamic-window approach (Fox, Burgard, Thrun 1997) on scan, goal and twist.

    Tries the twists that the commands allow and that the robot can reach from its present one in a
    period; each is held for the look-ahead. A twist with a contact before the robot could stop is
    inadmissible; the best of the others in distance, aim, clearance and time to contact is chosen.
    It plans no path: behind a long wall it stays. Which twist a command leads to follows from the
    robot's kind and parameters.

    Attributes:
        task: defines observations and actions.
        margin: clearance to keep around the footprint [m].
        period: between commands [s].
        steps: of the look-ahead, each a period and a half long.
        weights: of gap to the goal [1/m], aim, clearance, and time until a contact.

    Raises:
        ConfigError: it is not known where the robot's commands lead, see `steady_twist`.
    """

    task: Navigation
    margin: float = 0.05
    period: float = 0.1
    steps: int = 10
    weights: tuple[float, float, float, float] = (1.0, 0.6, 0.3, 1.5)

    def __post_init__(self) -> None:
        _ = self._twists

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the action (C,) for an observation (O,); or (N, C) for (N, O)."""
        parts = self.task.scan_parts
        seen = np.atleast_2d(observation).astype(np.float64)
        goals = seen[:, parts : parts + 1] * seen[:, parts + 1 : parts + 3]
        chosen = np.empty(len(seen), np.int64)
        kernels.choose_all(
            chosen, np.ascontiguousarray(seen[:, :parts]), goals,
            np.ascontiguousarray(seen[:, parts + 3 : parts + 6]),
            self._twists, self._rays, self._ahead, kernels.TwistWeights(*self.weights),
        )  # fmt: skip
        return self._actions[chosen[0] if observation.ndim == 1 else chosen]

    @cached_property
    def _rays(self) -> kernels.ScanRays:
        sight = self.task.sight
        directions = np.stack([np.cos(sight.angles), np.sin(sight.angles)], axis=-1)
        return kernels.ScanRays(directions, sight.origin, float(sight.range_max))

    @cached_property
    def _ahead(self) -> kernels.LookAhead:
        robot = self.task.robot
        lags = [value for name, value in robot.parameters.items() if name.endswith("_lag")]
        lag = max(lags, default=0.0)
        share = 1.0 - math.exp(-self.period / lag) if lag > 0.0 else 1.0
        reach = share * (self._twists.max(axis=0) - self._twists.min(axis=0)) + 1e-6
        radius = robot.footprint_radius + self.margin
        rest = 2.0 * self.period + lag
        return kernels.LookAhead(reach, radius, 1.5 * self.period, self.steps, rest)

    @cached_property
    def _commands(self) -> Array:
        """(K, C) grid of commands between their limits, including zero."""
        robot = self.task.robot
        counts = {1: (15,), 2: (7, 15), 3: (7, 7, 5)}.get(len(robot.command))
        axes = [
            np.unique(np.append(np.linspace(one.min, one.max, count), np.clip(0, one.min, one.max)))
            for one, count in zip(robot.command, counts or [3] * len(robot.command), strict=True)
        ]
        return np.array(list(itertools.product(*axes)))

    @cached_property
    def _actions(self) -> NDArray[np.float32]:
        """(K, C) the same commands, scaled to [-1, 1]."""
        low, high = self.task.robot.command_low, self.task.robot.command_high
        return (2.0 * (self._commands - low) / (high - low) - 1.0).astype(np.float32)

    @cached_property
    def _twists(self) -> Array:
        """(K, 3) body twist of each command."""
        return steady_twist(self.task.robot, self._commands)
