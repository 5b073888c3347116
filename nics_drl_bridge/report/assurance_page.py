"""The page of `nics assure`: claims with their evidence, failures, and how it was tested."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from nics_drl_bridge.files import format_json
from nics_drl_bridge.gate.assurance.adversaries import ADVERSARIES
from nics_drl_bridge.gate.assurance.episodes import (
    MAX_COMMAND_DELAY_S,
    MAX_SCAN_DELAY_S,
)
from nics_drl_bridge.gate.assurance.place import ADVERSARY_S, POLICY, POLICY_S
from nics_drl_bridge.gate.assurance.protocol import CLAIMS, STOPS, Protocol
from nics_drl_bridge.report import html

Blocks = Sequence[str]
HEADS = ("claim", "failures", "rate of failures, 95 %", "without the gate")
MAX_CLUSTERS = 50
MAX_SEEDS = 5  # maximum number of seeds that the table shows for a cluster
NOT_SHOWN = (
    "Safety of the vehicle: this is evidence from a simulator, not a certificate. The bounds hold "
    "for the scenes, drivers and delays that this protocol draws.",
    "That the vehicle brakes like its model. Measure its latency and deceleration.",
    "Obstacles that the lidar does not see, or that are faster than the shield's obstacle_speed.",
    "A crash of the gate's process or of the machine: the base itself must then stop.",
)


def make_assurance_page(
    protocol: Protocol, results: Mapping[str, Any], folder: str
) -> str:
    """Makes the page of a run that is complete in a folder."""
    subject = (
        f"Robot {protocol.model}, policy {protocol.policy}, limits {protocol.limits}"
    )
    lead = (
        f"{subject}: {results['episodes']:,} episodes that try to make the gate fail."
    )
    title = "Safety evidence for a command gate"
    if protocol.control:
        lead = f"{subject}. Control: the gate was off, so failures must appear."
        title = "Control of safety evidence: the gate was off"
    sections = [
        ("Result", _make_result(protocol, results)),
        ("Failures", _make_failures(protocol, results, folder)),
        ("How it was tested", _make_method(protocol, results)),
        ("What this does not show", [html.make_bullets(NOT_SHOWN)]),
        ("Protocol, versions and hashes", _make_protocol(protocol)),
    ]
    return html.make_page(title, lead, sections)


def tabulate(
    protocol: Protocol, results: Mapping[str, Any]
) -> list[tuple[str, str, str, str]]:
    """Returns the rows of the table with the columns `HEADS`, a claim each."""
    shown = results["control" if protocol.control else "claims"]
    return [
        (
            sentence,
            _format_counts(shown[claim]),
            _format_bounds(shown[claim]),
            _format_counts(results["control"][claim]),
        )
        for claim, sentence in protocol.claims.items()
    ]


def _format_counts(figures: Mapping[str, Any]) -> str:
    """Formats failures and trials."""
    if not figures["trials"]:
        return "not tested"
    return f"{figures['failures']:,} of {figures['trials']:,}"


def _format_bounds(figures: Mapping[str, Any]) -> str:
    """Formats the 95 % bounds of a rate of failures."""
    if not figures["trials"]:
        return "unknown"
    if not figures["failures"]:
        return f"below {figures['rate_high']:.1e}"
    return f"{figures['rate_low']:.1e} to {figures['rate_high']:.1e}"


def _make_result(protocol: Protocol, results: Mapping[str, Any]) -> Blocks:
    shown = results["control" if protocol.control else "claims"]
    tiles = []
    for claim, sentence in protocol.claims.items():
        figures = shown[claim]
        failed = figures["failures"] > 0
        good = figures["trials"] > 0 and failed == bool(protocol.control)
        if claim == STOPS and results["not_injected"]:
            good = False
        claim_of_tile = f"Claim: {sentence}"
        if figures["trials"]:
            claim_of_tile = f"failed. {claim_of_tile}"
        tiles.append((_format_counts(figures), claim_of_tile, good))
    sentences = _list_limits(results, shown)
    sentences += [_describe_control(claim, results["control"]) for claim in CLAIMS]
    return [
        html.make_tiles(tiles),
        html.make_table(HEADS, tabulate(protocol, results)),
        html.make_bullets([sentence for sentence in sentences if sentence]),
    ]


def _list_limits(results: Mapping[str, Any], shown: Mapping[str, Any]) -> list[str]:
    """Returns sentences on what the results do not show."""
    sentences = []
    if results["not_injected"]:
        sentences.append(
            f"{results['not_injected']:,} faults could not be injected, because the "
            "robot did not move. Therefore the claim on stopping in time is not met; "
            "repeat the same command to inject them."
        )
    elif not shown[STOPS]["trials"]:
        sentences.append(
            "The claim on stopping in time was not tested: it needs ROS 2 and --faults."
        )
    clean = {
        f["trials"]: f["rate_high"]
        for f in shown.values()
        if f["trials"] and not f["failures"]
    }
    if clean:
        bounds = [
            f"{high:.1e} for {trials:,}" for trials, high in sorted(clean.items())
        ]
        sentences.append(
            "No failure in n trials means, with 95 % confidence and one-sided, a rate below about "
            f"3/n, here {' and '.join(bounds)} trials. It does not mean that the rate is 0. With "
            "failures the bounds are two-sided."
        )
    return sentences


def _describe_control(claim: str, control: Mapping[str, Any]) -> str:
    figures = control[claim]
    if not figures["trials"]:
        return ""
    name = claim.replace("_", " ")
    if figures["failures"]:
        return (
            f"Control, {name}: without the gate, {_format_counts(figures)} trials fail, so this "
            "protocol can find such a failure."
        )
    return (
        f"Control, {name}: nothing fails without the gate either, so zero failures with it "
        "prove nothing."
    )


def _make_failures(
    protocol: Protocol, results: Mapping[str, Any], folder: str
) -> Blocks:
    clusters = results["clusters"]
    if not clusters:
        return [html.make_paragraph("None.")]
    rows = []
    for cluster in clusters[:MAX_CLUSTERS]:
        seeds = [str(seed) for seed in cluster["seeds"][:MAX_SEEDS]]
        more = " ..." if len(cluster["seeds"]) > MAX_SEEDS else ""
        near = ", ".join(f"{value:g}" for value in cluster["near"])
        rows.append(
            (
                cluster["claim"].replace("_", " "),
                cluster["kind"],
                cluster["world"],
                near,
                str(cluster["failures"]),
                ", ".join(seeds) + more,
            )
        )
    heads = ("claim", "driver or fault", "world", "near x, y [m]", "failures", "seeds")
    count = f"Failed trials: {len(results['failures']):,}. Clusters: {len(clusters):,}."
    advice = (
        "Replay one by its seed. An episode is repeated bit for bit and drawn; a "
        "fault is injected again, at another time:"
    )
    return [
        html.make_paragraph(count),
        html.make_table(heads, rows),
        html.make_paragraph(advice),
        html.make_code(_make_command(protocol, folder, clusters[0]["seeds"][0])),
    ]


def _make_command(protocol: Protocol, folder: str, seed: int | None = None) -> str:
    words = ["nics", "assure", protocol.policy, "--limits", protocol.limits]
    words += ["--model", protocol.model]
    for world in protocol.worlds:
        words += ["--world", world]
    words += ["--randomisation", protocol.randomisation]
    words += ["--episodes", str(protocol.episodes), "--seed", str(protocol.seed)]
    if protocol.control:
        words += ["--control", protocol.control]
    words += ["--faults", str(protocol.faults), "--out", folder]
    if seed is not None:
        words += ["--replay", str(seed)]
    return shlex.join(words)


def _list_drivers(
    protocol: Protocol, results: Mapping[str, Any]
) -> list[tuple[str, ...]]:
    """Returns a row for each driver: what it does, and how often it touched something."""
    aims = {name: f"{aim}; knows the true scene" for name, aim in ADVERSARIES.items()}
    aims[POLICY] = (
        "the policy on its way to a goal, with robot and sensors perturbed by the "
        f"randomisation {protocol.randomisation!r}"
    )
    drivers = list[tuple[str, ...]]()
    for name, aim in aims.items():
        touches, tried, without_gate, controls = results["drivers"][name]
        counts = (f"{touches:,} of {tried:,}", f"{without_gate:,} of {controls:,}")
        drivers.append((f"{name}: {aim}", *counts))
    return drivers


def _make_method(protocol: Protocol, results: Mapping[str, Any]) -> Blocks:
    latched = ", ".join(f"{rule} {n:,}" for rule, n in results["latched"].items())
    path_km = results["path_m"] / 1000.0
    hours = results["seconds"] / 3600.0
    facts = [
        f"Worlds: {', '.join(protocol.worlds)}. An adversary drives for {ADVERSARY_S:g} s, the "
        f"policy for up to {POLICY_S:g} s: {path_km:.2f} km in {hours:.2f} h with the gate.",
        f"Scans reach the gate up to {MAX_SCAN_DELAY_S:g} s late, and commands arrive up to "
        f"{MAX_COMMAND_DELAY_S:g} s late before and after the gate; each episode draws its delays.",
        f"A contact is a failure if the robot moved. In {results['walked_into']:,} "
        "episodes something walked into a robot at rest.",
        f"The gate latched a stop in {sum(results['latched'].values()):,} episodes "
        f"({latched or 'none'}): such an episode ends at rest and still counts.",
        f"One episode in {protocol.control_every}, and the first of each driver in "
        "each world, is repeated without the gate, as a control.",
        "Seeds, numbers and hashes were written to the JSON before the first episode.",
    ]
    faults = protocol.list_faults()
    if faults:
        kinds = dict.fromkeys(trial.kind for trial in faults)
        facts.append(
            f"{len(faults) - results['not_injected']:,} faults were injected over DDS, in real "
            "time, around a process of the gate and, where the fault is the policy's, of the "
            f"policy: {', '.join(kinds)}."
        )
    heads = ("drivers, in turn", "touches", "without the gate")
    return [
        html.make_table(heads, _list_drivers(protocol, results)),
        html.make_bullets(facts),
    ]


def _make_protocol(protocol: Protocol) -> Blocks:
    rows = [("protocol, SHA-256", protocol.sha256)]
    rows += [(name, value) for name, value in protocol.hashes.items()]
    rows += [(name, value) for name, value in protocol.versions.items()]
    text = format_json(protocol.data, indent=1)
    command = _make_command(protocol, "again")
    return [
        html.make_table(("what", "value"), rows),
        html.make_paragraph(
            "To repeat the run. With these versions its episodes are bit-identical; "
            "faults are injected in real time, hence at other times:"
        ),
        html.make_code(command),
        html.make_details("The predefined protocol", [html.make_code(text)]),
    ]
