"""Whole steps of ir-sim or irsim-x, in an environment of their own: see env_throughput.py.

Reads a JSON file of scenes, and prints one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import irsim
import numpy as np
import yaml
from irsim_scans import world

WARM_UP = 3


def field(circles: list[list[float]], about: dict, substeps: int) -> dict:
    """The circles and the four walls around a robot that collides, as ours does."""
    scene = world(circles, about)
    x1, y1, x2, y2 = about["walls"]
    corners = [[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]]
    scene["obstacle"].append({"shape": {"name": "linestring", "vertices": corners}})
    scene["world"]["collision_mode"] = "stop"
    scene["world"]["step_time"] = about["period"] / substeps
    scene["robot"][0]["shape"]["radius"] = about["footprint"]
    return scene


def steps(circles: list[list[float]], about: dict, repeats: int, substeps: int) -> float:
    """Seconds per step: the robot moves by a random command, and its lidar scans.

    One that touched something begins anew, since it would stand still without a scan from then on.
    The time that this takes does not count, though it does for us: they draw a picture anew.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.yaml"
        file.write_text(yaml.safe_dump(field(circles, about, substeps)))
        env = irsim.make(str(file), display=False, disable_all_plot=True, log_level="ERROR")
    rng, seconds, moved = np.random.default_rng(0), 0.0, False
    for k in range(WARM_UP + repeats):
        action = np.array([[rng.uniform(0.0, 1.0)], [rng.uniform(-2.0, 2.0)]])
        begin = time.perf_counter()
        for _ in range(substeps):
            env.step(action)
        seconds += time.perf_counter() - begin if k >= WARM_UP else 0.0
        ranges, moved = env.robot.lidar.range_data, moved or bool(np.any(env.robot.state[:2]))
        if env.robot.collision_flag:
            env.reset()
    if len(ranges) != about["beams"] or not moved:
        raise SystemExit("the robot did not move, or its lidar did not scan")
    env.end(0)
    return seconds / repeats


def main() -> None:
    """Prints the steps per second, by the number of substeps in a step."""
    given = json.loads(Path(sys.argv[1]).read_text())
    rates = {}
    for substeps in given["substeps"]:
        each = [
            steps(scene["circles"], {**given["about"], **scene}, given["repeats"], substeps)
            for scene in given["scenes"]
        ]
        rates[substeps] = len(each) / sum(each)
    sys.stdout.write("\n" + json.dumps(rates) + "\n")


if __name__ == "__main__":
    main()
