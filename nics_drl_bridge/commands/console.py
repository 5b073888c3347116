"""Shared parts of the commands: options, one-sentence errors, a table, a progress bar."""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from glob import glob
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from nics_drl_bridge import extensions
from nics_drl_bridge.commands.interrupts import was_interrupted
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from nics_drl_bridge.files import format_json
from nics_drl_bridge.status import STATUS

WIDEST = 10_000
# time before the first progress line and between lines [s]
PATIENCE_S = 2.0
REPEATED_S = 10.0
# description, amount done, total (0: unknown)
Tell = Callable[[str, int, int], None]


def print_line(as_json: bool, text: str, **facts: Any) -> None:
    """Prints a text or, as JSON, the facts behind it."""
    typer.echo(format_json(facts) if as_json else text)


def complete_names(*kinds: str, also: Sequence[str] = ()) -> Callable[[str], list[str]]:
    """Returns the shell completion of an option that takes a name in `config/KIND` or a path."""

    def complete(incomplete: str) -> list[str]:
        from nics_drl_bridge.config import list_shipped

        places = (Path(path) for path in sorted(glob(f"{incomplete}*")))
        paths = [
            str(path)
            for path in places
            if path.is_dir() or path.suffix in (".yaml", ".onnx")
        ]
        names = (*(name for kind in kinds for name in list_shipped(kind)), *also)
        return [name for name in names if name.startswith(incomplete)] + paths

    return complete


ROBOTS = complete_names("robots")
WORLDS = complete_names("worlds", "world_sets", also=("barn",))
POLICIES = complete_names(
    "policies", also=("dynamic_window", "mppi", "random", "straight")
)
ROBOT_OPTIONS = ("--robot", "--model")  # synonyms in every command
ROBOT = Option(*ROBOT_OPTIONS, autocompletion=ROBOTS)
WORLD = Option("--world", "--scene", autocompletion=WORLDS)

# Options of several commands. Options without help are described in each command's docstring.
RobotOption = Annotated[str, ROBOT]
OptionalRobotOption = Annotated[str | None, ROBOT]
WorldsOption = Annotated[list[str] | None, WORLD]
LidarOption = Annotated[str | None, Option(autocompletion=complete_names("lidars"))]
CountOption = Annotated[int, Option(min=1)]
OptionalCountOption = Annotated[int | None, Option(min=1)]
SeedOption = Annotated[int, Option(min=0)]
JsonOption = Annotated[bool, Option("--json", help="Print one JSON object instead.")]
YesOption = Annotated[bool, Option("--yes")]
SimTimeOption = Annotated[bool, Option("--use-sim-time", help="Take time from /clock.")]
PolicyFileArgument = Annotated[
    str,
    Argument(
        autocompletion=POLICIES, help="A policy file, or the name of a shipped one."
    ),
]
RandomisationOption = Annotated[
    str | None,
    Option(
        autocompletion=complete_names("randomisation"),
        help="Randomisation of each episode: shipped (mild) or a YAML file.",
    ),
]
TaskOption = Annotated[
    str | None,
    Option(help="The policy's task, if it is your own: path/to/file.py:ClassName."),
]
GateOption = Annotated[
    str | None,
    Option(
        metavar="LIMITS",
        help="Drive through the gate and its shield, with these limits: shipped "
        "(differential) or a YAML file.",
        autocompletion=complete_names("limits"),
    ),
]
TopicOption = Annotated[
    list[str] | None,
    Option(
        metavar="ROLE=TOPIC",
        help="Topic of one role, such as cmd_vel=/car/drive; repeatable. Roles: "
        "cmd_vel, pose, odom, joint_states, imu; the topic none disables a role.",
    ),
]
RolesOption = Annotated[
    list[str] | None,
    Option(
        metavar="ROLE=TOPIC",
        help="For a bag: topic of a role, such as odom=/wheel_odom; repeatable. Roles: scan, odom, "
        "cmd_vel, pose, imu.",
    ),
]
NamespaceOption = Annotated[
    str, Option(help="Namespace of the robot's topics, for example robot1.")
]
ImuOption = Annotated[
    str,
    Option(
        metavar="TOPIC",
        help="Topic of the gyro; auto: imu or imu/data, if present; none: no gyro.",
    ),
]
HARDWARE_OPTIONS = (
    "start",
    "namespace",
    "pose_type",
    "imu",
    "yes",
    "arm",
    "goal_frame",
    "confirm_beyond",
)
# command -> option -> options, at least one of which it requires
NEEDED: dict[str, dict[str, tuple[str, ...]]] = {
    "evaluate": dict.fromkeys(HARDWARE_OPTIONS, ("hardware",))
    | {"topic": ("shadow",), "ahead": ("shadow",), "goal": ("hardware", "shadow")},
    "watch": {"topic": ("bag",), "namespace": ("ros",), "episodes": ("record",)},
    "replay": dict.fromkeys(("model", "topic", "out"), ("estimate",)),
}
# command -> option -> options that can't be combined with it
APART: dict[str, dict[str, tuple[str, ...]]] = {
    "doctor": {"load": ("bag", "namespace", "duration", "imu", "install")},
    "evaluate": {
        "hardware": ("places", "shadow", "lidar", "randomisation", "gate"),
        "shadow": ("places", "lidar", "randomisation", "gate", "task"),
    },
    "watch": {
        "ros": ("bag", "record", "policy", "lidar", "randomisation", "gate", "task"),
        "bag": ("policy", "lidar", "randomisation", "gate", "task"),
    },
}


