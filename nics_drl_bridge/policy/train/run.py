"""Trains policies on the vector env, seed after seed, and evaluates them."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, cast

import filelock
import gymnasium
import numpy as np

from nics_drl_bridge import extensions
from nics_drl_bridge.config import dump_yaml, list_shipped
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError, shorten
from nics_drl_bridge.files import format_json, write_text
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.arrays import AnyArray, Singles
from nics_drl_bridge.policy.evaluation import (
    FIRST_SEED,
    Act,
    Outcomes,
    Summary,
    drive_worlds,
    summarise,
)
from nics_drl_bridge.policy.train import checkpoint as checkpoints
from nics_drl_bridge.policy.train.export import export_policy
from nics_drl_bridge.policy.train.normaliser import observe_statistics
from nics_drl_bridge.policy.train.ppo import LeanPpo
from nics_drl_bridge.policy.train.progress import Tell, TrainingLog, Watch
from nics_drl_bridge.policy.train.settings import (
    Opened,
    TrainingSettings,
    check_serves,
    is_code,
    open_training,
    read_settings,
)
from nics_drl_bridge.policy.train.stop import Stop
from nics_drl_bridge.policy.train.worlds import TrainingWorlds
from nics_drl_bridge.seeds import check_seeds
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.threads import one_blas_thread

CHECKPOINT = "checkpoint.npz"
OLD_CHECKPOINT = "checkpoint.pt"  # of version 1, which can't be resumed
SETTINGS = "settings.yaml"
LOCK = ".lock"
EVALUATION = "evaluation.json"
POLICY = "policy.onnx"
SEEDS = 2**40
MOST_WEIGHT = 80.0  # largest sane weight; exp of a log deviation below it is finite
TRIED = 8  # number of worlds, and of steps, in the trial run of a task
# maximum seed of numpy's global generator, which Stable-Baselines3 uses
GREATEST_SB3_SEED = 2**32 - 1
Worlds = Mapping[str, AnyWorld]  # by their names in the settings


@dataclass(frozen=True)
class Trained:
    """The result of a training."""

    # what can be exported: Stable-Baselines3's algorithm, or an actor
    algorithm: Any
    act: Act  # its policy, without exploration noise
    steps: int  # environment steps of all worlds together
    wall_s: float  # wall time of this process [s]
    stepping_s: float  # part of it spent in the simulator [s]


def train(
    model: SimulatorModel,
    worlds: Worlds,
    settings: TrainingSettings,
    seed: int,
    folder: Path,
    tell: Tell = lambda _: None,
    resumed: bool = False,
    on_worlds: Callable[[TrainingWorlds], None] = lambda _: None,
) -> Trained:
    """Trains a policy, or resumes its training in `folder` bit-identically. Raises ConfigError.

    `on_worlds` gets the worlds before the first step, for example to set their `on_step`.
    """
    begin = time.perf_counter()
    path = folder / CHECKPOINT
    content = checkpoints.read_checkpoint(path) if resumed else None
    about: dict[str, Any] = {"seed": seed, "settings": settings.model_dump(mode="json")}
    training_worlds = make_training_worlds(model, worlds, settings)
    check_serves(settings, training_worlds.envs[0])
    stop = _stop_of(model, worlds, settings)
    on_worlds(training_worlds)
    engine = _find_engine(settings)
    if content is None:
        rng = np.random.default_rng(seed)
        training_worlds.seed(int(rng.integers(SEEDS)))
        training = engine(
            settings, training_worlds, seed, observe_statistics(training_worlds, rng)
        )
        # Overrides the algorithm's seeds, which would overlap those of other runs.
        training_worlds.seed(int(rng.integers(SEEDS)))
    else:
        check_same(content["about"], about, path)
        nothing = np.zeros(training_worlds.observation_space.shape)
        training = engine(settings, training_worlds, seed, (nothing, nothing + 1.0))
        _restore(content, (training, stop), training_worlds, path)
    busy = training_worlds.stepping_s

    def save() -> None:
        # Check before replacing a checkpoint that can still be resumed.
        refuse_diverged(training)
        state = training.state() | stop.state()
        checkpoints.save_checkpoint(path, state, training_worlds, about)

    if training.steps < settings.steps and not stop.over:
        log = TrainingLog(folder)
        watch = Watch(training_worlds, seed, settings, save, tell, stop)
        try:
            training.learn(watch, log)
        except (RuntimeError, ValueError, gymnasium.error.InvalidAction):
            refuse_diverged(training, MOST_WEIGHT)
            raise
        finally:
            log.close()
        save()
    return Trained(
        training.algorithm,
        training.act,
        training.steps,
        wall_s=time.perf_counter() - begin,
        stepping_s=training_worlds.stepping_s - busy,
    )


class Training(Protocol):
    """A training in progress, of any engine."""

    algorithm: Any  # see `Trained`

    @property
    def steps(self) -> int:
        """Environment steps done, over all worlds."""

    @property
    def greatest_weight(self) -> float:
        """Largest magnitude of a weight; NaN if one is not a number."""

    def act(self, observations: Singles) -> AnyArray:
        """Returns actions without exploration noise."""

    def learn(self, watch: Watch, log: TrainingLog) -> None:
        """Learns until all steps are done, or the watch ends the training."""

    def state(self) -> dict[str, Any]:
        """Returns everything that changes, for a checkpoint."""

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from the state of another training made with the same arguments."""


