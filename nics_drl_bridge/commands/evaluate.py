"""`nics evaluate`: in simulators, on a vehicle, or against the commands in a bag."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import check_above, format_json, write_bytes, write_text


def evaluate(
    policies: Annotated[
        list[str], Argument(metavar="POLICY...", autocompletion=console.POLICIES)
    ],
    model: console.OptionalRobotOption = None,
    task: console.TaskOption = None,
    world: Annotated[str, console.WORLD] = defaults.EVALUATION_WORLD,
    places: Annotated[list[str] | None, Option("--in")] = None,
    episodes: Annotated[
        int | None,
        Option(
            min=1,
            help=f"Number of episodes. Default: {defaults.EVALUATION_EPISODES}, or 1 on a vehicle.",
        ),
    ] = None,
    seed: console.SeedOption = defaults.EVALUATION_SEED,
    lidar: console.LidarOption = None,
    randomisation: console.RandomisationOption = None,
    gate: console.GateOption = None,
    out: Path = Path("runs/evaluate"),
    shadow: Path | None = None,
    topic: console.RolesOption = None,
    ahead: float = defaults.SHADOW_AHEAD_S,
    backend: Annotated[str | None, Option(metavar="dds")] = None,
    hardware: Annotated[bool, Option("--hardware")] = False,
    start: Literal["wait", "present"] = defaults.VEHICLE_START,
    goal: Annotated[str | None, Option(metavar="X,Y")] = None,
    goal_frame: Annotated[
        Literal["robot", "map"] | None, Option(metavar="robot|map")
    ] = None,
    confirm_beyond: Annotated[
        float, Option(min=0.0, metavar="METRES")
    ] = defaults.CONFIRMED_BEYOND_M,
    namespace: console.NamespaceOption = "",
    pose_type: str = defaults.POSE_TYPE,
    imu: console.ImuOption = defaults.IMU_TOPIC,
    yes: console.YesOption = False,
    arm: Annotated[bool, Option("--arm")] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Drives policies through the same episodes, and compares them.

    Args:
        policies: Policy files, shipped policies (differential), or baselines (dynamic_window, mppi,
            straight, random).
        model: A model's folder, or a shipped robot. Default: the policy's.
        world: A shipped world or a YAML file.
        places: fast, dds, mujoco_dds or dart_dds; repeatable. Default: those of the first three
            that work here.
        seed: Seed of the first episode.
        lidar: A shipped lidar (rplidar_a2) or a YAML file, instead of the model's.
        out: Folder for all output.
        shadow: Compare policies with the drive in a bag.
        ahead: For --shadow without --goal: use the robot's position this much later [s].
        backend: dds, which --hardware implies.
        hardware: Drive the vehicle, through command_gate.
        start: For --hardware: wait until the vehicle is at the start, or start where it is.
        goal: Goal [m], see --goal-frame; for --shadow in map. Default: the world's.
        goal_frame: For --hardware: the goal is relative to the robot's start (ahead, left), or in
            map. Default: robot with --start present, else map.
        confirm_beyond: For --hardware: ask for confirmation of goals farther away [m].
        pose_type: For --hardware: message type of the topic `pose`, in map.
        yes: For --hardware: do not ask before the vehicle moves.
        arm: For --hardware: arm command_gate.

    Examples:
        nics evaluate differential dynamic_window --world circles --in fast
        nics evaluate runs/mine/seed_0/policy.onnx --world doorway --episodes 100
    """
    place = _parse_point(goal)
    if backend not in (None, "dds"):
        raise ConfigError(
            f"--backend {backend!r}: must be dds; simulators are chosen by --in."
        )
    if backend == "dds" and not hardware:
        reason = "drives the vehicle: add --hardware; the fast simulator over DDS is --in dds."
        raise ConfigError(f"--backend dds {reason}")
    check_above(out / "evaluation.json")
    if hardware and len(policies) > 1:
        raise ConfigError(
            f"--hardware drives one policy at a time, not {', '.join(policies)}."
        )
    if shadow is not None:
        _replay_shadow(shadow, policies, model, topic or [], place, ahead, out, as_json)
        return
    with console.show_progress():
        from nics_drl_bridge.commands import episodes as driving

    count = episodes or (1 if hardware else defaults.EVALUATION_EPISODES)
    tell = partial(typer.echo, err=True)
    conditions = driving.Conditions(lidar, randomisation, gate, kind=task)
    order = driving.EvaluationOrder(
        policies,
        out,
        model,
        world,
        count,
        seed,
        tuple(dict.fromkeys(places or ())),
        conditions,
    )
    console.tell_replaced(out / driving.EVALUATION)
    if hardware:
        from nics_drl_bridge.commands.vehicle_goals import GoalOrder

        goals = GoalOrder(
            place, goal_frame, start, pose_type != defaults.POSE_TYPE, confirm_beyond
        )
        with extensions.require_modules("nics evaluate --hardware"):
            ask = partial(_ask, yes)
            confirm = partial(_confirm, yes)
            drive = driving.VehicleDrive(order, goals, tell, ask, confirm, arm)
            options = {"namespace": namespace, "pose_type": pose_type, "imu": imu}
            evaluated = [drive.run(**options)]
    else:
        with console.show_progress("opening robot and policies") as advance:
            evaluated = driving.evaluate(order, tell, advance)
    if as_json:
        typer.echo((out / driving.EVALUATION).read_text().rstrip())
        return
    typer.echo(console.format_table(driving.HEADS, driving.format_rows(evaluated)))
    for result in evaluated:
        typer.echo(driving.summarize(result))
    typer.echo(f"pictures and evaluation.json: {out}")


