"""Drivers of the shield's benchmark: adversaries that know the true scene, and one with a goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.sim.collision_kernels import wall_distance

Array = NDArray[np.float64]
ADVERSARIES = ("ram", "graze", "late", "jerk")
HORIZON_S = (0.3, 1.0)
TRIES = 12
GRAZE = 0.01
"""So deep does the grazing adversary want to be in what it grazes [m]."""


@dataclass(frozen=True)
class Truth:
    """All that there is to know about a robot and what is around it.

    Attributes:
        pose: (3,) of the robot.
        twist: (3,) of it.
        ranges: (B,) its scan.
        circles: (K, 3) x, y, radius of the obstacles [m].
        velocities: (K, 2) theirs [m/s].
        walls: (W, 4).
        goal: (2,) [m].
    """

    pose: Array
    twist: Array
    ranges: NDArray[np.float32]
    circles: Array
    velocities: Array
    walls: Array
    goal: Array


class Driver(Protocol):
    """Says what it wants the robot to be told."""

    def act(self, truth: Truth) -> Array:
        """The command (C,)."""
        ...


class Adversary:
    """Picks, among some commands, the one that is worst by its own lights.

    It rams the nearest thing, grazes it, turns into it at the last moment, or jerks the robot
    about.

    Args:
        kind: which of the adversaries.
        model: of the robot.
        rng: draws the commands.
    """

    def __init__(
        self, kind: str, model: SimulatorModel, rng: np.random.Generator
    ) -> None:
        self._kind = kind
        self._robot = model.robot
        self._rng = rng
        self._held = np.zeros(len(model.robot.command))
        self._left = 0

    def act(self, truth: Truth) -> Array:
        """The command (C,)."""
        low = self._robot.command_low
        high = self._robot.command_high
        ends = np.where(self._rng.random((TRIES, len(low))) < 0.5, low, high)
        tries = np.concatenate([ends, self._rng.uniform(low, high, (TRIES, len(low)))])
        if self._kind == "jerk":
            return self._hold(ends[0])
        sign = 1.0
        if (
            self._kind == "late"
        ):  # away from everything for a while, then into the nearest
            self._left = (
                self._left - 1 if self._left > 0 else int(self._rng.integers(2, 15))
            )
            sign = -1.0 if self._left > 2 else 1.0
        least = self._nearest(truth, tries)
        if self._kind == "graze":
            return np.asarray(tries[int(np.argmin(np.abs(least + GRAZE)))])
        return np.asarray(tries[int(np.argmin(sign * least))])

    def _hold(self, wish: Array) -> Array:
        if self._left == 0:
            self._held, self._left = wish, int(self._rng.integers(1, 8))
        self._left -= 1
        return self._held

    def _nearest(self, truth: Truth, commands: Array) -> Array:
        """(n,) clearances [m] that commands (n, C) lead to, at the end or on the way."""
        twist = compute_steady_twist(self._robot, commands)
        moved = geometry.exp(np.multiply.outer(np.array(HORIZON_S), twist))
        places = geometry.compose(truth.pose, moved)[..., :2]
        away = np.array(
            [[wall_distance(x, y, truth.walls) for x, y in row] for row in places]
        )
        ahead = np.multiply.outer(np.array(HORIZON_S), truth.velocities)
        for k, (x, y, radius) in enumerate(truth.circles):
            there = ahead[:, None, k] + (x, y)
            away = np.minimum(
                away, np.hypot(*np.moveaxis(places - there, -1, 0)) - radius
            )
        return np.asarray(away.min(axis=0) - self._robot.footprint_radius)


class GoalDriver:
    """A policy that means well: the baseline that plans by a dynamic window.

    Args:
        model: of the robot.
    """

    RADIUS = Navigation.goal_radius

    def __init__(self, model: SimulatorModel) -> None:
        self._policy, self._task = open_policy("dynamic_window", model)

    def act(self, truth: Truth) -> Array:
        """The command (C,)."""
        view = RobotView(truth.pose, truth.twist, truth.ranges, 0.0, 0.0, 0.0)
        observation = self._task.observation(view, {"goal": truth.goal})
        return np.asarray(self._task.command(self._policy.act(observation)), np.float64)


class Standing:
    """Wants to stay where it is."""

    def __init__(self, model: SimulatorModel) -> None:
        self._size = len(model.robot.command)

    def act(self, truth: Truth) -> Array:
        """The command (C,)."""
        return np.zeros(self._size)
