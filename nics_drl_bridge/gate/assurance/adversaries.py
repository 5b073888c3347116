"""Drivers of episodes behind a gate: adversaries that know the true scene, and the policy."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Array, RobotView
from nics_drl_bridge.policy.file import stateful
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.sim.collision_kernels import wall_distance

ADVERSARIES = {
    "ram": "drives into the nearest thing",
    "graze": "brushes the nearest thing",
    "late": "keeps away, then turns into the nearest thing",
    "jerk": "jerks between the ends of its commands",
}
HORIZONS_S = (0.3, 1.0)  # look-ahead times at which commands are compared
TRIES = 12  # number of commands of each type that are compared
GRAZE_M = 0.01  # overlap at which the grazing adversary aims


@dataclass(frozen=True)
class Truth:
    """True state of a robot and its surroundings."""

    pose: Array  # (3,) of the robot
    twist: Array  # (3,) of the robot
    ranges: NDArray[np.float32]  # (B,) its scan
    circles: Array  # (K, 3) x, y, radius of the obstacles [m]
    velocities: Array  # (K, 2) of the obstacles [m/s]
    walls: Array  # (W, 4)
    goal: Array  # (2,) [m]


class Driver(Protocol):
    """Decides on the robot's commands."""

    def act(self, truth: Truth) -> Array:
        """Returns the command (C,)."""


class Adversary:
    """Picks the worst of some random commands, by one of the aims in `ADVERSARIES`."""

    def __init__(
        self, kind: str, model: SimulatorModel, rng: np.random.Generator
    ) -> None:
        self._kind = kind
        self._robot = model.robot
        self._rng = rng
        self._held = np.zeros(len(model.robot.command))
        self._left = 0

    def act(self, truth: Truth) -> Array:
        """Returns the command (C,)."""
        low = self._robot.command_low
        high = self._robot.command_high
        ends = np.where(self._rng.random((TRIES, len(low))) < 0.5, low, high)
        tries = np.concatenate([ends, self._rng.uniform(low, high, (TRIES, len(low)))])
        if self._kind == "jerk":
            return self._hold(ends[0])
        sign = 1.0
        if self._kind == "late":
            self._left -= 1
            if self._left < 0:
                self._left = int(self._rng.integers(2, 15))
            sign = -1.0 if self._left > 2 else 1.0
        clearance = self._find_clearance(truth, tries)
        if self._kind == "graze":
            return np.asarray(tries[int(np.argmin(np.abs(clearance + GRAZE_M)))])
        return np.asarray(tries[int(np.argmin(sign * clearance))])

    def _hold(self, command: Array) -> Array:
        if self._left == 0:
            self._held = command
            self._left = int(self._rng.integers(1, 8))
        self._left -= 1
        return self._held

    def _find_clearance(self, truth: Truth, commands: Array) -> Array:
        """Returns the minimum clearances (n,) [m] to which commands (n, C) lead."""
        twist = compute_steady_twist(self._robot, commands)
        horizons = np.array(HORIZONS_S)
        moved = geometry.exp(np.multiply.outer(horizons, twist))
        places = geometry.compose(truth.pose, moved)[..., :2]
        clearance = np.array(
            [[wall_distance(*place, truth.walls) for place in row] for row in places]
        )
        ahead = np.multiply.outer(horizons, truth.velocities)
        for k, circle in enumerate(truth.circles):
            centre = ahead[:, None, k] + circle[:2]
            distance = np.hypot(*np.moveaxis(places - centre, -1, 0)) - circle[2]
            clearance = np.minimum(clearance, distance)
        return np.asarray(clearance.min(axis=0) - self._robot.footprint_radius)


class PolicyDriver:
    """A policy that drives to its goal."""

    def __init__(self, policy: str, model: SimulatorModel) -> None:
        self._policy, self._task = open_policy(policy, model)
        self.goal_radius = getattr(self._task, "goal_radius", Navigation.goal_radius)

    def begin(self) -> None:
        """Begins an episode."""
        stateful.begin(self._policy)

    def act(self, truth: Truth) -> Array:
        """Returns the command (C,)."""
        view = RobotView(truth.pose, truth.twist, truth.ranges)
        observation = self._task.observation(view, {"goal": truth.goal})
        return np.asarray(self._task.command(self._policy.act(observation)), np.float64)
