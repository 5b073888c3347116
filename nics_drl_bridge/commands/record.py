"""`nics record`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nics_drl_bridge.commands.console import EXIT_INTERRUPTED, RobotOption, one_sentence


def record(
    out: Annotated[Path, typer.Option(help="An .npz file, or the folder of a rosbag2, to write.")],
    robot: RobotOption = "ackermann",
    bound: Annotated[
        float, typer.Option(help="Radius of the circle around the start to keep within [m].")
    ] = 2.0,
    duration: Annotated[float, typer.Option(help="Of the drive [s].")] = 60.0,
    speed: Annotated[float, typer.Option(help="Share of the greatest speeds to use.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Of the pattern.")] = 0,
    namespace: Annotated[str, typer.Option(help="Namespace of the robot's topics.")] = "",
    remap: Annotated[
        list[str] | None, typer.Option(help="A topic's other name, as in odom:=/wheel_odometry.")
    ] = None,
    topics: Annotated[
        Path | None, typer.Option(help="YAML file that names the joints of state and wheels.")
    ] = None,
    stamped: Annotated[bool, typer.Option(help="Send cmd_vel as TwistStamped.")] = False,
    use_sim_time: Annotated[
        bool, typer.Option("--use-sim-time", help="Take the time from /clock.")
    ] = False,
    preview: Annotated[
        bool, typer.Option("--preview", help="Show what the drive will be, and stop.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the robot moves.")] = False,
) -> None:
    """Drives a robot over ROS 2 so that it shows its whole motion, and records it."""
    with one_sentence():
        from nics_drl_bridge.nodes import recorder

        order = recorder.RecordOrder(
            robot, out, bound, duration, speed, seed, namespace, tuple(remap or ()), topics,
            stamped, use_sim_time,
        )  # fmt: skip
        if not preview:
            recorder.require_ros()  # first: with ROS 2 from wheels it restarts Python
        for line in recorder.preview(order):
            typer.echo(line)
        if preview:
            return
        if not yes and not typer.confirm("Drive the robot now?"):
            typer.echo("nothing was driven or recorded.")
            return
        lines, whole = recorder.drive(order)
        for line in lines:
            typer.echo(line)
        if not whole:
            raise typer.Exit(EXIT_INTERRUPTED)
