"""`nics train`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from nics_drl_bridge.commands.console import one_sentence, progress_bar


def train(
    more_seeds: Annotated[list[int] | None, typer.Argument(hidden=True)] = None,
    task: Annotated[str, typer.Option(help="A task, or path/to/file.py:ClassName.")] = "navigation",
    robot: Annotated[
        str | None,
        typer.Option(help="A shipped robot (differential), or the folder of a model."),
    ] = None,
    settings: Annotated[
        str | None,
        typer.Option(help="Shipped settings (navigation_differential), or a YAML file."),
    ] = None,
    world: Annotated[
        list[str] | None,
        typer.Option(help="Train in this world only; given several times, in all of them."),
    ] = None,
    algorithm: Annotated[str | None, typer.Option(help="ppo or sac.")] = None,
    seeds: Annotated[list[int] | None, typer.Option(help="One or more, as --seeds 0 1 2.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Environment steps.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Of the evaluation, in each world.")] = 500,
    out: Annotated[Path | None, typer.Option(help="Folder of the run.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on where --out was interrupted.")] = False,
) -> None:
    """Trains policies with Stable-Baselines3 in the fast simulator, and evaluates them."""
    with one_sentence():
        from nics_drl_bridge.errors import ConfigError
        from nics_drl_bridge.policy.training_settings import chosen_settings

        given = {"robot": robot, "algorithm": algorithm, "steps": steps, "world": world}
        named = {name: value for name, value in given.items() if value}
        if resume and (settings or named):
            raise ConfigError(
                f"--{next(iter(named), 'settings')}: a resumed run has its own settings; leave it "
                "out."
            )
        if resume and out is None:
            raise ConfigError("--resume needs --out, the folder of the run to go on with.")
        try:
            from nics_drl_bridge.policy import train_run
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"training needs the module {error.name!r}; pip install 'nics_drl_bridge[train]'."
            ) from None
        if resume and out is not None:
            chosen = train_run.settings_of(out)
        else:
            chosen = chosen_settings(task, settings, named)
        folder = out or Path("runs") / chosen.title
        _run(train_run, chosen, [*(seeds or [0]), *(more_seeds or [])], folder, episodes, resume)


def _run(
    train_run: Any, settings: Any, seeds: list[int], folder: Path, episodes: int, resume: bool
) -> None:
    def told(progress: Any) -> None:
        tell(
            f"seed {progress.seed}: success {100 * progress.success:.1f} %, "
            f"{progress.steps_per_s:,.0f} steps/s",
            progress.steps,
            progress.total,
        )

    def done(result: Any) -> None:
        trained = result.trained
        typer.echo(f"seed {result.seed}: {trained.steps:,} steps in {trained.wall_s:.0f} s")
        for world, summary in result.summaries.items():
            typer.echo(f"  {world}: {train_run.line_of(summary)}")

    with progress_bar() as tell:
        command = shlex.join(["nics", *sys.argv[1:]])
        order = train_run.TrainOrder(settings, seeds, folder, episodes, resume, command)
        train_run.run(order, told, done)
    typer.echo(f"policy files, checkpoints and logs: {folder}; tensorboard --logdir {folder}")
