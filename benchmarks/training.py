"""How long does it take to learn to navigate, from nothing?

Trains a shipped robot among ten random obstacles with the shipped settings, then drives unseen
episodes there. Wall time counts from the first random weight to the last evaluated episode; the
kernels are compiled before. Of several seeds, `--json` gives the one with the least success, and
the longest time, the greatest share and the lowest speed of all. `--lidar` learns and drives with
another than the robot's, as `rplidar_a2`, by the same bars.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench import answer, parser_of
from numpy.typing import NDArray

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.evaluation import (
    FIRST_SEED,
    Summary,
    drive_worlds,
    summarise,
)
from nics_drl_bridge.policy.train.algorithms import act_of
from nics_drl_bridge.policy.train.run import train
from nics_drl_bridge.policy.train.settings import (
    TrainingSettings,
    load_training,
    open_training,
)

WORLD = "circles"
BARS = {
    "differential": (0.95, 15.0),
    "ackermann": (0.95, 45.0),
    "mecanum": (0.95, 25.0),
}
"""Least success and longest time [s]."""
SPEED_BAR = 100_000.0
"""Least environment steps per second of training. The share of the time that goes to the simulator
has no bar: it steps on one core while the other learns."""
CONTROLS = {"untrained": "a net that has learnt from a single rollout"}


@dataclass(frozen=True)
class Run:
    """One training and its evaluation.

    Attributes:
        summary: of the evaluation.
        steps: environment steps of the training.
        wall_s, cpu_s: of both together [s].
        training_s: of the wall time, the training from the first random weight on [s].
        env_s: of the wall time, what went to the simulator [s].
    """

    summary: Summary
    steps: int
    wall_s: float
    cpu_s: float
    training_s: float
    env_s: float

    def figures(self) -> dict[str, Any]:
        """What `--json` prints."""
        success = self.summary.success
        return {
            "success_rate": success.value,
            "success_95ci": [success.low, success.high],
            "believed_rate": self.summary.believed.value,
            "collision_rate": self.summary.collision.value,
            "wall_s": self.wall_s,
            "env_steps": self.steps,
            "steps_per_s": self.steps / self.training_s,
            "env_share_of_wall": self.env_s / self.wall_s,
        }


def measure(settings: TrainingSettings, seed: int, episodes: int) -> Run:
    """Trains with one seed and drives unseen episodes."""
    model, worlds = open_training(settings)
    begin = time.perf_counter()
    cpu = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        trained = train(model, worlds, settings, seed, Path(folder))
    env = BridgeVectorEnv(
        episodes,
        model,
        WORLD,
        settings.task,
        settings.task_options,
        settings.max_episode_steps,
    )
    act = act_of(trained.algorithm)
    acting = [0.0]

    def timed(observations: NDArray[np.float32]) -> NDArray[Any]:
        start = time.perf_counter()
        actions = act(observations)
        acting[0] += time.perf_counter() - start
        return actions

    start = time.perf_counter()
    outcomes = drive_worlds(env, timed, range(FIRST_SEED, FIRST_SEED + episodes))
    end = time.perf_counter()
    return Run(
        summarise(outcomes, model.control_period),
        trained.steps,
        end - begin,
        time.process_time() - cpu,
        trained.wall_s,
        trained.stepping_s + (end - start - acting[0]),
    )


def warmed_up(settings: TrainingSettings, episodes: int) -> None:
    """Compiles all kernels, and fills caches, with a training of one rollout."""
    measure(untrained(settings), 0, min(episodes, 20))


def untrained(settings: TrainingSettings) -> TrainingSettings:
    """The same, but for one rollout only."""
    short = settings.ppo.rollout * settings.num_envs
    return settings.model_copy(update={"steps": short})


def worst(runs: list[Run]) -> dict[str, Any]:
    """The figures of the run with the least success, but the worst time, share and speed of all."""
    figures = [run.figures() for run in runs]
    least = min(figures, key=lambda one: one["success_rate"])
    greatest = ("wall_s", "env_steps", "env_share_of_wall")
    slowest = {"steps_per_s": min(one["steps_per_s"] for one in figures)}
    return {
        **least,
        **{name: max(one[name] for one in figures) for name in greatest},
        **slowest,
    }


def missed(robot: str, figures: dict[str, Any]) -> list[str]:
    """A sentence for each bar that was missed."""
    (success, limit_s), said = BARS[robot], []
    if not figures["success_rate"] >= success:
        said.append(
            f"{robot}: {figures['success_rate']:.1%} success after training, "
            f"less than {success:.0%}"
        )
    if not figures["wall_s"] <= limit_s:
        said.append(
            f"{robot}: it took {figures['wall_s']:.0f} s, more than {limit_s:.0f} s"
        )
    if not figures["steps_per_s"] >= SPEED_BAR:
        speed = f"{figures['steps_per_s']:,.0f} steps per second, less than {SPEED_BAR:,.0f}"
        said.append(f"{robot}: it learned from {speed}")
    return said


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--robot", choices=sorted(BARS), default="differential")
    parser.add_argument(
        "--lidar", help="instead of the robot's own, a shipped one or a file"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--seeds", type=int, nargs="+", help="several seeds instead of one"
    )
    parser.add_argument("--episodes", type=int, default=500)
    given = parser.parse_args()
    settings = load_training(f"navigation_{given.robot}")
    settings = settings.model_copy(update={"lidar": given.lidar or settings.lidar})
    if given.control == "untrained":
        settings = untrained(settings)
    else:
        warmed_up(settings, given.episodes)
    runs = []
    for seed in given.seeds or [given.seed]:
        run = measure(settings, seed, given.episodes)
        runs.append(run)
    figures = worst(runs)
    answer(figures, missed(given.robot, figures), given.json)


if __name__ == "__main__":
    main()
