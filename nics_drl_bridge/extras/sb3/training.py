"""PPO and SAC of Stable-Baselines3."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed

from nics_drl_bridge.extras.sb3.layers import NormaliserLayer, to_tensors
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import AnyArray, Singles
from nics_drl_bridge.policy.train.progress import RECENT, TrainingLog, Watch
from nics_drl_bridge.policy.train.settings import LEAST_RATE, TrainingSettings
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv
from nics_drl_bridge.policy.train.worlds import COLLISION, TrainingWorlds

# rollouts or episodes between two TensorBoard entries
LOG_EVERY = {
    "ppo": 1,
    "sac": 1000,
}
COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_current_progress_remaining",
)
LAST = ("_last_obs", "_last_episode_starts")
REPLAYED = (
    "observations",
    "next_observations",
    "actions",
    "rewards",
    "dones",
    "timeouts",
)


class Sb3Training:
    """A training with a Stable-Baselines3 algorithm; `statistics` are mean and deviation (O,)."""

    def __init__(
        self,
        settings: TrainingSettings,
        worlds: TrainingWorlds,
        seed: int,
        statistics: tuple[Array, Array],
    ) -> None:
        torch.set_num_threads(settings.threads)
        env = TrainVecEnv(worlds=worlds)
        self._total = settings.steps
        self._log_every = LOG_EVERY[settings.algorithm]
        shared: dict[str, Any] = {
            "seed": seed,
            "device": "cpu",
            "stats_window_size": RECENT,
        }
        network: dict[str, Any] = {
            "net_arch": list(settings.hidden),
            "features_extractor_class": NormaliserLayer,
            "features_extractor_kwargs": {"mean": statistics[0], "std": statistics[1]},
        }
        if settings.algorithm == "sac":
            sac = settings.sac
            self.algorithm: PPO | SAC = SAC(
                "MlpPolicy",
                env,
                sac.learning_rate,
                buffer_size=sac.buffer,
                learning_starts=sac.begin_after,
                batch_size=sac.batch,
                tau=sac.soft_update,
                gamma=sac.discount,
                train_freq=1,
                gradient_steps=sac.updates,
                policy_kwargs=network,
                **shared,
            )
        else:
            ppo = settings.ppo
            network |= {"log_std_init": ppo.log_std, "activation_fn": torch.nn.Tanh}
            self.algorithm = PPO(
                "MlpPolicy",
                env,
                lambda remaining: ppo.learning_rate * max(remaining, LEAST_RATE),
                n_steps=ppo.rollout,
                batch_size=ppo.batch,
                n_epochs=ppo.epochs,
                gamma=ppo.discount,
                gae_lambda=ppo.gae_lambda,
                clip_range=ppo.clip,
                ent_coef=ppo.entropy,
                policy_kwargs=network,
                **shared,
            )

    @property
    def steps(self) -> int:
        """Environment steps done, over all worlds."""
        return int(self.algorithm.num_timesteps)

    @property
    def greatest_weight(self) -> float:
        """Largest magnitude of a weight; NaN if one is not a number."""
        parts = self.algorithm.policy.parameters()
        return float(torch.stack([part.detach().abs().max() for part in parts]).max())

    def act(self, observations: Singles) -> AnyArray:
        """Returns the deterministic actions for observations, without exploration noise."""
        policy: Any = self.algorithm.policy
        with torch.no_grad():
            chosen = policy._predict(torch.as_tensor(observations), deterministic=True)
            return np.asarray(chosen.numpy())

    def learn(self, watch: Watch, log: TrainingLog) -> None:
        """Learns until all steps are done, or the watch ends the training."""
        self.algorithm.set_logger(Logger(None, [LogWriter(log)]))
        left = self._total - self.steps
        companion = Companion(self, watch, log)
        self.algorithm.learn(
            left, companion, self._log_every, reset_num_timesteps=False
        )

    def state(self) -> dict[str, Any]:
        """Returns everything that changes, for a checkpoint."""
        algorithm = self.algorithm
        replay: dict[str, Any] = {}
        if isinstance(algorithm, OffPolicyAlgorithm):
            buffer: Any = algorithm.replay_buffer
            rows = {name: getattr(buffer, name)[: buffer.size()] for name in REPLAYED}
            replay = {"pos": buffer.pos, "full": buffer.full, **rows}
        shared = np.random.get_state(legacy=False)  # noqa: NPY002 - the library uses it
        drawn = algorithm.action_space.np_random.bit_generator.state
        return {
            "parameters": algorithm.get_parameters(),
            "variables": {  # not in the networks: SAC's temperature
                name: getattr(algorithm, name).detach()
                for name in algorithm._get_torch_save_params()[1]
            },
            "counters": {name: getattr(algorithm, name) for name in COUNTERS},
            "recent": list(algorithm.ep_success_buffer or ()),
            "last": {name: getattr(algorithm, name) for name in LAST},
            "replay": replay,
            "random": {
                "torch": torch.get_rng_state(),
                "numpy": shared,
                "actions": drawn,
            },
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from the state of another training made with the same arguments."""
        algorithm = self.algorithm
        algorithm.set_parameters(to_tensors(state["parameters"]), exact_match=True)
        for name, value in to_tensors(state["variables"]).items():
            getattr(algorithm, name).data.copy_(value)
        for name, value in state["counters"].items():
            setattr(algorithm, name, value)
        size = algorithm._stats_window_size
        algorithm.ep_success_buffer = deque(state["recent"], maxlen=size)
        algorithm.ep_info_buffer = deque(maxlen=size)
        for name, value in state["last"].items():
            setattr(algorithm, name, value)
        if isinstance(algorithm, OffPolicyAlgorithm):
            buffer: Any = algorithm.replay_buffer
            replay = state["replay"]
            buffer.pos = replay["pos"]
            buffer.full = replay["full"]
            for name in REPLAYED:
                getattr(buffer, name)[: buffer.size()] = replay[name]
        random = state["random"]
        set_random_seed(0)
        torch.set_rng_state(to_tensors(random["torch"]))
        np.random.set_state(random["numpy"])  # noqa: NPY002 - as above
        algorithm.action_space.np_random.bit_generator.state = random["actions"]