def _find_engine(settings: TrainingSettings) -> Callable[..., Training]:
    if settings.lean:
        return LeanPpo
    return cast(Callable[..., Training], extensions.load("trainings", "sb3"))


def refuse_diverged(training: Training, bound: float = math.inf) -> None:
    """Raises ConfigError if a weight of the training is not finite or exceeds a bound."""
    if not training.greatest_weight < bound:
        raise ConfigError(
            f"the training diverged: after {training.steps} steps its weights are too large or "
            "not finite; lower its learning_rate."
        )


def make_training_worlds(
    model: SimulatorModel, worlds: Worlds, settings: TrainingSettings
) -> TrainingWorlds:
    """Makes all worlds of the settings."""
    margin = settings.teaching.margin
    if margin:
        model = replace(model, robot=model.robot.grow_footprint(margin))
    envs = []
    for world, count in settings.worlds.items():
        envs.append(_make_env(model, worlds[world], settings, count, "SameStep"))
        envs[-1].teach(settings.teaching)
    return TrainingWorlds(*envs)


def _restore(
    content: dict[str, Any],
    parts: Iterable[Training | Stop],
    training_worlds: TrainingWorlds,
    path: Path,
) -> None:
    try:
        for part in parts:
            part.restore(content["state"])
        for env, arrays in zip(training_worlds.envs, content["envs"], strict=True):
            checkpoints.restore(env, arrays)
    except ConfigError:
        raise
    except Exception as error:  # noqa: BLE001 - damaged content breaks libraries in any way
        raise ConfigError(
            f"{path}: is not the checkpoint of a training "
            f"({shorten(str(error), 120)}); train again."
        ) from None


def check_same(old: dict[str, Any], new: dict[str, Any], path: Path) -> None:
    """Raises ConfigError unless a checkpoint has the same settings and seed as the training."""
    if (
        not isinstance(old, dict)
        or not isinstance(old.get("settings"), dict)
        or "seed" not in old
    ):
        raise ConfigError(
            f"{path}: does not record which training it belongs to; train again."
        )
    for key, value in new["settings"].items():
        then = old["settings"].get(key)
        if then != value:
            raise ConfigError(
                f"{path}: was trained with {key} {then!r}, not {value!r}; resume with the same "
                "settings, or train in another folder."
            )
    if old["seed"] != new["seed"]:
        raise ConfigError(
            f"{path}: has seed {old['seed']}, not {new['seed']}; name that seed."
        )


@one_blas_thread
def evaluate(
    act: Act,
    model: SimulatorModel,
    world: AnyWorld,
    settings: TrainingSettings,
    episodes: int,
) -> Outcomes:
    """Runs the evaluation protocol's episodes in a world with a policy."""
    env = _make_env(model, world, settings, episodes)
    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    return drive_worlds(env, act, seeds)


