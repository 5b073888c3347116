"""Fig. 7 of the paper: trajectories of one policy in different worlds, for three robots."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path

from measuring.evaluations import Run, evaluations

ROBOTS = ("differential", "ackermann", "mecanum")
WORLD, FIRST_SEED = "circles", 2_000_000


def main() -> int:
    """Writes a picture for each robot, and prints where, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("runs/paper_fig7"))
    parser.add_argument("--policy", help="a baseline instead of each robot's shipped policy")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    told = {}
    with tempfile.TemporaryDirectory() as folder:
        runs = {
            robot: Run(
                given.policy or robot, robot, WORLD, given.episodes, FIRST_SEED,
                Path(folder) / robot,
            )
            for robot in ROBOTS
        }  # fmt: skip
        for robot, places in evaluations(runs).items():
            picture = given.out / f"fig7_{robot}.png"
            shutil.move(next((Path(folder) / robot).glob("trajectories_*.png")), picture)
            told[robot] = {
                "picture": str(picture),
                "success": {place: figures["success"][0] for place, figures in places.items()},
                "deviation_m": {
                    place: figures["deviation"][0] for place, figures in places.items()
                },
            }
    if given.json:
        print(json.dumps({"robots": told}))
        return 0
    for robot, one in told.items():
        print(
            f"{robot}: {one['picture']}; success {one['success']}; deviation {one['deviation_m']}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
