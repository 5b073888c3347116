"""Settings of a training: task, worlds, algorithm and duration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from nics_drl_bridge import defaults
from nics_drl_bridge.config import (
    Schema,
    find_config,
    list_shipped,
    load_yaml,
    validate,
)
from nics_drl_bridge.env.teaching import Teaching
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot import DEFAULT_ROBOT

Share = Annotated[float, Field(gt=0.0, le=1.0)]
Count = Annotated[int, Field(ge=1, le=10**12)]
MOST_WORLDS = 65_536  # maximum number of copies of all worlds together
MOST_LAYERS = 16
MOST_WIDE = 8_192
# maximum number of stored transitions: a rollout in all worlds, or SAC's buffer
MOST_KEPT = 2**26
Width = Annotated[int, Field(ge=1, le=MOST_WIDE)]
DISCOUNT = 0.98  # of both algorithms


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
    # threads of PyTorch; results depend slightly on their number
    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    checkpoint_every: Count = 200_000  # environment steps between two checkpoints
    ppo: PpoSettings = PpoSettings()  # used if `algorithm` is `ppo`
    sac: SacSettings = SacSettings()  # used if `algorithm` is `sac`

    @field_validator("task_options")
    @classmethod
    def _named(cls, options: dict[str, Any]) -> dict[str, Any]:
        taken = sorted({"robot", "lidar"} & set(options))
        if taken:
            raise ValueError(
                f"task_options can't hold {taken[0]!r}, which the model defines"
            )
        return options

    @model_validator(mode="after")
    def _holdable(self) -> TrainingSettings:
        if self.num_envs > MOST_WORLDS:
            raise ValueError(
                f"all worlds together may have at most {MOST_WORLDS} copies"
            )
        rows = self.num_envs * self.ppo.rollout
        kept = rows if self.algorithm == "ppo" else self.sac.buffer
        if kept > MOST_KEPT:
            kept_by = (
                f"{self.algorithm} would keep {kept} transitions, more than {MOST_KEPT}"
            )
            raise ValueError(
                f"{kept_by}; lower the copies of worlds, ppo.rollout or sac.buffer"
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

    A user's task is a program. A file may name the task it is for, but only a `task` named by the
    caller is run; it replaces the file's.
    """
    return read_settings(find_config(name, "training"), task)


def read_settings(path: Path, task: str | None) -> TrainingSettings:
    """Reads settings from a file, with the caller's own task if given; see `load_training`."""
    settings = load_yaml(path, TrainingSettings)
    if is_code(settings.task) and not (task is not None and is_code(task)):
        reason = "is a program, which a data file must not start"
        fix = "name it yourself: --task path/to/file.py:ClassName, or task= in Python"
        raise ConfigError(f"{path}: key 'task' {settings.task!r}: {reason}; {fix}.")
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