def _stop_of(model: SimulatorModel, worlds: Worlds, settings: TrainingSettings) -> Stop:
    """Makes the early stop of a training, with separate worlds."""
    stop = settings.stop
    if stop is None:
        return Stop(None, {})
    envs = {
        name: _make_env(model, worlds[name], settings, stop.episodes)
        for name in settings.worlds
    }
    return Stop(stop, envs)


def _make_env(
    model: SimulatorModel,
    world: AnyWorld,
    settings: TrainingSettings,
    count: int,
    mode: str = "NextStep",
) -> BridgeVectorEnv:
    """Makes copies of a world without teaching; for an evaluation, one per episode."""
    return BridgeVectorEnv(
        count,
        model,
        world,
        settings.task,
        settings.task_options,
        settings.max_episode_steps,
        mode,
        randomisation=settings.randomisation,
    )


# signature of `train`
Learn = Callable[
    [SimulatorModel, Worlds, TrainingSettings, int, Path, Tell, bool], Trained
]


@dataclass(frozen=True)
class SeedResult:
    """The training of one seed, and the evaluation of its policy by world."""

    seed: int
    trained: Trained
    summaries: dict[str, Summary]

    def plain(self) -> dict[str, Any]:
        """Returns the steps of the training and the summaries as plain data."""
        plain: dict[str, Any] = {"training_steps": self.trained.steps}
        for world, summary in self.summaries.items():
            plain[world] = dataclasses.asdict(summary)
        return plain


@dataclass(frozen=True)
class TrainOrder:
    """A request for a training run."""

    # for a resumed run, its saved settings, see `read_run_settings`
    settings: TrainingSettings
    seeds: Sequence[int]
    out: Path  # folder of the run; each seed gets a subfolder
    episodes: int  # evaluation episodes per world
    resumed: bool = False  # True: continue from existing checkpoints
    command: str = ""  # the user's command line, for the policy files


def run(
    order: TrainOrder,
    tell: Tell = lambda _: None,
    done: Callable[[SeedResult], None] = lambda _: None,
    learn: Learn = train,
    evaluating: Callable[[str], None] = lambda _: None,
    opened: Opened | None = None,
) -> list[SeedResult]:
    """Trains and evaluates seed after seed.

    `opened` is what the settings name, if it is open already. Raises ConfigError if a run already
    exists in the folder or, to resume, if there is none.
    """
    _check(order.settings, order.seeds, order.out, order.resumed)
    settings = order.settings
    if not settings.lean:
        extensions.require("Stable-Baselines3's engine", *extensions.SB3)
    model, worlds = opened or open_training(settings)
    _try_task(model, worlds, settings)
    results = []
    with _lock_folder(order.out):
        write_text(order.out / SETTINGS, dump_yaml(settings.model_dump(mode="json")))
        for seed in order.seeds:
            folder = order.out / f"seed_{seed}"
            resumed = order.resumed and (folder / CHECKPOINT).is_file()
            trained = learn(model, worlds, settings, seed, folder, tell, resumed)
            summaries = {}
            for name in settings.worlds:
                evaluating(name)
                driven = evaluate(
                    trained.act, model, worlds[name], settings, order.episodes
                )
                summaries[name] = summarise(driven, model.control_period)
            result = SeedResult(seed, trained, summaries)
            write_text(folder / EVALUATION, format_json(result.plain(), 2) + "\n")
            export(model, settings, result, order.command, folder / POLICY)
            done(result)
            results.append(result)
    return results


@contextmanager
def _lock_folder(out: Path) -> Iterator[None]:
    """Locks the folder of a run against other trainings. Raises ConfigError if it is locked."""
    out.mkdir(parents=True, exist_ok=True)
    try:
        with filelock.FileLock(out / LOCK, timeout=0.0):
            existed = (out / SETTINGS).is_file()
            try:
                yield
            except ConfigError:
                # Unreadable settings must not block other trainings.
                if not existed and not seeds_of(out):
                    (out / SETTINGS).unlink(missing_ok=True)
                raise
    except filelock.Timeout:
        raise ConfigError(
            f"{out}: another training is running there; wait until it ends, "
            "or choose another --out."
        ) from None


