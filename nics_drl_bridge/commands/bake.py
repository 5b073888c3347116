"""`nics bake`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nics_drl_bridge.commands.console import one_sentence, progress_bar


def bake(
    lidar: Annotated[str, typer.Option(help="A shipped lidar (paper) or a YAML file.")] = "paper",
    world: Annotated[
        str | None, typer.Option(help="Bake the obstacles of this world (arena), or YAML file.")
    ] = None,
    shapes: Annotated[
        Path | None, typer.Option(help="Bake the shapes of this YAML file, below its key shapes.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Bake the footprint of this robot (ackermann), or YAML file.")
    ] = None,
    budget: Annotated[
        str | None, typer.Option(help="Find the best density within this memory, as 8MB.")
    ] = None,
    distances: Annotated[int | None, typer.Option(help="Grid distances, instead.")] = None,
    rotations: Annotated[int | None, typer.Option(help="Grid rotations, instead.")] = None,
    phases: Annotated[int | None, typer.Option(help="Points per beam, instead.")] = None,
    sensor_model: Annotated[
        Path | None, typer.Option(help="A YAML file of it, instead of that of the lidar.")
    ] = None,
    out: Annotated[Path, typer.Option(help="The .npz file to write.")] = Path("lidar_table.npz"),
) -> None:
    """Bakes a lidar table and tells how far its ranges will be off."""
    with one_sentence():
        from nics_drl_bridge.bake_order import BakeOrder, run

        given = {"distances": distances, "rotations": rotations, "phases": phases}
        density = {name: value for name, value in given.items() if value is not None}
        order = BakeOrder(lidar, world, shapes, robot, budget, density, out, sensor_model)
        with progress_bar() as told:
            lines = run(order, told)
        for line in lines:
            typer.echo(line)
