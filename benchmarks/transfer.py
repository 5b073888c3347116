"""Does a policy drive as well where it was not trained, in every shipped world?

The shipped policy of each robot, one file, drives the same episodes in three places: the fast
simulator in process, the fast simulator over DDS, and the robot's machine in MuJoCo over DDS. The
conditions are those of a deployment: a real lidar, mild randomisation, the gate and its shield.
What counts is where the robot truly ended and whether it truly touched something; what the robot
itself took for a success is told beside it. Two worlds
are driven at a time, each in processes of its own.
"""

from __future__ import annotations

import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

from bench import answer, parser_of
from measuring.evaluations import Run, evaluations

from nics_drl_bridge.commands.conditions import Conditions
from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS, MUJOCO, PLACES
from nics_drl_bridge.policy.policies import shipped_policies
from nics_drl_bridge.robot.spec import load_robot

CONTROLS = {
    "lying": "a robot that tells that it is at its goal",
    "standing": "a policy that stands still",
}
FLOORS = {
    "circles": 0.97,
    "doorway": 0.97,
    "arena": 0.97,
    "empty": 0.97,
    "clutter": 0.95,
    "corridor": 0.95,
    "crowd": 0.95,
    "room": 0.95,
}
"""Least success in process, by world: what fails everywhere alike has not been transferred."""
BELIEF = 0.05
"""More than this share of the episodes may not be successes to the robot alone."""
LEAST_WAY_M = 1.0
BARS = {DDS: 0.02, MUJOCO: 0.04}
"""How far the success may be from that in process."""
LIDAR = "rplidar_a2"
RANDOMISATION = "mild"
FIRST_SEED = 2_000_000
SHARES = ("success", "collision", "believed")
Found = dict[str, dict[str, dict[str, Any]]]


def conditions(robot: str) -> Conditions:
    """Those of a deployment: the robot's own lidar, if it has one, randomisation, its limits."""
    lidar = None if load_robot(robot).lidar else LIDAR
    return Conditions(lidar, RANDOMISATION, robot)


def measure(
    robots: list[str],
    worlds: list[str],
    places: list[str],
    episodes: int,
    folder: Path,
    control: str | None,
) -> Found:
    """What `nics evaluate` found: robot -> world -> place -> figures."""
    runs = {}
    for robot, world in product(robots, worlds):
        given: Any = world, episodes, FIRST_SEED, folder / robot / world
        under: Any = {
            "control": control,
            "conditions": conditions(robot),
            "places": places,
        }
        runs[f"{robot}/{world}"] = Run(robot, robot, *given, **under)

    def tell(name: str, figures: dict[str, Any]) -> None:
        shares = (
            f"{place} {100 * each['success'][0]:.1f} %"
            for place, each in figures.items()
        )
        sys.stderr.write(f"{name}: {', '.join(shares)}\n")

    found: Found = {}
    for name, figures in evaluations(runs, tell).items():
        robot, world = name.split("/")
        found.setdefault(robot, {})[world] = figures
    return found


def shares(found: Found, name: str) -> dict[str, Any]:
    """One share of the episodes, robot -> world -> place -> its value."""
    return {
        robot: {
            world: {place: each[name][0] for place, each in places.items()}
            for world, places in worlds.items()
        }
        for robot, worlds in found.items()
    }


def apart(found: Found) -> dict[str, Any]:
    """Success less that in process [points], robot -> world -> place."""
    return {
        robot: {
            world: {
                place: round(
                    100.0 * (each["success"][0] - places[FAST]["success"][0]), 3
                )
                for place, each in places.items()
                if place != FAST and FAST in places
            }
            for world, places in worlds.items()
        }
        for robot, worlds in found.items()
    }


def missed(found: Found) -> list[str]:
    """A sentence for each bar that was missed."""
    said = []
    for robot, worlds in found.items():
        for world, places in worlds.items():
            who = f"{robot} in {world}"
            if (fast := places.get(FAST)) is not None:
                said += _missed_success(who, fast["success"][0], FLOORS[world], places)
            for place, figures in places.items():
                said += _missed_belief(f"{who} {LABELS[place]}", figures)
    return said if any(found.values()) else ["no robot was driven"]


def _missed_success(
    who: str, fast: float, floor: float, places: dict[str, Any]
) -> list[str]:
    said = []
    if not fast >= floor - 1e-9:
        said.append(f"{who}: {fast:.1%} success in process, less than {floor:.0%}")
    for place, bar in BARS.items():
        if (
            place in places
            and not abs(off := places[place]["success"][0] - fast) <= bar + 1e-9
        ):
            said.append(
                f"{who}: success {LABELS[place]} is {100 * abs(off):.1f} points off that in "
                f"process, more than {100 * bar:g}"
            )
    return said


def _missed_belief(who: str, figures: dict[str, Any]) -> list[str]:
    lied = figures["believed"][0] - figures["success"][0]
    said = []
    if not lied <= BELIEF + 1e-9:
        said.append(
            f"{who}: {lied:.0%} of the episodes were successes to the robot alone, more than "
            f"{BELIEF:.0%}"
        )
    length = figures["length"][0]
    if length is None or not length >= LEAST_WAY_M:
        said.append(f"{who}: no successful way of at least {LEAST_WAY_M:g} m")
    return said


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    robots = shipped_policies()
    parser.add_argument("--episodes", type=int, default=100, help="in each place")
    parser.add_argument("--robots", nargs="+", choices=robots, default=robots)
    parser.add_argument(
        "--worlds", nargs="+", choices=list(FLOORS), default=list(FLOORS)
    )
    parser.add_argument(
        "--in",
        nargs="+",
        dest="places",
        choices=PLACES,
        default=list(PLACES),
        metavar="PLACE",
        help=f"some of {', '.join(PLACES)}",
    )
    given = parser.parse_args()
    chosen = (given.robots, given.worlds, given.places)
    with tempfile.TemporaryDirectory() as folder:
        found = measure(*chosen, given.episodes, Path(folder), given.control)
    result = {name: shares(found, name) for name in SHARES}
    result |= {"points_from_fast": apart(found)}
    answer({**result, "episodes": given.episodes}, missed(found), given.json)


if __name__ == "__main__":
    main()