def _ask(yes: bool, question: str) -> None:
    typer.echo(question, err=True)
    if not yes:
        typer.prompt("Enter when ready", default="", show_default=False, err=True)


def _confirm(yes: bool, question: str) -> None:
    from nics_drl_bridge.commands.vehicle_goals import confirm_at_terminal

    if yes:
        typer.echo(question, err=True)
    else:
        confirm_at_terminal(question)


def _parse_point(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        x, y = (float(part) for part in text.split(","))
        if abs(x) + abs(y) < float("inf"):
            return x, y
    except ValueError:
        pass
    raise ConfigError(f"--goal {text!r}: must be X,Y in metres, such as 2.5,-1.")


def _list_differences(policy: str, comparison: Any) -> list[tuple[str, ...]]:
    """Returns a row for each command: its differences, and how often its sign is opposite."""
    rows = []
    commands = comparison.differences().items()
    for (command, figures), unit in zip(commands, comparison.units, strict=True):
        *amounts, opposite = figures.values()
        cells = (f"{value:.3g}" for value in amounts)
        rows.append((policy, command, unit, *cells, f"{100 * opposite:.1f} %"))
    return rows


def _replay_shadow(
    bag: Path,
    policies: list[str],
    model: str | None,
    topics: list[str],
    goal: tuple[float, float] | None,
    ahead: float,
    out: Path,
    as_json: bool,
) -> None:
    from nics_drl_bridge.commands.episodes import (
        model_name,
        read_contracts,
        shorten_name,
    )
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.policy.shadow import PERCENTILES, shadow
    from nics_drl_bridge.report.pictures import draw_shadow

    rows = list[tuple[str, ...]]()
    lines = list[str]()
    facts = list[dict[str, Any]]()
    for policy in policies:
        name = model_name(model, read_contracts([policy], model))
        comparison = shadow(
            bag, open_model(name), policy, console.parse_roles(topics), goal, ahead
        )
        place = out / f"shadow_{shorten_name(policy, policies)}"
        write_bytes(place.with_suffix(".png"), draw_shadow(comparison))
        data = {
            "bag": str(bag),
            "policy": policy,
            "model": name,
            "goal": goal,
            "ahead_s": None if goal else ahead,
            "compared": len(comparison.time),
            "skipped": dict(comparison.skipped),
            "resets": comparison.resets,
            "commands": comparison.differences(),
        }
        write_text(place.with_suffix(".json"), format_json(data) + "\n")
        facts.append(data)
        rows += _list_differences(policy, comparison)
        left_out = ", ".join(
            f"{count} {why}" for why, count in comparison.skipped.items() if count
        )
        line = f"{policy}: compared at {len(comparison.time)} times"
        line += f"; left out: {left_out or 'none'}"
        if comparison.resets:
            line += f"; its state was reset after {comparison.resets} gaps"
        lines.append(line)
    heads = (
        "policy",
        "command",
        "unit",
        "mean",
        "mean size",
        *(f"{q} %" for q in PERCENTILES),
        "greatest",
        "opposite sign",
    )
    lines = [
        console.format_table(heads, rows),
        *lines,
        f"pictures and shadow_*.json: {out}",
    ]
    console.print_line(as_json, "\n".join(lines), policies=facts)
