"""`nics record`, `inspect`, `import`, `generate` and `urdf`: from a robot to its model."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.commands.first_checks import check_drive, check_suffix
from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.exit_codes import EXIT_INTERRUPTED
from nics_drl_bridge.files import format_json
from nics_drl_bridge.nodes.parameters import STAMPED
from nics_drl_bridge.robot import DEFAULT_ROBOT

if TYPE_CHECKING:
    from nics_drl_bridge.recording.excite import DrivePlan


SourceArgument = Annotated[
    Path, Argument(help="A bag, a table, or a folder of tables.")
]


def record(
    out: Annotated[Path, Option()],
    robot: console.RobotOption = DEFAULT_ROBOT,
    bound: float = defaults.DRIVE_BOUND_M,
    duration: float = defaults.DRIVE_S,
    speed: float = 1.0,
    seed: int = 0,
    namespace: console.NamespaceOption = "",
    remap: list[str] | None = None,
    topics: Path | None = None,
    stamped: bool | None = None,
    imu: console.ImuOption = defaults.IMU_TOPIC,
    use_sim_time: console.SimTimeOption = False,
    preview: Annotated[bool, Option("--preview")] = False,
    yes: console.YesOption = False,
    as_json: console.JsonOption = False,
) -> None:
    """Drives a robot through its full range of motion and records it.

    Args:
        out: An .npz file, or the folder of a rosbag2, to write.
        robot: A shipped robot (see nics list robots) or a YAML file.
        bound: Radius around the start to keep within [m].
        duration: Duration of the drive [s].
        speed: Fraction of the maximum speeds to use.
        seed: Seed of the pattern.
        remap: Rename a topic, as in odom:=/wheels.
        topics: YAML file: joints of the state and of the wheels.
        stamped: Send cmd_vel as TwistStamped.
        preview: Only show the planned drive.
        yes: Do not ask before the robot moves.

    Examples:
        nics record --robot my_robot.yaml --out drive.npz --preview
        nics record --robot my_robot.yaml --out drive.npz --bound 2 --speed 0.3
    """
    arguments = make_node_arguments(namespace, remap or ())
    parameters = {
        "robot": robot,
        "out": str(out),
        "bound": bound,
        "duration": duration,
        "speed": speed,
        "seed": seed,
        "topics": str(topics or ""),
        "use_sim_time": use_sim_time,
        "imu": imu,
    } | ({} if stamped is None else {STAMPED: stamped})
    plan = check_drive(parameters)
    if not preview:
        # This comes first because ROS 2 from wheels restarts the Python process.
        with extensions.require_modules("nics record"):
            from nics_drl_bridge.nodes.own_process import forward_errors
            from nics_drl_bridge.nodes.record_node import record as drive
    lines = draw_preview(plan, out)
    facts: dict[str, Any] = {"out": str(out), "robot": robot}
    if preview:
        console.print_line(as_json, "\n".join(lines), **facts, told=lines)
        return
    typer.echo("\n".join(lines), err=as_json)
    if not yes and not typer.confirm("Drive the robot now?", err=as_json):
        console.print_line(
            as_json,
            "the robot was not driven, and nothing was recorded.",
            **facts,
            recorded=False,
        )
        return
    with forward_errors():
        driven = drive(parameters, arguments)
    if driven.failure is not None:
        raise BackendError(driven.line)
    recording = driven.recording
    lines = (driven.line,)
    if recording is not None:
        lines += drive_summary(recording, parameters)
    facts |= {"recorded": recording is not None, "complete": driven.complete}
    console.print_line(as_json, "\n".join(lines), **facts, told=lines)
    if not driven.complete:
        raise typer.Exit(EXIT_INTERRUPTED)


def make_node_arguments(namespace: str, remap: Sequence[str]) -> list[str]:
    """Returns `record_node`'s command line. Raises ConfigError for a malformed remapping rule."""
    space = parse_namespace(namespace)
    rules = ["-r", f"__ns:={space}"] if space else []
    for rule in remap:
        if not all(rule.partition(":=")):
            raise ConfigError(
                f"--remap {rule!r}: must be NAME:=OTHER, as in odom:=/wheel_odom."
            )
        rules += ["-r", rule]
    return ["nics", "--ros-args", *rules] if rules else ["nics"]


