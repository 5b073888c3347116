"""`nics doctor`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from nics_drl_bridge.commands.console import needs_ros, one_sentence, table

EXIT_FINDINGS = 1


def doctor(
    bag: Annotated[
        Path | None, typer.Argument(help="A bag to look at; the live robot when left out.")
    ] = None,
    model: Annotated[
        str, typer.Option(help="What the robot must fit: folder of a model, or a shipped robot.")
    ] = "ackermann",
    namespace: Annotated[str, typer.Option(help="Namespace of the robot's topics.")] = "",
    duration: Annotated[
        float, typer.Option(min=1.0, help="How long to listen to a live robot [s].")
    ] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Looks at a robot or a bag beside a model, and tells what does not fit; it sends nothing."""
    with one_sentence():
        from nics_drl_bridge.generator import open_model
        from nics_drl_bridge.report.doctor import examine, expected_of_model
        from nics_drl_bridge.report.doctor_facts import facts_of_bag

        expected = expected_of_model(open_model(model))
        if bag is not None:
            facts = facts_of_bag(bag, namespace)
        else:
            with needs_ros("nics doctor"):
                from nics_drl_bridge.nodes.doctor import listen
            facts = listen(duration, namespace)
        findings = examine(facts, expected)
        if as_json:
            told = {"source": facts.source, "findings": [asdict(each) for each in findings]}
            typer.echo(json.dumps(told))
        elif findings:
            heads = ("", "check", "where", "what does not fit", "what to do")
            rows = [(f.severity, f.check, f.where, f.what, f.fix) for f in findings]
            typer.echo(table(heads, rows))
        else:
            typer.echo(f"{facts.source}: all fits {model}.")
        if findings:
            raise typer.Exit(EXIT_FINDINGS)
