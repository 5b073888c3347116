"""`nics up`: runs the nodes of a launch file until Ctrl-C, without ROS 2's `launch`."""

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NoReturn

import typer
from typer import Argument, Option

from nics_drl_bridge import extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT
from nics_drl_bridge.nodes.processes import ChildProcess, make_command
from nics_drl_bridge.nodes.starting import LAUNCHES, Launch, NodeStart, complete

EXIT_NODE_ENDED = 1
POLL_S = 0.1
SIMULATORS = ("simulator_node", "mujoco_node", "dart_node")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


def up(
    what: Annotated[
        str,
        Argument(
            help=f"What to start: {', '.join(LAUNCHES)}.",
            autocompletion=lambda incomplete: [
                n for n in LAUNCHES if n.startswith(incomplete)
            ],
        ),
    ],
    arguments: Annotated[list[str] | None, Argument(metavar="NAME:=VALUE...")] = None,
    show_args: Annotated[bool, Option("--show-args")] = False,
) -> None:
    """Starts the nodes of a simulation, vehicle or fleet.

    Args:
        arguments: Arguments, the same as those of the launch files.
        show_args: List the arguments and their defaults; start nothing.

    Examples:
        nics up simulation world:=corridor
        nics up fleet robots:='[ant, bee]'
        nics up vehicle model:=my_car params_file:=car.yaml
    """
    if what not in LAUNCHES:
        raise ConfigError(f"nics up can't start {what!r}; {suggest(what, LAUNCHES)}")
    launch = LAUNCHES[what]
    if show_args:
        typer.echo(format_arguments(launch))
        return
    values = parse_values(arguments or ())
    complete(launch.arguments, values)
    extensions.require("nics up", "rclpy")
    nodes = launch.nodes(values)
    if not nodes:
        raise ConfigError(f"nics up {what}: there is nothing to start; add rviz:=true.")
    run(nodes)


def parse_values(words: Sequence[str]) -> dict[str, str]:
    """Parses arguments `name:=value`; returns name -> value. Raises ConfigError."""
    values: dict[str, str] = {}
    for word in words:
        name, sign, value = word.partition(":=")
        if not sign:
            raise ConfigError(
                f"argument {word!r}: write name:=value, as in world:=corridor."
            )
        if name in values:
            raise ConfigError(f"argument {name!r} is given twice; give it once.")
        values[name] = value
    return values


def format_arguments(launch: Launch) -> str:
    """Returns the arguments of a launch as a table."""
    rows = []
    for argument in launch.arguments:
        about = argument.about
        if argument.choices:
            about = f"{about} ({' or '.join(argument.choices)})"
        rows.append((f"{argument.name}:=", argument.default, about))
    return f"{launch.about}\n\n{console.format_table(('argument', 'default', 'meaning'), rows)}"


def run(nodes: Sequence[NodeStart]) -> None:
    """Runs nodes until a signal comes or one of this package's nodes ends; then ends them all."""
    processes: list[ChildProcess] = []
    with TemporaryDirectory(prefix="nics_up_") as folder, end_nodes_by_signals():
        commands = [make_command(node, Path(folder)) for node in nodes]
        typer.echo(f"starting {', '.join(map(name_of, nodes))}; Ctrl-C ends them all")
        next_step = describe_next_step(nodes)
        if next_step:
            typer.echo(next_step)
        try:
            for node, command in zip(nodes, commands, strict=True):
                processes.append(ChildProcess(name_of(node), command))
            name, code = wait_for_end(nodes, processes)
        finally:
            end_all(processes)
    typer.echo(
        f"nics: {name} ended with code {code}, so all nodes were ended.", err=True
    )
    raise typer.Exit(EXIT_BAD_INPUT if code == EXIT_BAD_INPUT else EXIT_NODE_ENDED)


def name_of(node: NodeStart) -> str:
    """Returns a node's name with its namespace, as shown in its log lines."""
    return f"{node.namespace}/{node.executable}".lstrip("/")


def describe_next_step(nodes: Sequence[NodeStart]) -> str:
    """Returns the user's next step, or "" if the nodes neither drive nor simulate a robot."""
    gates = [node for node in nodes if node.executable == "command_gate"]
    if not gates and not any(node.executable in SIMULATORS for node in nodes):
        return ""
    if not gates:
        return "next: send commands on cmd_vel, or watch it with `nics watch --ros`"
    space = f" --namespace {gates[0].namespace}" if gates[0].namespace else ""
    step = f"`nics arm{space}`, `nics goal{space} 1 0`, and to stop it `nics stop`"
    return f"next, in another terminal: {step}"


def wait_for_end(
    nodes: Sequence[NodeStart], processes: Sequence[ChildProcess]
) -> tuple[str, int]:
    """Waits until a node of this package, or every node, ends; returns its name and exit code.

    Other nodes, such as RViz, may end earlier.
    """
    while True:
        for node, process in zip(nodes, processes, strict=True):
            code = process.poll()
            if code is not None and node.own:
                return process.name, code
        if all(process.poll() is not None for process in processes):
            return processes[-1].name, processes[-1].close()
        time.sleep(POLL_S)


def end_all(processes: Sequence[ChildProcess]) -> None:
    """Ends all processes at once; ignores further signals meanwhile."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    for process in processes:
        process.interrupt()
    for process in processes:
        process.close()


@contextmanager
def end_nodes_by_signals() -> Iterator[None]:
    """Lets all `SIGNALS` end the nodes properly; restores the handlers afterwards."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number, handler in before.items():
        # Ignored signals stay ignored: SIGHUP under nohup.
        if handler is signal.SIG_DFL:
            signal.signal(number, _leave)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave(number: int, _: Any) -> NoReturn:
    raise SystemExit(128 + number)