def check_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a command refuse numbers that are not finite and options that would have no effect.

    Its user errors are reported by `report_in_one_sentence`.
    """
    parameters = signature(command).parameters
    needed_options = NEEDED.get(command.__name__, {})
    conflicting_options = APART.get(command.__name__, {})

    @wraps(command)
    def run(**options: Any) -> Any:
        given_options = {
            name: value
            for name, value in options.items()
            if value and value != parameters[name].default
        }
        with report_in_one_sentence():
            for name, value in given_options.items():
                _check_finite(name, value)
                needed_names = needed_options.get(name, ())
                if needed_names and not given_options.keys() & needed_names:
                    alternatives = " or ".join(map(_format_option, needed_names))
                    fix = f"{alternatives}; add it, or remove this option."
                    raise ConfigError(f"{_format_option(name)}: requires {fix}")
                for other in conflicting_options.get(name, ()):
                    if other in given_options:
                        refused = _format_option(other)
                        partner = _format_option(name)
                        fix = f"remove {refused} or {partner}."
                        raise ConfigError(
                            f"{refused} can't be combined with {partner}; {fix}"
                        )
            return command(**options)

    return run


def _check_finite(name: str, value: Any) -> None:
    for item in value if isinstance(value, tuple | list) else (value,):
        if isinstance(item, float) and not math.isfinite(item):
            raise ConfigError(
                f"{_format_option(name)} {item}: must be a finite number."
            )


def _format_option(name: str) -> str:
    return {"places": "--in", "policy": "a policy"}.get(
        name, f"--{name.replace('_', '-')}"
    )


def parse_roles(options: Sequence[str]) -> dict[str, str]:
    """Parses the options ROLE=TOPIC of a bag; returns role -> topic. Raises ConfigError."""
    from nics_drl_bridge.middleware.playback import TYPES
    from nics_drl_bridge.recording.topic_roles import parse_topics

    topics = parse_topics(options, TYPES)
    return {role: f"/{topic.removeprefix('/')}" for role, topic in topics.items()}


@contextmanager
def report_in_one_sentence() -> Iterator[None]:
    """Turns user errors into one sentence and exit code 2, never a traceback."""
    try:
        yield
    except (typer.Exit, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        if was_interrupted(error):
            typer.echo(
                "nics: interrupted; everything that was started has ended.", err=True
            )
            raise typer.Exit(EXIT_INTERRUPTED) from None
        if not isinstance(error, Exception):
            raise
        clause = _explain_user_error(error)
        if clause is None:
            raise
        typer.echo(f"nics: {clause}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None


def _explain_user_error(error: Exception) -> str | None:
    """Returns a sentence about an error that the user can fix, or None."""
    if isinstance(error, BridgeError):
        return str(error)
    clause = extensions.explain_own_fault(error)
    if clause is not None:
        return clause
    if isinstance(error, ImportError):
        return extensions.explain_unmet(error)
    if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror or error}; choose another place."
    return None


def tell_replaced(file: Path) -> None:
    """Warns the user if an existing file will be replaced."""
    if file.exists():
        typer.echo(
            f"{file.parent}: the existing {file.name} will be replaced", err=True
        )


def format_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Formats a table; without a terminal, cells are not truncated or wrapped."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    # Text, unlike str, has no markup.
    table = Table(*(Column(Text(head)) for head in heads), box=SIMPLE, pad_edge=False)
    for row in rows:
        table.add_row(*(Text(cell, overflow="fold") for cell in row))
    console = Console()
    if not console.is_terminal:
        wide = Console(width=WIDEST, color_system=None)
        console = Console(width=wide.measure(table).maximum, color_system=None)
    with console.capture() as captured:
        console.print(table)
    return captured.get().rstrip()


@contextmanager
def show_progress(begin: str = "starting") -> Iterator[Tell]:
    """Yields a function that updates a progress bar or, without a terminal, prints some lines."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    task = progress.add_task(begin, total=None)

    def tell(what: str, done: int = 0, total: int = 0) -> None:
        progress.update(task, description=what, completed=done, total=total or None)

    def show(text: str) -> None:
        progress.update(task, description=text)

    is_shown = (
        STATUS.shown_by(show) if console.is_terminal else _print_progress(progress)
    )
    with progress, is_shown:
        yield tell


@contextmanager
def _print_progress(progress: Any) -> Iterator[None]:
    """Prints a line about the only task of a `rich` progress now and then."""
    task = progress.tasks[0]
    ended = threading.Event()

    def print_lines() -> None:
        patience_s = PATIENCE_S
        while not ended.wait(patience_s):
            patience_s = REPEATED_S
            line = task.description
            if task.total:
                line += f", {task.completed:,} of {task.total:,}"
            if task.time_remaining:
                minutes = round(task.time_remaining / 60.0)
                line += f", {minutes // 60} h {minutes % 60:02} min left"
            typer.echo(f"{line} ({task.elapsed:.0f} s)", err=True)

    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
