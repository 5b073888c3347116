"""Adapts the vector env to Stable-Baselines3's VecEnv, without copying each world."""

import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from nics_drl_bridge import extensions
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.arrays import AnyArray, Mask, Singles

with extensions.require_modules("TrainVecEnv"):
    from stable_baselines3.common.vec_env import VecEnv

Observation = NDArray[np.float32]


class TrainVecEnv(VecEnv):
    """Adapts `BridgeVectorEnv`s (`SameStep`, `copy=True`) to SB3. Raises ConfigError for others."""

    def __init__(self, *envs: BridgeVectorEnv) -> None:
        for env in envs:
            if (
                env.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP
                or not env.copy
            ):
                raise ConfigError(
                    "Stable-Baselines3 needs "
                    "BridgeVectorEnv(autoreset_mode='SameStep', copy=True)."
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
        count = int(edges[-1])
        super().__init__(
            count, first.single_observation_space, first.single_action_space
        )
        self._infos: list[dict[str, Any]] = [{} for _ in range(count)]
        self._ended: list[int] = []
        self._actions: AnyArray = np.zeros(0)
        self.stepping_s = 0.0  # wall time in the envs [s]
        # called after each step of all worlds
        self.on_step: Callable[[], None] | None = None

    def reset(self) -> Observation:
        """Starts an episode in every world, with the seeds given to `seed`."""
        observations = []
        for env, rows in zip(self.envs, self._rows, strict=True):
            seeds_of_env = self._seeds[rows]
            seeds = None if all(seed is None for seed in seeds_of_env) else seeds_of_env
            observations.append(
                env.reset(seed=seeds, options=self._options[0] or None)[0]
            )
        self._reset_seeds()
        self._reset_options()
        return _join_rows(observations)

    def step_async(self, actions: AnyArray) -> None:
        """Stores the actions for the next step."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[Observation, Singles, Mask, list[Any]]:
        """Advances every world by one control period; see Stable-Baselines3."""
        begin = time.perf_counter()
        self._clear_infos()
        parts = []
        for env, rows in zip(self.envs, self._rows, strict=True):
            *seen, terminated, truncated, info = env.step(self._actions[rows])
            ended = terminated | truncated
            parts.append((*seen, ended))
            if ended.any():
                self._fill_infos(rows.start, ended, truncated & ~terminated, info)
        observations, rewards, dones = map(_join_rows, zip(*parts, strict=True))
        self.stepping_s += time.perf_counter() - begin
        if self.on_step is not None:
            self.on_step()
        return observations, rewards.astype(np.float32), dones, list(self._infos)

    def _clear_infos(self) -> None:
        """Puts new dicts in place of those of ended worlds, which an algorithm may keep."""
        for n in self._ended:
            self._infos[n] = {}
        self._ended = []

    def _fill_infos(
        self, first: int, ended: Mask, truncated: Mask, info: dict[str, Any]
    ) -> None:
        """Fills in the infos of ended worlds of an env, the first of whose worlds is `first`."""
        flags = {"TimeLimit.truncated": truncated}
        for name in {"is_success", "collision"} & info["final_info"].keys():
            values = info["final_info"][name]
            flags[name] = values.reshape(len(ended), -1).all(axis=1)
        for n in np.flatnonzero(ended).tolist():
            self._ended.append(first + n)
            known = {name: bool(values[n]) for name, values in flags.items()}
            known["terminal_observation"] = info["final_obs"][n]
            self._infos[first + n] = known

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Reads an attribute of each world's vector env."""
        every = [
            getattr(env, attr_name) for env in self.envs for _ in range(env.num_envs)
        ]
        return [every[n] for n in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of the vector envs, which all their worlds share."""
        for env in self.envs:
            setattr(env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: Any = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Calls a method of each vector env once; returns its result for each of its worlds."""
        every: list[Any] = []
        for env in self.envs:
            every += [
                getattr(env, method_name)(*method_args, **method_kwargs)
            ] * env.num_envs
        return [every[n] for n in self._get_indices(indices)]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],
        indices: Any = None,
    ) -> list[bool]:
        """Returns False for every world: none is wrapped."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Draws every world."""
        return [
            picture
            for env in self.envs
            for picture in env.render() or [None] * env.num_envs
        ]

    def close(self) -> None:
        """Closes the vector envs."""
        for env in self.envs:
            env.close()


def _join_rows(parts: Sequence[AnyArray]) -> AnyArray:
    """Concatenates the rows of several envs; a single env's rows are returned unchanged."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