def draw_preview(plan: "DrivePlan", out: Path) -> tuple[str, ...]:
    """Draws the drive that `record_node` would make; returns text lines."""
    from nics_drl_bridge.files import write_bytes
    from nics_drl_bridge.report.pictures import drive_picture

    pattern = plan.preview()
    picture = out.with_name(f"{out.stem}_preview.png")
    write_bytes(picture, drive_picture(pattern, plan.robot))
    return (*pattern.describe(), f"its path is drawn in {picture}")


def drive_summary(recording: Any, parameters: dict[str, Any]) -> tuple[str, ...]:
    """Returns text lines on the robot's path, the coverage of each command, and the next step."""
    import numpy as np

    from nics_drl_bridge.identify.fit import measure_coverage
    from nics_drl_bridge.robot.spec import load_robot

    out = Path(parameters["out"])
    place = recording.pose.values[:, :2] - recording.pose.values[0, :2]
    path = np.hypot(*np.diff(place, axis=0).T).sum()
    reach = np.hypot(*place.T).max()
    return (
        f"measured: a path of {path:.1f} m, up to {reach:.2f} m from the start",
        *(
            span.line()
            for span in measure_coverage(recording, load_robot(parameters["robot"]))
        ),
        f"next: nics generate {out} --robot {parameters['robot']} --out {out.stem}_model",
    )


def inspect(
    source: SourceArgument,
    mapping: Annotated[Path | None, Option("--map")] = None,
    as_json: console.JsonOption = False,
) -> None:
    """Lists the contents of any recording and drafts its mapping.

    Args:
        mapping: YAML file to write: a draft mapping, with guesses.

    Examples:
        nics inspect drive.csv --map drive.yaml
    """
    from nics_drl_bridge.files import write_text
    from nics_drl_bridge.recording.mapping_draft import propose_mapping
    from nics_drl_bridge.recording.readers import explain_no_mapping, open_source
    from nics_drl_bridge.recording.recording import is_recording
    from nics_drl_bridge.recording.survey import inspect_tables

    if mapping is not None and mapping.exists():
        raise ConfigError(f"--map {mapping}: already exists; give another name.")
    with open_source(source) as opened, console.show_progress(f"reading {source}"):
        tables = inspect_tables(opened)
    why = explain_no_mapping(source)
    is_own = is_recording(source)  # mappings don't apply to its arrays
    draft = None if is_own else propose_mapping(tables)
    doubts = () if draft is None else draft.doubts
    written = None
    if draft is not None and mapping is not None:
        write_text(mapping, draft.text)
        written = str(mapping)
    needless = ""
    if why:
        needless = (
            f"{source}: {why}, and needs no mapping: nics generate {source} --out MODEL"
        )
    if as_json:
        facts = {
            "tables": [table.facts for table in tables],
            "doubts": doubts,
            "mapping": written,
            "needs_mapping": not why,
        }
        typer.echo(format_json(facts))
        return
    for line in (*([needless] if needless else ()), *doubts):
        typer.echo(line)
    for table in tables:
        findings = (f"\n  {line}" for line in table.regularity + table.findings)
        typer.echo(f"{table.name}: {table.rows} rows{''.join(findings)}")
        rows = [(c.name, f"{c.low:.6g}", f"{c.high:.6g}") for c in table.columns]
        if rows:
            typer.echo(console.format_table(("column", "minimum", "maximum"), rows))
    if draft is None:
        typer.echo(
            f"no mapping was written: {needless}" if mapping is not None else needless
        )
        return
    if mapping is None:
        typer.echo(
            f"A draft mapping to edit; --map FILE writes it to a file:\n\n{draft.text}"
        )
        return
    for line in draft.unused:
        typer.echo(line)
    typer.echo(
        f"a draft mapping is in {mapping}: edit it, then run nics import or nics generate"
    )


