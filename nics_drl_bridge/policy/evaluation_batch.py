"""The evaluation protocol: episodes of fixed seeds, hundreds at once in a vector env."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.evaluation import truly_near
from nics_drl_bridge.policy.statistics import ConfidenceInterval, mean, rate
from nics_drl_bridge.seeds import checked_seeds

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Act = Callable[[NDArray[np.float32]], NDArray[Any]]
"""Actions (N, C) for observations (N, O)."""
FIRST_SEED = 1_000_000
"""First seed of an evaluation, far from the seeds of any training."""


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of episodes. All arrays are (E,).

    Attributes:
        seeds: of the episodes, as `BridgeEnv.reset` takes them.
        success: the goal was truly reached, and nothing touched.
        collision: the task reports one, or the robot truly touched something.
        steps: control periods.
        length: of the true path [m]; for a team, the mean over its robots.
        reward: sum over the episode.
    """

    seeds: NDArray[np.int64]
    success: Flags
    collision: Flags
    steps: NDArray[np.int64]
    length: Array
    reward: Array

    @property
    def time_out(self) -> Flags:
        """Neither success nor collision."""
        return ~(self.success | self.collision)


@dataclass(frozen=True)
class Summary:
    """Summary of an evaluation, each figure with its 95 % interval.

    Attributes:
        episodes: E.
        success, collision, time_out: shares of the episodes.
        length: mean path of the successful ones [m].
        time: mean duration of the successful ones [s].
    """

    episodes: int
    success: ConfidenceInterval
    collision: ConfidenceInterval
    time_out: ConfidenceInterval
    length: ConfidenceInterval
    time: ConfidenceInterval


def summarise(outcomes: Outcomes, control_period: float) -> Summary:
    """Summarises episodes; `control_period` [s]."""
    count = len(outcomes.seeds)
    success, collision, time_out = (
        rate(int(flags.sum()), count)
        for flags in (outcomes.success, outcomes.collision, outcomes.time_out)
    )
    length = mean(outcomes.length[outcomes.success])
    time = mean(outcomes.steps[outcomes.success] * control_period)
    return Summary(count, success, collision, time_out, length, time)


def drive_worlds(env: BridgeVectorEnv, act: Act, seeds: Sequence[int]) -> Outcomes:
    """Drives one episode per seed, as many at once as the env has worlds.

    The episodes are bit-identical to those of `BridgeEnv.reset(seed=...)` without estimator.

    Args:
        env: its `autoreset_mode` is `NextStep`, the default.
        act: the policy, for many robots at once.
        seeds: of the episodes.
    """
    width, given = env.num_envs, checked_seeds(seeds)
    done = []
    for first in range(0, len(given), width):
        # The last batch is padded with seeds that are driven but not counted.
        chunk = np.resize(given[first : first + width], width)
        rows = _drive_once(env, act, chunk)
        done.append(tuple(row[: len(given) - first] for row in rows))
    return Outcomes(given, *(np.concatenate(each) for each in zip(*done, strict=True)))


def _drive_once(env: BridgeVectorEnv, act: Act, seeds: NDArray[np.int64]) -> tuple[Any, ...]:
    """Drives one episode in each world: success, collision, steps, length, reward, each (N,)."""
    count = env.num_envs
    observation, info = env.reset(seed=list(seeds))
    where = np.reshape(info["start"], (count, -1, 3))[..., :2]
    success, collision = np.zeros((2, count), np.bool_)
    steps, reward = np.zeros(count, np.int64), np.zeros(count)
    length, running = np.zeros(count), np.ones(count, np.bool_)
    while running.any():
        observation, gain, terminated, truncated, info = env.step(act(observation))
        there = np.reshape(info["true_pose"], (count, -1, 3))[..., :2]
        moved = np.hypot(*np.moveaxis(there - where, -1, 0)).mean(axis=-1)
        where = there
        length += np.where(running, moved, 0.0)
        reward += np.where(running, gain, 0.0)
        steps += running
        ended = running & (terminated | truncated)
        touched = _any_robot(info, "collision") | _any_robot(info, "true_collision")
        collision |= ended & touched
        arrived = _all_robots(info, "is_success")
        if arrived.any() and "goal" in info:
            near = truly_near(env.task, info["true_pose"], info["goal"])
            arrived = arrived & near.reshape(count, -1).all(axis=1)
        success |= ended & ~touched & arrived
        running &= ~ended
    return success, collision, steps, length, reward


def _any_robot(info: dict[str, Any], name: str) -> Flags:
    values = np.asarray(info[name], np.bool_) if name in info else np.zeros(1, np.bool_)
    return np.asarray(values.reshape(len(values), -1).any(axis=1))


def _all_robots(info: dict[str, Any], name: str) -> Flags:
    values = np.asarray(info[name], np.bool_) if name in info else np.zeros(1, np.bool_)
    return np.asarray(values.reshape(len(values), -1).all(axis=1))
