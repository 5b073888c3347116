"""`nics train`."""

import math
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.commands.first_checks import check_settings, check_training
from nics_drl_bridge.commands.interrupts import was_interrupted
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.files import format_json

DEFAULT_EPISODES = 500
# PPO engines in this process, see `policy.train.settings.PpoSettings`
OWN = ("lean", "sb3")


def train(
    more_seeds: Annotated[list[str] | None, Argument(hidden=True)] = None,
    task: str = defaults.TASK,
    robot: console.OptionalRobotOption = None,
    settings: Annotated[
        str | None, Option(autocompletion=console.complete_names("training"))
    ] = None,
    world: Annotated[list[str] | None, Option(autocompletion=console.WORLDS)] = None,
    algorithm: str | None = None,
    seeds: list[int] | None = None,
    steps: console.OptionalCountOption = None,
    episodes: console.CountOption = DEFAULT_EPISODES,
    out: Path | None = None,
    resume: bool = False,
    engine: str | None = None,
    address: str | None = None,
    env_runners: console.OptionalCountOption = None,
    as_json: console.JsonOption = False,
    watch: Annotated[bool, Option("--watch")] = False,
) -> None:
    """Trains policies in the fast simulator, and evaluates them.

    Args:
        task: A task of this package, or path/to/file.py:ClassName.
        robot: A shipped robot (differential), a YAML file, or the folder of a model.
        settings: Shipped settings (navigation_differential), or a YAML file. Default: those of
            the robot, else of the shipped robot that moves like it.
        world: Train in this world only; repeat to train in several.
        algorithm: ppo or sac.
        seeds: One or more: --seeds 0 1 2.
        steps: Number of environment steps.
        episodes: Number of evaluation episodes in each world.
        out: Folder of the run.
        resume: Continue the interrupted run in --out.
        engine: lean or sb3 (Stable-Baselines3), in this process; ray: a cluster.
        address: Ray cluster: auto (this machine's) or HOST:PORT. Default: a new one.
        env_runners: Number of Ray processes that share the worlds. Default: one per CPU.
        watch: Show some of the worlds on a page, as nics watch does.

    Examples:
        nics train --robot differential --world circles --out runs/first
        nics train --robot my_robot.yaml --world doorway --out runs/mine
    """
    named = _keep_given(
        robot=robot,
        algorithm=algorithm,
        steps=steps,
        world=world,
        engine=engine if engine in OWN else None,
    )
    if resume:
        _check_resumed(out, bool(settings), named)
    if watch and engine not in (None, *OWN):
        raise ConfigError(
            f"--watch --engine {engine}: worlds in other processes can't be shown; "
            "remove --watch or --engine."
        )
    further_seeds = seeds_of_words(more_seeds or [], seeds is not None)
    check_training(task, robot, world or [], [*(seeds or []), *further_seeds], out)
    check_engine(engine, {"address": address, "env-runners": env_runners})
    if (settings or algorithm) and not resume:
        check_settings(task, settings, named)
    extensions.require("training", *extensions.TRAINING)
    from nics_drl_bridge.policy.train import run as train_run

    task_of_user = task if ":" in task else None
    opened = None
    if resume and out is not None:
        chosen = train_run.read_run_settings(out, task_of_user)
    else:
        chosen, opened = _load_settings(task, settings, named)
    folder = out or Path("runs") / chosen.title
    started = train_run.seeds_of(folder) if resume and not seeds else []
    if started:
        typer.echo(
            f"continuing the seeds {started}; choose others with --seeds", err=True
        )
    all_seeds = [*(seeds or started or [0]), *further_seeds]
    order = train_run.TrainOrder(
        chosen,
        all_seeds,
        folder,
        episodes,
        resume,
        command=shlex.join(["nics", *sys.argv[1:]]),
    )
    resume_command = make_resume_command(
        folder,
        all_seeds,
        episodes=None if episodes == DEFAULT_EPISODES else episodes,
        task=task_of_user,  # a shipped task is in the run's settings
        engine=None if engine in OWN else engine,
        address=address,
        env_runners=env_runners,
    )
    with (
        report_interruption(folder, resume_command, train_run.seeds_of),
        _open_learner(engine, address, env_runners, chosen.num_envs) as learn,
    ):
        show = _run_watched if watch else _run
        show(partial(train_run.run, opened=opened), order, learn, as_json)


def _keep_given(**options: object) -> dict[str, Any]:
    """Returns the options that were given."""
    return {name: value for name, value in options.items() if value}


def _check_resumed(
    out: Path | None, has_settings: bool, named: Mapping[str, Any]
) -> None:
    """Raises ConfigError unless a run can be resumed, with its own settings."""
    if has_settings or named:
        option = next(iter(named), "settings")
        raise ConfigError(
            f"--{option}: a resumed run has its own settings; leave it out."
        )
    if out is None:
        raise ConfigError("--resume requires --out, the folder of the run to continue.")
    if not (out / "settings.yaml").is_file():
        fix = "name the folder of a run with --out"
        raise ConfigError(f"{out}: contains no settings.yaml; {fix}.")


def make_resume_command(
    out: Path, seeds: Sequence[int], **options: object | None
) -> str:
    """Returns the command that resumes a training, ready to paste into a shell."""
    words = ["nics", "train", "--resume", "--out", str(out)]
    words += ["--seeds", *map(str, seeds)]
    for name, value in options.items():
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


