"""Evaluation: runs episodes, judges them by the ground truth, and tallies the results."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import defaults
from nics_drl_bridge.confidence import (
    ConfidenceInterval,
    estimate_mean,
    estimate_rate,
)
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.guard import delay_interrupts
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import Integers, Mask, Singles
from nics_drl_bridge.middleware.uncertainty import Uncertainty, compute_uncertainty_gain
from nics_drl_bridge.policy.file.stateful import Policy, begin
from nics_drl_bridge.seeds import check_seeds

# actions (N, C) for observations (N, O)
Act = Callable[[Singles], NDArray[Any]]

FIRST_SEED = defaults.EVALUATION_SEED
# allowance for odometry drift, since a robot stops where it believes its goal is [m]
DRIFT_M = 0.1
ELSEWHERE = "elsewhere"


@dataclass(frozen=True)
class Episode:
    """Record of an episode. The true `result` is success, collision, time-out or elsewhere."""

    seed: int
    result: str
    path: Array  # (T, 3) poses at the start and after each step
    estimate: Array  # (T, 3) estimated poses
    goal: Array  # (2,) [m]
    bodies: Array  # (K, 7) obstacles at the start, see `sim.scenes.Scene`
    reward: float  # sum over the episode
    believed: str | None = None  # the robot's own result; `result` is the truth
    # increase of the estimate's uncertainty since the start, if known
    uncertain: Uncertainty | None = None

    @property
    def believed_success(self) -> bool:
        """True if the robot believes it arrived without touching anything."""
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

    def plain(self) -> dict[str, Any]:
        """Returns the episode as plain data."""
        return {
            "seed": self.seed,
            "result": self.result,
            "believed": self.believed,
            "goal_distance_m": round(self.miss, 4),
            "steps": self.steps,
            "length_m": round(self.length, 4),
            "goal": self.goal.tolist(),
            "path": np.round(self.path, 4).tolist(),
            "uncertain": None if self.uncertain is None else self.uncertain._asdict(),
        }


def _drive_steps(
    env: Any, policy: Any, seed: Any, options: Any = None, on_start: Any = None
) -> Iterator[tuple[Any, Any, dict[str, Any]]]:
    """Runs an episode, or one in each world of a vector env, until all have ended.

    Yields rewards, ends and `info` after the reset and after each step. `policy` may be a method
    `act`. Raises ConfigError for an action that is not finite.
    """
    act = getattr(policy, "act", policy)
    observation, info = env.reset(seed=seed, options=options)
    if on_start is not None:
        on_start()
    begin(policy)
    yield 0.0, False, info
    running: Any = True
    step = 0
    while np.any(running):
        step += 1
        action = act(observation)
        if not np.isfinite(action).all():
            raise ConfigError(
                f"the policy's action in step {step} contains NaN or inf; train it again."
            )
        observation, reward, terminated, truncated, info = env.step(action)
        ended = np.logical_or(terminated, truncated)
        yield reward, ended, info
        running = running & ~ended


def drive(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    seed: int,
    options: dict[str, Any] | None = None,
    on_start: Callable[[], None] | None = None,
    touched: Callable[[], bool] | None = None,
) -> Episode:
    """Runs one episode to its end; halts the robot if the policy or a callback raises."""
    try:
        steps = _drive_steps(env, policy, seed, options, on_start)
        _, _, start = next(steps)
        track = _Track([start["start"]], [start["pose"]])
        end = start
        for reward, _, end in steps:
            track.add(reward, end)
        return _make_episode(env, seed, track, start, end, touched)
    except BaseException:
        # The env does not see errors raised by the policy.
        if isinstance(env.unwrapped, BridgeEnv):
            with delay_interrupts():
                env.unwrapped.halt()
        raise


@dataclass
class _Track:
    """What is recorded of the steps of an episode."""

    path: list[Array]
    estimate: list[Array]
    reward: float = 0.0
    covariances: tuple[Array, ...] = ()  # the first and the last

    def add(self, reward: float, info: dict[str, Any]) -> None:
        """Adds a step, given its `info`."""
        self.path.append(info.get("true_pose", info["pose"]))
        self.estimate.append(info["pose"])
        self.reward += float(reward)
        covariance = info.get("covariance")
        if covariance is not None and np.shape(covariance) == (3, 3):
            self.covariances = (*self.covariances[:1], covariance)


def _make_episode(
    env: Any,
    seed: int,
    track: _Track,
    start: dict[str, Any],
    end: dict[str, Any],
    touched: Callable[[], bool] | None,
) -> Episode:
    """Judges an episode by `info` of its start and end."""
    goal = start.get("goal")
    if goal is None:  # a user's task may not expose its goal
        goal = env.get_wrapper_attr("scene").goals[0]
    collided = "collision" if np.any(end.get("collision", False)) else "time-out"
    believed = "success" if np.all(end.get("is_success", False)) else collided
    path = np.array(track.path)
    estimate = np.array(track.estimate)
    episode = Episode(
        seed, believed, path, estimate, goal, start["bodies"], track.reward
    )
    if "true_pose" in end:
        task = getattr(env.unwrapped, "task", None)
        result = _judge(believed, end, task, goal, touched)
        return replace(episode, result=result, believed=believed)
    if not track.covariances:
        return episode
    first, last = track.covariances[0], track.covariances[-1]
    return replace(episode, uncertain=compute_uncertainty_gain(first, last))


def _judge(
    believed: str,
    info: dict[str, Any],
    task: Any,
    goal: Array,
    touched: Callable[[], bool] | None,
) -> str:
    """Returns the true result of an episode, from the `info` of its last step."""
    collisions = info.get("true_collision")
    # Without ground truth, use `touched` if given, otherwise the robot's own judgement.
    if collisions is None:
        collisions = believed == "collision" if touched is None else touched()
    if np.any(collisions):
        return "collision"
    is_near = is_truly_near(task, info["true_pose"], goal).all()
    if (believed == "success" and not is_near) or believed == "collision":
        return ELSEWHERE
    return believed


def is_truly_near(task: Any, poses: Array, goals: Array) -> Mask:
    """Returns True if poses (..., 3) are within `DRIFT_M` of goals (..., 2), or without goals."""
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
    """Runs one episode per seed and calls `on_episode` as each ends."""
    episodes = []
    for seed in seeds:
        episodes.append(drive(env, policy, seed, touched=touched))
        on_episode(episodes[-1])
    return episodes


def successes(episodes: Iterable[Episode]) -> int:
    """Returns the number of episodes that reached their goal."""
    return sum(episode.result == "success" for episode in episodes)


def deviation(first: Episode, second: Episode) -> float:
    """Returns the maximum distance [m] between two paths at the same step, over common steps."""
    steps = min(len(first.path), len(second.path))
    return float(
        np.linalg.norm(first.path[:steps, :2] - second.path[:steps, :2], axis=1).max()
    )


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of E episodes; all arrays are (E,)."""

    seeds: Integers
    success: Mask  # the robot truly reached its goal and touched nothing
    collision: Mask  # the robot truly touched something
    steps: Integers  # control periods
    length: Array  # true path length [m]; for a team, the mean over its robots
    reward: Array  # sum over the episode
    believed: Mask  # the robot believes it reached its goal and touched nothing

    @property
    def time_out(self) -> Mask:
        """(E,) True for episodes with neither success nor collision."""
        return ~(self.success | self.collision)


