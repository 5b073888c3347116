"""Whole steps of ir-sim or irsim-x, in an environment of their own: see env_throughput.py.

Reads a JSON file of scenes, and prints one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import irsim
import numpy as np
import yaml
from irsim_scans import world

WARM_UP = 3
EPISODE = 25


def steps(circles: list[list[float]], about: dict, repeats: int) -> list[float]:
    """Times of many steps [s]: the robot moves by a random command, and its lidar scans."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.yaml"
        scene = world(circles, about)
        scene["world"]["step_time"] = about["period"]
        file.write_text(yaml.safe_dump(scene))
        env = irsim.make(str(file), display=False, disable_all_plot=True, log_level="ERROR")
    rng, times = np.random.default_rng(0), []
    for k in range(WARM_UP + repeats):
        if k % EPISODE == 0:
            env.reset()
        action = np.array([[rng.uniform(0.0, 1.0)], [rng.uniform(-2.0, 2.0)]])
        begin = time.perf_counter()
        env.step(action)
        ranges = env.robot.lidar.range_data
        times.append(time.perf_counter() - begin)
    if len(ranges) != about["beams"] or not np.any(env.robot.state[:2]):
        raise SystemExit("the robot did not move, or its lidar did not scan")
    env.end(0)
    return times[WARM_UP:]


def main() -> None:
    """Prints the steps per second."""
    given = json.loads(Path(sys.argv[1]).read_text())
    times = [steps(circles, given["about"], given["repeats"]) for circles in given["scenes"]]
    middle = median(seconds for each in times for seconds in each)
    sys.stdout.write("\n" + json.dumps({"steps_per_s": 1.0 / middle}) + "\n")


if __name__ == "__main__":
    main()
