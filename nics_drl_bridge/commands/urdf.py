"""`nics urdf`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nics_drl_bridge.commands.console import one_sentence


def urdf(
    model: Annotated[str, typer.Argument(help="A shipped robot, or the folder of a model.")],
    out: Annotated[Path | None, typer.Option(help="The file to write; <robot>.urdf.")] = None,
) -> None:
    """Writes a robot's URDF, for RViz and robot_state_publisher."""
    with one_sentence():
        from nics_drl_bridge.files import write_text
        from nics_drl_bridge.generator import open_model
        from nics_drl_bridge.kinematics.urdf import urdf_of

        opened = open_model(model)
        file = out or Path(f"{opened.robot.name}.urdf")
        lidar = opened.lidar
        write_text(file, urdf_of(opened.robot, lidar.mount, lidar.frame))
        typer.echo(f"{file}: the URDF of {opened.robot.name}")
