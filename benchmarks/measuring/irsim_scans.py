"""Scans circles with ir-sim or irsim-x, in an environment of their own: see lidar_peers.py.

Reads a JSON file of scenes, writes ranges to another and prints one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import irsim
import yaml

WARM_UP = 3


def world(circles: list[list[float]], about: dict) -> dict:
    """A world of circles around a robot that stands still."""
    lidar = {
        "name": "lidar2d",
        "number": about["beams"],
        "angle_range": about["angle_range"],
        "range_min": about["range_min"],
        "range_max": about["range_max"],
    }
    robot = {
        "kinematics": {"name": "diff"},
        "shape": {"name": "circle", "radius": 0.01},
        "state": [0.0, 0.0, 0.0],
        "sensors": [lidar],
    }
    obstacles = [
        {"shape": {"name": "circle", "radius": about["radius"]}, "state": [x, y, 0.0]}
        for x, y in circles
    ]
    side = 4.0 * about["range_max"]
    return {
        "world": {
            "width": side,
            "height": side,
            "offset": [-0.5 * side, -0.5 * side],
            "collision_mode": "unobstructed",
        },
        "robot": [robot],
        "obstacle": obstacles,
    }


def measure(circles: list[list[float]], about: dict, repeats: int) -> tuple[list, list]:
    """Ranges of a scan, and the times of many [s]."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.yaml"
        file.write_text(yaml.safe_dump(world(circles, about)))
        env = irsim.make(str(file), display=False, disable_all_plot=True, log_level="ERROR")
    lidar, state, times = env.robot.lidar, env.robot.state, []
    for _ in range(WARM_UP + repeats):
        begin = time.perf_counter()
        lidar.step(state)
        times.append(time.perf_counter() - begin)
    env.end(0)
    return [float(value) for value in lidar.range_data], times[WARM_UP:]


def main() -> None:
    """Prints the scans per second."""
    given = json.loads(Path(sys.argv[1]).read_text())
    found = [measure(circles, given["about"], given["repeats"]) for circles in given["scenes"]]
    Path(sys.argv[2]).write_text(json.dumps([ranges for ranges, _ in found]))
    middle = median(seconds for _, times in found for seconds in times)
    sys.stdout.write("\n" + json.dumps({"scans_per_s": 1.0 / middle}) + "\n")


if __name__ == "__main__":
    main()
