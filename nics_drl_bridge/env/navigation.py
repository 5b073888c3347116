"""The paper's task: navigate to a goal by lidar, without touching anything (Sec. VI-B).

Written once, over `...` leading dimensions: the same functions serve one robot over ROS 2 and
thousands in the vector simulator. Nothing here asks where the robot lives.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.lidar.spec import LidarSpec

Array = NDArray[np.float64]
GOAL_PARTS = 3
TWIST_PARTS = 3


@dataclass(frozen=True)
class Verdict:
    """How a step ended. Each is (...,) bool.

    Attributes:
        reached: the robot is at the goal.
        touched: the scan says that something is within the footprint.
    """

    reached: NDArray[np.bool_]
    touched: NDArray[np.bool_]


@dataclass(frozen=True)
class Navigation:
    """Observation, action, reward and end of the navigation task.

    Observation (..., B + 6), float32: the scan in shares of its range, counter-clockwise, 1 is
    free and 0 too close or unknown; distance to the goal [m]; cosine and sine of its bearing;
    twist vx, vy [m/s], wz [rad/s].

    Action (..., C), float32 in [-1, 1]: each command between its limits.

    Attributes:
        robot: gives commands, their limits, and the footprint.
        lidar: gives the scan's layout.
        goal_radius: how near is there [m].
        contact_margin: a return this close to the footprint counts as a touch [m].
        success_reward, collision_reward: for ending that way.
        progress_reward: per metre of approach.
        time_reward: per step.
    """

    robot: RobotSpec
    lidar: LidarSpec
    goal_radius: float = 0.3
    contact_margin: float = 0.02
    success_reward: float = 10.0
    collision_reward: float = -10.0
    progress_reward: float = 1.0
    time_reward: float = -0.01

    @property
    def observation_space(self) -> gymnasium.Space[NDArray[np.float32]]:
        """Box of one robot's observation."""
        beams = self.lidar.beams
        low = np.full(beams + GOAL_PARTS + TWIST_PARTS, -np.inf, np.float32)
        high = np.full_like(low, np.inf)
        low[:beams], high[:beams] = 0.0, 1.0
        low[beams : beams + GOAL_PARTS] = 0.0, -1.0, -1.0
        high[beams + 1 : beams + GOAL_PARTS] = 1.0
        return gymnasium.spaces.Box(low, high, dtype=np.float32)

    @property
    def action_space(self) -> gymnasium.Space[NDArray[np.float32]]:
        """Box of one robot's action."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.robot.command),), np.float32)

    def command(self, action: ArrayLike) -> Array:
        """The command (..., C) of an action (..., C), clipped to the robot's limits."""
        share = (np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0) + 1.0) / 2.0
        low, high = self.robot.command_low, self.robot.command_high
        return low + share * (high - low)

    def observe(self, view: RobotView, goal: ArrayLike) -> NDArray[np.float32]:
        """The observation (..., B + 6) of a view, for goals (..., 2) in `map`."""
        relative = self._relative(view, goal)
        distance = np.hypot(relative[..., 0], relative[..., 1])
        bearing = np.arctan2(relative[..., 1], relative[..., 0])
        parts = [
            self.free_share(view.ranges),
            np.stack([distance, np.cos(bearing), np.sin(bearing)], axis=-1),
            view.twist,
        ]
        return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")

    def free_share(self, ranges: NDArray[np.float32]) -> NDArray[np.float32]:
        """Ranges (..., B) in shares of the greatest: 1 no return, 0 too close or unknown."""
        share = np.clip(ranges / np.float32(self.lidar.range_max), 0.0, 1.0)
        return np.where(np.isnan(ranges), np.float32(0.0), share).astype(np.float32)

    def judge(self, view: RobotView, goal: ArrayLike) -> Verdict:
        """Whether robots are at their goals, and whether they touch something."""
        distance = np.linalg.norm(self._relative(view, goal), axis=-1)
        # Comparing with NaN, which is unknown, is False; -inf, too close, is nearer than all.
        touched = (view.ranges < self._contact_ranges).any(axis=-1)
        return Verdict(np.asarray(distance < self.goal_radius), np.asarray(touched))

    @cached_property
    def _contact_ranges(self) -> NDArray[np.float32]:
        """(B,) range at which each beam leaves the footprint and its margin [m]."""
        x, y, heading = self.lidar.mount
        angles = self.lidar.angles + heading
        limit = self.robot.footprint_radius + self.contact_margin
        along = x * np.cos(angles) + y * np.sin(angles)
        rest = limit * limit - x * x - y * y + along * along
        leaves = np.where(rest >= 0.0, np.sqrt(np.maximum(rest, 0.0)) - along, -np.inf)
        return leaves.astype(np.float32)

    def reward(
        self, before: RobotView, after: RobotView, goal: ArrayLike, verdict: Verdict
    ) -> dict[str, Array]:
        """The terms (...,) of the reward for a step; their sum is the reward."""
        approach = np.linalg.norm(self._relative(before, goal), axis=-1) - np.linalg.norm(
            self._relative(after, goal), axis=-1
        )
        return {
            "progress": self.progress_reward * approach,
            "time": np.full_like(approach, self.time_reward),
            "success": self.success_reward * (verdict.reached & ~verdict.touched),
            "collision": self.collision_reward * verdict.touched,
        }

    @staticmethod
    def _relative(view: RobotView, goal: ArrayLike) -> Array:
        """Goals (..., 2) as seen from the robots."""
        offset = np.asarray(goal, dtype=np.float64) - view.pose[..., :2]
        return geometry.rotate(offset, -view.pose[..., 2])
