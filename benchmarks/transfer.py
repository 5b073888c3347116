"""Does a policy drive as well where it was not trained?

The shipped policy of each robot, one file, drives the same episodes among ten random obstacles in
three worlds: the fast simulator in process, the fast simulator over DDS, and the robot's machine in
MuJoCo over DDS. What counts is where the robot truly ended and whether it truly touched something.
`without_randomisation` are policies that were trained without any, see `benchmarks/policies`. Two
robots are driven at a time, each in processes of its own.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

from measuring.evaluations import Run, evaluations
from measuring.verdict import answer, parser_of

from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS, MUJOCO, PLACES

ROBOTS = ("differential", "ackermann", "mecanum")
CONTROLS = {
    "lying": "a robot that tells that it is at its goal",
    "standing": "a policy that stands still",
}
FLOOR = {"differential": 0.9, "ackermann": 0.8, "mecanum": 0.85}
"""Least success in process: what fails everywhere alike has not been transferred."""
BELIEF = 0.05
"""More than this share of the episodes may not be successes to the robot alone."""
LEAST_WAY_M = 1.0
BARS = {DDS: 0.02, MUJOCO: 0.05}
"""How far the success may be from that in process."""
PLAIN, PLAIN_KEY = Path(__file__).parent / "policies", "without_randomisation"
WORLD, FIRST_SEED = "circles", 2_000_000


def measure(
    episodes: int, robots: list[str], folder: Path, control: str | None
) -> dict[str, dict[str, Any]]:
    """`robots` and `without_randomisation`: robot -> place -> what `nics evaluate` found."""
    kinds = {"robots": {robot: robot for robot in robots}}
    files = {robot: PLAIN / f"{robot}.onnx" for robot in robots}
    kinds[PLAIN_KEY] = {robot: str(file) for robot, file in files.items() if file.is_file()}
    if control is not None:
        del kinds[PLAIN_KEY]
    runs = {
        f"{kind}/{robot}": Run(
            policy, robot, WORLD, episodes, FIRST_SEED, folder / kind / robot, control
        )
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


def missed(robots: dict[str, dict[str, Any]]) -> list[str]:
    """A sentence for each bar that was missed; robot -> place -> figures."""
    said = []
    for robot, places in robots.items():
        fast = places[FAST]["success"][0]
        if not fast >= FLOOR[robot]:
            said.append(f"{robot}: {fast:.0%} success in process, less than {FLOOR[robot]:.0%}")
        for place, bar in BARS.items():
            apart = abs(places[place]["success"][0] - fast)
            if not apart <= bar + 1e-9:
                said.append(
                    f"{robot}: success {LABELS[place]} is {apart:.0%} off that in process, more "
                    f"than {bar:.0%}"
                )
        for place, figures in places.items():
            said += _missed_belief(f"{robot} {LABELS[place]}", figures)
    return said if robots else ["no robot was driven"]


def _missed_belief(who: str, figures: dict[str, Any]) -> list[str]:
    lied, said = figures["believed"][0] - figures["success"][0], []
    if not lied <= BELIEF:
        said.append(
            f"{who}: {lied:.0%} of the episodes were successes to the robot alone, more than "
            f"{BELIEF:.0%}"
        )
    length = figures["length"][0]
    if length is None or not length >= LEAST_WAY_M:
        said.append(f"{who}: no successful way of at least {LEAST_WAY_M:g} m")
    return said


def table_of(found: dict[str, dict[str, Any]], wall_s: float) -> str:
    """The figures for people."""
    lines = []
    for kind, robots in found.items():
        lines.append(f"{kind}:")
        for robot, places in robots.items():
            for place, figures in places.items():
                share, low, high = (100 * value for value in figures["success"])
                lines.append(
                    f"  {robot:<13}{LABELS[place]:<16}{share:5.1f} % ({low:.0f} to {high:.0f}), "
                    f"believed {100 * figures['believed'][0]:.1f} %, "
                    f"collision {100 * figures['collision'][0]:.1f} %, deviation "
                    f"{figures['deviation'][0]:.2g} m, greatest {figures['greatest_deviation']:.2g}"
                )
    return "\n".join([*lines, f"{wall_s:.0f} s on {os.cpu_count()} cores"]) + "\n"


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--episodes", type=int, default=100, help="in each world")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    given = parser.parse_args()
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(given.episodes, given.robots, Path(folder), given.control)
    believed = {
        robot: {place: places[place]["believed"][0] for place in PLACES}
        for robot, places in found["robots"].items()
    }
    table = table_of(found, time.perf_counter() - begin)
    answer({**rates(found), "believed": believed}, missed(found["robots"]), table, given.json)


if __name__ == "__main__":
    main()