class LogWriter(KVWriter):
    """Hands the figures that Stable-Baselines3 logs to a training's log."""

    def __init__(self, log: TrainingLog) -> None:
        self._log = log

    def write(
        self,
        key_values: dict[str, Any],
        key_excluded: dict[str, tuple[str, ...]],
        step: int = 0,
    ) -> None:
        """Records all numbers, and writes them."""
        for name, value in key_values.items():
            is_for_others = "tensorboard" in (key_excluded.get(name) or ())
            if isinstance(value, int | float | np.number) and not is_for_others:
                self._log.record(name, float(value))
        self._log.dump(step)

    def close(self) -> None:
        """Leaves the log open."""


class Companion(BaseCallback):
    """Callback that makes Stable-Baselines3 call a watch in each step and rollout."""

    def __init__(self, training: Sb3Training, watch: Watch, log: TrainingLog) -> None:
        super().__init__()
        self._act = training.act
        self._watch = watch
        self._log = log
        self._ends = False

    def _on_training_start(self) -> None:
        self._watch.begin(self.num_timesteps)

    def _on_rollout_start(self) -> None:
        steps = self.model.num_timesteps
        self._watch.keep(steps)
        self._ends = self._watch.ends(steps, self._act, self._log)

    def _on_step(self) -> bool:
        for n in np.flatnonzero(self.locals["dones"]):
            self._watch.collisions.append(
                bool(self.locals["infos"][n].get(COLLISION, False))
            )
        # Stable-Baselines3 can't stop before the first step of a rollout.
        if self._ends:
            self._on_rollout_end()
        return not self._ends

    def _on_rollout_end(self) -> None:
        self._watch.report(
            self.num_timesteps, self.model.ep_success_buffer or (), self._log
        )
