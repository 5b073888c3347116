"""`nics replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nics_drl_bridge.commands.console import one_sentence


def replay(
    file: Annotated[Path, typer.Argument(help="What command_gate wrote at a stop, *.jsonl.")],
) -> None:
    """Decides anew on what led to a stop of the gate, and tells the stops in it."""
    with one_sentence():
        from nics_drl_bridge.gate import black_box

        again = black_box.replay(file)
        for line in again.story:
            typer.echo(line)
        if again.differing:
            raise typer.Exit(1)
