"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, PolicyError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.dynamic_window import DynamicWindow
from nics_drl_bridge.policy.go_to_goal import GoToGoal
from nics_drl_bridge.policy.simple_policies import RandomActions, StraightToGoal


class Policy(Protocol):
    """From an observation to an action; the same in every world."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action (C,) in [-1, 1] for an observation (O,); or (N, C) for (N, O)."""
        ...


POLICIES: dict[str, Callable[[Navigation], Policy]] = {
    "dynamic_window": DynamicWindow,
    "go_to_goal": GoToGoal,
    "random": RandomActions,
    "straight": StraightToGoal,
}


SUFFIX = ".onnx"


def shipped_policies() -> list[str]:
    """Names of the policy files that come with the package."""
    return sorted(file.stem for file in (share_folder() / "config" / "policies").glob(f"*{SUFFIX}"))


def check_name(name: str) -> None:
    """Raises ConfigError for what is neither a policy's name nor that of a policy file."""
    files = shipped_policies()
    if name not in POLICIES and not name.endswith(SUFFIX) and name not in files:
        raise ConfigError(f"unknown policy {name!r}; {nearest(name, (*POLICIES, *files))}")


def make_policy(name: str, task: Navigation, model: SimulatorModel | None = None) -> Policy:
    """A policy by name.

    Args:
        name: of one in `POLICIES`, of a shipped policy file, or the path of a policy file.
        task: whose observations and actions it speaks.
        model: of the robot; a policy file is then checked against it, and against the task.

    Raises:
        ConfigError: an unknown name, with the nearest.
        PolicyError: the file can't be used, or does not fit; the field is named.
    """
    check_name(name)
    if name in POLICIES:
        return POLICIES[name](task)
    # Imported here: the others need neither onnx nor onnxruntime.
    policy: Policy = import_module("nics_drl_bridge.policy.policy_file").load_policy(name)
    policy.check_fits(model, task)  # type: ignore[attr-defined]
    return policy


def open_policy(name: str, model: SimulatorModel) -> tuple[Policy, Navigation]:
    """A policy by name and the navigation task that it is for.

    Args:
        name: see `make_policy`.
        model: of the robot.

    Raises:
        ConfigError, PolicyError: see `make_policy`; or it was trained for another task.
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
