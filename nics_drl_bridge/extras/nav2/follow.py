"""Follows a path with a goal-driven policy: sub-goals on the path, progress, and arrival."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import measure_path, wrap_angle
from nics_drl_bridge.interface import Array

SPACING = 0.05  # distance between the sampled points of a path [m]
WINDOW = 2.0  # path length ahead that is searched for the nearest point [m]
FARTHEST = 1e6  # maximum coordinate of a path [m]
LONGEST = 1e5  # maximum length of a path [m]


class GoalCheck(NamedTuple):
    """When a path counts as followed; cf. Nav2's SimpleGoalChecker and PositionGoalChecker."""

    xy_goal_tolerance: float  # [m]
    # tolerance of the heading [rad]; ignored for robots that steer
    yaw_goal_tolerance: float
    # True: a position once reached counts as reached while the robot turns
    stateful: bool
    path_length_tolerance: float  # maximum remaining path length [m]


class ProgressCheck(NamedTuple):
    """When a robot counts as stuck; cf. Nav2's SimpleProgressChecker and PoseProgressChecker."""

    required_movement_radius: float  # distance that the robot must move [m]
    movement_time_allowance: float  # time within which it must do so [s]
    required_movement_angle: float  # turn that also counts as progress [rad]


class Place(NamedTuple):
    """Position of a robot relative to its path."""

    ahead: Array  # (2,) sub-goal [m]
    nearest: int  # index of the nearest original pose of the path
    remaining: float  # remaining path length [m]
    distance: float  # straight-line distance to the end [m]
    left: float  # offset to the left of the path, negative to its right [m]
    turned: float  # angle from the robot's heading to the path's direction [rad]


class PlannedPath:
    """A path (P, 3) or (P, 2) and the robot's progress along it. Raises ConfigError if invalid.

    Points already passed are not considered again, so a path may cross itself.
    """

    def __init__(self, poses: Array) -> None:
        if not len(poses):
            raise ConfigError("the path is empty; give one with at least one pose.")
        if not (np.abs(poses) < FARTHEST).all():
            raise ConfigError(
                "the path has a coordinate that is not a number, or too large."
            )
        along = measure_path(poses)
        if along[-1] > LONGEST:
            raise ConfigError(
                f"the path is {along[-1]:.3g} m long; the maximum is {LONGEST:g} m."
            )
        count = max(1, math.ceil(along[-1] / SPACING)) + 1
        self.end = poses[-1]
        self._along = np.linspace(0.0, along[-1], count)
        self._points = np.column_stack(
            [np.interp(self._along, along, poses[:, i]) for i in (0, 1)]
        )
        self._given = np.minimum(np.searchsorted(along, self._along), len(poses) - 1)
        self._at = 0

    @property
    def length(self) -> float:
        """Length of the whole path [m]."""
        return float(self._along[-1])

    def locate(self, pose: Array, lookahead: float) -> Place:
        """Locates a robot at a pose (3,), with a sub-goal up to `lookahead` [m] ahead.

        Advances the progress to the nearest point.
        """
        last = int(
            np.searchsorted(self._along, self._along[self._at] + WINDOW, "right")
        )
        away = np.hypot(*(self._points[self._at : last] - pose[:2]).T)
        at = self._at = self._at + int(np.argmin(away))
        ahead = (
            int(np.searchsorted(self._along, self._along[at] + lookahead, "right")) - 1
        )
        after = min(at + 1, len(self._points) - 1)
        direction = self._points[after] - self._points[max(after - 1, 0)]
        if direction.any():
            heading = math.atan2(direction[1], direction[0])
        else:
            heading = float(pose[2])
        off = pose[:2] - self._points[at]
        return Place(
            self._points[ahead],
            int(self._given[at]),
            self.length - float(self._along[at]),
            math.dist(pose[:2], self.end[:2]),
            math.cos(heading) * off[1] - math.sin(heading) * off[0],
            float(wrap_angle(heading - pose[2])),
        )


@dataclass
class GoalChecker:
    """Judges whether a path has been followed to its end."""

    check: GoalCheck
    turns: bool  # True for a robot that turns at the goal
    there: bool = False  # True once its position has been reached

    def turn_left(self, place: Place, pose: Array, end: Array) -> float | None:
        """Returns the remaining turn [rad], 0 at the goal; None before its position is reached."""
        check = self.check
        near = place.distance <= check.xy_goal_tolerance
        reached = near and place.remaining <= check.path_length_tolerance
        self.there = reached or (self.there and check.stateful)
        if not self.there:
            return None
        if self.turns and len(end) > 2:
            turn = float(wrap_angle(end[2] - pose[2]))
        else:
            turn = 0.0
        return turn if abs(turn) > check.yaw_goal_tolerance else 0.0


@dataclass
class ProgressChecker:
    """Judges whether a robot makes progress."""

    check: ProgressCheck
    base: tuple[float, Array] | None = None  # time and pose of the latest progress

    def stuck(self, time_s: float, pose: Array) -> bool:
        """Returns True if a robot at a pose (3,) has not moved enough for too long."""
        check = self.check
        # Restart without a starting point, or if it is later than now: the clock was set back.
        since, place = self.base or (
            math.inf,
            pose,
        )
        moved = math.dist(pose[:2], place[:2]) > check.required_movement_radius
        turned = abs(wrap_angle(pose[2] - place[2])) > check.required_movement_angle
        if time_s < since or moved or turned:
            self.base = since, _ = time_s, pose
        return time_s - since > check.movement_time_allowance
