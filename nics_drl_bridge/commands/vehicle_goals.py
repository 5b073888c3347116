"""Starts and goals of a vehicle's episodes, and confirmation of far goals."""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.sim.scenes import Scene
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import AnyWorld

# frames of goals
ROBOT = "robot"
MAP = "map"
# where episodes start, see `RealtimeOptions.start`
PRESENT = "present"
# increase of a confirmed distance that needs no new confirmation [m]
NEAR_M = 0.5
MARGIN_M = 10.0  # open ground beyond a goal [m]
Say = Callable[[str], None]
Point = tuple[float, float]


@dataclass(frozen=True)
class GoalOrder:
    """A goal as requested by the user.

    In the frame `robot`, x points ahead and y left from the start. In `map`, both are coordinates
    of the estimate, whose origin is that of odometry unless there is a pose sensor.
    """

    point: Point | None = None  # x, y [m]; None: each episode's goal in the world
    # None: `robot` if episodes start at the current pose, else `map`
    frame: str | None = None
    start: str = defaults.VEHICLE_START  # `wait` or PRESENT
    localised: bool = False  # True: a pose sensor locates the robot in `map`
    confirm_beyond_m: float = defaults.CONFIRMED_BEYOND_M

    @property
    def relative(self) -> bool:
        """True if goals are relative to the start."""
        return (self.frame or (ROBOT if self.start == PRESENT else MAP)) == ROBOT

    @property
    def lays_map(self) -> bool:
        """True if `map` is shifted so that the robot stands at the start of each episode."""
        return self.start == PRESENT and self.relative and not self.localised

    @property
    def needs_pose(self) -> bool:
        """True if the distance of the goal depends on the current pose."""
        return self.start == PRESENT and not self.lays_map

    def ground(self, world: AnyWorld) -> AnyWorld:
        """Returns the episodes' world, or open ground if its obstacles can't be placed."""
        if not self.lays_map or self.point is None:
            return world
        reach = float(np.hypot(*self.point)) + MARGIN_M
        return World(
            name="around the vehicle",
            bounds=(-reach, -reach, reach, reach),
            goal_distance=(0.0, 1.0),
        )

    def episode(self, scene: Scene, present: Array | None = None) -> "VehicleEpisode":
        """Returns start and goal of an episode; `present` is the current pose (3,) in `map`."""
        start = np.array(scene.starts[0])
        scene_goal = geometry.between(start, (*scene.goals[0][:2], 0.0))[:2]
        if self.start == PRESENT and present is not None:
            start = np.array(present)
        elif self.lays_map and self.point is not None:
            start = np.zeros(3)
        if self.relative:
            relative_goal = np.array(scene_goal if self.point is None else self.point)
            goal = geometry.compose(start, (*relative_goal, 0.0))[:2]
        else:
            goal = np.array(scene.goals[0] if self.point is None else self.point)
            relative_goal = geometry.between(start, (*goal, 0.0))[:2]
        return VehicleEpisode(self, start, goal, relative_goal)


@dataclass(frozen=True)
class VehicleEpisode:
    """Start and goal of one episode."""

    order: GoalOrder
    start: Array  # (3,) x, y [m], heading [rad] in `map`
    goal: Array  # (2,) x, y in `map` [m]
    seen: Array  # (2,) goal relative to the start: ahead, left [m]

    @property
    def distance(self) -> float:
        """Straight-line distance from the start to the goal [m]."""
        return float(np.hypot(*self.seen))

    @property
    def options(self) -> dict[str, Array]:
        """Options for the env's reset."""
        options = {}
        if self.order.point is not None or self.order.needs_pose:
            options["goal"] = self.goal
        if self.order.lays_map and self.order.point is not None:
            options["start"] = self.start
        return options

    def sentence(self) -> str:
        """Says where to place the vehicle and where it will drive."""
        ahead, left = self.seen
        sides = f"{abs(ahead):.2f} m {'ahead' if ahead >= 0.0 else 'back'}"
        sides += f" and {abs(left):.2f} m to the {'left' if left >= 0.0 else 'right'}"
        place = f"({self.goal[0]:.2f} m, {self.goal[1]:.2f} m) in map"
        if self.order.start == PRESENT:
            if self.order.relative:
                return f"it will drive to {sides} of where it stands"
            return (
                f"it will drive to {place}, {self.distance:.2f} m from where it stands"
            )
        x, y, heading = self.start
        stand = f"place the vehicle at ({x:.2f} m, {y:.2f} m, {heading:.2f} rad)"
        return f"{stand}; it will drive to {place}, {self.distance:.2f} m from there"

    def confirm(self, confirm: Say | None) -> None:
        """Asks before a far drive. Raises ConfigError if `confirm` is None."""
        limit = self.order.confirm_beyond_m
        if self.distance <= limit:
            return
        question = f"{self.sentence()}, farther than {limit:g} m"
        if confirm is None:
            raise ConfigError(f"{question}: nobody can confirm that here; {UNATTENDED}")
        confirm(question)


UNATTENDED = "use --yes to skip the question, or a larger --confirm-beyond."


def confirm_at_terminal(question: str) -> None:
    """Asks at the terminal. Raises ConfigError without a terminal or if the answer is no."""
    import typer

    if not sys.stdin.isatty():
        raise ConfigError(f"{question}: nobody can confirm that here; {UNATTENDED}")
    if not typer.confirm(f"{question}. Drive there?", err=True):
        raise ConfigError(
            "the vehicle is not driven because the goal was not confirmed; choose another."
        )
