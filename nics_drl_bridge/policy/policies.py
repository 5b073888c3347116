"""Policies by name: baselines that a trained policy must beat, planners, and policy files."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from nics_drl_bridge.config import read_text
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, PolicyError, suggest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.policy.file.contract import MAPPINGS, SUFFIX, shipped
from nics_drl_bridge.policy.file.stateful import Policy, Stateful
from nics_drl_bridge.policy.planners.dynamic_window import DynamicWindow
from nics_drl_bridge.policy.planners.mppi import Mppi
from nics_drl_bridge.policy.planners.twists import (
    find_steady_twists,
    list_commands,
    scale_to_actions,
)
from nics_drl_bridge.robot.kinds import find_command, has_textbook, reach

if TYPE_CHECKING:
    from nics_drl_bridge.policy.file.policy_file import PolicyFile


FULL_TURN_RAD = 0.8  # bearing of the goal above which a robot turns at full rate
# minimum of a twist component that counts as controllable [m/s, rad/s]
LEAST_REACH = 1e-3
# fraction of the speed if the goal is behind a robot that can't turn in place
CREEP = 0.3


@dataclass(frozen=True)
class StraightToGoal:
    """Turns to the goal and drives there, ignoring obstacles."""

    task: Navigation
    # provides the twists of a robot whose kind does not define them
    model: SimulatorModel | None = None

    def act(self, observation: Singles) -> Singles:
        """Chooses the action; see `Policy`."""
        robot = self.task.robot
        first = self.task.scan_parts + 1
        cosine, sine = np.moveaxis(
            observation[..., first : first + 2].astype(float), -1, 0
        )
        turn = np.clip(np.arctan2(sine, cosine) / FULL_TURN_RAD, -1.0, 1.0)
        ahead = np.maximum(cosine, 0.0 if self._turns_in_place else CREEP)
        shares = np.stack([ahead, np.zeros_like(ahead), turn], axis=-1)
        if robot.takes_cmd_vel:
            wanted = robot.from_fields(shares) * robot.command_high
        else:
            wanted = self._command(shares)
        return scale_to_actions(self.task, wanted)

    def _command(self, shares: Array) -> Array:
        """Returns commands (..., C) for fractions (..., 3) of the maximum twist."""
        robot = self.task.robot
        if has_textbook(robot):
            return find_command(robot, shares * self._reach)
        commands, twists = self._known
        apart = twists / self._reach - shares[..., None, :]
        return np.asarray(commands[(apart**2).sum(axis=-1).argmin(axis=-1)])

    @cached_property
    def _known(self) -> tuple[Array, Array]:
        commands = list_commands(self.task.robot)
        return commands, find_steady_twists(self.task, commands, self.model)

    @cached_property
    def _reach(self) -> Array:
        if has_textbook(self.task.robot):
            return reach(self.task.robot)
        return np.asarray(np.maximum(np.abs(self._known[1]).max(axis=0), LEAST_REACH))

    @cached_property
    def _turns_in_place(self) -> bool:
        if self.task.robot.takes_cmd_vel:
            return not self.task.robot.steers
        return bool(self._command(np.array([0.0, 0.0, 1.0])).any())


@dataclass(frozen=True)
class RandomActions:
    """Draws each action at random, ignoring the observation."""

    task: Navigation
    seed: int = 0

    def act(self, observation: Singles) -> Singles:
        """Draws the action; see `Policy`."""
        shape = (*observation.shape[:-1], len(self.task.robot.command))
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32)

    @cached_property
    def _rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)


POLICIES: dict[str, Callable[[Navigation, SimulatorModel | None], Policy]] = {
    "dynamic_window": DynamicWindow,
    "mppi": Mppi,
    "random": lambda task, _: RandomActions(task),
    "straight": StraightToGoal,
}


def list_shipped_policies() -> list[str]:
    """Returns the names of the shipped policy files."""
    return sorted(file.stem for file in shipped().glob(f"*{SUFFIX}"))


def is_policy_file(name: str) -> bool:
    """Returns True for a policy file, the name of a shipped one, or a foreign policy's mapping.

    Returns False for a baseline or planner. Raises ConfigError for an unknown name.
    """
    files = list_shipped_policies()
    if (
        name not in POLICIES
        and not name.endswith((SUFFIX, *MAPPINGS))
        and name not in files
    ):
        raise ConfigError(
            f"unknown policy {name!r}; {suggest(name, (*POLICIES, *files))}"
        )
    return name not in POLICIES


def check_policy_file(name: str) -> None:
    """Raises PolicyError or ConfigError unless a policy file can be read, for any robot."""
    from nics_drl_bridge.policy.file.policy_file import load_policy

    if name.endswith(MAPPINGS):
        read_text(name)
    else:
        load_policy(name)


def make_policy(
    name: str, task: Navigation, model: SimulatorModel | None = None
) -> Policy:
    """Makes a policy from a name or the path of a file. Raises ConfigError, PolicyError."""
    if not is_policy_file(name):
        return POLICIES[name](task, model)
    # Only policy files need onnxruntime.
    from nics_drl_bridge.policy.file.policy_file import load_policy

    policy = load_policy(name, model)
    policy.check_fits(model, task)
    return _keep_state(policy)


def open_policy(
    name: str, model: SimulatorModel, kind: str | None = None
) -> tuple[Policy, Navigation]:
    """Opens a policy and its task: navigation, or the task class `kind`.

    `kind` is path/to/file.py:ClassName. Raises ConfigError, and PolicyError for another task.
    """
    if not is_policy_file(name):
        if kind is not None:
            raise ConfigError(
                f"policy {name!r} only drives the task 'navigation'; use another "
                "policy, or leave out --task."
            )
        task = Navigation(model.robot, model.lidar)
        return POLICIES[name](task, model), task
    from nics_drl_bridge.policy.file.policy_file import load_policy

    policy = load_policy(name, model)
    opened: Any = policy.make_task(model, kind)  # any task, if `kind` names its class
    if kind is None and not isinstance(opened, Navigation):
        raise PolicyError(
            name,
            "task.name",
            f"is {policy.contract.task.name!r}; only policies of 'navigation' can be driven.",
        )
    return _keep_state(policy), opened


def _keep_state(policy: "PolicyFile") -> Policy:
    """Returns the policy of a file, wrapped to keep its state if it has one."""
    kept = policy.contract.state
    if kept is None:
        return policy
    return Stateful(policy.step, kept.size, kept.start, kept.longest_gap)
