"""Where a vehicle is to drive: starts and goals of its episodes, and how far that is."""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.interface import Array
from nics_drl_bridge.sim.scenes import Scene
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import AnyWorld

# frames of a goal
ROBOT = "robot"
MAP = "map"
GOAL_FRAMES = (ROBOT, MAP)
# where episodes start: see `RealtimeOptions.start`
WAIT = "wait"
PRESENT = "present"
NEAR_M = 0.5  # a vehicle that was moved by less since it was asked for is not asked about again [m]
MARGIN_M = 10.0  # of the open ground beyond a goal [m]
Say = Callable[[str], None]
Point = tuple[float, float]


@dataclass(frozen=True)
class GoalOrder:
    """A goal as the user asks for it.

    In the frame `robot`, x is ahead of the place where the robot starts, and y is left of it; in
    `map`, both are coordinates of the estimate, which begin where odometry does unless there is a
    pose sensor.
    """

    point: Point | None = None  # x, y [m]; None: the world's own, of each episode
    # None: `robot` where the start is the present place, else `map`
    frame: str | None = None
    start: str = defaults.VEHICLE_START  # or PRESENT
    localised: bool = False  # a pose sensor tells where the robot is in `map`
    confirm_beyond_m: float = defaults.CONFIRMED_BEYOND_M

    def __post_init__(self) -> None:
        if self.frame not in (None, *GOAL_FRAMES):
            raise ConfigError(
                f"--goal-frame {self.frame!r}: {suggest(str(self.frame), GOAL_FRAMES)}"
            )
        if self.start not in (WAIT, PRESENT):
            raise ConfigError(
                f"--start {self.start!r}: {suggest(self.start, (WAIT, PRESENT))}"
            )
        if not self.confirm_beyond_m >= 0.0:
            told = f"--confirm-beyond {self.confirm_beyond_m:g}"
            raise ConfigError(f"{told}: must be a distance of 0 m or more.")

    @property
    def relative(self) -> bool:
        """True if goals are seen from the place where the robot starts."""
        return (self.frame or (ROBOT if self.start == PRESENT else MAP)) == ROBOT

    @property
    def lays_map(self) -> bool:
        """True if `map` is laid so that the robot stands at the start of each episode."""
        return self.start == PRESENT and self.relative and not self.localised

    @property
    def needs_pose(self) -> bool:
        """True if the present pose has to be known to tell how far the goal is."""
        return self.start == PRESENT and not self.lays_map

    def ground(self, world: AnyWorld) -> AnyWorld:
        """Returns the world of the episodes: open ground where its obstacles mean nothing."""
        if not self.lays_map or self.point is None:
            return world
        reach = float(np.hypot(*self.point)) + MARGIN_M
        return World(
            name="around the vehicle",
            bounds=(-reach, -reach, reach, reach),
            goal_distance=(0.0, 1.0),
        )

    def episode(self, scene: Scene, present: Array | None = None) -> "VehicleEpisode":
        """Returns start and goal of an episode, for a robot at a pose (3,) in `map`, if known."""
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
    seen: Array  # (2,) the goal from the start: ahead, left [m]

    @property
    def distance(self) -> float:
        """Straight from the start to the goal [m]."""
        return float(np.hypot(*self.seen))

    @property
    def options(self) -> dict[str, Array]:
        """Options of the env's reset."""
        if self.order.point is None and not self.order.needs_pose:
            given = {}
        else:
            given = {"goal": self.goal}
        if self.order.lays_map and self.order.point is not None:
            given["start"] = self.start
        return given

    def sentence(self) -> str:
        """Returns where it will drive, and where the vehicle has to stand."""
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
        """Asks before a far drive. Raises ConfigError if nobody can be asked."""
        limit = self.order.confirm_beyond_m
        if self.distance <= limit:
            return
        told = f"{self.sentence()}, farther than {limit:g} m"
        if confirm is None:
            raise ConfigError(f"{told}: nobody can confirm that here; {UNATTENDED}")
        confirm(told)


UNATTENDED = (
    "say --yes to drive there without a question, or --confirm-beyond with more metres."
)


def confirm_at_terminal(question: str) -> None:
    """Asks at the terminal. Raises ConfigError without one, and if the answer is no."""
    import typer

    if not sys.stdin.isatty():
        raise ConfigError(f"{question}: nobody can confirm that here; {UNATTENDED}")
    if not typer.confirm(f"{question}. Drive there?", err=True):
        raise ConfigError(
            "the vehicle is not driven, as the goal was not confirmed; choose another."
        )
