"""How far does a newcomer get within the first hour, from a clean clone and a fresh environment?

`make setup` in a clone, then four roads, each in a folder of its own, by the commands of the pages:
a picture of a robot that moves; a robot of one's own, a TurtleBot3 Burger by its YAML file, to a
policy in `doorway`; a recording of one's own to a report; a task of one's own to a policy. What is
not committed is not in the clone. Typing and reading are not in the times.
"""

from __future__ import annotations

import json
import os
import shlex
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench import ROOT, answer, parser_of
from measuring.environments import newcomer, wait_for
from PIL import Image, ImageChops

CONTROLS = {"untrained": "the learning: a policy is trained for 2,048 steps"}
BARS = {"picture": 180.0, "robot": 600.0, "recording": 600.0, "task": 600.0}
"""Longest time [s], the set-up included in that of the picture; a reader may type for 5 minutes
on top of that of the robot."""
SUCCESS, MOVED = {"robot": 0.9, "task": 0.5}, 20
"""Least success, and least extent of what differs between first and last picture [pixels]."""
BURGER = """name: my_robot
kind: differential
footprint: [[0.04, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.04, -0.1]]
lidar: turtlebot3_lds_02
lidar_mount: [-0.032, 0.0, 0.0]
parameters: {wheel_radius: 0.033, track: 0.16}
command:
  - {name: forward_command, unit: m/s, min: -0.22, max: 0.22, cmd_vel: linear.x}
  - {name: turn_command, unit: rad/s, min: -2.84, max: 2.84, cmd_vel: angular.z}
"""
TASK = "examples/own_task.py:Patrol"
ROADS = {
    "picture": ("nics watch differential --world circles --record moving.gif",),
    "robot": (
        "nics drive --robot my_robot.yaml --out my_robot",
        "nics train --robot my_robot --world doorway --out run --json",
    ),
    "recording": (
        "nics drive --robot my_robot.yaml --recording drive.npz --out textbook",
        "nics inspect drive.npz",
        "nics generate drive.npz --robot my_robot.yaml --world arena --out my_robot",
    ),
    "task": (
        f"nics train --task {TASK} --robot differential --world circles --steps 400000 --out run "
        "--json",
    ),
}


def moved(picture: Path) -> int:
    """Extent of what differs between the first and the last picture of an animation [pixels]."""
    with Image.open(picture) as film:
        first = film.convert("RGB")
        film.seek(film.n_frames - 1)
        box = ImageChops.difference(first, film.convert("RGB")).getbbox()
    return max(box[2] - box[0], box[3] - box[1]) if box else 0


def travelled(
    name: str, clone: Path, folder: Path, around: dict[str, str], control: str | None
) -> tuple[float, list[str]]:
    """Goes one of the roads; returns how long it took [s], and what each command printed."""
    folder.mkdir()
    (folder / "examples").symlink_to(clone / "examples")
    (folder / "my_robot.yaml").write_text(BURGER)
    taken = 0.0
    told = []
    for line in ROADS[name]:
        words = shlex.split(line)
        if control == "untrained" and words[1] == "train":
            words += ["--steps", "2048"]
        words[0] = str(clone / ".venv" / "bin" / "nics")
        seconds, printed = wait_for(words, folder, around)
        taken = taken + seconds
        told = [*told, printed]
    return taken, told


def measure(folder: Path, roads: Sequence[str], control: str | None) -> dict[str, Any]:
    """All figures, see the head of this file."""
    clone = folder / "clone"
    around = newcomer(folder)
    wait_for(["git", "clone", "--quiet", str(ROOT), str(clone)], folder, around)
    setup_s, _ = wait_for(["make", "setup"], clone, around)
    seconds = {}
    success = {}
    for name in roads:
        seconds[name], told = travelled(name, clone, folder / name, around, control)
        if name in SUCCESS:
            (world,) = json.loads(told[-1])["seeds"][0]["worlds"].values()
            success[name] = world["success"]["value"]
    result = {
        "seconds": seconds,
        "setup_s": setup_s,
        "success": success,
        "cores": os.cpu_count(),
    }
    if "picture" in roads:
        seconds["picture"] += setup_s
        result["moved_pixels"] = moved(folder / "picture" / "moving.gif")
    if "recording" in roads:
        report = folder / "recording" / "my_robot" / "report.html"
        result["report_bytes"] = report.stat().st_size if report.is_file() else 0
    return result


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = [
        f"{name}: took {result['seconds'][name]:.0f} s, bar {bar:g} at most"
        for name, bar in BARS.items()
        if not result["seconds"].get(name, 0.0) <= bar
    ]
    missed += [
        f"{name}: success {result['success'][name]:.1%}, bar {bar:.0%} at least"
        for name, bar in SUCCESS.items()
        if not result["success"].get(name, 1.0) >= bar
    ]
    if not (differ := result.get("moved_pixels", MOVED)) >= MOVED:
        missed.append(f"picture: {differ} pixels differ, so that nothing moves")
    return (
        missed
        if result.get("report_bytes", 1)
        else [*missed, "recording: there is no report"]
    )


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--roads", nargs="+", choices=list(ROADS), default=list(ROADS))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measure(Path(folder), given.roads, given.control)
    answer(result, missed_of(result), given.json)


if __name__ == "__main__":
    main()
