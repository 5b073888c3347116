"""Does a policy drive as well where it was not trained?

The shipped policy of each robot, one file, drives the same episodes among ten random obstacles in
three worlds: the fast simulator in process, the fast simulator over DDS, and the robot's machine in
MuJoCo over DDS. `without_randomisation` are policies that were trained without any, see
`benchmarks/policies`. Two robots are driven at a time, each in processes of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from measuring.evaluations import Run, evaluations

from nics_drl_bridge.trial import DDS, FAST, LABELS, MUJOCO, PLACES

ROBOTS = ("differential", "ackermann", "mecanum")
BARS = {DDS: 0.02, MUJOCO: 0.05}
"""How far the success may be from that in process."""
PLAIN, PLAIN_KEY = Path(__file__).parent / "policies", "without_randomisation"
WORLD, FIRST_SEED = "circles", 2_000_000


def measure(episodes: int, robots: list[str], folder: Path) -> dict[str, dict[str, Any]]:
    """`robots` and `without_randomisation`: robot -> place -> what `nics evaluate` found."""
    kinds = {"robots": {robot: robot for robot in robots}}
    files = {robot: PLAIN / f"{robot}.onnx" for robot in robots}
    kinds[PLAIN_KEY] = {robot: str(file) for robot, file in files.items() if file.is_file()}
    runs = {
        f"{kind}/{robot}": Run(policy, robot, WORLD, episodes, FIRST_SEED, folder / kind / robot)
        for kind, policies in kinds.items()
        for robot, policy in policies.items()
    }
    found = evaluations(runs)
    return {
        kind: {robot: found[f"{kind}/{robot}"] for robot in policies}
        for kind, policies in kinds.items()
    }


def rates(found: dict[str, dict[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Success rates alone."""
    return {
        kind: {
            robot: {place: places[place]["success"][0] for place in PLACES}
            for robot, places in robots.items()
        }
        for kind, robots in found.items()
    }


def passes(places: dict[str, float]) -> bool:
    """Whether success elsewhere is as near to that in process as it has to be."""
    return all(abs(places[place] - places[FAST]) <= bar + 1e-9 for place, bar in BARS.items())


def _print(found: dict[str, dict[str, Any]], wall_s: float) -> None:
    for kind, robots in found.items():
        print(f"{kind}:")
        for robot, places in robots.items():
            for place, figures in places.items():
                share, low, high = (100 * value for value in figures["success"])
                print(
                    f"  {robot:<13}{LABELS[place]:<16}{share:5.1f} % ({low:.0f} to {high:.0f}), "
                    f"collision {100 * figures['collision'][0]:.1f} %, deviation "
                    f"{figures['deviation'][0]:.2g} m, greatest {figures['greatest_deviation']:.2g}"
                )
    print(f"{wall_s:.0f} s on {os.cpu_count()} cores")


def main() -> int:
    """Prints a table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100, help="in each world")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args()
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(given.episodes, given.robots, Path(folder))
    told = rates(found)
    if given.json:
        print(json.dumps(told))
    else:
        _print(found, time.perf_counter() - begin)
    return 0 if all(passes(places) for places in told["robots"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
