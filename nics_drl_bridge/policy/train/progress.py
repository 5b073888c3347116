"""Progress of a training: what is reported, logged and saved between two rollouts."""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from stable_baselines3.common.logger import Logger

from nics_drl_bridge.policy.evaluation import Act
from nics_drl_bridge.policy.train.settings import TrainingSettings
from nics_drl_bridge.policy.train.stop import Stop
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv

RECENT = 1000  # number of recent episodes over which the progress reports rates
TOLD_S = 0.2  # minimum time between two progress reports [s]


@dataclass(frozen=True)
class Progress:
    """Progress of a training."""

    seed: int
    steps: int  # environment steps done
    total: int
    # fractions over the last 1000 episodes; NaN before the first one ends
    success: float
    collision: float
    steps_per_s: float  # since this process started
    env_share: float  # fraction of the wall time spent in the simulator
    # minimum success over the worlds in the latest evaluation of `stop`
    held_out: float = math.nan

    @property
    def line(self) -> str:
        """Success rate, if known, and speed, as readable text."""
        unknown = math.isnan(self.success)
        if unknown:
            rate = "no episode has ended yet"
        else:
            rate = f"success {100 * self.success:.1f} %"
        return f"{rate}, {self.steps_per_s:,.0f} steps/s"


Tell = Callable[[Progress], None]


@dataclass
class Watch:
    """Reports the progress of a training and saves it at intervals, between two rollouts."""

    env: TrainVecEnv
    seed: int
    settings: TrainingSettings
    save: Callable[[], None]
    tell: Tell
    stop: Stop

    def __post_init__(self) -> None:
        self.collisions: deque[bool] = deque(maxlen=RECENT)  # latest episodes

    def begin(self, steps: int) -> None:
        """Starts the clock of a training that has already done `steps`."""
        self._begin = self._told = time.perf_counter()
        self._busy = self.env.stepping_s
        self._first = self._saved = steps

    def keep(self, steps: int) -> None:
        """Saves the training if it is due."""
        every = self.settings.checkpoint_every
        if steps // every > self._saved // every:
            self.save()
            self._saved = steps

    def ends(self, steps: int, act: Act, logger: Logger) -> bool:
        """Evaluates on held-out episodes if due; returns True if the training should end."""
        if self.stop.judge(steps, act):
            for world, share in self.stop.shares.items():
                logger.record(f"held_out/{world}", share)
            logger.dump(steps)
        return self.stop.over

    def report(self, steps: int, successes: Sequence[bool], logger: Logger) -> bool:
        """Reports and logs the progress if due; returns True if it did."""
        now = time.perf_counter()
        total = self.settings.steps
        if now - self._told < TOLD_S and steps < total and not self.stop.over:
            return False
        self._told = now
        taken = max(now - self._begin, 1e-9)
        recent = successes, self.collisions
        success, collision = (float(np.mean(r)) if r else np.nan for r in recent)
        progress = Progress(
            self.seed,
            steps,
            total,
            success,
            collision,
            (steps - self._first) / taken,
            (self.env.stepping_s - self._busy) / taken,
            self.stop.least,
        )
        logger.record("rollout/success_rate", progress.success)
        logger.record("rollout/collision_rate", progress.collision)
        logger.record("time/env_share", progress.env_share)
        self.tell(progress)
        return True