def drive_worlds(env: BridgeVectorEnv, act: Act, seeds: Sequence[int]) -> Outcomes:
    """Runs an episode per seed, bit-identical to `BridgeEnv.reset(seed=...)` without an estimator.

    For a policy with a state, pass its method `act`, so that the state can be reset.
    """
    width = env.num_envs
    checked_seeds = check_seeds(seeds)
    # Seeds that pad the last batch are run but not counted.
    batches = (
        np.resize(checked_seeds[k : k + width], width)
        for k in range(0, len(checked_seeds), width)
    )
    done = (vars(_drive_once(env, act, batch)).values() for batch in batches)
    rows = zip(*done, strict=True)
    return Outcomes(*(np.concatenate(row)[: len(checked_seeds)] for row in rows))


def _drive_once(env: BridgeVectorEnv, act: Act, seeds: Integers) -> Outcomes:
    """Runs one episode in each world, from seeds (N,)."""
    count = env.num_envs
    flags = np.zeros((3, count), np.bool_)
    sums = np.zeros((2, count))
    steps = np.zeros(count, np.int64)
    outcomes = Outcomes(seeds, flags[0], flags[1], steps, sums[0], sums[1], flags[2])
    driven = _drive_steps(env, act, list(seeds))
    _, _, info = next(driven)
    place = np.reshape(info["start"], (count, -1, 3))[..., :2]
    running = np.ones(count, np.bool_)
    for reward, over, info in driven:
        last_place = place
        place = np.reshape(info["true_pose"], (count, -1, 3))[..., :2]
        moved = np.hypot(*np.moveaxis(place - last_place, -1, 0)).mean(axis=-1)
        sums[:, running] += np.stack([moved, reward])[:, running]
        steps += running
        _judge_worlds(env.task, info, running & over, outcomes)
        running &= ~over
    return outcomes