def _try_task(
    model: SimulatorModel, worlds: Worlds, settings: TrainingSettings
) -> None:
    """Refuses a task that does not serve or gives no finite numbers, before a folder is made."""
    env = _make_env(model, worlds[next(iter(settings.worlds))], settings, TRIED)
    check_serves(settings, env)
    env.reset(seed=FIRST_SEED)
    for _ in range(TRIED):
        env.step(env.action_space.sample())


def export(
    model: SimulatorModel,
    settings: TrainingSettings,
    result: SeedResult,
    command: str,
    path: Path,
) -> None:
    """Writes the policy file `*.onnx`, with the user's command line and the success rates."""
    task = make_task(settings.task, model, settings.task_options)
    rates = {
        f"success in {world}": summary.success.value
        for world, summary in result.summaries.items()
    }
    provenance = {
        "command": command,
        "seed": result.seed,
        "steps": result.trained.steps,
        **rates,
    }
    # An evaluation finds the robot by this path.
    if settings.robot not in list_shipped("robots"):
        provenance["model"] = str(Path(settings.robot).resolve())
    limit = settings.max_episode_steps
    export_policy(result.trained.algorithm, task, model, path, None, provenance, limit)


def _check(
    settings: TrainingSettings, seeds: Sequence[int], out: Path, resumed: bool
) -> None:
    check_seeds(seeds, GREATEST_SB3_SEED)
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigError(f"seeds {list(seeds)}: give one or more, without duplicates.")
    for seed in seeds:
        old = out / f"seed_{seed}" / OLD_CHECKPOINT
        if old.is_file():
            raise ConfigError(
                f"{old}: is a checkpoint of an earlier version, which can't "
                "be resumed; choose another --out, or remove it."
            )
    started = seeds_of(out)
    begun = not set(started).isdisjoint(seeds)
    if begun and not resumed:
        raise ConfigError(
            f"{out}: contains checkpoints of these seeds; add --resume, or choose another --out."
        )
    own_task = settings.task if is_code(settings.task) else None
    if (
        (out / SETTINGS).is_file()
        and not resumed
        and read_run_settings(out, own_task) != settings
    ):
        raise ConfigError(
            f"{out}: contains a run with other settings; choose another --out, or remove it."
        )
    if resumed and not begun:
        fix = f"name one of {started} with --seeds" if started else "leave out --resume"
        raise ConfigError(f"{out}: contains no checkpoint of these seeds; {fix}.")


def seeds_of(out: Path) -> list[int]:
    """Returns the seeds whose training has started in the folder of a run."""
    begun = (
        path.parent.name.removeprefix("seed_")
        for path in out.glob(f"seed_*/{CHECKPOINT}")
    )
    return sorted(int(seed) for seed in begun if seed.isdecimal())


def read_run_settings(out: Path, task: str | None = None) -> TrainingSettings:
    """Reads the settings of an existing run. Raises ConfigError if there is none.

    If the run trains a user's task, `task` must name it again: a folder never runs
    code.
    """
    if not (out / SETTINGS).is_file():
        raise ConfigError(
            f"{out}: contains no {SETTINGS}; name the folder of a run with --out."
        )
    return read_settings(out / SETTINGS, task)


def line_of(summary: Summary) -> str:
    """Formats a summary as text, with the 95 % interval of every statistic."""
    rates = ", ".join(
        f"{name} {100 * share.value:.1f} % ({100 * share.low:.1f} to {100 * share.high:.1f})"
        for name, share in summary.shares.items()
    )
    path = f", path {summary.length.text('m')}, time {summary.time.text('s')}"
    some = "" if math.isnan(summary.time.value) else path
    return f"{rates}{some} of {summary.episodes} episodes"