def import_(
    source: SourceArgument,
    mapping: Annotated[Path, Option("--map")],
    out: Annotated[Path, Option()],
    as_json: console.JsonOption = False,
) -> None:
    """Converts a recording of any format to .npz, using its mapping.

    Args:
        mapping: YAML mapping of the recording, see docs/recordings.md.
        out: The .npz file to write.

    Examples:
        nics import drive.csv --map drive.yaml --out drive.npz
    """
    from nics_drl_bridge.recording.readers import read_recording
    from nics_drl_bridge.recording.recording import save_recording
    from nics_drl_bridge.recording.write import check_out

    check_suffix("--out", out, ".npz")
    check_out(out)
    with console.show_progress(f"reading {source}"):
        drive = read_recording(source, mapping=mapping)
        save_recording(drive, out)
    streams: list[dict[str, Any]] = [
        {
            "stream": name,
            "rows": len(s.t),
            "rate_hz": (len(s.t) - 1) / max(float(s.t[-1] - s.t[0]), 1e-9),
            "from_s": float(s.t[0]),
            "to_s": float(s.t[-1]),
            "clock": s.clock,
        }
        for name, s in drive.streams.items()
    ]
    rows = [
        (
            s["stream"],
            f"{s['rows']}",
            f"{s['rate_hz']:.1f} Hz",
            f"{s['from_s']:.2f} to {s['to_s']:.2f} s",
            s["clock"],
        )
        for s in streams
    ]
    table = console.format_table(("stream", "rows", "rate", "time", "clock"), rows)
    text = "\n".join((table, *drive.repairs, f"recording written to {out}"))
    facts = {"streams": streams, "repairs": drive.repairs, "robot": drive.robot}
    console.print_line(as_json, text, recording=str(out), **facts)


def generate(
    recording: list[Path],
    out: Annotated[Path, Option()],
    robot: console.OptionalRobotOption = None,
    mapping: Annotated[Path | None, Option("--map")] = None,
    topics: Path | None = None,
    topic: console.TopicOption = None,
    world: Annotated[str, console.WORLD] = defaults.WORLD,
    lidar: console.LidarOption = None,
    sensor: list[Path] | None = None,
    order: str = defaults.TAYLOR_ORDER,
    alpha: str = defaults.PRUNING,
    assume_textbook: bool = False,
    strict: bool = False,
    anyway: Annotated[bool, Option("--anyway")] = False,
    pictures: bool = False,
    as_json: console.JsonOption = False,
) -> None:
    """Generates a simulator from recordings and writes its folder.

    Args:
        recording: One or more recordings of a robot: bags, .npz files, or tables with a --map.
        out: Folder of the model to write.
        robot: A shipped robot or a YAML file. Default: the recording's, else differential.
        mapping: YAML mapping of the recording, see docs/recordings.md.
        topics: YAML file: a bag's topic for each role.
        world: A shipped world or a YAML file.
        lidar: A shipped lidar or a YAML file. Default: the robot's, else paper.
        sensor: YAML file of an additional sensor, see docs/sensors.md; repeatable.
        order: Order of the Taylor model, 1 to 4, or auto.
        alpha: Pruning threshold of Eq. 2, 0 to 1, or auto for the knee; no effect where the motion
            is the state.
        assume_textbook: Complete the model from the textbook where the drive shows nothing.
        strict: Fail if an input was not varied independently.
        anyway: Write the model even if it predicts unseen data badly.
        pictures: Draw the fit into the model's pictures/.

    Examples:
        nics generate drive.npz --robot ackermann --out my_robot
        nics generate drive.csv --map drive.yaml --out my_robot
    """
    from nics_drl_bridge.generator import check_place, mount_lidar, save_model
    from nics_drl_bridge.generator import generate as generate_model
    from nics_drl_bridge.identify.calibration import parse_alpha, parse_order
    from nics_drl_bridge.lidar.sensor import load_sensor
    from nics_drl_bridge.lidar.spec import load_lidar
    from nics_drl_bridge.recording.readers import choose_mapping, open_drives
    from nics_drl_bridge.recording.topic_roles import load_topic_roles
    from nics_drl_bridge.sim.world import load_world

    check_place(out)
    threshold = parse_alpha(alpha)
    terms = parse_order(order)
    if lidar is not None:  # fail on a wrong name before reading the drive
        load_lidar(lidar)
    sensors = tuple(load_sensor(file) for file in sensor or ())
    shapes = load_world(world).shapes
    named = ", ".join(map(str, recording))
    chosen = choose_mapping(load_topic_roles(topics, topic or ()), mapping)
    with console.show_progress(f"reading {named}"):
        spec, drives = open_drives(recording, robot, chosen)
    drives = [
        replace(drive, source=name)
        for drive, name in zip(drives, names_of_sources(recording), strict=True)
    ]
    with console.show_progress("generating"):
        model, identified = generate_model(
            drives if len(drives) > 1 else drives[0],
            spec,
            mount_lidar(spec, lidar),
            shapes,
            terms,
            threshold,
            assume_textbook,
            strict,
            anyway,
            sensors,
        )
        save_model(model, out)
    from nics_drl_bridge.identify.report import (
        conclude,
        format_equations,
        format_opening,
    )
    from nics_drl_bridge.report.fit_page import write_fit_page
    from nics_drl_bridge.report.fit_pictures import write_pictures

    with console.show_progress("drawing the report"):
        write_fit_page(out / "report.html", named, spec, identified, model.report)
        if pictures:
            write_pictures(spec, identified, out / "pictures")
    why = ", the default; choose another with --lidar"
    lines = (
        f"{format_opening(identified.recording.source, identified)}\n",
        f"its lidar is {model.lidar.name!r}{'' if lidar or spec.lidar else why}",
        f"all figures: {out / 'report.txt'}, with pictures: {out / 'report.html'}",
        f"model written to {out}",
    )
    facts = {
        "model": str(out),
        "robot": spec.name,
        **conclude(identified)._asdict(),
        "equations": format_equations(identified.model),
        "errors": [asdict(error) for error in identified.judgement],
        "report": str(out / "report.txt"),
        "page": str(out / "report.html"),
    }
    console.print_line(as_json, "\n".join(lines), **facts)


