"""Progress of a training: what is reported, logged and saved between two rollouts."""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tensorboard.compat.proto.event_pb2 import Event  # type: ignore[import-untyped]
from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[import-untyped]
from tensorboard.summary.writer.event_file_writer import (  # type: ignore[import-untyped]
    EventFileWriter,
)

from nics_drl_bridge.policy.evaluation import Act
from nics_drl_bridge.policy.train.settings import TrainingSettings
from nics_drl_bridge.policy.train.stop import Stop
from nics_drl_bridge.policy.train.worlds import TrainingWorlds

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


class TrainingLog:
    """Writes figures over environment steps into a folder, for TensorBoard."""

    def __init__(self, folder: Path) -> None:
        self._writer = EventFileWriter(str(folder))
        self._figures: dict[str, float] = {}

    def record(self, name: str, value: float) -> None:
        """Sets a figure of the next `dump`."""
        self._figures[name] = value

    def dump(self, steps: int) -> None:
        """Writes the figures recorded since the last dump."""
        values = [
            Summary.Value(tag=name, simple_value=value)
            for name, value in self._figures.items()
        ]
        self._figures.clear()
        summary = Summary(value=values)
        self._writer.add_event(
            Event(step=steps, wall_time=time.time(), summary=summary)
        )
        self._writer.flush()

    def close(self) -> None:
        """Closes the file; drops figures that were not dumped."""
        self._writer.close()


@dataclass
class Watch:
    """Reports the progress of a training and saves it at intervals, between two rollouts."""

    worlds: TrainingWorlds
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
        self._busy = self.worlds.stepping_s
        self._first = self._saved = steps

    def keep(self, steps: int) -> None:
        """Saves the training if it is due."""
        every = self.settings.checkpoint_every
        if steps // every > self._saved // every:
            self.save()
            self._saved = steps

    def ends(self, steps: int, act: Act, log: TrainingLog) -> bool:
        """Evaluates on held-out episodes if due; returns True if the training should end."""
        if self.stop.judge(steps, act):
            for world, share in self.stop.shares.items():
                log.record(f"held_out/{world}", share)
            log.dump(steps)
        return self.stop.over

    def report(self, steps: int, successes: Sequence[bool], log: TrainingLog) -> bool:
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
            (self.worlds.stepping_s - self._busy) / taken,
            self.stop.least,
        )
        log.record("rollout/success_rate", progress.success)
        log.record("rollout/collision_rate", progress.collision)
        log.record("time/env_share", progress.env_share)
        self.tell(progress)
        return True
