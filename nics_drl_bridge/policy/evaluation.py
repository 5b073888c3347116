"""Drives episodes with a policy, records them, and judges them by the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.guard import uninterrupted
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.policy.policies import Policy

Array = NDArray[np.float64]

DRIFT_M = 0.1
"""A robot stops where it believes its goal is; odometry may have drifted by this much."""
ELSEWHERE = "elsewhere"


@dataclass(frozen=True)
class Episode:
    """Record of one episode.

    Attributes:
        seed: of the episode.
        result: `success`, `collision`, `time-out`, or `elsewhere` if the robot wrongly believed to
            be at its goal. Judged by the truth if the backend knows it.
        path: (T, 3) poses at the start and after each step: true ones if the backend knows them,
            else estimates.
        estimate: (T, 3) estimated poses.
        goal: (2,) [m].
        bodies: (K, 7) obstacles at the start, see `sim.scenes.Scene`.
        reward: sum over the episode.
        believed: the result by the robot's own knowledge; None if nothing else is known.
    """

    seed: int
    result: str
    path: Array
    estimate: Array
    goal: Array
    bodies: Array
    reward: float
    believed: str | None = None

    @property
    def believed_success(self) -> bool:
        """True if the robot believed to have arrived without touching anything."""
        return (self.believed or self.result) == "success"

    @property
    def miss(self) -> float:
        """Distance from the end of the path to the goal [m]."""
        return float(np.linalg.norm(self.path[-1, :2] - self.goal))

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
    touched: Callable[[], bool] | None = None,
) -> Episode:
    """Drives one episode to its end; halts the robot if the policy or a callback raises.

    Args:
        env: to drive in.
        policy: chooses the actions.
        seed: of the episode.
        options: of `env.reset`.
        on_start: called when the robot stands at its start.
        touched: returns at the end whether the robot truly touched something, if `info` does not.
    """
    try:
        return _drive(env, policy, seed, options, on_start, touched)
    except BaseException:
        if isinstance(env.unwrapped, BridgeEnv):  # it does not see errors of a policy
            with uninterrupted():
                env.unwrapped.halt()
        raise


def _drive(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    seed: int,
    options: dict[str, Any] | None,
    on_start: Callable[[], None],
    touched: Callable[[], bool] | None,
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
    believed = _believed(info)
    driven = np.array(paths), np.array(estimates), goal, bodies, total
    if "true_pose" not in info:
        return Episode(seed, believed, *driven)
    known = info.get("true_collision")
    hit = bool(np.any(known)) if known is not None else touched is not None and touched()
    there = bool(truly_near(getattr(env.unwrapped, "task", None), info["true_pose"], goal).all())
    return Episode(seed, _true(believed, there, hit), *driven, believed)


def _believed(info: dict[str, Any]) -> str:
    if np.all(info["is_success"]):
        return "success"
    return "collision" if np.any(info["collision"]) else "time-out"


def _true(believed: str, there: bool, hit: bool) -> str:
    if hit:
        return "collision"
    return ELSEWHERE if believed == "success" and not there else believed


def truly_near(task: Any, poses: Array, goals: Array) -> NDArray[np.bool_]:
    """True where robots at true poses (..., 3) are at their goals (..., 2), up to `DRIFT_M`.

    Always True for tasks other than `Navigation`, whose robots have no individual goals.
    """
    if not isinstance(task, Navigation):
        return np.ones(np.shape(poses)[:-1], np.bool_)
    gaps = np.hypot(*np.moveaxis(poses[..., :2] - goals, -1, 0))
    return np.asarray(gaps < task.goal_radius + DRIFT_M)


def drive_all(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    seeds: Iterable[int],
    on_episode: Callable[[Episode], None] = lambda _: None,
    touched: Callable[[], bool] | None = None,
) -> list[Episode]:
    """Drives one episode per seed and calls `on_episode` as each ends."""
    episodes = []
    for seed in seeds:
        episodes.append(drive(env, policy, seed, touched=touched))
        on_episode(episodes[-1])
    return episodes


def successes(episodes: Iterable[Episode]) -> int:
    """Number of episodes that reached their goal."""
    return sum(episode.result == "success" for episode in episodes)


def deviation(one: Episode, other: Episode) -> float:
    """Maximum distance between two paths at the same step, over their common length [m]."""
    steps = min(len(one.path), len(other.path))
    return float(np.linalg.norm(one.path[:steps, :2] - other.path[:steps, :2], axis=1).max())
