"""Do our nodes speak the standards of others: simulation_interfaces, Nav2, LEAPP?

- simulation_interfaces: a client calls every feature that `simulator_node` announces, and sees that
  it does what the standard says, and that each other one is answered as unsupported.
- LEAPP: a policy that comes with the package is exported as a bundle, which LEAPP runs; both are
  given the same observations.
- Nav2: what `nav2_standards` measures, by its bars; its control is its own.

Bars: no check fails, and both policies give the same actions. The controls announce a feature that
is not there, do nothing of what is asked for, or round what LEAPP is given.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import nav2_standards
import numpy as np
from campaign import Given, Result, at_most, missed_bars, run_campaign, some_of

from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

BARS = {
    "sim_conformance_failed": at_most(0),
    "leapp_max_abs_difference": at_most(1e-6),
}
ROBOT = "ackermann"
WORLD = "circles"
CLAIMED = "NAMED_POSES"
OBSERVATIONS = 64
POLICY = "differential"


@contextmanager
def simulator(
    domain_id: int, folder: Path, namespace: str, mode: str
) -> Iterator[None]:
    """A simulator node in a process of its own, which listens to a Twist."""
    folder.mkdir(exist_ok=True)
    given = {
        "model": ROBOT,
        "world": WORLD,
        "mode": mode,
        "enable_stamped_cmd_vel": False,
    }
    with NodeProcess("simulator_node", folder, given, domain_id, namespace):
        yield


def conformance(domain_id: int, folder: Path, control: str | None) -> dict[str, Any]:
    """How many features are announced, and the sentences about those that fail."""
    from parts.conformance import Client, announced, failures

    namespace = f"conformance_{os.getpid()}"
    with simulator(domain_id, folder / "conformance", namespace, "realtime"):
        client = Client(domain_id, f"/{namespace}")
        try:
            told = announced(client)
            client.idle = control == "idle"
            claimed = told | {CLAIMED} if control == "claims" else told
            failed = failures(client, "empty", claimed)
        finally:
            client.close()
    return {
        "sim_features": len(told),
        "sim_conformance_failed": len(failed),
        "failed": failed,
    }


def leapp(folder: Path, control: str | None) -> dict[str, float]:
    """Greatest difference of what a shipped policy and its bundle, run by LEAPP, do."""
    import torch
    from leapp import InferenceManager

    from nics_drl_bridge.extras.foreign_policies import export_bundle
    from nics_drl_bridge.policy.file.contract import shipped
    from nics_drl_bridge.policy.file.policy_file import load_policy

    policy = load_policy(shipped() / f"{POLICY}.onnx")
    manager = InferenceManager(str(export_bundle(policy, folder / "bundle")))
    layout = policy.contract.observation
    random = np.random.default_rng(0)
    scans = random.uniform(0.0, 1.0, (OBSERVATIONS, layout.scan_parts))
    rest = random.uniform(
        layout.rest_low, layout.rest_high, (OBSERVATIONS, len(layout.rest_low))
    )
    gap = 0.0
    zero = np.zeros(1)
    for row in np.concatenate([scans, rest], axis=1).astype(np.float32):
        scan, goal, velocity = np.split(row, [layout.scan_parts, layout.scan_parts + 3])
        pieces = {
            "scan": scan,
            "goal": goal,
            "linear_velocity": np.concatenate([velocity[:2], zero]),
            "angular_velocity": np.concatenate([zero, zero, velocity[2:]]),
        }
        if control == "coarse":
            pieces = {name: each.round(2) for name, each in pieces.items()}
        given = {
            f"policy/{name}": torch.as_tensor(each.astype(np.float32)[None])
            for name, each in pieces.items()
        }
        theirs = manager(given)
        for name, ours in zip(
            ("action", "command"), policy.run(row[None]), strict=True
        ):
            gap = max(gap, float(np.abs(theirs[f"policy/{name}"].numpy() - ours).max()))
    return {"leapp_max_abs_difference": gap}


def judge(result: Result) -> list[str]:
    measured = {name: bar for name, bar in BARS.items() if name in result}
    missed = missed_bars(result, measured)
    if "map_agreement" in result:
        missed += missed_bars(result, nav2_standards.BARS)
    return [*missed, *result.get("failed", [])]


NOT_BUILT = "simulation_interfaces: source what `nox -s messages` builds"
SIMULATION = ("sim_features", "sim_conformance_failed")
PARTS = ("conformance", "leapp", "nav2")


def measure(given: Given) -> Result:
    """All figures of the parts that were asked for."""
    domain_id = free_domain_id()
    result = dict[str, Any]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built = importlib.util.find_spec("simulation_interfaces") is not None
        if "conformance" in given.parts and not built:
            result |= dict.fromkeys(SIMULATION, np.nan) | {"failed": [NOT_BUILT]}
        if "conformance" in given.parts and built:
            result |= conformance(domain_id, folder, given.control)
        if "leapp" in given.parts:
            result |= leapp(folder, given.control)
        if "nav2" in given.parts:
            result |= nav2_standards.figures(parameters=given.parameters)
    return result


OPTIONS = {
    "parts": some_of(PARTS),
    "parameters": {"type": Path, "help": "another parameter file of Nav2"},
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