@contextmanager
def report_interruption(
    out: Path, command: str, seeds_of: Callable[[Path], list[int]]
) -> Iterator[None]:
    """Prints the command that resumes a training if Ctrl-C or SIGTERM ends the block."""
    try:
        yield
    except BaseException as error:
        if was_interrupted(error) or isinstance(error, SystemExit):
            line = f"{out}: no checkpoint has been written yet; start again."
            if seeds_of(out):
                line = f"to continue from the last checkpoint: {command}"
            typer.echo(line, err=True)
        raise


def seeds_of_words(words: Sequence[str], after_seeds: bool) -> list[int]:
    """Returns the seeds after the first in `--seeds 0 1 2`. Raises ConfigError for other words."""
    for word in words:
        if not after_seeds or not word.isdecimal():
            fix = f"a task is given as --task {word}, seeds as --seeds 0 1 2"
            raise ConfigError(f"nics train: unexpected argument {word!r}; {fix}.")
    return [int(word) for word in words]


def _to_plain(result: Any) -> dict[str, Any]:
    worlds = {world: asdict(summary) for world, summary in result.summaries.items()}
    run = result.trained
    return {
        "seed": result.seed,
        "steps": run.steps,
        "seconds": run.wall_s,
        "worlds": worlds,
    }


def _load_settings(
    task: str, settings: str | None, named: dict[str, Any]
) -> tuple[Any, Any]:
    """Returns the settings of a training, and what they name; prints what was adapted."""
    from nics_drl_bridge.policy.train.settings import choose_fitting_settings

    chosen = choose_fitting_settings(task, settings, named)
    for line in chosen.notes:
        typer.echo(line, err=True)
    return chosen.settings, chosen.opened


def check_engine(engine: str | None, of_clusters: dict[str, Any]) -> None:
    """Raises ConfigError for an unknown engine or an option that the engine does not have."""
    engines = (*OWN, *extensions.find_extensions("engines"))
    if engine is not None and engine not in engines:
        raise ConfigError(f"unknown engine {engine!r}; {suggest(engine, engines)}")
    if engine is None or engine in OWN:
        for name, value in of_clusters.items():
            if value is not None:
                raise ConfigError(
                    f"--{name}: requires --engine ray; add it, or remove this option."
                )


@contextmanager
def _open_learner(
    engine: str | None, address: str | None, runners: int | None, worlds: int
) -> Iterator[Any]:
    if engine is None or engine in OWN:
        from nics_drl_bridge.policy.train.run import train as learn

        yield learn
    else:
        with extensions.load("engines", engine)(address, runners, worlds) as learn:
            yield learn


def _run_watched(
    run: Callable[..., Any], order: Any, learn: Any, as_json: bool
) -> None:
    """Like `_run`, with a live page, which costs nothing while it is closed."""
    from nics_drl_bridge.watch.server import PageServer
    from nics_drl_bridge.watch.show import open_page
    from nics_drl_bridge.watch.training import TrainingView

    with closing(PageServer(port=0)) as server:
        open_page(server.url)

        views: list[TrainingView] = []  # one per seed started so far

        def on_worlds(worlds: Any) -> None:
            views.append(TrainingView(server, worlds))
            worlds.on_step = views[-1]

        def note(what: str) -> None:
            views[-1].note = what

        _run(run, order, partial(learn, on_worlds=on_worlds), as_json, note)


def _run(
    run: Callable[..., Any],
    order: Any,
    learn: Any,
    as_json: bool,
    note: Callable[[str], None] = lambda _: None,
) -> None:
    from nics_drl_bridge.policy.train.run import line_of

    def told(progress: Any) -> None:
        what = f"seed {progress.seed}: {progress.line}"
        if not math.isnan(progress.held_out):
            what += f", held out {100 * progress.held_out:.1f} %"
        note(what)
        tell(what, progress.steps, progress.total)

    def done(result: Any) -> None:
        trained = result.trained
        if as_json:
            return
        typer.echo(
            f"seed {result.seed}: {trained.steps:,} steps in {trained.wall_s:.0f} s"
        )
        for world, summary in result.summaries.items():
            typer.echo(f"  {world}: {line_of(summary)}")

    with console.show_progress("starting the worlds") as tell:

        def evaluating(world: str) -> None:
            tell(f"evaluating in {world}", 0, 0)

        results = run(order, told, done, learn, evaluating)
    folder = order.out
    if as_json:
        typer.echo(
            format_json({"out": str(folder), "seeds": list(map(_to_plain, results))})
        )
        return
    typer.echo(
        f"policy files, checkpoints and logs: {folder}; tensorboard --logdir {folder}"
    )
    policy = folder / f"seed_{results[0].seed}" / "policy.onnx"
    world = next(iter(results[0].summaries))
    task_option = ""
    if ":" in order.settings.task:
        task_option = f" --task {order.settings.task}"
        summaries = [s for result in results for s in result.summaries.values()]
        if not any(summary.success.value > 0.0 for summary in summaries):
            typer.echo(
                "no episode succeeded; check that the task's `info` contains `is_success`",
                err=True,
            )
    typer.echo(f"see it drive: nics watch {policy} --world {world}{task_option}")
