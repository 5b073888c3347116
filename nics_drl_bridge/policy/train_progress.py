"""How a training gets on: told to the user and to TensorBoard, and kept in checkpoints."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from nics_drl_bridge.policy.train_algorithms import RECENT
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv

TOLD_S = 0.2
"""Progress is told at most so often [s]."""


@dataclass(frozen=True)
class Progress:
    """Where a training stands.

    Attributes:
        seed: of the training.
        steps: environment steps done.
        total: of all.
        success, collision: shares of the last 1000 episodes; NaN before the first has ended.
        steps_per_s: since this process took it up.
        env_share: share of the wall time that went to the simulator.
    """

    seed: int
    steps: int
    total: int
    success: float
    collision: float
    steps_per_s: float
    env_share: float


class Companion(BaseCallback):
    """Looks after each step and rollout of a training.

    Args:
        env: that is learned on.
        seed: of the training.
        total: environment steps of all.
        checkpoint_every: environment steps between two calls of `save`.
        save: keeps all that there is; called between two rollouts only.
        tell: is told of the progress.
    """

    def __init__(
        self,
        env: TrainVecEnv,
        seed: int,
        total: int,
        checkpoint_every: int,
        save: Callable[[], None],
        tell: Callable[[Progress], None],
    ) -> None:
        super().__init__()
        self._env, self._seed, self._total = env, seed, total
        self._every, self._save, self._tell = checkpoint_every, save, tell
        self._collisions: deque[bool] = deque(maxlen=RECENT)
        self._begin = self._told = time.perf_counter()
        self._first = self._saved = 0
        self._busy = env.stepping_s

    def _on_training_start(self) -> None:
        self._begin, self._busy = time.perf_counter(), self._env.stepping_s
        self._first = self._saved = self.num_timesteps

    def _on_rollout_start(self) -> None:
        """Between two rollouts nothing is half done: the place for a checkpoint."""
        if self.model.num_timesteps // self._every > self._saved // self._every:
            self._save()
            self._saved = self.model.num_timesteps

    def _on_step(self) -> bool:
        for n in np.flatnonzero(self.locals["dones"]):
            self._collisions.append(bool(self.locals["infos"][n].get("collision", False)))
        return True

    def _on_rollout_end(self) -> None:
        now = time.perf_counter()
        if now - self._told < TOLD_S and self.num_timesteps < self._total:
            return
        self._told = now
        progress = self.progress()
        self.logger.record("rollout/collision_rate", progress.collision)
        self.logger.record("time/env_share", progress.env_share)
        self._tell(progress)

    def progress(self) -> Progress:
        """Where the training stands now."""
        taken = max(time.perf_counter() - self._begin, 1e-9)
        successes = self.model.ep_success_buffer
        return Progress(
            self._seed,
            self.num_timesteps,
            self._total,
            float(np.mean(successes)) if successes else np.nan,
            float(np.mean(self._collisions)) if self._collisions else np.nan,
            (self.num_timesteps - self._first) / taken,
            (self._env.stepping_s - self._busy) / taken,
        )
