"""The paper's task: lidar navigation to a goal without contact (Sec. VI-B)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np

from nics_drl_bridge.env import kernels, task
from nics_drl_bridge.env.kernels import LIMIT, NavigationRules
from nics_drl_bridge.env.task import (
    BoundStep,
    Episodes,
    Facts,
    Flags,
    Info,
    Memory,
    Observation,
    Outcome,
    Task,
    Terms,
)
from nics_drl_bridge.interface import Array, RobotView
from nics_drl_bridge.kernels import bind, pack

# rewards in the order of `kernels.navigate`, whose last row is not a reward
TERMS = ("progress", "time", "success", "collision")


class GoalProgress(NamedTuple):
    """Progress of robots towards their goals in a step."""

    approach: Array  # (...,) decrease of the distance to the goal [m]
    reached: Flags  # (...,) True at the goal
    touched: Flags  # (...,) True if the scan shows a contact with the footprint
    succeeded: Flags  # (...,) True at the goal without a contact


@dataclass(frozen=True)
class Navigation(Task):
    """A robot in a walled field with obstacles has to reach a goal without touching anything.

    ## Observation Space

    `Box((B + 6,), float32)` for B beams, or B sectors with `scan`, counter-clockwise:

    | Num | Observation | Min | Max | Unit |
    |---|---|---|---|---|
    | 0 to B - 1 | range as a fraction of the maximum; 1 free, 0 too close or unknown | 0 | 1 | - |
    | B | distance to the goal | 0 | 1000 | m |
    | B + 1, B + 2 | cosine, sine of the bearing of the goal | -1 | 1 | - |
    | B + 3, B + 4 | estimated velocity forward, left | -1000 | 1000 | m/s |
    | B + 5 | estimated turn rate | -1000 | 1000 | rad/s |
    | from B + 6 | fractions of additional `sensors`, if any | 0 | 1 | - |

    ## Action Space

    `Box(-1, 1, (C,), float32)`: each command, scaled between its limits; or `Discrete(7)`, the
    paper's motion commands (`task.DRIVES`; 9 for a robot that moves sideways).

    ## Rewards

    `progress`, 1 per metre of approach; `time`, -0.01 per step; `success`, 10 at the goal;
    `collision`, -10 at a contact.

    ## Starting State

    The world draws obstacles, start and goal. Memory: `goal` (2,) [m].

    ## Episode End

    The robot is within 0.3 m of the goal, or something touches its footprint, according
    to the robot's own estimate and scan. A contact at the goal is not a success.
    """

    keeps_last_scan: ClassVar[bool] = False
    observes_sensors: ClassVar[bool] = True
    shown: ClassVar[tuple[str, ...]] = ("goal",)

    goal_radius: float = task.GOAL_RADIUS_M
    success_reward: float = task.SUCCESS_REWARD
    collision_reward: float = task.COLLISION_REWARD
    progress_reward: float = task.PROGRESS_REWARD
    time_reward: float = task.TIME_REWARD

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_above_zero("goal_radius", self.goal_radius)

    @cached_property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Box of one robot's observation."""
        low = [0.0, -1.0, -1.0, *[-LIMIT] * 3]
        high = [LIMIT, 1.0, 1.0, *[LIMIT] * 3]
        return self.box(low, high)

    def reset(self, episodes: Episodes) -> Memory:
        """Returns a memory with the goal that the world drew."""
        return {"goal": episodes.goals.copy()}

    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """Returns the observation (..., B + 6) of a view, for goals (..., 2) in `map`."""
        return self._observe(view.pose, view, memory)[0]

    def judge(
        self, view: RobotView, memory: Memory, before: RobotView | None = None
    ) -> GoalProgress:
        """Determines which robots are at their goals and which touch something."""
        _, terms, flags = self._observe((before or view).pose, view, memory)
        return GoalProgress(terms[4], flags[0], flags[1], flags[2])

    def reward(self, before: RobotView, after: RobotView, memory: Memory) -> Terms:
        """Returns the terms (...,) whose sum is the reward of a step."""
        progress = self.judge(after, memory, before)
        return {
            "progress": self.progress_reward * progress.approach,
            "time": np.full(progress.approach.shape, self.time_reward, np.float64),
            "success": np.multiply(self.success_reward, progress.succeeded),
            "collision": np.multiply(self.collision_reward, progress.touched),
        }

    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Returns True where a robot is at its goal or touches something."""
        progress = self.judge(view, memory)
        return progress.reached | progress.touched

    def info(self, view: RobotView, memory: Memory) -> Facts:
        """Returns success and contact of each robot."""
        progress = self.judge(view, memory)
        return {"is_success": progress.succeeded, "collision": progress.touched}

    def step_into(
        self, out: Observation, before: RobotView, after: RobotView, memory: Memory
    ) -> Outcome:
        """Computes all of the above in one pass over each scan; `out` is contiguous."""
        _, terms, flags = self._observe(before.pose, after, memory, out)
        facts = {"is_success": flags[2], "collision": flags[1]}
        return Outcome(dict(zip(TERMS, terms, strict=False)), flags[3], facts)

    def bind(self, before: Array, view: RobotView) -> BoundStep | None:
        """Binds steps to a view; see `Task.bind`. Returns None if there are additional sensors."""
        if self.sensors:
            return None
        observation = np.empty(self.observation_space.shape, np.float32)
        terms = np.empty(5)
        flags = np.empty(4, np.bool_)
        goals = np.empty((1, 2))
        navigate = bind(
            kernels.navigate,
            observation[None],
            terms[:, None],
            flags[:, None],
            before[0],
            view.pose[0],
            view.twist[0],
            view.ranges[0],
            goals,
            self._rules,
        )

        def judge(
            memory: Memory,
        ) -> tuple[Observation, dict[str, float], bool, Info]:
            goals[0] = memory["goal"]
            navigate()
            paid = dict(zip(TERMS, terms.tolist(), strict=False))
            _, touched, succeeded, ended = flags.tolist()
            facts = {"is_success": succeeded, "collision": touched}
            return observation.copy(), paid, ended, facts

        return judge

    def _observe(
        self,
        before: Array,
        now: RobotView,
        memory: Memory,
        out: Observation | None = None,
    ) -> tuple[Observation, Array, Flags]:
        """Returns the results of `kernels.navigate`; written to `out` if given."""
        lead = now.pose.shape[:-1]
        terms = np.empty((5, *lead))
        flags = np.empty((4, *lead), np.bool_)
        if out is None:
            out = np.empty((*lead, *self.observation_space.shape), np.float32)
        own = out
        if self.sensors:
            own = np.empty((*lead, self.scan_parts + 6), np.float32)
        kernels.navigate(
            own.reshape(-1, own.shape[-1]),
            terms.reshape(5, -1),
            flags.reshape(4, -1),
            before.reshape(-1, 3),
            now.pose.reshape(-1, 3),
            now.twist.reshape(-1, 3),
            now.ranges.reshape(-1, now.ranges.shape[-1]),
            memory["goal"].reshape(-1, 2),
            self._rules,
        )
        if self.sensors:
            np.concatenate([own, self.sensor_shares(now)], axis=-1, out=out)
        return out, terms, flags

    @cached_property
    def _rules(self) -> Any:
        """NavigationRules, packed for the kernels."""
        _, *names = NavigationRules._fields  # those of this class
        numbers = [float(getattr(self, name)) for name in names]
        return pack(NavigationRules(self.scale, *numbers))
