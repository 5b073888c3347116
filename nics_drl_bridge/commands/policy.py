"""`nics policy`."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from nics_drl_bridge.commands.console import one_sentence

policy = typer.Typer(help="Policy files.", no_args_is_help=True)


@policy.callback()
def _group() -> None:
    """Policy files."""


@policy.command()
def info(
    file: Annotated[str, typer.Argument(help="A policy file, or the name of a shipped one.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object instead.")] = False,
) -> None:
    """Checks a policy file and tells what it was trained on and needs."""
    with one_sentence():
        from nics_drl_bridge.policy.policy_file import load_policy, summary

        facts = summary(load_policy(file))
        if as_json:
            typer.echo(json.dumps(facts))
            return
        for name, value in _lines(facts):
            typer.echo(f"{name:<18} {value}")


def _lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and text of each printed line."""
    lidar, scan, seen = facts["lidar"], facts["scan"], facts["observation"]
    turn = 180.0 / 3.141592653589793
    commands = [
        f"{c['name']} {c['min']:g} to {c['max']:g} {c['unit']}" for c in facts["robot"]["command"]
    ]
    sees = "the beams of this lidar"
    if scan is not None:
        sees = (
            f"{scan['sectors']} sectors from {scan['angle_min'] * turn:.4g} to "
            f"{scan['angle_max'] * turn:.4g} deg, {scan['range_max']:g} m"
        )
    lines = {
        "file": f"{facts['file']}, {facts['bytes'] / 1024:.0f} kB, all checks passed",
        "robot": f"{facts['robot']['name']}: {', '.join(commands)}",
        "task": facts["task"]["name"],
        "actions": facts["actions"],
        "scan": sees,
        "lidar": f"{lidar['name']}: {lidar['beams']} beams, {lidar['range_max']:g} m",
        "observation": f"{seen['size']} parts, {seen['scan_parts']} of them the scan",
        "control period": f"{facts['control_period']:g} s",
        "model": facts["model_fingerprint"],
        "graph": facts["graph_sha256"][:16],
    }
    provenance = [(name, str(value)) for name, value in facts["provenance"].items()]
    return [*lines.items(), *provenance]
