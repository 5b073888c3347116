"""TrainVecEnv: the vector env as Stable-Baselines3's VecEnv, without a copy for each world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError

Observation = NDArray[np.float32]


class TrainVecEnv(VecEnv):
    """Feeds Stable-Baselines3 from a `BridgeVectorEnv`.

    The observations are the vector env's own array of the step; what is done for one world at a
    time concerns only those that ended: their `terminal_observation`, `TimeLimit.truncated`,
    `is_success` and `collision` in `infos`.

    Args:
        env: whose `autoreset_mode` is `SameStep` and whose `copy` is True, as the algorithms keep
            the last observation over a step.

    Raises:
        ConfigError: an env that is made otherwise.
    """

    def __init__(self, env: BridgeVectorEnv) -> None:
        if env.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP or not env.copy:
            raise ConfigError(
                "Stable-Baselines3 needs BridgeVectorEnv(autoreset_mode='SameStep', copy=True)."
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._infos: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
        self._told: NDArray[np.intp] = np.zeros(0, np.intp)
        self._actions: NDArray[Any] = np.zeros(0)

    def reset(self) -> Observation:
        """Begins an episode in every world, of the seeds given to `seed`."""
        seeds = None if all(one is None for one in self._seeds) else self._seeds
        observation, _ = self.env.reset(seed=seeds, options=self._options[0] or None)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Takes the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], list[Any]]:
        """One control period in every world; see Stable-Baselines3."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        for n in self._told:  # fresh ones: an algorithm may still hold those it was given
            self._infos[n] = {}
        self._told = np.flatnonzero(done)
        for n in self._told:
            self._infos[n] = {
                "terminal_observation": info["final_obs"][n],
                "TimeLimit.truncated": bool(truncated[n] and not terminated[n]),
                **_results(info["final_info"], n),
            }
        return observation, reward.astype(np.float32), done, list(self._infos)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the vector env, for each of the worlds."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of the vector env, which all worlds share."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of the vector env once; its result for each of the worlds."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """No world is."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A picture of every world."""
        return list(self.env.render() or [None] * self.num_envs)

    def close(self) -> None:
        """Closes the vector env."""
        self.env.close()


def _results(final: dict[str, Any], n: np.intp) -> dict[str, Any]:
    """How the episode of world n ended, as far as its task says."""
    known = {name: final[name][n] for name in ("is_success", "collision") if name in final}
    return {name: bool(np.all(value)) for name, value in known.items()}
