"""A policy, and the state that it may keep during an episode."""

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError

Rows = NDArray[np.float32]
Step = Callable[[Rows, Rows], tuple[NDArray[Any], Rows]]
"""Actions (..., C) and the next state (..., S), for observations (..., O) and a state (..., S)."""


class Policy(Protocol):
    """Maps observations to actions; the interface is the same in every world."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the action (C,) in [-1, 1] for an observation (O,); or (N, C) for (N, O)."""


class Stateful:
    """Policy that keeps a state between the steps of an episode, one row per world."""

    def __init__(
        self, step: Step, size: int, start: float, longest_gap: float = math.inf
    ) -> None:
        self._step = step
        self._start = np.full(size, start, np.float32)
        self._longest_gap = longest_gap  # maximum time between observations [s]
        self._state: Rows | None = None
        self._time = math.inf  # time of the last observation [s]

    def reset(self, worlds: NDArray[np.bool_] | None = None) -> None:
        """Resets the state for a new episode, in some worlds (N,) or in all of them."""
        if worlds is None or self._state is None:
            self._state = None
            self._time = math.inf
        else:
            self._state[worlds] = self._start

    def resume(self, time_s: float) -> str:
        """Resets the state if there was a gap before an observation at this time [s].

        Returns the reason, or '' if it was not reset.
        """
        gap = time_s - self._time
        self._time = time_s
        if gap <= self._longest_gap:
            return ""
        self.reset()
        self._time = time_s
        return (
            f"no observation for {gap:.3g} s, longer than the {self._longest_gap:g} s for which "
            "the policy's state stays valid; the state was reset."
        )

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Chooses the action; see `Policy`. Raises ConfigError if the number of worlds changed."""
        lead = observation.shape[:-1]
        if self._state is None:
            self._state = np.tile(self._start, (*lead, 1))
        if self._state.shape[:-1] != lead:
            raise ConfigError(
                f"the state has {self._state.shape[:-1]} worlds, the observations "
                f"{lead}; reset the policy when episodes begin."
            )
        action, self._state = self._step(observation, self._state)
        return action


def begin(policy: Any, *worlds: Any) -> None:
    """Resets a policy, or the owner of a method `act`, if it is stateful; see `Stateful.reset`."""
    reset = getattr(getattr(policy, "__self__", policy), "reset", None)
    if reset is not None:
        reset(*worlds)


def resume(policy: Policy, time_s: float) -> str:
    """Resumes a policy, see `Stateful.resume`; returns '' for a policy without a state."""
    resume_policy = getattr(policy, "resume", None)
    return "" if resume_policy is None else str(resume_policy(time_s))
