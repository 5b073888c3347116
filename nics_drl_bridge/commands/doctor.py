"""`nics doctor` and `nics explain`: find a robot's faults, and explain why its gate stopped it."""

from collections.abc import Sequence
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
LOAD_NOTE = (
    "CPU and memory of middleware, policy and gate on one core. Latencies from the "
    "stamp of a scan: median, 99th percentile. The gate sends motion every 20 ms."
)


def doctor(
    bag: Annotated[Path | None, Argument()] = None,
    model: console.OptionalRobotOption = None,
    policy: str | None = None,
    namespace: console.NamespaceOption = "",
    duration: Annotated[float, Option(min=1.0)] = defaults.LISTEN_S,
    imu: console.ImuOption = defaults.IMU_TOPIC,
    install: Annotated[bool, Option("--install")] = False,
    load: Annotated[bool, Option("--load")] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Checks a robot or a bag against a model; sends nothing to it.

    Args:
        bag: A bag to check. Default: the live robot.
        model: Check against a model's folder, or a shipped robot (differential).
        policy: Check against a policy file instead.
        duration: Time to listen to a robot [s].
        install: Check which features work on this machine instead.
        load: Measure a vehicle's nodes on this machine instead.

    Examples:
        nics doctor --install
        nics doctor drive_bag --model my_robot
        nics doctor --policy policy.onnx --namespace robot1
    """
    if install:
        _tell_installation(as_json)
        return
    if load:
        _tell_load(model or DEFAULT_ROBOT, policy, as_json)
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
            "--model and --policy: give only one, which the robot must fit."
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
    text = f"{facts.source}: everything fits {policy or model or DEFAULT_ROBOT}."
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


def _tell_load(name: str, policy: str | None, as_json: bool) -> None:
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.policy.policies import list_shipped_policies

    model = open_model(name)
    if policy is None:
        policy = name if name in list_shipped_policies() else "dynamic_window"
    with extensions.require_modules("nics doctor"):
        from nics_drl_bridge.nodes.load import measure_load
    with console.show_progress("starting the nodes") as tell:
        loads, unlimited = measure_load(model, policy, tell=tell)
    heads = (
        "cores",
        "scans [Hz]",
        "answered",
        "CPU [% of a core]",
        "memory [MB]",
        "to cmd_vel_raw [ms]",
        "to cmd_vel [ms]",
    )
    rows = [
        (
            f"{load.cores:g}",
            f"{load.rate:g}",
            f"{load.answered:.0%}",
            _format_sum([100.0 * part for part in load.cpu.values()]),
            _format_sum(list(load.memory_mb.values())),
            f"{load.policy.median_ms:.1f}, {load.policy.p99_ms:.1f}",
            f"{load.gate.median_ms:.1f}, {load.gate.p99_ms:.1f}",
        )
        for load in loads
    ]
    text = f"{console.format_table(heads, rows)}\n\n{LOAD_NOTE}"
    if unlimited:
        text += f" Half a core and less can only be measured as root ({unlimited})."
    facts = [asdict(load) for load in loads]
    console.print_line(as_json, text, policy=policy, loads=facts, unlimited=unlimited)


def _format_sum(parts: Sequence[float]) -> str:
    return f"{' + '.join(f'{part:.0f}' for part in parts)} = {sum(parts):.0f}"


def explain(
    file: Path,
    as_json: console.JsonOption = False,
) -> None:
    """Explains why command_gate stopped a robot, from its black box.

    Args:
        file: Black box written at a stop, *.jsonl.

    Examples:
        nics explain ~/.ros/black_box/stop.jsonl
    """
    from nics_drl_bridge.gate import black_box

    replay = black_box.replay(file)
    story = list(replay.story)
    console.print_line(
        as_json, "\n".join(story), story=story, differing=replay.differing
    )
    if replay.differing:
        raise typer.Exit(EXIT_FINDINGS)
