"""`nics demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nics_drl_bridge.commands.console import (
    RobotOption,
    WorldOption,
    one_sentence,
)


def demo(
    recording: Annotated[
        Path | None, typer.Option(help="A drive; by default one of the textbook robot.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for everything the demo writes.")] = Path(
        "runs/demo"
    ),
    robot: RobotOption = "ackermann",
    world: WorldOption = "arena",
    episodes: Annotated[int, typer.Option(min=1, help="How many episodes.")] = 5,
) -> None:
    """Goes the whole road once: generate, drive in process, drive over DDS, report."""
    with one_sentence():
        from nics_drl_bridge.demo import Plan, run

        plan = Plan(out, robot, world, recording, episodes)
        outcome = run(plan, lambda line: typer.echo(line))
        typer.echo(outcome.line())
