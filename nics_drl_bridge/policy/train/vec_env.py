"""Adapts the vector env to Stable-Baselines3's VecEnv, without copying each world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import extensions
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.lidar.arrays import AnyArray, Mask, Singles
from nics_drl_bridge.policy.train.worlds import TrainingWorlds

with extensions.require_modules("TrainVecEnv"):
    from stable_baselines3.common.vec_env import VecEnv


class TrainVecEnv(VecEnv):
    """Adapts `BridgeVectorEnv`s (`SameStep`, `copy=True`), or the `worlds` of a training, to SB3.

    Raises ConfigError for other vector envs.
    """

    def __init__(
        self, *envs: BridgeVectorEnv, worlds: TrainingWorlds | None = None
    ) -> None:
        self.worlds = worlds = worlds or TrainingWorlds(*envs)
        self.envs = worlds.envs
        super().__init__(worlds.num_envs, worlds.observation_space, worlds.action_space)
        self._infos: list[dict[str, Any]] = [{} for _ in range(worlds.num_envs)]
        self._ended: list[int] = []
        self._actions: AnyArray = np.zeros(0)

    def seed(self, seed: int | None = None) -> Sequence[int]:
        """Sets the seeds of the next `reset`: `seed` plus the index of the world."""
        seeds: Sequence[int] = super().seed(seed)
        self.worlds.seed(seeds[0])
        return seeds

    def reset(self) -> Singles:
        """Starts an episode in every world, with the seeds given to `seed`."""
        observations = self.worlds.reset(self._options[0] or None)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: AnyArray) -> None:
        """Stores the actions for the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Singles, Singles, Mask, list[Any]]:
        """Advances every world by one control period; see Stable-Baselines3."""
        step = self.worlds.step(self._actions)
        # An algorithm may keep the dicts of ended worlds, so these get new ones.
        for n in self._ended:
            self._infos[n] = {}
        self._ended = step.endings.worlds.tolist()
        endings = step.endings
        for k, n in enumerate(self._ended):
            info: dict[str, Any] = {
                name: bool(flag[k]) for name, flag in endings.flags.items()
            }
            info["TimeLimit.truncated"] = bool(endings.truncated[k])
            info["terminal_observation"] = endings.observations[k]
            self._infos[n] = info
        return step.observations, step.rewards, step.ended, list(self._infos)

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
        self.worlds.close()
