"""Tasks of several robots: cooperative reaching, and pursuit and evasion."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env import task
from nics_drl_bridge.env.kernels import LIMIT
from nics_drl_bridge.env.task import (
    Episodes,
    Facts,
    Flags,
    Memory,
    Observation,
    Task,
    Terms,
)
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array, RobotView

# limits of distance, cosine and sine, and of a twist
PLACE_LOW = [0.0, -1.0, -1.0]
PLACE_HIGH = [LIMIT, 1.0, 1.0]
TWIST_LOW = [-LIMIT] * 3
TWIST_HIGH = [LIMIT] * 3


def find_bearings(pose: Array, points: Array) -> Array:
    """Returns `task.bearing` (..., M, P, 3) of each point (..., P, 2) from each robot."""
    return task.bearing(pose[..., None, :], points[..., None, :, :])


def find_distances(pose: Array, points: Array) -> Array:
    """Returns the distance (..., M, P) [m] of each point (..., P, 2) from each robot."""
    return task.distance(pose[..., None, :], points[..., None, :, :])


def drop_own(of_all: Array) -> Array:
    """Drops the diagonal of (..., M, M, F), and joins the rows of the others."""
    *lead, count, _, width = of_all.shape
    # Without its first entry, the flat row of pairs has a diagonal entry after each `count` others.
    row = of_all.reshape(*lead, count * count, width)
    groups = row[..., 1:, :].reshape(*lead, count - 1, count + 1, width)
    kept = groups[..., :-1, :]
    return kept.reshape(*lead, count, -1)


def join_parts(*parts: NDArray[Any]) -> Observation:
    """Joins the parts of an observation."""
    return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")


@dataclass(frozen=True)
class CooperativeReaching(Task):
    """M robots have to reach M goals; a goal is done once any robot has reached it.

    ## Observation Space

    Per robot, `Box((B + 4 M + 3 (M - 1) + 3,), float32)` for B beams or sectors. The robots share
    their positions.

    | Num | Observation | Min | Max | Unit |
    |---|---|---|---|---|
    | 0 to B - 1 | range as a fraction of the maximum; 1 free, 0 too close or unknown | 0 | 1 | - |
    | 4 for each goal | distance | 0 | 1000 | m |
    | | cosine, sine of the bearing | -1 | 1 | - |
    | | 1 if it has been reached | 0 | 1 | - |
    | 3 for each other robot, in order | distance | 0 | 1000 | m |
    | | cosine, sine of the bearing | -1 | 1 | - |
    | the last 3 | estimated velocity forward, left; turn rate | -1000 | 1000 | m/s, rad/s |

    ## Action Space

    Per robot, as in navigation: `Box(-1, 1, (C,), float32)`, or `Discrete`.

    ## Rewards

    For each robot: `progress`, 1 per metre of decrease in the distance from each open goal to its
    nearest robot, shared by the team; `time`, -0.01 per step; `reached`, 10 for each goal that is
    reached, shared by the team; `collision`, -10 for the robot that touches something.

    ## Starting State

    The world draws obstacles, starts and goals. Memory: `goal` (M, 2) [m], `reached` (M,).

    ## Episode End

    A robot's episode ends when it touches something; it then stops and remains as an
    obstacle. All robots end when the last goal is reached, that is, when a robot is
    within `goal_radius` [m] of it.
    """

    keeps_last_scan: ClassVar[bool] = False
    shown: ClassVar[tuple[str, ...]] = ("goal",)

    robots: int = 3
    goal_radius: float = task.GOAL_RADIUS_M
    reached_reward: float = task.SUCCESS_REWARD
    collision_reward: float = task.COLLISION_REWARD
    progress_reward: float = task.PROGRESS_REWARD
    time_reward: float = task.TIME_REWARD

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_above_zero("goal_radius", self.goal_radius)
        if self.robots < 2:
            raise ConfigError(
                f"task option robots={self.robots}: a team needs at least 2."
            )

    @cached_property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Box of one robot's observation."""
        goals = self.robots
        mates = self.robots - 1
        low = [*PLACE_LOW, 0.0] * goals
        low += PLACE_LOW * mates
        high = [*PLACE_HIGH, 1.0] * goals
        high += PLACE_HIGH * mates
        return self.box(low + TWIST_LOW, high + TWIST_HIGH)

    def reset(self, episodes: Episodes) -> Memory:
        """Returns a memory with no goal reached; `newly` marks those reached in the last step."""
        goals = episodes.goals.copy()
        none = np.zeros(goals.shape[:-1], np.bool_)
        return {"goal": goals, "reached": none, "newly": none.copy()}

    def update(self, before: RobotView, after: RobotView, memory: Memory) -> None:
        """Marks the goals that a robot has reached."""
        distances = find_distances(after.pose, memory["goal"])
        there = (distances < self.goal_radius).any(axis=-2)
        memory["newly"][...] = there & ~memory["reached"]
        memory["reached"] |= there

    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """Returns the observation (..., M, O) of views (..., M)."""
        goals = find_bearings(view.pose, memory["goal"])
        reached = memory["reached"][..., None, :, None]
        reached = np.broadcast_to(reached, (*goals.shape[:-1], 1))
        goals = np.concatenate([goals, reached], axis=-1)
        mates = find_bearings(view.pose, view.pose[..., :2])
        return join_parts(
            self.free_share(view.ranges),
            goals.reshape(*view.pose.shape[:-1], -1),
            drop_own(mates),
            task.limited(view.twist),
        )

    def reward(self, before: RobotView, after: RobotView, memory: Memory) -> Terms:
        """Returns the reward terms (..., M)."""
        lead = after.pose.shape[:-1]
        gap_before = find_distances(before.pose, memory["goal"]).min(axis=-2)
        gap_after = find_distances(after.pose, memory["goal"]).min(axis=-2)
        # A goal reached in this step still earns its last approach.
        is_open = ~memory["reached"] | memory["newly"]
        nearer = task.total(np.where(is_open, gap_before - gap_after, 0.0))
        newly = task.total(memory["newly"].astype(np.float64))
        share = 1.0 / self.robots
        return {
            "progress": np.full(lead, self.progress_reward * share * nearer[..., None]),
            "time": np.full(lead, self.time_reward),
            "reached": np.full(lead, self.reached_reward * share * newly[..., None]),
            "collision": self.collision_reward * self.touches(after.ranges),
        }

    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Returns True where a robot touches something, or all goals are reached."""
        all_reached = memory["reached"].all(-1, keepdims=True)
        return self.touches(view.ranges) | all_reached

    def info(self, view: RobotView, memory: Memory) -> Facts:
        """Returns success of the team, contacts, and goals reached so far (..., M)."""
        all_reached = memory["reached"].all(-1, keepdims=True)
        return {
            "is_success": np.full(view.pose.shape[:-1], all_reached),
            "collision": self.touches(view.ranges),
            "reached": memory["reached"].copy(),
        }


@dataclass(frozen=True)
class PursuitEvasion(Task):
    """P pursuers have to get close to E evaders, which have to escape; all robots are alike.

    The first P of the M = P + E robots pursue.

    ## Observation Space

    Per robot, `Box((B + 5 (M - 1) + 1 + 3,), float32)` for B beams or sectors. Every robot knows
    the positions of all others.

    | Num | Observation | Min | Max | Unit |
    |---|---|---|---|---|
    | 0 to B - 1 | range as a fraction of the maximum; 1 free, 0 too close or unknown | 0 | 1 | - |
    | 5 for each other robot, in order | distance | 0 | 1000 | m |
    | | cosine, sine of the bearing | -1 | 1 | - |
    | | 1 if it is on the same team | 0 | 1 | - |
    | | 1 if it is out: caught, or in contact with something | 0 | 1 | - |
    | then 1 | 1 if the robot itself is a pursuer | 0 | 1 | - |
    | the last 3 | estimated velocity forward, left; turn rate | -1000 | 1000 | m/s, rad/s |

    ## Action Space

    Per robot, as in navigation: `Box(-1, 1, (C,), float32)`, or `Discrete`.

    ## Rewards

    `pursuit`: for a pursuer, 1 per metre of approach to the nearest evader that is not out; for an
    evader, 1 per metre gained on the nearest pursuer. `capture`: 10 for every pursuer for each
    evader that is caught, -10 for that evader. `time`: -0.01 per step for a pursuer, 0.01 for an
    evader. `collision`: -10 for a robot that touches something else. To train one side, use
    that side's rewards, from `info["reward_terms"]` or from the PettingZoo env; the reward of the
    Gymnasium env is the sum over all robots.

    ## Starting State

    The world draws obstacles and starts. Memory: `out` (M,), `caught` (M,), `newly` (M,).

    ## Episode End

    An evader is out when the free space between it and a pursuer is below `capture_gap`
    [m]. Any robot is out when it touches something else; it then stops and remains as
    an obstacle. All robots end when all evaders, or all pursuers, are out. The pursuers
    succeed when every evader is caught.
    """

    keeps_last_scan: ClassVar[bool] = False

    pursuers: int = 2
    evaders: int = 1
    capture_gap: float = 0.15
    capture_reward: float = task.SUCCESS_REWARD
    collision_reward: float = task.COLLISION_REWARD
    pursuit_reward: float = task.PROGRESS_REWARD
    time_reward: float = task.TIME_REWARD

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_above_zero("capture_gap", self.capture_gap)
        if min(self.pursuers, self.evaders) < 1:
            raise ConfigError(
                f"task options pursuers={self.pursuers}, "
                f"evaders={self.evaders}: need at least 1 each."
            )

    @property
    def robots(self) -> int:
        """M = P + E."""
        return self.pursuers + self.evaders

    @cached_property
    def pursues(self) -> Flags:
        """(M,) True for pursuers."""
        return np.arange(self.robots) < self.pursuers

    @cached_property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Box of one robot's observation."""
        others = self.robots - 1
        low = [*PLACE_LOW, 0.0, 0.0] * others
        high = [*PLACE_HIGH, 1.0, 1.0] * others
        return self.box([*low, 0.0, *TWIST_LOW], [*high, 1.0, *TWIST_HIGH])

    def reset(self, episodes: Episodes) -> Memory:
        """Returns a memory with no robot out; `newly` marks those caught in the last step."""
        none = np.zeros(episodes.starts.shape[:-1], np.bool_)
        return {"out": none, "caught": none.copy(), "newly": none.copy()}

    def update(self, before: RobotView, after: RobotView, memory: Memory) -> None:
        """Marks the robots that are caught or out."""
        chased = self._find_gaps(after, memory)
        reach = 2.0 * self.robot.footprint_radius + self.capture_gap
        caught = ~self.pursues & (chased < reach) & ~memory["out"]
        memory["newly"][...] = caught
        memory["caught"] |= caught
        memory["out"] |= caught | self._find_collided(after, memory)

    def _find_gaps(self, view: RobotView, memory: Memory) -> Array:
        """Returns distances (..., M) [m] to the nearest active opponent, or inf."""
        distances = find_distances(view.pose, view.pose[..., :2])
        is_active = ~memory["out"][..., None, :]
        is_foe = (self.pursues[:, None] != self.pursues) & is_active
        gaps = np.where(is_foe, distances, np.inf)
        return np.asarray(gaps.min(axis=-1))

    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """Returns the observation (..., M, O) of views (..., M)."""
        lead = view.pose.shape[:-1]
        square = (*lead, self.robots)
        are_mates = np.broadcast_to(self.pursues[:, None] == self.pursues, square)
        are_out = np.broadcast_to(memory["out"][..., None, :], square)
        places = find_bearings(view.pose, view.pose[..., :2])
        others = [places, are_mates[..., None], are_out[..., None]]
        return join_parts(
            self.free_share(view.ranges),
            drop_own(np.concatenate(others, axis=-1)),
            np.broadcast_to(self.pursues[:, None], (*lead, 1)),
            task.limited(view.twist),
        )

    def reward(self, before: RobotView, after: RobotView, memory: Memory) -> Terms:
        """Returns the reward terms (..., M)."""
        # Evaders caught in this step still count in this step.
        known = dict(memory)
        known["out"] = memory["out"] & ~memory["newly"]
        gap_before = self._find_gaps(before, known)
        gap_after = self._find_gaps(after, known)
        has_foe = np.isfinite(gap_before) & np.isfinite(gap_after)
        nearer = np.zeros(gap_before.shape)
        np.subtract(gap_before, gap_after, out=nearer, where=has_foe)
        side = np.where(self.pursues, 1.0, -1.0)
        newly = memory["newly"]
        captures = newly.sum(axis=-1, keepdims=True)
        captures = np.where(self.pursues, captures, -1.0 * newly)
        return {
            "pursuit": self.pursuit_reward * side * nearer,
            "capture": self.capture_reward * captures,
            "time": np.full(nearer.shape, self.time_reward * side),
            "collision": np.multiply(
                self.collision_reward, self._find_collided(after, memory)
            ),
        }

    def _find_collided(self, view: RobotView, memory: Memory) -> Flags:
        return self.touches(view.ranges) & ~memory["newly"]

    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Returns True for robots that are out, or for all once a side has none left."""
        out = memory["out"]
        pursuers_out = out[..., self.pursues].all(-1, keepdims=True)
        evaders_out = out[..., ~self.pursues].all(-1, keepdims=True)
        return out | pursuers_out | evaders_out

    def info(self, view: RobotView, memory: Memory) -> Facts:
        """Returns success of each robot's side, contacts, and captures (..., M)."""
        evaders_caught = memory["caught"][..., ~self.pursues]
        won = evaders_caught.all(-1, keepdims=True)
        return {
            "is_success": np.asarray(won == self.pursues),
            "collision": self._find_collided(view, memory),
            "caught": memory["caught"].copy(),
        }
