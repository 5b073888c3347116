"""`nics demo`."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from nics_drl_bridge import defaults
from nics_drl_bridge.commands import console


def demo(
    recording: Path | None = None,
    out: Path = Path("runs/demo"),
    robot: console.OptionalRobotOption = None,
    world: Annotated[str, console.WORLD] = defaults.WORLD,
    episodes: console.CountOption = defaults.DEMO_EPISODES,
    policy: Annotated[str | None, Option(autocompletion=console.POLICIES)] = None,
    train_steps: console.OptionalCountOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Runs the whole chain once, from a recording to a report.

    Args:
        recording: A recorded drive. Default: a drive of the textbook model.
        out: Folder for all output.
        robot: A shipped robot or a YAML file. Default: the recording's, else differential.
        world: A shipped world or a YAML file.
        episodes: Number of episodes in process, repeated over DDS.
        policy: Skip training: use a policy file, a shipped one or a baseline.
        train_steps: Environment steps to train.

    Examples:
        nics demo
        nics demo --recording drive.npz --robot my_robot.yaml
    """
    from nics_drl_bridge.commands.demo_report import DemoPlan
    from nics_drl_bridge.commands.demo_run import Demo

    console.tell_replaced(out / "report.html")
    plan = DemoPlan(out, robot, world, recording, episodes, policy, train_steps)
    line = Demo(plan, partial(typer.echo, err=as_json)).run()
    console.print_line(as_json, line, told=line, report=str(out / "report.html"))
