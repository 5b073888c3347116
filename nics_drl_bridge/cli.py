"""The command line: `nics ...`."""

from __future__ import annotations

from typing import Annotated

import typer

from nics_drl_bridge import __version__
from nics_drl_bridge.commands.bag import bag
from nics_drl_bridge.commands.bake import bake
from nics_drl_bridge.commands.demo import demo
from nics_drl_bridge.commands.doctor import doctor
from nics_drl_bridge.commands.evaluate import evaluate
from nics_drl_bridge.commands.generate import generate
from nics_drl_bridge.commands.policy import policy
from nics_drl_bridge.commands.record import record
from nics_drl_bridge.commands.replay import replay
from nics_drl_bridge.commands.train import train
from nics_drl_bridge.commands.urdf import urdf

app = typer.Typer(
    help="From a recording of a robot to a fast simulator, and back to the robot over ROS 2.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options of every command."""


for command in (generate, bake, record, replay, doctor, urdf, train, evaluate, demo):
    app.command()(command)
app.add_typer(bag, name="bag")
app.add_typer(policy, name="policy")


def main() -> None:
    """Entry point of the executable."""
    app(prog_name="nics")


if __name__ == "__main__":
    main()
