"""Time limits of episodes, and rewards and discounts adapted to longer episodes."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from nics_drl_bridge import defaults
from nics_drl_bridge.config import list_shipped
from nics_drl_bridge.env.registry import class_for
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.lidar.sectors import LAYOUTS, covers, sectors_over
from nics_drl_bridge.policy import training_settings as recordings
from nics_drl_bridge.robot.kinds import has_textbook, reach
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

OWN_TASK = "navigation"  # task whose settings user-defined robots inherit
LEAST_S = 30.0  # minimum time limit [s]
ROOM = 1.8  # factor on the straight-line time, for detours, turns and slow sections


@dataclass(frozen=True)
class Pace:
    """Pace of a robot in its worlds: range of start-to-goal distances, and maximum speed."""

    world: str  # world with the maximum distance
    near: float  # minimum distance in any world [m]
    far: float  # maximum distance [m]
    speed: float  # maximum speed of the robot; inf if unknown [m/s]
    period: float  # time between commands [s]

    @property
    def steps(self) -> int:
        """Suitable time limit [steps]."""
        return math.ceil(
            max(LEAST_S, ROOM * self.far / self.speed) / self.period - 1e-9
        )

    def shortfall(self, steps: int) -> str | None:
        """Returns a warning if time is too short for some goals. Raises ConfigError if for all."""
        limit = steps * self.period
        if self.far <= limit * self.speed:
            return None
        reason = (
            f"world {self.world!r}: a goal may be {self.far:g} m away, which takes "
            f"{self.far / self.speed:.0f} s at {self.speed:g} m/s, but an episode ends after "
            f"{limit:g} s; set max_episode_steps to {self.steps}."
        )
        if self.near > limit * self.speed:
            raise ConfigError(f"no goal can be reached in time: {reason}")
        return reason


def pace_of(
    model: SimulatorModel, worlds: Iterable[AnyWorld], top: float | None = None
) -> Pace:
    """Returns the pace of a robot in worlds; `top` limits its speed [m/s]."""
    members = [member for world in worlds for member in world.members]
    distances = []
    for member in members:
        diagonal = math.dist(member.extent[:2], member.extent[2:])
        distances.append((min(member.goal_distance[1], diagonal), member.name))
    far, name = max(distances)
    near = min(member.goal_distance[0] for member in members)
    return Pace(
        name,
        near,
        far,
        min(top or math.inf, top_speed(model.robot)),
        model.control_period,
    )


def top_speed(robot: RobotSpec) -> float:
    """Returns a robot's maximum speed along one axis [m/s]; inf if nothing limits it."""
    if has_textbook(robot):
        return float(reach(robot)[:2].max())
    speeds = [
        max(abs(command.min), abs(command.max))
        for command in robot.command
        if command.unit == "m/s"
    ]
    return max(speeds, default=math.inf)


def kin(robot: RobotSpec) -> str:
    """Returns the name of the shipped robot that moves most like this one."""
    if robot.steers:
        return "ackermann"
    return "mecanum" if robot.moves_sideways else "differential"


class Fitted(NamedTuple):
    """Training settings that fit robot and worlds, with a sentence per adaptation."""

    settings: recordings.TrainingSettings
    notes: tuple[str, ...]


def settings_for(task: str, name: str | None, changes: dict[str, Any]) -> Fitted:
    """Loads settings like `chosen_settings`; a robot without settings gets a similar robot's.

    Raises ConfigError, and ModelError if there is no such robot.
    """
    robot = changes.get("robot")
    notes = list[str]()
    shipped = list_shipped("training")
    has_settings = f"{task}_{robot}" in shipped
    if name is None and robot is not None and not has_settings and task == OWN_TASK:
        name = f"own_{kin(open_model(robot).robot)}"
        notes.append(
            f"settings {name!r}, because the robot {robot!r} has none of its own"
        )
    settings = recordings.chosen_settings(task, name, changes)
    inherited = (
        name in shipped and recordings.load_training(str(name)).robot != settings.robot
    )
    made = fitted(settings, open_model(settings.robot, settings.lidar), inherited)
    return Fitted(made.settings, (*notes, *made.notes))


def fitted(
    settings: recordings.TrainingSettings, model: SimulatorModel, inherited: bool
) -> Fitted:
    """Adds a time limit if there is none. Raises ConfigError if the limit is too short.

    Settings inherited from another robot also get a scan layout that this robot's lidar covers, and
    a time reward and discount that amount to the same over an episode.
    """
    options = dict(settings.task_options)
    notes = list[str]()
    lidar = model.lidar
    worlds = [load_worlds(world) for world in settings.worlds]
    class_for(settings.task, options)
    pace = pace_of(model, worlds, options.get("top_speed"))
    changed: dict[str, Any] = {}
    if inherited and options.get("scan") == "around" and not covers(lidar, "around"):
        scan = options["scan"] = (
            "front" if covers(lidar, "front") else sectors_over(lidar)
        )
        far = LAYOUTS["around"].range_max
        notes.append(
            f"the lidar {lidar.name!r} does not cover {far:g} m all around: scan: {scan}"
        )
    if (
        "max_episode_steps" not in settings.model_fields_set
        and pace.steps != defaults.EPISODE_STEPS
    ):
        changed["max_episode_steps"] = pace.steps
        limit = f"{pace.steps * pace.period:g} s ({pace.steps} steps)"
        notes.append(f"time limit {limit}, for {pace.far:g} m at {pace.speed:g} m/s")
        if inherited and pace.steps > defaults.EPISODE_STEPS:
            changed |= _stretched(
                settings, options, pace.steps / defaults.EPISODE_STEPS, notes
            )
    made = settings.model_copy(update={**changed, "task_options": options})
    short = pace.shortfall(made.max_episode_steps)
    return Fitted(made, tuple(notes) if short is None else (*notes, short))


def _stretched(
    settings: recordings.TrainingSettings,
    options: dict[str, Any],
    factor: float,
    notes: list[str],
) -> dict[str, Any]:
    """Returns the settings to change for episodes `factor` times as long; updates `options`."""
    reward = options.get("time_reward")
    if reward:
        options["time_reward"] = round(reward / factor, 6)
        notes.append(f"time_reward {options['time_reward']:g}, was {reward:g}")
    name = settings.algorithm
    learner = settings.ppo if name == "ppo" else settings.sac
    discount = round(1.0 - (1.0 - learner.discount) / factor, 6)
    notes.append(f"{name}.discount {discount:g}, was {learner.discount:g}")
    return {name: learner.model_copy(update={"discount": discount})}
