"""Driving episodes with a policy, and keeping what happened."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.guard import uninterrupted
from nics_drl_bridge.policy.policies import Policy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """What happened in one episode.

    Attributes:
        seed: of the episode.
        result: `success`, `collision` or `time-out`.
        path: (T, 3) true pose where the backend knows it, else the estimate, after each step.
        estimate: (T, 3) what the robot believed.
        goal: (2,) [m].
        bodies: (K, 7) obstacles as they stood at the start, see `sim.scenes.Scene`.
        reward: sum over the episode.
    """

    seed: int
    result: str
    path: Array
    estimate: Array
    goal: Array
    bodies: Array
    reward: float

    @property
    def steps(self) -> int:
        """Number of control periods."""
        return len(self.path) - 1

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return float(np.linalg.norm(np.diff(self.path[:, :2], axis=0), axis=1).sum())


def drive(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    seed: int,
    options: dict[str, Any] | None = None,
    on_start: Callable[[], None] = lambda: None,
) -> Episode:
    """Drives one episode to its end; the robot is halted where the policy or a callback raises.

    Args:
        env: to drive in.
        policy: that drives.
        seed: of the episode.
        options: of `env.reset`.
        on_start: is called when the robot stands at its start.
    """
    try:
        return _drive(env, policy, seed, options, on_start)
    except BaseException:
        if isinstance(env.unwrapped, BridgeEnv):  # which never sees what a policy raises
            with uninterrupted():
                env.unwrapped.halt()
        raise


def _drive(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    seed: int,
    options: dict[str, Any] | None,
    on_start: Callable[[], None],
) -> Episode:
    observation, info = env.reset(seed=seed, options=options)
    on_start()
    goal, bodies = info["goal"], info["bodies"]
    paths, estimates, total = [info["start"]], [info["pose"]], 0.0
    while True:
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        paths.append(info.get("true_pose", info["pose"]))
        estimates.append(info["pose"])
        total += float(reward)
        if terminated or truncated:
            break
    reached, touched = np.all(info["is_success"]), np.any(info["collision"])
    result = "success" if reached else "collision" if touched else "time-out"
    return Episode(seed, result, np.array(paths), np.array(estimates), goal, bodies, total)


def drive_all(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    seeds: Iterable[int],
    on_episode: Callable[[Episode], None] = lambda _: None,
) -> list[Episode]:
    """Drives one episode per seed and tells of each as it ends."""
    episodes = []
    for seed in seeds:
        episodes.append(drive(env, policy, seed))
        on_episode(episodes[-1])
    return episodes


def successes(episodes: Iterable[Episode]) -> int:
    """How many reached their goal."""
    return sum(episode.result == "success" for episode in episodes)


def deviation(one: Episode, other: Episode) -> float:
    """Greatest distance between two paths, step by step, over their common length [m]."""
    steps = min(len(one.path), len(other.path))
    return float(np.linalg.norm(one.path[:steps, :2] - other.path[:steps, :2], axis=1).max())
