"""The command line: `nics ...`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from nics_drl_bridge import __version__
from nics_drl_bridge.errors import BridgeError

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130

app = typer.Typer(
    help="From a recording of a robot to a fast simulator, and back to the robot over ROS 2.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

RobotOption = Annotated[str, typer.Option(help="A shipped robot (ackermann) or a YAML file.")]
WorldOption = Annotated[
    str, typer.Option("--world", "--scene", help="A shipped world (arena) or a YAML file.")
]
TopicsOption = Annotated[
    Path | None, typer.Option(help="YAML file that says which topic of a bag plays which role.")
]
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ROLE=TOPIC",
        help="The same for one role, as cmd_vel=/car/drive; may be given several times. Roles: "
        "cmd_vel, pose, odom, joint_states, imu; none as a topic leaves a role out.",
    ),
]


@contextmanager
def _one_sentence() -> Iterator[None]:
    """What the user got wrong becomes one sentence and exit code 2, never a traceback."""
    try:
        yield
    except BridgeError as error:
        typer.echo(f"nics: {error}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None
    except BrokenPipeError:
        raise
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        typer.echo(f"nics: {place}{error.strerror or error}; choose another place.", err=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None
    except (KeyboardInterrupt, SystemError) as error:
        # Ctrl-C in a compiled function comes out of it as a SystemError.
        if not isinstance(error.__cause__ or error, KeyboardInterrupt):
            raise
        typer.echo("nics: interrupted; everything that was started has ended.", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """Gives a function that moves a bar on a terminal: what is done, how much, of how much.

    Where standard error is no terminal it shows nothing; a total of 0 is not known yet.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        task = progress.add_task("", total=None)
        yield lambda what, done, total: progress.update(
            task, description=what, completed=done, total=total or None
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


@app.command()
def generate(
    recording: Annotated[
        Path, typer.Argument(help="A rosbag2, an .npz recording, or a folder of CSV files.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the model to write.")],
    robot: RobotOption = "ackermann",
    topics: TopicsOption = None,
    topic: TopicOption = None,
    world: WorldOption = "arena",
    lidar: Annotated[str, typer.Option(help="A shipped lidar (paper) or a YAML file.")] = "paper",
    order: Annotated[int, typer.Option(min=1, max=4, help="Order of the Taylor model.")] = 2,
    alpha: Annotated[
        str, typer.Option(help="Pruning threshold of Eq. 2, 0 to 1, or auto for the knee.")
    ] = "auto",
    assume_textbook: Annotated[
        bool, typer.Option(help="Fill in from the textbook what the drive did not show.")
    ] = False,
    strict: Annotated[
        bool, typer.Option(help="Refuse a drive that did not move every input on its own.")
    ] = False,
    budget: Annotated[
        str | None, typer.Option(help="Greatest size of the lidar table, as 8MB; see nics bake.")
    ] = None,
    pictures: Annotated[
        bool, typer.Option(help="Draw the fit into the folder pictures of the model.")
    ] = False,
) -> None:
    """Generates a simulator from a recording and writes it as a folder."""
    with _one_sentence():
        from nics_drl_bridge.generator import check_place, save_model
        from nics_drl_bridge.generator import generate as generate_model
        from nics_drl_bridge.kinematics.dof import parse_alpha
        from nics_drl_bridge.kinematics.readers import read_recording
        from nics_drl_bridge.kinematics.spec import load_robot
        from nics_drl_bridge.kinematics.topic_roles import topic_roles
        from nics_drl_bridge.lidar.budget import parse_size
        from nics_drl_bridge.lidar.spec import load_lidar
        from nics_drl_bridge.sim.world import load_world

        check_place(out)
        spec, sensor, threshold = load_robot(robot), load_lidar(lidar), parse_alpha(alpha)
        shapes = load_world(world).shapes
        size = None if budget is None else parse_size(budget)
        drive = read_recording(recording, spec, topic_roles(topics, topic or ()))
        model, identified = generate_model(
            drive, spec, sensor, shapes, order, threshold, assume_textbook, strict, size
        )
        save_model(model, out)
        if pictures:
            from nics_drl_bridge.report.fit_pictures import write_pictures

            write_pictures(spec, identified, out / "pictures")
        typer.echo(model.report.rstrip())
        typer.echo(f"model written to {out}")


@app.command()
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
    with _one_sentence():
        from nics_drl_bridge.bake_order import BakeOrder, run

        given = {"distances": distances, "rotations": rotations, "phases": phases}
        density = {name: value for name, value in given.items() if value is not None}
        order = BakeOrder(lidar, world, shapes, robot, budget, density, out, sensor_model)
        with _progress() as told:
            lines = run(order, told)
        for line in lines:
            typer.echo(line)


@app.command()
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
    with _one_sentence():
        from nics_drl_bridge.nodes import recorder

        order = recorder.Order(
            robot, out, bound, duration, speed, seed, namespace, tuple(remap or ()), topics,
            stamped, use_sim_time,
        )  # fmt: skip
        if not preview:
            recorder.require_ros()  # first: where ROS 2 comes from wheels it begins Python anew
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


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(help="What command_gate wrote at a stop, *.jsonl.")],
) -> None:
    """Decides anew on what led to a stop of the gate, and tells the stops in it."""
    with _one_sentence():
        from nics_drl_bridge.safety import black_box

        again = black_box.replay(file)
        for line in again.story:
            typer.echo(line)
        if again.differing:
            raise typer.Exit(1)


@app.command()
def demo(
    recording: Annotated[
        Path | None, typer.Option(help="A drive; by default one of the textbook robot.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for everything the demo writes.")] = Path(
        "runs/demo"
    ),
    robot: RobotOption = "ackermann",
    world: WorldOption = "arena",
    episodes: Annotated[int, typer.Option(min=1, help="How many episodes.")] = 5,
) -> None:
    """Goes the whole road once: generate, drive in process, drive over DDS, report."""
    with _one_sentence():
        from nics_drl_bridge.demo import Plan, run

        plan = Plan(out, robot, world, recording, episodes)
        outcome = run(plan, lambda line: typer.echo(line))
        typer.echo(outcome.line())


def main() -> None:
    """Entry point of the executable."""
    app(prog_name="nics")


if __name__ == "__main__":
    main()
