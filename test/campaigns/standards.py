"""Do our nodes speak the standards of others: simulation_interfaces and Nav2?

- simulation_interfaces: a client calls every feature that `simulator_node` announces, and sees that
  it does what the standard says, and that each other one is answered as unsupported.
- Nav2: paths that are planned on the map are sent to `follow_path`, in lock-step over DDS, by a
  stand-in for the behaviour tree; one is followed if the action succeeds, at the goal, without a
  touch. Then the topics, frames, types, qualities of service and actions are counted that Nav2's
  parameter file names and nobody serves.

Both need message packages: source what `nox -s messages` builds.
"""

from __future__ import annotations

import os
import tarfile
import tempfile
from pathlib import Path

from campaign import (
    NAV2_SOURCES,
    Bars,
    Given,
    Result,
    Silence,
    at_least,
    at_most,
    run_campaign,
    some_of,
)

from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

BARS = {
    "sim_conformance_failed": at_most(0),
    "follow_path_success": at_least(0.95),
    "nav2_names_missing": at_most(0),
}
CLAIMED = "NAMED_POSES"
UPSTREAM = "navigation2/nav2_bringup/params/nav2_params.yaml"


def check_conformance(folder: Path, given: Given) -> Result:
    """Counts the announced features, and those that fail, with a sentence about each."""
    from parts.conformance import Client, announced, failures

    domain_id = choose_domain_id()
    space = f"conformance_{os.getpid()}"
    parameters = {"model": "ackermann", "world": "circles"}
    parameters |= {"mode": "realtime", "enable_stamped_cmd_vel": False}
    with NodeProcess("simulator_node", folder, parameters, domain_id, space):
        client = Client(domain_id, f"/{space}")
        try:
            told = announced(client)
            client.idle = given.control == "idle"
            claimed = told | {CLAIMED} if given.control == "claims" else told
            failed = failures(client, "empty", claimed)
        finally:
            client.close()
    return {
        "sim_features": len(told),
        "sim_conformance_failed": len(failed),
        "failed": {line.partition(" ")[0]: line for line in failed},
    }


def check_nav2(folder: Path, given: Given) -> Result:
    """Counts the paths that are followed, and the names that nobody serves."""
    from parts.nav2 import find_missing, follow_paths

    is_bare = given.control == "bare"
    file = given.parameters
    if file is None:
        with tarfile.open(NAV2_SOURCES) as archive:
            archive.extract(UPSTREAM, folder, filter="data")
        file = folder / UPSTREAM
    missing = find_missing(folder / "names", file, is_bare)
    not_followed = follow_paths(folder / "paths", given.episodes, is_bare)
    return {
        "nav2_names_missing": len(missing),
        "missing": missing,
        "follow_path_success": 1.0 - len(not_followed) / given.episodes,
        "not_followed": not_followed,
    }


PARTS = {"conformance": check_conformance, "nav2": check_nav2}


def measure(given: Given) -> Result:
    """Checks the parts that were asked for."""
    result: Result = {}
    for part in given.parts:
        with tempfile.TemporaryDirectory() as folder:
            result |= PARTS[part](Path(folder), given)
    return result


def set_bars(result: Result) -> Bars:
    bars = {name: bar for name, bar in BARS.items() if name in result}
    if "failed" in result:
        bars["failed"] = dict.fromkeys(result["failed"], Silence())
    return bars


OPTIONS = {
    "parts": some_of(tuple(PARTS)),
    "episodes": (20, "paths to follow"),
    "parameters": {"type": Path, "help": "another parameter file of Nav2"},
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
