"""When a robot counts as arrived or stuck on a path: parameters and their defaults."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class GoalCheck:
    """When a path counts as followed; cf. Nav2's SimpleGoalChecker and PositionGoalChecker."""

    xy_goal_tolerance: float = 0.25  # [m]
    # tolerance of the heading [rad]; ignored for robots that steer
    yaw_goal_tolerance: float = 0.25
    # True: a position once reached counts as reached while the robot turns
    stateful: bool = True
    # maximum remaining path length [m]
    path_length_tolerance: float = 1.0


@dataclass(frozen=True)
class ProgressCheck:
    """When a robot counts as stuck; cf. Nav2's SimpleProgressChecker and PoseProgressChecker."""

    required_movement_radius: float = 0.5  # distance that the robot must move [m]
    movement_time_allowance: float = 10.0  # time within which it must do so [s]
    # turn that also counts as progress [rad]
    required_movement_angle: float = math.inf
