"""`nics assure`: safety evidence for a policy behind the gate, as a page and a JSON file."""

import json
import platform
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Option

from nics_drl_bridge import __version__, defaults, extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.files import check_above, format_json, write_bytes, write_text

if TYPE_CHECKING:
    from nics_drl_bridge.gate.assurance.protocol import Protocol, Trial
    from nics_drl_bridge.gate.assurance.run import Run
    from nics_drl_bridge.generator import SimulatorModel

PAGE = "assurance.html"
EXIT_FAILED = 1  # a claim failed, or a control without the gate did not
MIN_CONTROLS = 4  # fewer controls may all pass by chance
COMPUTED_WITH = ("numpy", "numba", "scipy", "onnxruntime")


def assure(
    policy: console.PolicyFileArgument,
    limits: Annotated[str, Option(autocompletion=console.complete_names("limits"))],
    model: console.OptionalRobotOption = None,
    world: console.WorldsOption = None,
    episodes: console.CountOption = defaults.ASSURANCE_EPISODES,
    seed: console.SeedOption = defaults.EVALUATION_SEED,
    randomisation: Annotated[
        str, Option(autocompletion=console.complete_names("randomisation"))
    ] = defaults.ASSURANCE_RANDOMISATION,
    faults: Annotated[int, Option(min=0)] = defaults.ASSURANCE_FAULTS,
    control: Literal["no_gate"] | None = None,
    replay: Annotated[int | None, Option(min=0, metavar="SEED")] = None,
    out: Path = Path("runs/assure"),
    as_json: console.JsonOption = False,
) -> None:
    """Tries to make a gated policy fail, and writes the evidence.

    Args:
        limits: Limits of the gate: shipped (differential) or a YAML file.
        model: A model's folder, or a shipped robot. Default: the policy's.
        world: A shipped world or a YAML file; repeatable. Default: arena, clutter and crowd.
        episodes: Number of episodes in process.
        seed: Seed of the first episode.
        randomisation: Randomisation of the policy's episodes: shipped or a YAML file.
        faults: Number of faults injected over DDS, in real time; needs ROS 2.
        control: Run everything without the gate, as a control that must find failures.
        replay: Repeat only the episode with this seed.
        out: Folder for all output; an existing run is continued.

    Examples:
        nics assure differential --limits differential --episodes 300
        nics assure my.onnx --limits my_limits.yaml --out runs/evidence
    """
    check_above(out / PAGE)
    with console.show_progress("opening robot and policy"):
        from nics_drl_bridge.commands.episodes import model_name, read_contracts
        from nics_drl_bridge.gate.assurance import protocol as protocols
        from nics_drl_bridge.gate.assurance.run import Run, begin
        from nics_drl_bridge.generator import open_model
        from nics_drl_bridge.policy.policies import is_policy_file

        if not is_policy_file(policy):
            raise ConfigError(
                f"{policy!r} is a baseline; give a policy file, or the name of a shipped one."
            )
        name = model_name(model, read_contracts([policy], model))
        opened = open_model(name)
        opened.robot.require_cmd_vel()
        order = protocols.Protocol(
            policy=policy,
            limits=limits,
            model=name,
            worlds=tuple(dict.fromkeys(world or defaults.ASSURANCE_WORLDS)),
            episodes=episodes,
            seed=seed,
            randomisation=randomisation,
            control=control or "",
            hashes={},
            claims=protocols.choose_claims(opened.robot),
            versions={
                "nics_drl_bridge": __version__,
                "python": platform.python_version(),
                **{module: version(module) for module in COMPUTED_WITH},
            },
            **_choose_faults(faults),
        )
        order = replace(order, hashes=_compute_hashes(order, opened))
        run = Run(order, opened)
    if replay is not None:
        _replay(run, replay, out, as_json)
        return
    begin(out, order)
    results = _drive(run, out)
    if as_json:
        typer.echo(format_json(results))
    else:
        _tell(order, results, out)
    if not _is_as_expected(order, results):
        raise typer.Exit(EXIT_FAILED)


def _choose_faults(count: int) -> dict[str, Any]:
    """Returns the fields of a protocol on faults: none without ROS 2."""
    if not count:
        return {"faults": 0}
    try:
        extensions.require("nics assure --faults", "rclpy")
    except ConfigError as error:
        typer.echo(f"no faults over DDS: {error}", err=True)
        return {"faults": 0}
    from nics_drl_bridge.nodes.gate_faults import CONTROLS, FAULTS

    kinds = tuple(FAULTS)
    return {"faults": count, "fault_kinds": kinds, "fault_controls": CONTROLS}


