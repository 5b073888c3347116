"""Baselines that any policy must beat: straight to the goal, and random actions.

Policies by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, PolicyError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.planners import DynamicWindow

FULL_TURN_RAD = 0.8
"""Bearing of the goal from which a robot turns as fast as it can."""
CREEP = 0.3
"""Share of the maximum speed for a robot that can't turn on the spot and has its goal behind."""


@dataclass(frozen=True)
class StraightToGoal:
    """Turns to the goal and drives there, ignoring obstacles.

    Attributes:
        task: defines observations and actions.
    """

    task: Navigation

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the action (C,) for an observation (O,); or (N, C) for (N, O)."""
        robot, first = self.task.robot, self.task.scan_parts + 1
        cosine, sine = np.moveaxis(observation[..., first : first + 2].astype(float), -1, 0)
        turn = np.clip(np.arctan2(sine, cosine) / FULL_TURN_RAD, -1.0, 1.0)
        ahead = np.maximum(cosine, CREEP if robot.steers else 0.0)
        shares = np.stack([ahead, np.zeros_like(ahead), turn], axis=-1)
        wanted = robot.from_cmd_vel(shares) * robot.command_high
        low, high = robot.command_low, robot.command_high
        return np.clip(2.0 * (wanted - low) / (high - low) - 1.0, -1.0, 1.0).astype(np.float32)


@dataclass(frozen=True)
class RandomActions:
    """Draws each action at random, ignoring the observation.

    Attributes:
        task: defines the actions.
        seed: of the draws.
    """

    task: Navigation
    seed: int = 0
    _rng: list[np.random.Generator] = field(default_factory=list, repr=False)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns an action (C,); or (N, C) for (N, O)."""
        if not self._rng:
            self._rng.append(np.random.default_rng(self.seed))
        shape = (*observation.shape[:-1], len(self.task.robot.command))
        return self._rng[0].uniform(-1.0, 1.0, shape).astype(np.float32)


class Policy(Protocol):
    """Maps observations to actions; the same in every world."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the action (C,) in [-1, 1] for an observation (O,); or (N, C) for (N, O)."""
        ...


POLICIES: dict[str, Callable[[Navigation], Policy]] = {
    "dynamic_window": DynamicWindow,
    "random": RandomActions,
    "straight": StraightToGoal,
}


SUFFIX = ".onnx"


def shipped_policies() -> list[str]:
    """Names of the policy files that come with the package."""
    return sorted(file.stem for file in (share_folder() / "config" / "policies").glob(f"*{SUFFIX}"))


def check_name(name: str) -> None:
    """Raises ConfigError for a name that is neither a policy's nor a policy file's."""
    files = shipped_policies()
    if name not in POLICIES and not name.endswith(SUFFIX) and name not in files:
        raise ConfigError(f"unknown policy {name!r}; {nearest(name, (*POLICIES, *files))}")


def make_policy(name: str, task: Navigation, model: SimulatorModel | None = None) -> Policy:
    """Makes a policy by name.

    Args:
        name: a key of `POLICIES`, a shipped policy file, or the path of a policy file.
        task: defines observations and actions.
        model: of the robot; a policy file is checked against it and the task.

    Raises:
        ConfigError: an unknown name; suggests the nearest.
        PolicyError: the file can't be used, or does not fit; names the field.
    """
    check_name(name)
    if name in POLICIES:
        return POLICIES[name](task)
    # Imported here: the others need neither onnx nor onnxruntime.
    policy: Policy = import_module("nics_drl_bridge.policy.policy_file").load_policy(name)
    policy.check_fits(model, task)  # type: ignore[attr-defined]
    return policy


def open_policy(name: str, model: SimulatorModel) -> tuple[Policy, Navigation]:
    """Opens a policy by name, with the navigation task that it is for.

    Args:
        name: see `make_policy`.
        model: of the robot.

    Raises:
        ConfigError, PolicyError: see `make_policy`; or the policy was trained for another task.
    """
    if name in POLICIES or not (name.endswith(SUFFIX) or name in shipped_policies()):
        task = Navigation(model.robot, model.lidar)
        return make_policy(name, task, model), task
    policy = import_module("nics_drl_bridge.policy.policy_file").load_policy(name)
    found = policy.make_task(model)
    if not isinstance(found, Navigation):
        reason = f"is {policy.contract.task.name!r}; this drives policies of 'navigation'."
        raise PolicyError(name, "task.name", reason)
    return policy, found
