"""The worlds of a training: vector envs that are stepped together."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.arrays import AnyArray, Integers, Mask, Singles

SUCCESS = "is_success"
COLLISION = "collision"


class Endings(NamedTuple):
    """The K episodes that ended in a step of all worlds."""

    worlds: Integers  # (K,) their worlds
    truncated: Mask  # (K,) those that only the time limit ended
    # (K,) success and collision, if the task reports them
    flags: dict[str, Mask]
    observations: Singles  # (K, O) their last observations

    def get_flag(self, name: str) -> Mask:
        """Returns a flag (K,); False if the task does not tell it."""
        return self.flags.get(name, np.zeros(len(self.worlds), np.bool_))


class Step(NamedTuple):
    """A step of all N worlds."""

    # (N, O) current observations; where an episode ended, the first of the next one
    observations: Singles
    rewards: Singles  # (N,)
    ended: Mask  # (N,)
    endings: Endings


class TrainingWorlds:
    """Joins `BridgeVectorEnv`s (`SameStep`, `copy=True`). Raises ConfigError for others."""

    def __init__(self, *envs: BridgeVectorEnv) -> None:
        for env in envs:
            if (
                env.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP
                or not env.copy
            ):
                raise ConfigError(
                    "a training needs BridgeVectorEnv(autoreset_mode='SameStep', copy=True)."
                )
        first = envs[0]
        spaces = [env.single_observation_space for env in envs]
        for space in spaces:
            if space != spaces[0]:
                raise ConfigError(
                    f"the combined vector envs have the spaces {spaces[0]} and {space}; use the "
                    "same robot, lidar and task."
                )
        self.envs = envs
        edges = np.cumsum([0, *(env.num_envs for env in envs)])
        self._rows = [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
        self.num_envs = int(edges[-1])
        self.observation_space = cast(
            "gymnasium.spaces.Box", first.single_observation_space
        )
        self.action_space = first.single_action_space
        self.stepping_s = 0.0  # wall time in the envs [s]
        # called after each step of all worlds
        self.on_step: Callable[[], None] | None = None
        self._seeds: Sequence[int] | None = None

    @property
    def unwrapped(self) -> TrainingWorlds:
        """Returns itself, for learners that look behind wrappers."""
        return self

    def seed(self, seed: int) -> None:
        """Sets the seeds of the next `reset`: `seed` plus the index of the world."""
        self._seeds = range(seed, seed + self.num_envs)

    def reset(self, options: dict[str, Any] | None = None) -> Singles:
        """Starts an episode in every world; returns the first observations (N, O)."""
        seeds = self._seeds
        self._seeds = None
        observations = []
        for env, rows in zip(self.envs, self._rows, strict=True):
            own = None if seeds is None else list(seeds[rows])
            observations.append(env.reset(seed=own, options=options)[0])
        return _join_rows(observations)

    def step(self, actions: AnyArray) -> Step:
        """Advances every world by one control period, with actions (N, C) or (N,)."""
        begin = time.perf_counter()
        parts = [
            _step_env(env, rows.start, actions[rows])
            for env, rows in zip(self.envs, self._rows, strict=True)
        ]
        *columns, endings = zip(*parts, strict=True)
        observations, rewards, ended = map(_join_rows, columns)
        self.stepping_s += time.perf_counter() - begin
        if self.on_step is not None:
            self.on_step()
        return Step(observations, rewards, ended, _join_endings(endings))

    def close(self) -> None:
        """Closes the vector envs."""
        for env in self.envs:
            env.close()


def _step_env(env: BridgeVectorEnv, first: int, actions: AnyArray) -> Step:
    """Steps one vector env, the first of whose worlds is `first`."""
    observations, rewards, terminated, truncated, info = env.step(actions)
    ended = terminated | truncated
    worlds = np.flatnonzero(ended)
    flags: dict[str, Mask] = {}
    last = observations[:0]
    if len(worlds):
        last = np.stack(info["final_obs"][worlds])
        for name in {SUCCESS, COLLISION} & info["final_info"].keys():
            of_robots = info["final_info"][name].reshape(len(ended), -1)
            flags[name] = of_robots.all(axis=1)[worlds]
    only_truncated = (truncated & ~terminated)[worlds]
    endings = Endings(first + worlds, only_truncated, flags, last)
    return Step(observations, rewards.astype(np.float32), ended, endings)


def _join_endings(parts: Sequence[Endings]) -> Endings:
    if len(parts) == 1:
        return parts[0]
    worlds, truncated, _, observations = zip(*parts, strict=True)
    names = {name for part in parts for name in part.flags}
    flags = {
        name: np.concatenate([part.get_flag(name) for part in parts]) for name in names
    }
    return Endings(
        np.concatenate(worlds),
        np.concatenate(truncated),
        flags,
        np.concatenate(observations),
    )


def _join_rows(parts: Sequence[AnyArray]) -> AnyArray:
    """Concatenates the rows of several envs; a single env's rows are returned unchanged."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
