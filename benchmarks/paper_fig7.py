"""Fig. 7 of the paper: trajectories of one policy in different worlds, for three robots."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

from bench import answer, parser_of
from measuring.evaluations import Run, evaluations

from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS, MUJOCO

ROBOTS = ("differential", "ackermann", "mecanum")
WORLD = "circles"
FIRST_SEED = 2_000_000
CONTROLS = {
    "standing": "a policy that stands still",
    "lying": "a robot that tells that it is at its goal",
}
LEAST_REACHED = 0.8
"""Share of the goals that are truly reached in each world; the picture shows six."""
DEVIATION_M = {FAST: 0.0, DDS: 1e-6, MUJOCO: 1.0}
"""Mean of how far a path may be from that in process [m]."""


def missed(robots: dict[str, dict[str, Any]]) -> list[str]:
    """A sentence for each bar that was missed."""
    said = []
    for robot, told in robots.items():
        for place, bar in DEVIATION_M.items():
            reached = told["success"][place]
            off = told["deviation_m"][place]
            if not reached >= LEAST_REACHED:
                said.append(
                    f"{robot} {LABELS[place]}: {reached:.0%} of the goals were truly reached, "
                    f"less than {LEAST_REACHED:.0%}"
                )
            if off is None or not off <= bar:
                said.append(
                    f"{robot} {LABELS[place]}: paths are {off} m apart, more than {bar:g}"
                )
    return said if robots else ["no robot was driven"]


def main() -> None:
    """Writes a picture for each robot, and prints where, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--out", type=Path, default=Path("runs/paper_fig7"))
    parser.add_argument(
        "--policy", help="a baseline instead of each robot's shipped policy"
    )
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    told = {}
    with tempfile.TemporaryDirectory() as folder:
        runs = {
            robot: Run(
                given.policy or robot,
                robot,
                WORLD,
                given.episodes,
                FIRST_SEED,
                Path(folder) / robot,
                given.control,
            )
            for robot in given.robots
        }
        for robot, places in evaluations(runs).items():
            picture = given.out / f"fig7_{robot}.png"
            shutil.move(
                next((Path(folder) / robot).glob("trajectories_*.png")), picture
            )
            told[robot] = {
                "picture": str(picture),
                "success": {
                    place: figures["success"][0] for place, figures in places.items()
                },
                "deviation_m": {
                    place: figures["deviation"][0] for place, figures in places.items()
                },
            }
    answer({"robots": told}, missed(told), given.json)


if __name__ == "__main__":
    main()
