"""`nics policy`."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from nics_drl_bridge.commands.console import (
    POLICIES,
    JsonOption,
    OptionalRobotOption,
    PolicyFileArgument,
    print_line,
)
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import write_bytes

policy = typer.Typer(
    help="Checks, exports and imports policy files.", no_args_is_help=True
)


@policy.command()
def info(
    file: Annotated[str, Argument(autocompletion=POLICIES)],
    as_json: JsonOption = False,
) -> None:
    """Checks a policy file and shows its training and requirements.

    Args:
        file: A policy file, the name of a shipped one, or the mapping of a foreign policy.

    Examples:
        nics policy info differential --json
    """
    from nics_drl_bridge.policy.file.policy_file import load_policy, summary

    facts = summary(load_policy(file))
    print_line(
        as_json,
        "\n".join(f"{name:<18} {value}" for name, value in _format_lines(facts)),
        **facts,
    )


@policy.command()
def export(
    file: PolicyFileArgument,
    leapp: Annotated[Path, Option()],
    as_json: JsonOption = False,
) -> None:
    """Converts a policy file to another format: Isaac's LEAPP.

    Args:
        leapp: Folder of the bundle: network, YAML file, start values.

    Examples:
        nics policy export policy.onnx --leapp bundle
    """
    from nics_drl_bridge.policy.file.policy_file import foreign_policies, load_policy

    written = str(foreign_policies().export_bundle(load_policy(file), leapp))
    print_line(as_json, f"wrote {written}", file=written)


@policy.command(name="import")
def import_(
    source: Path,
    out: Annotated[Path, Option("--out", "-o")],
    robot: OptionalRobotOption = None,
    as_json: JsonOption = False,
) -> None:
    """Makes a policy file from a policy trained elsewhere.

    Args:
        source: A LEAPP bundle, or the mapping (YAML) of a foreign policy.
        out: The policy file to write (*.onnx).
        robot: A shipped robot, or the folder of a model.

    Examples:
        nics policy import bundle --robot my_robot --out policy.onnx
    """
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.policy.file.contract import SUFFIX
    from nics_drl_bridge.policy.file.policy_file import foreign_policies, policy_of

    if out.suffix != SUFFIX:
        raise ConfigError(
            f"--out {out}: a policy file ends with {SUFFIX!r}; change the name."
        )
    model = None if robot is None else open_model(robot)
    data = foreign_policies().import_policy(source, model)
    # Raises before an unusable file is written.
    contract = policy_of(data, out).contract
    write_bytes(out, data)
    name = contract.robot.name
    line = f"wrote {out}, a policy of {name!r}; see nics policy info {out}"
    print_line(as_json, line, file=str(out), robot=name)


def _format_lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    lidar = facts["lidar"]
    scan = facts["scan"]
    observation = facts["observation"]
    steps = facts["max_episode_steps"]
    limits = "{name} {min:g} to {max:g} {unit}"
    commands = [limits.format(**command) for command in facts["robot"]["command"]]
    observed = "the beams of this lidar"
    if scan is not None:
        observed = (
            f"{scan['sectors']} sectors from {math.degrees(scan['angle_min']):.4g} to "
            f"{math.degrees(scan['angle_max']):.4g} deg, {scan['range_max']:g} m"
        )
    lines = {
        "file": f"{facts['file']}, {facts['bytes'] / 1024:.0f} kB, all checks passed",
        "robot": f"{facts['robot']['name']}: {', '.join(commands)}",
        "task": facts["task"]["name"],
        "actions": facts["actions"],
        "scan": observed,
        "lidar": f"{lidar['name']}: {lidar['beams']} beams, {lidar['range_max']:g} m",
        "observation": f"{observation['size']} parts, {observation['scan_parts']} of them the scan",
        "control period": f"{facts['control_period']:g} s",
        "time limit": "not given"
        if steps is None
        else f"{steps * facts['control_period']:g} s",
        "model": facts["model_fingerprint"],
        "graph": facts["graph_sha256"][:16],
    }
    provenance = {name: str(value) for name, value in facts["provenance"].items()}
    return [*lines.items(), *provenance.items()]
