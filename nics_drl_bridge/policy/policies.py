"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.policy.dynamic_window import DynamicWindow
from nics_drl_bridge.policy.go_to_goal import GoToGoal
from nics_drl_bridge.policy.simple_policies import RandomActions, StraightToGoal


class Policy(Protocol):
    """From an observation to an action; the same in every world."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action (C,) in [-1, 1] for an observation (O,)."""
        ...


POLICIES: dict[str, Callable[[Navigation], Policy]] = {
    "dynamic_window": DynamicWindow,
    "go_to_goal": GoToGoal,
    "random": RandomActions,
    "straight": StraightToGoal,
}


def make_policy(name: str, task: Navigation) -> Policy:
    """A policy by name. Raises ConfigError for an unknown one, with the nearest."""
    if name not in POLICIES:
        raise ConfigError(f"unknown policy {name!r}; {nearest(name, POLICIES)}")
    return POLICIES[name](task)


def act_all(policy: Policy) -> Callable[[NDArray[np.float32]], NDArray[Any]]:
    """A policy for many robots: actions (N, C) for observations (N, O)."""
    batched = getattr(policy, "act_all", None)
    if batched is not None:
        return lambda observations: np.asarray(batched(observations))
    return lambda observations: np.stack([policy.act(one) for one in observations])