def _judge_worlds(
    task: Any, info: dict[str, Any], ended: Mask, outcomes: Outcomes
) -> None:
    """Writes the flags of the worlds (N,) that have just ended."""
    seen = np.asarray(_get_flags(info, "collision").any(axis=1))
    arrived = np.asarray(_get_flags(info, "is_success").all(axis=1)) & ~seen
    is_there = arrived
    if arrived.any() and "goal" in info:
        near = is_truly_near(task, info["true_pose"], info["goal"])
        is_there = arrived & near.reshape(len(arrived), -1).all(axis=1)
    true = "true_collision" if "true_collision" in info else "collision"
    hit = np.asarray(_get_flags(info, true).any(axis=1))
    outcomes.believed[ended & arrived] = True
    outcomes.success[ended & is_there & ~hit] = True
    outcomes.collision[ended & hit] = True


def _get_flags(info: dict[str, Any], name: str) -> Mask:
    """Returns the flags (N, M) of an entry in `info`; (1, 1) False if it is missing."""
    values = np.asarray(info.get(name, [False]), np.bool_)
    return values.reshape(len(values), -1)


@dataclass(frozen=True)
class Summary:
    """Success rates of episodes; mean path length [m] and duration [s] of successful ones."""

    episodes: int
    success: ConfidenceInterval
    collision: ConfidenceInterval
    time_out: ConfidenceInterval
    believed: ConfidenceInterval  # fraction that the robot itself believed successful
    length: ConfidenceInterval
    time: ConfidenceInterval

    @property
    def shares(self) -> dict[str, ConfidenceInterval]:
        """Fractions by the name of the result."""
        names = "success", "believed", "collision", "time_out"
        return {name.replace("_", "-"): getattr(self, name) for name in names}


def summarise(outcomes: Outcomes, control_period: float) -> Summary:
    """Summarises episodes; `control_period` [s]."""
    count = len(outcomes.seeds)
    arrived = outcomes.success
    flags = arrived, outcomes.collision, outcomes.time_out, outcomes.believed
    length = outcomes.length[arrived]
    time = outcomes.steps[arrived] * control_period
    shares = (estimate_rate(int(flag.sum()), count) for flag in flags)
    return Summary(count, *shares, *map(estimate_mean, (length, time)))


@dataclass(frozen=True)
class Tally(Summary):
    """Statistics of one world; `deviation` is the mean deviation from the first world [m]."""

    same: float  # fraction of episodes that ended as in the first world
    deviation: ConfidenceInterval
    greatest_deviation: float  # maximum over all episodes [m]

    def figures(self) -> dict[str, Any]:
        """Returns the tally as plain data: intervals as lists, non-finite values as null."""
        figures: dict[str, Any] = {}
        for name, value in vars(self).items():
            is_interval = isinstance(value, ConfidenceInterval)
            ends = vars(value).values() if is_interval else [value]
            finite = [end if math.isfinite(end) else None for end in ends]
            figures[name] = finite if is_interval else finite[0]
        return figures


def _collect_outcomes(episodes: Sequence[Episode]) -> Outcomes:
    rows = (
        (e.seed, e.result, e.steps, e.length, e.reward, e.believed_success)
        for e in episodes
    )
    seeds, results, *figures = map(np.array, zip(*rows, strict=True))
    return Outcomes(seeds, results == "success", results == "collision", *figures)


def tallies(
    runs: Mapping[str, Sequence[Episode]], control_period: float
) -> dict[str, Tally]:
    """Computes the statistics of each world, compared with the first world's by seed."""
    first = next(iter(runs.values()))
    by_place = {}
    for place, episodes in runs.items():
        pairs = list(zip(episodes, first, strict=True))
        gaps = [deviation(episode, reference) for episode, reference in pairs]
        same = [episode.result == reference.result for episode, reference in pairs]
        by_place[place] = Tally(
            **vars(summarise(_collect_outcomes(episodes), control_period)),
            same=sum(same) / len(same),
            deviation=estimate_mean(gaps),
            greatest_deviation=max(gaps),
        )
    return by_place
