"""A run of training: several seeds, each trained, evaluated, and kept in a folder of its own."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nics_drl_bridge.config import dump_yaml, load_yaml
from nics_drl_bridge.env.tasks import make_task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import write_text
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.evaluation_batch import Summary, summarise
from nics_drl_bridge.policy.evaluation_intervals import Estimate
from nics_drl_bridge.policy.train import CHECKPOINT, Tell, Trained, evaluate, train
from nics_drl_bridge.policy.train_export import export_policy
from nics_drl_bridge.policy.training_settings import TrainingSettings
from nics_drl_bridge.seeds import checked_seeds

SETTINGS, EVALUATION, POLICY = "settings.yaml", "evaluation.json", "policy.onnx"
GREATEST_SEED = 2**32 - 1
"""That numpy's shared generator takes, from which Stable-Baselines3 draws."""
Learn = Callable[[TrainingSettings, int, Path, Tell, bool], Trained]
"""As `train`: of settings, seed, folder, whom to tell, and whether it was begun before."""


@dataclass(frozen=True)
class SeedResult:
    """What one seed came to.

    Attributes:
        seed: of the training.
        trained: the algorithm with its policy.
        summaries: world -> how the policy drives there.
    """

    seed: int
    trained: Trained
    summaries: dict[str, Summary]


@dataclass(frozen=True)
class TrainOrder:
    """What a run is to do.

    Attributes:
        settings: what to learn; a resumed run gives its own, see `settings_of`.
        seeds: of the trainings.
        out: folder of the run; each seed gets one below it.
        episodes: of an evaluation in each world.
        resumed: whether to go on from the checkpoints that there are.
        command: what the user called, for the policy files.
    """

    settings: TrainingSettings
    seeds: Sequence[int]
    out: Path
    episodes: int
    resumed: bool = False
    command: str = ""


def run(
    order: TrainOrder,
    tell: Tell = lambda _: None,
    done: Callable[[SeedResult], None] = lambda _: None,
    learn: Learn = train,
) -> list[SeedResult]:
    """Trains seed after seed and evaluates each in the worlds that it learned in.

    Args:
        order: what to do.
        tell: is told of the progress.
        done: is told of each seed that is through.
        learn: trains one policy.

    Raises:
        ConfigError: the folder holds a run already, or none to resume.
    """
    _check(order.seeds, order.out, order.resumed)
    settings = order.settings
    write_text(order.out / SETTINGS, dump_yaml(settings.model_dump(mode="json")))
    results = []
    for seed in order.seeds:
        folder = order.out / f"seed_{seed}"
        begun = (folder / CHECKPOINT).is_file()
        trained = learn(settings, seed, folder, tell, order.resumed and begun)
        result = SeedResult(seed, trained, _evaluated(settings, trained, order.episodes))
        plain = {world: dataclasses.asdict(one) for world, one in result.summaries.items()}
        write_text(folder / EVALUATION, json.dumps(plain, indent=2) + "\n")
        export(settings, result, order.command, folder / POLICY)
        done(result)
        results.append(result)
    return results


def export(settings: TrainingSettings, result: SeedResult, command: str, path: Path) -> None:
    """Writes the policy file, which tells how the policy came about and how well it drives.

    Args:
        settings: of the training.
        result: of one seed.
        command: what the user called.
        path: of the file, `*.onnx`.
    """
    model = open_model(settings.robot)
    task = make_task(settings.task, model, settings.task_options)
    rates = {f"success in {world}": one.success.value for world, one in result.summaries.items()}
    provenance = {"command": command, "seed": result.seed, "steps": result.trained.steps, **rates}
    export_policy(result.trained.algorithm, task, model, path, provenance=provenance)


def _check(seeds: Sequence[int], out: Path, resumed: bool) -> None:
    checked_seeds(seeds, GREATEST_SEED)
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigError(f"seeds {list(seeds)}: give one or more, none twice.")
    begun = any((out / f"seed_{seed}" / CHECKPOINT).is_file() for seed in seeds)
    if begun and not resumed:
        raise ConfigError(
            f"{out}: holds checkpoints of these seeds; add --resume, or choose another --out."
        )
    if resumed and not begun:
        raise ConfigError(f"{out}: holds no checkpoint of these seeds; leave out --resume.")


def settings_of(out: Path) -> TrainingSettings:
    """The settings of a run that was begun. Raises ConfigError where there is none."""
    if not (out / SETTINGS).is_file():
        raise ConfigError(f"{out}: holds no {SETTINGS}; name the folder of a run with --out.")
    return load_yaml(out / SETTINGS, TrainingSettings)


def _evaluated(settings: TrainingSettings, trained: Trained, episodes: int) -> dict[str, Summary]:
    model = open_model(settings.robot)
    return {
        world: summarise(
            evaluate(trained.algorithm, settings, world, episodes, model), model.control_period
        )
        for world in settings.worlds
    }


def line_of(summary: Summary) -> str:
    """A summary in words, every figure with its 95 % interval."""
    shares = (summary.success, summary.collision, summary.time_out)
    named = zip(("success", "collision", "time-out"), shares, strict=True)
    rates = ", ".join(f"{name} {_percent(share)}" for name, share in named)
    length, time = _amount(summary.length, "m"), _amount(summary.time, "s")
    return f"{rates}, path {length}, time {time} of {summary.episodes} episodes"


def _percent(share: Estimate) -> str:
    return f"{100 * share.value:.1f} % ({100 * share.low:.1f} to {100 * share.high:.1f})"


def _amount(value: Estimate, unit: str) -> str:
    return f"{value.value:.2f} {unit} ({value.low:.2f} to {value.high:.2f})"
