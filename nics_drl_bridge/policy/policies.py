"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.policy.go_to_goal import GoToGoal


class Policy(Protocol):
    """From an observation to an action; the same in every world."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action (C,) in [-1, 1] for an observation (O,)."""
        ...


POLICIES: dict[str, Callable[[Navigation], Policy]] = {"go_to_goal": GoToGoal}


def make_policy(name: str, task: Navigation) -> Policy:
    """A policy by name. Raises ConfigError for an unknown one, with the nearest."""
    if name not in POLICIES:
        raise ConfigError(f"unknown policy {name!r}; {nearest(name, POLICIES)}")
    return POLICIES[name](task)
