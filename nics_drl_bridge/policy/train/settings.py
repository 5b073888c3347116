"""Training settings: task, worlds, algorithm, duration, and their fit to a robot."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import gymnasium
from pydantic import Field, field_validator, model_validator

from nics_drl_bridge import defaults
from nics_drl_bridge.config import (
    Schema,
    find_config,
    list_shipped,
    load_yaml,
    validate,
)
from nics_drl_bridge.env.registry import find_task_class
from nics_drl_bridge.env.teaching import Teaching
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.lidar.sectors import LAYOUTS, count_sectors, covers
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.robot.kinds import has_textbook, reach
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

Share = Annotated[float, Field(gt=0.0, le=1.0)]
Count = Annotated[int, Field(ge=1, le=10**12)]
MOST_WORLDS = 65_536  # maximum number of copies of all worlds together
MOST_LAYERS = 16
MOST_WIDE = 8_192
# maximum number of stored transitions: a rollout in all worlds, or SAC's buffer
MOST_KEPT = 2**26
Width = Annotated[int, Field(ge=1, le=MOST_WIDE)]
DISCOUNT = 0.98  # of both algorithms
OWN_TASK = "navigation"  # task whose settings user-defined robots inherit
LEAST_S = 30.0  # minimum time limit [s]
LEAST_RATE = 0.02  # final fraction of PPO's learning rate
ROOM = 1.8  # factor on the straight-line time, for detours, turns and slow sections


class PpoSettings(Schema):
    """Proximal policy optimisation (Schulman and others 2017), as in Stable-Baselines3.

    The engine `lean` learns on one core while it collects on another; `sb3` is Stable-Baselines3's.
    """

    engine: Literal["lean", "sb3"] = "lean"  # see above
    # initial learning rate; falls linearly to a fiftieth of it
    learning_rate: float = Field(default=1e-3, gt=0.0)
    rollout: Count = 32  # steps in each world between two updates
    batch: Count = 2048  # transitions of one gradient step
    epochs: Count = 5  # passes through the rollout in each update
    discount: Share = DISCOUNT  # gamma, per step
    gae_lambda: Share = 0.95  # lambda of generalised advantage estimation
    clip: float = Field(default=0.2, gt=0.0)  # range of the probability ratio around 1
    # weight of the entropy bonus; a higher weight means more exploration
    entropy: float = Field(default=0.0, ge=0.0)
    log_std: float = -0.5  # initial log standard deviation of the actions


class SacSettings(Schema):
    """Soft actor-critic (Haarnoja and others 2018), as in Stable-Baselines3."""

    learning_rate: float = Field(default=1e-3, gt=0.0)  # for all networks, constant
    buffer: Count = 300_000  # number of stored transitions, over all worlds
    batch: Count = 512  # transitions of one gradient step
    updates: Count = 8  # gradient steps after each step of the worlds
    begin_after: Count = 5_000  # transitions of random actions before the first update
    discount: Share = DISCOUNT  # gamma, per step
    # fraction by which each gradient step moves the target critics
    soft_update: Share = 0.01


class StopSettings(Schema):
    """Early stop, when held-out success passes the threshold in two consecutive evaluations."""

    success: Share  # minimum success rate in each world
    every: Count = 200_000  # environment steps between two evaluations
    # number of episodes in each world; they differ each time
    episodes: int = Field(default=200, ge=1, le=10_000)


class TrainingSettings(Schema):
    """A training, as in `config/training/*.yaml`; `worlds` maps names or files to copies."""

    # a shipped task, or `path/to/file.py:ClassName` if the caller also names it, as with `--task`
    task: str = defaults.TASK
    # arguments of the task's class
    task_options: dict[str, Any] = Field(default_factory=dict)
    robot: str = DEFAULT_ROBOT  # a shipped robot, or the folder of a model
    lidar: str | None = None  # shipped lidar or file; None: the model's
    # number of copies of each world
    worlds: dict[str, Count] = Field(default={"circles": 256}, min_length=1)
    # shipped randomisation or file, drawn for each episode
    randomisation: str | None = None
    # rewards from the simulator's ground truth, and repeated episodes
    teaching: Teaching = Teaching()
    # environment steps over all worlds; a maximum if `stop` is set
    steps: Count = 1_000_000
    stop: StopSettings | None = None  # early stop; None: train for all steps
    # time limit of an episode [steps]; by default `nics train` sets 30 s, or 1.8 times what the
    # longest straight path to a goal in the worlds takes at top speed, if that is longer
    max_episode_steps: Count = defaults.EPISODE_STEPS
    # learning algorithm; its settings are in the section of that name
    algorithm: Literal["ppo", "sac"] = "ppo"
    # sizes of the hidden layers, the same for actor and critic
    hidden: tuple[Width, ...] = Field(
        default=(64, 64), min_length=1, max_length=MOST_LAYERS
    )
    # threads of PyTorch, for its engines; results depend slightly on their number
    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    checkpoint_every: Count = 200_000  # environment steps between two checkpoints
    ppo: PpoSettings = PpoSettings()  # used if `algorithm` is `ppo`
    sac: SacSettings = SacSettings()  # used if `algorithm` is `sac`

    @field_validator("task_options")
    @classmethod
    def _check_names(cls, options: dict[str, Any]) -> dict[str, Any]:
        taken = sorted({"robot", "lidar"} & set(options))
        if taken:
            raise ValueError(
                f"task_options can't hold {taken[0]!r}, which the model defines"
            )
        return options

    @model_validator(mode="after")
    def _check_size(self) -> TrainingSettings:
        if self.num_envs > MOST_WORLDS:
            raise ValueError(
                f"all worlds together may have at most {MOST_WORLDS} copies"
            )
        rows = self.num_envs * self.ppo.rollout
        kept = rows if self.algorithm == "ppo" else self.sac.buffer
        if kept > MOST_KEPT:
            raise ValueError(
                f"{self.algorithm} would keep {kept} transitions, more than {MOST_KEPT}; lower "
                "the copies of worlds, ppo.rollout or sac.buffer"
            )
        return self

    @property
    def title(self) -> str:
        """Suitable name for the folder of a run."""
        task = self.task.rpartition(":")[2]
        return f"{task}_{Path(self.robot).stem}_{self.algorithm}"

    @property
    def lean(self) -> bool:
        """True if the lean engine is used."""
        return self.algorithm == "ppo" and self.ppo.engine == "lean"

    @property
    def num_envs(self) -> int:
        """N, the total number of worlds."""
        return sum(self.worlds.values())


def load_training(name: str | Path, task: str | None = None) -> TrainingSettings:
    """Loads settings by the name of a shipped file, or by path. Raises ConfigError.

    A user's task is code. A file may name its task, but only a `task` named by the
    caller is run; it replaces the file's.
    """
    return read_settings(find_config(name, "training"), task)


def read_settings(path: Path, task: str | None) -> TrainingSettings:
    """Reads settings from a file, with the caller's own task if given; see `load_training`."""
    settings = load_yaml(path, TrainingSettings)
    if is_code(settings.task) and not (task is not None and is_code(task)):
        reason = "is code, which a data file must not run"
        raise ConfigError(
            f"{path}: key 'task' {settings.task!r}: {reason}; name it yourself: --task "
            "path/to/file.py:ClassName, or task= in Python."
        )
    return settings if task is None else settings.model_copy(update={"task": task})


