"""`nics evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nics_drl_bridge.commands.console import one_sentence, progress_bar, table

EXIT_FINDINGS = 1


def evaluate(
    policies: Annotated[
        list[str],
        typer.Argument(
            metavar="POLICY...",
            help="Policy files, shipped policies (differential), or baselines (dynamic_window, "
            "straight, random).",
        ),
    ],
    model: Annotated[
        str | None,
        typer.Option(
            "--model", "--robot",
            help="Folder of a model, or a shipped robot; the policy's own by default.",
        ),
    ] = None,
    world: Annotated[
        str, typer.Option("--world", "--scene", help="A shipped world (circles) or a YAML file.")
    ] = "circles",
    places: Annotated[
        list[str] | None,
        typer.Option("--in", help="fast, dds or mujoco_dds; several times; all by default."),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many; 20, or 1 on a vehicle.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the first episode.")] = 1_000_000,
    out: Annotated[Path, typer.Option(help="Folder for everything that is written.")] = Path(
        "runs/evaluate"
    ),
    shadow: Annotated[
        Path | None, typer.Option(help="A bag: compare the policy with what was driven in it.")
    ] = None,
    topic: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE=TOPIC", help="For --shadow: as scan=/front/scan."),
    ] = None,
    ahead: Annotated[
        float,
        typer.Option(help="For --shadow without --goal: the goal is where it was so much later."),
    ] = 4.0,
    backend: Annotated[
        str | None, typer.Option(help="dds, with --hardware.", metavar="dds")
    ] = None,
    hardware: Annotated[
        bool, typer.Option("--hardware", help="Drive the vehicle, through command_gate.")
    ] = False,
    start: Annotated[
        str, typer.Option(help="For --hardware: wait until it stands there, or take the present.")
    ] = "wait",
    goal: Annotated[
        str | None, typer.Option(metavar="X,Y", help="In map [m]; else that of the world.")
    ] = None,
    namespace: Annotated[str, typer.Option(help="For --hardware: of the vehicle's topics.")] = "",
    pose_type: Annotated[
        str, typer.Option(help="For --hardware: type of `pose`, a pose sensor in map.")
    ] = "none",
    yes: Annotated[
        bool, typer.Option("--yes", help="For --hardware: ask nothing before an episode.")
    ] = False,
    arm: Annotated[
        bool, typer.Option("--arm", help="For --hardware: arm command_gate before an episode.")
    ] = False,
) -> None:  # fmt: skip
    """Drives policies through the same episodes in several worlds, and compares."""
    with one_sentence():
        place = _point(goal)
        _check(backend, hardware, shadow, places)
        if shadow is not None:
            _shadow(shadow, policies, model, topic or [], place, ahead, out)
        elif hardware:
            from nics_drl_bridge.commands.vehicle import VehicleOrder

            order = VehicleOrder(
                policies[0], out, model, world, episodes or 1, seed, start, place, namespace,
                pose_type, arm,
            )  # fmt: skip
            _hardware(order, policies, yes)
        else:
            from nics_drl_bridge.commands.episodes import EvaluationOrder

            chosen = {"places": tuple(dict.fromkeys(places))} if places else {}
            _evaluate(EvaluationOrder(policies, out, model, world, episodes or 20, seed, **chosen))


def _check(
    backend: str | None, hardware: bool, shadow: Path | None, places: list[str] | None
) -> None:
    from nics_drl_bridge.errors import ConfigError

    if backend not in (None, "dds"):
        raise ConfigError(f"--backend {backend!r}: must be dds; simulators are chosen by --in.")
    if hardware != (backend == "dds"):
        raise ConfigError(
            "--hardware and --backend dds belong together; the fast simulator over DDS is --in dds."
        )
    if hardware and (shadow is not None or places):
        raise ConfigError("--hardware drives a vehicle: leave out --in and --shadow.")


def _point(text: str | None) -> tuple[float, float] | None:
    from nics_drl_bridge.errors import ConfigError

    if text is None:
        return None
    try:
        x, y = (float(part) for part in text.split(","))
        if abs(x) + abs(y) < float("inf"):
            return x, y
    except ValueError:
        pass
    raise ConfigError(f"--goal {text!r}: must be X,Y in metres, as 2.5,-1.")


def _evaluate(order: Any) -> None:
    from nics_drl_bridge.commands.episodes import HEADS, evaluate, line_of, rows_of

    with progress_bar() as tell:
        evaluated = evaluate(order, lambda line: typer.echo(line, err=True), tell)
    typer.echo(table(HEADS, rows_of(evaluated)))
    for one in evaluated:
        typer.echo(line_of(one))
    typer.echo(f"pictures and evaluation.json: {order.out}")


def _shadow(
    bag: Path, policies: list[str], model: str | None, topics: list[str],
    goal: tuple[float, float] | None, ahead: float, out: Path,
) -> None:  # fmt: skip
    from nics_drl_bridge.commands.console import roles_of
    from nics_drl_bridge.commands.shadow import HEADS, evaluate_shadow, rows_of

    made = {
        policy: evaluate_shadow(bag, policy, model, roles_of(topics), goal, ahead, out)
        for policy in policies
    }
    typer.echo(table(HEADS, rows_of(made)))
    for policy, one in made.items():
        left_out = ", ".join(f"{count} {why}" for why, count in one.skipped.items() if count)
        typer.echo(f"{policy}: compared at {len(one.time)} times; left out: {left_out or 'none'}")
    typer.echo(f"pictures and shadow_*.json: {out}")


def _hardware(order: Any, policies: list[str], yes: bool) -> None:
    from nics_drl_bridge.commands.console import needs_ros
    from nics_drl_bridge.commands.episodes import HEADS, line_of, rows_of
    from nics_drl_bridge.commands.vehicle import drive_vehicle
    from nics_drl_bridge.errors import ConfigError

    if len(policies) > 1:
        raise ConfigError(f"--hardware drives one policy at a time, not {', '.join(policies)}.")

    def ask(question: str) -> None:
        typer.echo(question)
        if not yes:
            typer.prompt("Enter when ready", default="", show_default=False)

    with needs_ros("nics evaluate --hardware"):
        made = drive_vehicle(order, lambda line: typer.echo(line, err=True), ask)
    typer.echo(table(HEADS, rows_of([made])))
    typer.echo(line_of(made))
    typer.echo(f"pictures and evaluation.json: {order.out}")