def _compute_hashes(order: "Protocol", model: "SimulatorModel") -> dict[str, str]:
    from nics_drl_bridge.config import find_config
    from nics_drl_bridge.files import hash_bytes
    from nics_drl_bridge.policy.file.policy_file import load_policy
    from nics_drl_bridge.seeds import check_seeds
    from nics_drl_bridge.sim.randomisation import load_randomisation
    from nics_drl_bridge.sim.world import load_world

    last_fault = order.list_faults()[-1:]
    check_seeds([order.seed + order.episodes, *(trial.seed for trial in last_fault)])
    policy = load_policy(order.policy, model)
    package = Path(__file__).parents[1]
    sources = [path.read_bytes() for path in sorted(package.rglob("*.py"))]
    hashes = {
        "package source, SHA-256": hash_bytes(b"".join(sources)),
        "policy file, SHA-256": hash_bytes(policy.path.read_bytes()),
        "policy graph, SHA-256": policy.contract.graph_sha256,
        "limits file, SHA-256": hash_bytes(
            find_config(order.limits, "limits").read_bytes()
        ),
        "model, fingerprint": model.fingerprint,
        "randomisation, fingerprint": load_randomisation(
            order.randomisation
        ).fingerprint,
    }
    for world in order.worlds:
        hashes[f"world {world}, fingerprint"] = load_world(world).fingerprint
    return hashes


def _drive(run: "Run", out: Path) -> dict[str, Any]:
    from nics_drl_bridge.gate.assurance import run as runs
    from nics_drl_bridge.gate.assurance.results import summarise
    from nics_drl_bridge.report.assurance_page import make_assurance_page

    order = run.protocol
    say = partial(typer.echo, err=True)
    with console.show_progress("first episode") as advance:
        rows = runs.drive_all(
            out / runs.LOG,
            list(order.list_trials()),
            partial(map, run.drive),
            partial(advance, "episodes"),
        )
        faults = order.list_faults()
        if faults:
            from nics_drl_bridge.nodes.gate_faults import inject_trials

            rows += runs.drive_all(
                out / runs.FAULT_LOG,
                faults,
                partial(inject_trials, order, out / "logs", say),
                partial(advance, "faults"),
            )
    results = summarise(rows, len(faults))
    runs.write_result(out, order, complete=True, **results)
    write_text(out / PAGE, make_assurance_page(order, results, str(out)))
    return results


def _replay(run: "Run", seed: int, out: Path, as_json: bool) -> None:
    """Drives one episode again, compares it with the run's, and draws it."""
    from nics_drl_bridge.gate.assurance import run as runs

    order = run.protocol
    order.check_same(runs.read_result(out)["protocol"], str(out))
    trial = order.find_trial(seed)
    if trial in order.list_faults():
        from nics_drl_bridge.nodes.gate_faults import inject_trials

        logs = out / "logs" / f"replay_{seed}"
        say = partial(typer.echo, err=True)
        for row in inject_trials(order, logs, say, [trial]):
            console.print_line(as_json, _list_values(row), **row)
            return
        raise BackendError(
            f"--replay {seed}: {trial.kind} could not be injected, because the robot did not "
            "move; try again, or read the logs."
        )
    rows, _ = runs.read_rows(out / runs.LOG, list(order.list_trials()))
    row = json.loads(format_json(run.drive(trial)))
    picture = out / f"replay_{seed}.png"
    _draw_episode(run, trial, "contact" if row["contact"] else "no contact", picture)
    in_run = [r for r in rows if r["seed"] == seed and r["gated"] == trial.gated]
    same = in_run == [row]
    comparison = "as in the run" if same else "not in the run, or different there"
    text = f"{_list_values(row)}\nthis episode is {comparison}; its picture: {picture}"
    console.print_line(as_json, text, **row, same=same, picture=str(picture))


def _list_values(row: Mapping[str, Any]) -> str:
    return "\n".join(f"{name:<12} {value}" for name, value in row.items())


def _draw_episode(run: "Run", trial: "Trial", result: str, file: Path) -> None:
    """Draws the episode that was driven last."""
    import numpy as np

    from nics_drl_bridge.policy.evaluation import Episode
    from nics_drl_bridge.report.pictures import draw_trajectories
    from nics_drl_bridge.sim.world import load_world

    place = run.open_place(trial.world, trial.kind)
    path = np.array(place.track)
    scene = place.scenes[0]
    episode = Episode(trial.seed, result, path, path, scene.goals[0], scene.bodies, 0.0)
    radius = place.model.robot.footprint_radius
    drawn = draw_trajectories({trial.kind: [episode]}, load_world(trial.world), radius)
    write_bytes(file, drawn)


def _tell(order: "Protocol", results: dict[str, Any], out: Path) -> None:
    from nics_drl_bridge.report.assurance_page import HEADS, tabulate

    typer.echo(console.format_table(HEADS, tabulate(order, results)))
    if results["not_injected"]:
        again = "the same command tries them again"
        typer.echo(
            f"faults not injected: {results['not_injected']:,}; {again}", err=True
        )
    typer.echo(f"{PAGE} and assurance.json: {out}")


def _is_as_expected(order: "Protocol", results: dict[str, Any]) -> bool:
    """True if all faults were injected, no claim failed, and each control failed."""
    from nics_drl_bridge.gate.assurance.protocol import CLAIMS, LIMITS

    if results["not_injected"]:
        return False
    if any(figures["failures"] for figures in results["claims"].values()):
        return False
    enough = 1 if order.control else MIN_CONTROLS
    for claim, figures in results["control"].items():
        # Without the gate, commands may still keep limits as wide as the robot's range.
        must_fail = claim != LIMITS or order.claims == CLAIMS
        if must_fail and figures["trials"] >= enough and not figures["failures"]:
            return False
    return True
