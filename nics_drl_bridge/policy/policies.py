"""Policies by name: baselines that any trained policy must beat, a planner, and policy files."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, PolicyError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy import dynamic_window_kernels as kernels
from nics_drl_bridge.policy.contract import SUFFIX, shipped
from nics_drl_bridge.robot.kinds import command_for, reach, steady_twist
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

FULL_TURN_RAD = 0.8  # bearing of the goal from which a robot turns as fast as it can
CREEP = 0.3  # share of the speed for a robot that can't turn on the spot and has its goal behind


class Policy(Protocol):
    """Maps observations to actions; the same in every world."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the action (C,) in [-1, 1] for an observation (O,); or (N, C) for (N, O)."""


def _actions(robot: RobotSpec, commands: Array) -> Array:
    low, high = robot.command_low, robot.command_high
    return np.asarray(2.0 * (commands - low) / (high - low) - 1.0)


@dataclass(frozen=True)
class StraightToGoal:
    """Turns to the goal and drives there, ignoring obstacles; ConfigError: see `command_for`."""

    task: Navigation

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Policy`."""
        robot, first = self.task.robot, self.task.scan_parts + 1
        cosine, sine = np.moveaxis(observation[..., first : first + 2].astype(float), -1, 0)
        turn = np.clip(np.arctan2(sine, cosine) / FULL_TURN_RAD, -1.0, 1.0)
        ahead = np.maximum(cosine, 0.0 if self._turns_in_place else CREEP)
        shares = np.stack([ahead, np.zeros_like(ahead), turn], axis=-1)
        if robot.takes_cmd_vel:
            wanted = robot.of_fields(shares) * robot.command_high
        else:
            wanted = command_for(robot, shares * self._reach)
        return np.clip(_actions(robot, wanted), -1.0, 1.0).astype(np.float32)

    @cached_property
    def _reach(self) -> Array:
        return reach(self.task.robot)

    @cached_property
    def _turns_in_place(self) -> bool:
        robot = self.task.robot
        if robot.takes_cmd_vel:
            return not robot.steers
        return bool(command_for(robot, self._reach * (0.0, 0.0, 1.0)).any())


@dataclass(frozen=True)
class RandomActions:
    """Draws each action at random, ignoring the observation."""

    task: Navigation
    seed: int = 0

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Policy`."""
        shape = (*observation.shape[:-1], len(self.task.robot.command))
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32)

    @cached_property
    def _rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)


@dataclass(frozen=True)
class DynamicWindow:
    """The dynamic-window approach (Fox, Burgard, Thrun 1997); ConfigError: see `steady_twist`."""

    task: Navigation
    margin: float = 0.05  # clearance to keep around the footprint [m]
    period: float = 0.1  # between commands [s]
    steps: int = 10  # of the look-ahead, each a period and a half long
    weights: tuple[float, float, float, float] = (1.0, 0.6, 0.3, 1.5)  # see `TwistWeights`

    def __post_init__(self) -> None:
        _ = self._search

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Policy`."""
        parts = self.task.scan_parts
        seen = np.atleast_2d(observation).astype(np.float64)
        goals = seen[:, parts : parts + 1] * seen[:, parts + 1 : parts + 3]
        chosen = np.empty(len(seen), np.int64)
        kernels.choose_all(
            chosen, np.ascontiguousarray(seen[:, :parts]), goals,
            np.ascontiguousarray(seen[:, parts + 3 : parts + 6]), *self._search,
        )  # fmt: skip
        return self._scaled[chosen[0] if observation.ndim == 1 else chosen]

    @cached_property
    def _search(self) -> tuple[Array, kernels.ScanRays, kernels.LookAhead, kernels.TwistWeights]:
        robot, sight = self.task.robot, self.task.sight
        twists = steady_twist(robot, self._commands)
        directions = np.stack([np.cos(sight.angles), np.sin(sight.angles)], axis=-1)
        rays = kernels.ScanRays(directions, sight.origin, float(sight.range_max))
        lags = [value for name, value in robot.parameters.items() if name.endswith("_lag")]
        lag = max(lags, default=0.0)
        share = 1.0 - math.exp(-self.period / lag) if lag > 0.0 else 1.0
        reach = share * (twists.max(axis=0) - twists.min(axis=0)) + 1e-6
        radius, rest = robot.footprint_radius + self.margin, 2.0 * self.period + lag
        ahead = kernels.LookAhead(reach, radius, 1.5 * self.period, self.steps, rest)
        return twists, rays, ahead, kernels.TwistWeights(*self.weights)

    @cached_property
    def _commands(self) -> Array:
        robot = self.task.robot
        counts = {1: (15,), 2: (7, 15), 3: (7, 7, 5)}.get(len(robot.command))
        axes = [
            np.unique(np.append(np.linspace(one.min, one.max, count), np.clip(0, one.min, one.max)))
            for one, count in zip(robot.command, counts or [3] * len(robot.command), strict=True)
        ]
        return np.array(list(itertools.product(*axes)))

    @cached_property
    def _scaled(self) -> NDArray[np.float32]:
        return _actions(self.task.robot, self._commands).astype(np.float32)


POLICIES: dict[str, Callable[[Navigation], Policy]] = {
    "dynamic_window": DynamicWindow, "random": RandomActions, "straight": StraightToGoal,
}  # fmt: skip


def shipped_policies() -> list[str]:
    """Names of the policy files that come with the package."""
    return sorted(file.stem for file in shipped().glob(f"*{SUFFIX}"))


def is_policy_file(name: str) -> bool:
    """True for a policy file or the name of a shipped one. Raises ConfigError if unknown."""
    files = shipped_policies()
    if name not in POLICIES and not name.endswith(SUFFIX) and name not in files:
        raise ConfigError(f"unknown policy {name!r}; {nearest(name, (*POLICIES, *files))}")
    return name not in POLICIES


def make_policy(name: str, task: Navigation, model: SimulatorModel | None = None) -> Policy:
    """Makes a policy by name, or the path of a file. Raises ConfigError, PolicyError."""
    if not is_policy_file(name):
        return POLICIES[name](task)
    from nics_drl_bridge.policy.policy_file import load_policy  # the others need no onnxruntime

    policy = load_policy(name)
    policy.check_fits(model, task)
    return policy


def open_policy(name: str, model: SimulatorModel) -> tuple[Policy, Navigation]:
    """Opens a policy and its navigation task; PolicyError if it was trained for another task."""
    if not is_policy_file(name):
        task = Navigation(model.robot, model.lidar)
        return POLICIES[name](task), task
    from nics_drl_bridge.policy.policy_file import load_policy

    policy = load_policy(name)
    found = policy.make_task(model)
    if not isinstance(found, Navigation):
        reason = f"is {policy.contract.task.name!r}; this drives policies of 'navigation'."
        raise PolicyError(name, "task.name", reason)
    return policy, found
