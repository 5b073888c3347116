"""`nics doctor` and `nics explain`: find a robot's faults, and explain why its gate stopped it."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot import DEFAULT_ROBOT

EXIT_FINDINGS = 1


def doctor(
    bag: Annotated[
        Path | None, Argument(help="A bag to check; else the live robot.")
    ] = None,
    model: Annotated[
        str | None,
        console.make_robot_option(
            f"Check against a model's folder, or a shipped robot ({DEFAULT_ROBOT})."
        ),
    ] = None,
    policy: Annotated[
        str | None, Option(help="Check against a policy file instead.")
    ] = None,
    namespace: console.NamespaceOption = "",
    duration: Annotated[
        float, Option(min=1.0, help="How long to listen to a robot [s].")
    ] = defaults.LISTEN_S,
    imu: console.ImuOption = defaults.IMU_TOPIC,
    install: Annotated[
        bool, Option("--install", help="Check this machine instead: what works here.")
    ] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Checks a robot or a bag against a model; sends nothing."""
    if install:
        _tell_installation(as_json)
        return
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.policy.file.policy_file import load_policy
    from nics_drl_bridge.report.doctor import examine
    from nics_drl_bridge.report.doctor_facts import (
        collect_facts_of_bag,
        derive_expected,
    )

    if policy is None:
        expected = derive_expected(open_model(model or DEFAULT_ROBOT))
    elif model is not None:
        raise ConfigError(
            "--model and --policy: give one of them, what the robot must fit."
        )
    else:
        contract = load_policy(policy).contract
        expected = derive_expected(contract, contract.scan)
    if bag is not None:
        facts = collect_facts_of_bag(bag, namespace, imu)
    else:
        with extensions.require_modules("nics doctor"):
            from nics_drl_bridge.nodes.listen import listen
        with console.show_progress(f"listening for {duration:g} s"):
            facts = listen(duration, namespace, imu=imu)
    findings = examine(facts, expected)
    text = f"{facts.source}: all fits {policy or model or DEFAULT_ROBOT}."
    if findings:
        heads = ("", "check", "where", "what does not fit", "what to do")
        rows = [(f.severity, f.check, f.where, f.what, f.fix) for f in findings]
        text = console.format_table(heads, rows)
    console.print_line(
        as_json, text, source=facts.source, findings=list(map(asdict, findings))
    )
    if findings:
        raise typer.Exit(EXIT_FINDINGS)


def _tell_installation(as_json: bool) -> None:
    from nics_drl_bridge.commands.installation import checks

    results = checks()
    heads = ("", "part", "what there is", "what to do")
    rows = [
        ("+" if c.works else "-", c.part, c.found, "" if c.works else c.fix)
        for c in results
    ]
    console.print_line(
        as_json,
        console.format_table(heads, rows),
        checks=[check._asdict() for check in results],
    )


def explain(
    file: Annotated[Path, Argument(help="Black box written at a stop, *.jsonl.")],
    as_json: console.JsonOption = False,
) -> None:
    """Explains why command_gate stopped a robot, from its black box."""
    from nics_drl_bridge.gate import black_box

    replay = black_box.replay(file)
    story = list(replay.story)
    console.print_line(
        as_json, "\n".join(story), story=story, differing=replay.differing
    )
    if replay.differing:
        raise typer.Exit(EXIT_FINDINGS)