def names_of_sources(recordings: Sequence[Path]) -> list[str]:
    """Returns the names of recordings for a report: the path of one, or short names of several."""
    names = [path.name for path in recordings]
    if len(names) > 1 and len(set(names)) == len(names):
        return names
    return list(map(str, recordings))


def drive(
    out: Path | None = None,
    robot: console.RobotOption = DEFAULT_ROBOT,
    recording: Path | None = None,
    lidar: console.LidarOption = None,
    duration: Annotated[float, Option(min=5.0, max=3600.0)] = defaults.DRIVE_S,
    seed: console.SeedOption = 0,
    as_json: console.JsonOption = False,
) -> None:
    """Generates a simulator from a drive of a robot's textbook model.

    For training without a recording; `nics generate` makes a more accurate simulator from one.

    Args:
        out: Folder to write. Default: <robot>_model.
        robot: A shipped robot (see nics list robots) or a YAML file.
        recording: Save the drive in this .npz file, like a drive of a real robot.
        lidar: A shipped lidar or a YAML file. Default: the robot's, else paper.
        duration: Duration of the drive [s].
        seed: Seed of the random commands.

    Examples:
        nics drive --robot my_robot.yaml --out my_robot
    """
    import numpy as np

    from nics_drl_bridge.generator import check_place, generate, mount_lidar, save_model
    from nics_drl_bridge.recording.textbook import record as record_textbook
    from nics_drl_bridge.recording.write import check_out, write_drive
    from nics_drl_bridge.robot.spec import load_robot

    spec = load_robot(robot)
    out = out or Path(f"{Path(robot).stem}_model")
    check_place(out)
    lidar_spec = mount_lidar(spec, lidar)
    if recording is not None:
        check_suffix("--recording", recording, ".npz")
    with console.show_progress(f"driving and generating {spec.name!r}"):
        driven = record_textbook(spec, np.random.default_rng(seed), duration)
        if recording is not None:
            write_drive(driven, check_out(recording), spec)
        model, _ = generate(driven, spec, lidar_spec, ())
    save_model(model, out)
    kept = () if recording is None else (f"recording written to {recording}",)
    made = (
        f"model of the textbook {spec.name!r} with the lidar {lidar_spec.name!r}: {out}"
    )
    lines = model.report.rstrip(), *kept, made, f"next: nics train --robot {out}"
    facts = {"model": str(out), "robot": spec.name, "lidar": lidar_spec.name}
    console.print_line(
        as_json, "\n".join(lines), **facts, recording=recording and str(recording)
    )


def urdf(
    model: Annotated[str, Argument(autocompletion=console.ROBOTS)],
    out: Path | None = None,
    as_json: console.JsonOption = False,
) -> None:
    """Writes a robot's URDF, for RViz and robot_state_publisher.

    Args:
        model: A shipped robot, or the folder of a model.
        out: File to write. Default: <robot>.urdf.

    Examples:
        nics urdf my_robot --out my_robot.urdf
    """
    from nics_drl_bridge.files import write_text
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.robot.urdf import make_urdf

    opened = open_model(model)
    file = out or Path(f"{opened.robot.name}.urdf")
    lidar = opened.lidar
    further = {sensor.frame: sensor.mount for sensor in opened.sensors}
    write_text(file, make_urdf(opened.robot, lidar.mount, lidar.frame, further=further))
    name = opened.robot.name
    console.print_line(
        as_json, f"{file}: the URDF of {name}", file=str(file), robot=name
    )
