"""Tasks of several robots: cooperative reaching, and pursuit and evasion."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env import task
from nics_drl_bridge.env.kernels import LIMIT
from nics_drl_bridge.env.task import Episodes, Flags, Memory, Observation, Task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array, RobotView


def pair_points(pose: Array, points: Array) -> tuple[Array, Array]:
    """Pairs each robot (..., M, 3) with each point (..., P, 2), broadcast to (..., M, P)."""
    return pose[..., None, :], points[..., None, :, :]


def drop_own(of_all: Array) -> Array:
    """Drops the diagonal of (..., M, M, F), which leaves rows of the others, (..., M, M - 1, F)."""
    *lead, count, _, width = of_all.shape
    # Without its first entry, the flat row of pairs has a diagonal entry after each `count` others.
    flat = of_all.reshape(*lead, count * count, width)[..., 1:, :]
    kept = flat.reshape(*lead, count - 1, count + 1, width)[..., :-1, :]
    return np.asarray(kept.reshape(*lead, count, count - 1, width))


@dataclass(frozen=True)
class CooperativeReaching(Task):
    """M robots have to reach M goals; a goal counts for all once any robot has reached it.

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

    A robot ends when it touches something; it then stands still as another obstacle. All robots end
    when the last goal is reached, that is, when a robot is within `goal_radius` [m] of it.
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
                f"task option robots={self.robots}: a team has at least 2."
            )

    @cached_property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Box of one robot's observation."""
        place = [LIMIT, 1.0, 1.0]
        low = [0.0, -1.0, -1.0]
        mates = self.robots - 1
        return self.box(
            [*[*low, 0.0] * self.robots, *low * mates, *[-LIMIT] * 3],
            [*[*place, 1.0] * self.robots, *place * mates, *[LIMIT] * 3],
        )

    def reset(self, episodes: Episodes) -> Memory:
        """Returns a memory with no goal reached; `newly` marks those reached in the last step."""
        goals = episodes.goals.copy()
        none = np.zeros(goals.shape[:-1], np.bool_)
        return {"goal": goals, "reached": none, "newly": none.copy()}

    def update(self, before: RobotView, after: RobotView, memory: Memory) -> None:
        """Marks the goals that a robot has reached."""
        there = (
            task.distance(*pair_points(after.pose, memory["goal"])) < self.goal_radius
        ).any(axis=-2)
        memory["newly"][...] = there & ~memory["reached"]
        memory["reached"] |= there

    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """Returns the observation (..., M, O) of views (..., M)."""
        goals = task.bearing(*pair_points(view.pose, memory["goal"]))
        reached = np.broadcast_to(
            memory["reached"][..., None, :, None], (*goals.shape[:-1], 1)
        )
        lead = view.pose.shape[:-1]
        parts = [
            self.free_share(view.ranges),
            np.concatenate([goals, reached], axis=-1).reshape(*lead, -1),
            drop_own(task.bearing(*pair_points(view.pose, view.pose[..., :2]))).reshape(
                *lead, -1
            ),
            task.limited(view.twist),
        ]
        return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")

    def reward(
        self, before: RobotView, after: RobotView, memory: Memory
    ) -> dict[str, Array]:
        """Returns the reward terms (..., M)."""
        lead = after.pose.shape[:-1]
        ways = (
            task.distance(*pair_points(view.pose, memory["goal"]))
            for view in (before, after)
        )
        gaps = [way.min(axis=-2) for way in ways]
        # A goal reached in this step still earns its last approach.
        approach = np.where(
            ~memory["reached"] | memory["newly"], gaps[0] - gaps[1], 0.0
        )
        share = 1.0 / self.robots
        nearer = task.total(approach)
        newly = task.total(memory["newly"].astype(np.float64))
        return {
            "progress": np.full(lead, self.progress_reward * share * nearer[..., None]),
            "time": np.full(lead, self.time_reward),
            "reached": np.full(lead, self.reached_reward * share * newly[..., None]),
            "collision": self.collision_reward * self.touches(after.ranges),
        }

    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Returns True where a robot touches something, or all goals are reached."""
        return np.asarray(
            self.touches(view.ranges) | memory["reached"].all(-1, keepdims=True)
        )

    def info(self, view: RobotView, memory: Memory) -> dict[str, NDArray[Any]]:
        """Returns success of the team, contacts, and goals reached so far (..., M)."""
        return {
            "is_success": np.full(
                view.pose.shape[:-1], memory["reached"].all(-1, keepdims=True)
            ),
            "collision": self.touches(view.ranges),
            "reached": memory["reached"].copy(),
        }


@dataclass(frozen=True)
class PursuitEvasion(Task):
    """P pursuers have to get close to E evaders, which have to keep away; all robots are equal.

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

    An evader ends when the free space between it and a pursuer is below `capture_gap` [m]. Any
    robot ends when it touches something else; it then stands still as another obstacle. All end
    when all evaders, or all pursuers, are out. The pursuers succeed when every evader is caught.
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
            counts = f"pursuers={self.pursuers}, evaders={self.evaders}"
            raise ConfigError(f"task options {counts}: need at least 1 each.")

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
        other = self.robots - 1
        return self.box(
            [*[0.0, -1.0, -1.0, 0.0, 0.0] * other, 0.0, *[-LIMIT] * 3],
            [*[LIMIT, 1.0, 1.0, 1.0, 1.0] * other, 1.0, *[LIMIT] * 3],
        )

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
        """Returns distances (..., M) [m] to the nearest active robot of the other side, or inf."""
        between = task.distance(*pair_points(view.pose, view.pose[..., :2]))
        foe = (self.pursues[:, None] != self.pursues) & ~memory["out"][..., None, :]
        return np.asarray(np.where(foe, between, np.inf).min(axis=-1))

    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """Returns the observation (..., M, O) of views (..., M)."""
        lead = view.pose.shape[:-1]
        mates = np.broadcast_to(
            self.pursues[:, None] == self.pursues, (*lead, self.robots)
        )
        out = np.broadcast_to(memory["out"][..., None, :], (*lead, self.robots))
        places = task.bearing(*pair_points(view.pose, view.pose[..., :2]))
        known = np.concatenate([places, mates[..., None], out[..., None]], axis=-1)
        parts: list[NDArray[Any]] = [
            self.free_share(view.ranges),
            drop_own(known).reshape(*lead, -1),
            np.broadcast_to(self.pursues[:, None], (*lead, 1)),
            task.limited(view.twist),
        ]
        return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")

    def reward(
        self, before: RobotView, after: RobotView, memory: Memory
    ) -> dict[str, Array]:
        """Returns the reward terms (..., M)."""
        # Evaders caught in this step still count in it.
        known = {**memory, "out": memory["out"] & ~memory["newly"]}
        gap = [self._find_gaps(view, known) for view in (before, after)]
        free = np.isfinite(gap[0]) & np.isfinite(gap[1])
        nearer = np.where(
            free, np.where(free, gap[0], 0.0) - np.where(free, gap[1], 0.0), 0.0
        )
        side = np.where(self.pursues, 1.0, -1.0)
        captures = memory["newly"].sum(axis=-1)[..., None]
        newly = np.where(self.pursues, captures, -1.0 * memory["newly"])
        return {
            "pursuit": self.pursuit_reward * side * nearer,
            "capture": self.capture_reward * newly,
            "time": np.full(nearer.shape, self.time_reward * side),
            "collision": np.multiply(
                self.collision_reward, self._find_collided(after, memory)
            ),
        }

    def _find_collided(self, view: RobotView, memory: Memory) -> Flags:
        return np.asarray(self.touches(view.ranges) & ~memory["newly"])

    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Returns True for robots that are out, or for all once a side has none left."""
        out = memory["out"]
        over = [
            out[..., side].all(-1, keepdims=True)
            for side in (self.pursues, ~self.pursues)
        ]
        return np.asarray(out | over[0] | over[1])

    def info(self, view: RobotView, memory: Memory) -> dict[str, NDArray[Any]]:
        """Returns success of each robot's side, contacts, and captures (..., M)."""
        won = memory["caught"][..., ~self.pursues].all(-1, keepdims=True)
        return {
            "is_success": np.asarray(won == self.pursues),
            "collision": self._find_collided(view, memory),
            "caught": memory["caught"].copy(),
        }
