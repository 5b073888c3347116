"""`nics demo`."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from nics_drl_bridge import defaults
from nics_drl_bridge.commands import console


def demo(
    recording: Annotated[
        Path | None, Option(help="A drive; by default a textbook one.")
    ] = None,
    out: Annotated[Path, Option(help="Folder for everything the demo writes.")] = Path(
        "runs/demo"
    ),
    robot: console.DrivenRobotOption = None,
    world: console.WorldOption = defaults.WORLD,
    episodes: Annotated[
        int, Option(min=1, help="Episodes in process, and again over DDS.")
    ] = defaults.DEMO_EPISODES,
    policy: Annotated[
        str | None,
        Option(
            autocompletion=console.POLICIES,
            help="Skip training: use a policy file, a shipped one or a baseline.",
        ),
    ] = None,
    train_steps: Annotated[
        int | None, Option(min=1, help="Environment steps to train.")
    ] = None,
    as_json: console.JsonOption = False,
) -> None:
    """Runs the whole chain once, from a recording to a report."""
    from nics_drl_bridge.commands.demo_report import DemoPlan
    from nics_drl_bridge.commands.demo_run import Demo

    console.tell_replaced(out / "report.html")
    plan = DemoPlan(out, robot, world, recording, episodes, policy, train_steps)
    line = Demo(plan, partial(typer.echo, err=as_json)).run()
    console.print_line(as_json, line, told=line, report=str(out / "report.html"))