def is_code(task: str) -> bool:
    """Returns True for a user's task: `path/to/file.py:ClassName`, or a file without a class."""
    return ":" in task or task.endswith(".py")


def chosen_settings(
    task: str, name: str | None, changes: dict[str, Any]
) -> TrainingSettings:
    """Loads settings by name or file, or else those shipped for task and robot; applies changes."""
    robot = str(changes.get("robot", DEFAULT_ROBOT))
    if name is None and f"{task}_{robot}" not in list_shipped("training"):
        base = TrainingSettings(task=task, robot=robot)
    else:
        base = load_training(name or f"{task}_{robot}", task if is_code(task) else None)
    changed = base.model_dump(mode="json", exclude_unset=True) | changes
    worlds = changed.pop("world", None)
    if worlds:
        changed["worlds"] = dict.fromkeys(worlds, max(1, base.num_envs // len(worlds)))
    engine = changed.pop("engine", None)
    if engine:
        algorithm = changed.get("algorithm", base.algorithm)
        if engine == "lean" and algorithm != "ppo":
            raise ConfigError(
                f"--engine lean requires ppo, not {algorithm!r}; leave it out."
            )
        changed["ppo"] = changed.get("ppo", {}) | {"engine": engine}
    return validate(changed, TrainingSettings, "training settings")


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


def find_pace(
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


def find_kin(robot: RobotSpec) -> str:
    """Returns the name of the shipped robot that moves most like this one."""
    if robot.steers:
        return "ackermann"
    return "mecanum" if robot.moves_sideways else "differential"


class Opened(NamedTuple):
    """The robot of a training, and its worlds by their names in the settings."""

    model: SimulatorModel
    worlds: dict[str, AnyWorld]


def open_training(settings: TrainingSettings) -> Opened:
    """Opens what settings name. Raises ConfigError or ModelError."""
    worlds = {name: load_worlds(name) for name in settings.worlds}
    return Opened(open_model(settings.robot, settings.lidar), worlds)


class Fitted(NamedTuple):
    """Training settings that fit robot and worlds, with a sentence per adaptation."""

    settings: TrainingSettings
    notes: tuple[str, ...]
    opened: Opened


def choose_fitting_settings(
    task: str, name: str | None, changes: dict[str, Any]
) -> Fitted:
    """Loads settings like `chosen_settings`; a robot without settings gets a similar robot's.

    Raises ConfigError, and ModelError if there is no such robot.
    """
    robot = changes.get("robot")
    notes = list[str]()
    shipped = list_shipped("training")
    has_settings = f"{task}_{robot}" in shipped
    if name is None and robot is not None and not has_settings and task == OWN_TASK:
        name = f"own_{find_kin(open_model(robot).robot)}"
        notes.append(
            f"settings {name!r}, because the robot {robot!r} has none of its own"
        )
    settings = chosen_settings(task, name, changes)
    inherited = name in shipped and load_training(str(name)).robot != settings.robot
    made = fit_settings(settings, open_training(settings), inherited)
    return made._replace(notes=(*notes, *made.notes))


def fit_settings(settings: TrainingSettings, opened: Opened, inherited: bool) -> Fitted:
    """Adds a time limit if there is none. Raises ConfigError if the limit is too short.

    Settings inherited from another robot also get a scan layout that this robot's lidar covers, and
    a time reward and discount that amount to the same over an episode.
    """
    options = dict(settings.task_options)
    notes = list[str]()
    lidar = opened.model.lidar
    find_task_class(settings.task, options)
    worlds = opened.worlds.values()
    pace = find_pace(opened.model, worlds, options.get("top_speed"))
    changed: dict[str, Any] = {}
    if inherited and options.get("scan") == "around" and not covers(lidar, "around"):
        front = covers(lidar, "front")
        options["scan"] = "front" if front else count_sectors(lidar)
        notes.append(
            f"the lidar {lidar.name!r} does not cover {LAYOUTS['around'].range_max:g} m "
            f"all around: scan: {options['scan']}"
        )
    if (
        "max_episode_steps" not in settings.model_fields_set
        and pace.steps != defaults.EPISODE_STEPS
    ):
        changed["max_episode_steps"] = pace.steps
        notes.append(
            f"time limit {pace.steps * pace.period:g} s ({pace.steps} steps), for "
            f"{pace.far:g} m at {pace.speed:g} m/s"
        )
        if inherited and pace.steps > defaults.EPISODE_STEPS:
            factor = pace.steps / defaults.EPISODE_STEPS
            changed |= _stretch(settings, options, factor, notes)
    made = settings.model_copy(update={**changed, "task_options": options})
    short = pace.shortfall(made.max_episode_steps)
    if short is not None:
        notes.append(short)
    return Fitted(made, tuple(notes), opened)


def _stretch(
    settings: TrainingSettings,
    options: dict[str, Any],
    factor: float,
    notes: list[str],
) -> dict[str, PpoSettings | SacSettings]:
    """Adapts time reward and discount to episodes that are longer by a factor.

    Changes the options and adds to the notes; returns the changed settings of the algorithm.
    """
    reward = options.get("time_reward")
    if reward:
        options["time_reward"] = round(reward / factor, 6)
        notes.append(f"time_reward {options['time_reward']:g}, was {reward:g}")
    name = settings.algorithm
    learner = settings.ppo if name == "ppo" else settings.sac
    discount = round(1.0 - (1.0 - learner.discount) / factor, 6)
    notes.append(f"{name}.discount {discount:g}, was {learner.discount:g}")
    return {name: learner.model_copy(update={"discount": discount})}


def check_serves(settings: TrainingSettings, env: BridgeVectorEnv) -> None:
    """Raises ConfigError if the algorithm does not suit task and settings, or for a team's task."""
    if env.robots > 1:
        raise ConfigError(
            f"task {settings.task!r}: has {env.robots} robots; train a single-robot task, or use "
            "your own learner (docs/environments.md)."
        )
    continuous = isinstance(env.single_action_space, gymnasium.spaces.Box)
    if settings.algorithm == "sac" and not continuous:
        raise ConfigError("algorithm 'sac' needs continuous actions; use 'ppo'.")
    size = settings.ppo.rollout * settings.num_envs
    if settings.algorithm == "ppo" and settings.ppo.batch > size:
        raise ConfigError(
            f"ppo.batch {settings.ppo.batch}: exceeds the {size} transitions of a rollout; lower "
            "it, or raise ppo.rollout or worlds."
        )
