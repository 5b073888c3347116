"""The command line: `nics ...`."""

import os
import sys
from collections.abc import Sequence
from itertools import zip_longest
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from nics_drl_bridge import __version__, extensions
from nics_drl_bridge.commands.assure import assure
from nics_drl_bridge.commands.console import (
    ROBOT_OPTIONS,
    report_in_one_sentence,
)
from nics_drl_bridge.commands.demo import demo
from nics_drl_bridge.commands.doctor import doctor, explain
from nics_drl_bridge.commands.evaluate import evaluate
from nics_drl_bridge.commands.help import complete
from nics_drl_bridge.commands.install import install
from nics_drl_bridge.commands.interrupts import was_interrupted
from nics_drl_bridge.commands.listing import list_
from nics_drl_bridge.commands.model import (
    drive,
    generate,
    import_,
    inspect,
    record,
    urdf,
)
from nics_drl_bridge.commands.operate import arm, goal, stop
from nics_drl_bridge.commands.policy import policy
from nics_drl_bridge.commands.train import train
from nics_drl_bridge.commands.up import up
from nics_drl_bridge.commands.warmup import warmup
from nics_drl_bridge.commands.watch import watch
from nics_drl_bridge.commands.world import world
from nics_drl_bridge.errors import LONGEST, shorten
from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT, EXIT_INTERRUPTED


class OneWordForARobot(TyperGroup):
    """Refuses `--robot` and `--model` with different values: they are the same option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parses a command line. Raises UsageError if the two options differ."""
        robots = []
        for option in ROBOT_OPTIONS:
            robots += read_option(option, args)
        if len(set(robots)) > 1:
            names = " and ".join(map(repr, robots))
            ctx.fail(
                f"--robot and --model are the same option, but got {names}; give only one."
            )
        return super().parse_args(ctx, args)


def read_option(option: str, args: Sequence[str]) -> list[str]:
    """Returns the values of an option in a command line: `--robot X` or `--robot=X`."""
    values = []
    for word, following in zip_longest(args, args[1:]):
        if word == option and following is not None:
            values.append(following)
        elif word.startswith(f"{option}="):
            values.append(word.removeprefix(f"{option}="))
    return values


app = typer.Typer(
    cls=OneWordForARobot,
    help="From a recording of a robot to a fast simulator, and back to the robot over ROS 2.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # would read units such as [m/s] as markup
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _declare_options(
    version: Annotated[
        bool,
        Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            help="Print the version.",
        ),
    ] = False,
    sensor_kind: Annotated[
        list[str] | None,
        Option(
            help="Import your own kind of sensor, path/to/file.py:ClassName, so that files can "
            "name it. Repeatable; give it before the command."
        ),
    ] = None,
) -> None:
    """Options of every command."""
    if sensor_kind:
        from nics_drl_bridge.lidar.sensor import add_sensor_kind

        with report_in_one_sentence():
            for place in sensor_kind:
                add_sensor_kind(place)


for command in (
    list_,
    drive,
    generate,
    inspect,
    import_,
    record,
    explain,
    doctor,
    urdf,
    train,
    evaluate,
    assure,
    watch,
    demo,
    warmup,
    arm,
    stop,
    install,
):
    app.command(command.__name__.rstrip("_"))(command)
# The arguments of these two may begin with a minus sign.
app.command(context_settings={"ignore_unknown_options": True})(up)
app.command(context_settings={"ignore_unknown_options": True})(goal)
app.add_typer(policy, name="policy")
app.add_typer(world, name="world")
for name, extension in extensions.find_extensions("commands").items():
    app.add_typer(extension.load(), name=name)
complete(app)


def _unwrap_validator(error: Any) -> None:
    """Lets an option error contain a validator's own words, without pydantic's introduction."""
    from pydantic import ValidationError

    cause = error.__cause__
    if isinstance(cause, ValidationError):
        first = cause.errors()[0]
        if first["type"] == "value_error":
            error.message = str(first["ctx"]["error"])


def main() -> None:
    """Runs the command line; a wrong option prints one sentence and exits with code 2."""
    try:
        code = app(prog_name="nics", standalone_mode=False)
    except typer.Abort as abort:
        if was_interrupted(abort):
            typer.echo("nics: interrupted; nothing was started.", err=True)
            raise SystemExit(EXIT_INTERRUPTED) from None
        typer.echo("Aborted.", err=True)
        raise SystemExit(1) from None
    except BrokenPipeError:
        # Python flushes stdout at exit, which must not raise again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except Exception as error:
        # Anything else is not an option error of click or typer.
        if not hasattr(error, "format_message"):
            raise
        _unwrap_validator(error)
        # The message is empty if the help has been shown. Typer has a copy of click's classes.
        message = error.format_message().strip()
        if type(error).__name__ == "NoArgsIsHelpError":
            typer.echo(message, err=True)
        elif message:
            message = shorten(message, LONGEST)
            typer.echo(f"nics: {message} (see `nics --help`)", err=True)
        raise SystemExit(EXIT_BAD_INPUT) from None
    raise SystemExit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    from nics_drl_bridge.commands import start

    start.main()
