"""The navigation task in ir-sim or irsim-x, in an environment of their own: see env_throughput.py.

Reads a JSON file of scenes, and prints one JSON object.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import irsim
import numpy as np
import yaml
from irsim_scans import world

CHUNK = 50
"""Steps that are timed together: about one begin of an episode is among them."""


def whole_steps(env: irsim.EnvBase, action: np.ndarray, substeps: int) -> None:
    """A control period by their own steps, each of which scans."""
    for _ in range(substeps):
        env.step(action)
        if env.robot.collision_flag:
            return


def one_scan(env: irsim.EnvBase, action: np.ndarray, substeps: int) -> None:
    """A control period of which only the last substep scans: robot and collision alone before it.

    Of irsim-x it takes the compiled world itself, past what it offers to users.
    """
    for _ in range(substeps - 1):
        if hasattr(env, "_cpp"):
            env._cpp._w.step(np.append(action, 0.0).astype(np.float32), 3)
            continue
        env.robot.step(action, sensor_step=False)
        env.robot.check_status()
        if env.robot.collision_flag:
            break
    env.step(action)


WAYS: dict[str, Callable[[irsim.EnvBase, np.ndarray, int], None]] = {
    "whole_steps": whole_steps,
    "one_scan": one_scan,
}


def made(scene: dict, about: dict) -> irsim.EnvBase:
    """The circles and the four walls around a robot that collides, as ours does; nothing drawn."""
    content = world(scene["circles"], about)
    x, y = about["half"]
    corners = [[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]]
    content["obstacle"].append({"shape": {"name": "linestring", "vertices": corners}})
    content["world"]["collision_mode"] = "stop"
    content["world"]["step_time"] = about["period"] / about["substeps"]
    content["robot"][0]["shape"]["radius"] = about["footprint"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.yaml"
        file.write_text(yaml.safe_dump(content))
        return irsim.make(str(file), display=False, disable_all_plot=True, log_level="ERROR")


def begin(env: irsim.EnvBase, scene: dict) -> None:
    """Begins an episode in another scene, by no more than it takes: `reset` would draw."""
    for circle, (x, y) in zip(env.obstacle_list, scene["circles"]):  # noqa: B905
        circle.set_state([x, y, 0.0], init=True)
    env.robot.set_state(scene["start"], init=True)
    env.robot.reset()
    if hasattr(env, "_cpp"):
        env._cpp.build()
    env.refresh()


def towards(env: irsim.EnvBase, goal: list[float]) -> tuple[float, float]:
    """Distance [m] and bearing [rad] of the goal."""
    x, y, heading = env.robot.state[:3, 0]
    dx, dy = goal[0] - x, goal[1] - y
    return math.hypot(dx, dy), math.atan2(dy, dx) - heading


def observation(env: irsim.EnvBase, about: dict, distance: float, bearing: float) -> np.ndarray:
    """What our task shows: the scan in shares, where the goal is, and the twist."""
    speed, turn = env.robot.velocity[:2, 0]
    rest = [distance, math.cos(bearing), math.sin(bearing), speed, 0.0, turn]
    shares = env.robot.lidar.range_data / about["range_max"]
    return np.concatenate([shares, rest]).astype(np.float32)


class Episodes:
    """Steps of the task by random commands, one episode after the other."""

    def __init__(self, scenes: list[dict], about: dict, way: str) -> None:
        self.scenes, self.about, self.way = scenes, about, WAYS[way]
        self.env, self.episodes, self.moved = made(scenes[0], about), -1, False
        self.rng = np.random.default_rng(0)
        self.next()

    def next(self) -> None:
        """Begins the next episode."""
        self.episodes, self.steps = self.episodes + 1, 0
        self.scene = self.scenes[self.episodes % len(self.scenes)]
        begin(self.env, self.scene)
        self.distance, bearing = towards(self.env, self.scene["goal"])
        self.seen = observation(self.env, self.about, self.distance, bearing)

    def step(self) -> float:
        """One step of the task: motion, scan, observation, reward, and the next episode's begin."""
        about, before = self.about, self.distance
        action = np.array([[self.rng.uniform(0.0, 1.0)], [self.rng.uniform(-2.0, 2.0)]])
        self.way(self.env, action, about["substeps"])
        self.steps += 1
        self.distance, bearing = towards(self.env, self.scene["goal"])
        self.seen = observation(self.env, about, self.distance, bearing)
        touched, there = self.env.robot.collision_flag, self.distance < about["goal_radius"]
        reward = before - self.distance - 0.01 + 10.0 * there - 10.0 * touched
        self.moved = self.moved or before != self.distance
        if touched or there or self.steps >= about["limit"]:
            self.next()
        return reward


def rate(scenes: list[dict], about: dict, way: str, repeats: int) -> float:
    """Steps per second: the median of chunks."""
    task, times = Episodes(scenes, about, way), []
    for _ in range(1 + repeats):
        start = time.perf_counter()
        for _ in range(CHUNK):
            task.step()
        times.append((time.perf_counter() - start) / CHUNK)
    if len(task.env.robot.lidar.range_data) != about["beams"] or not task.moved:
        raise SystemExit("the robot did not move, or its lidar did not scan")
    sys.stderr.write(f"{way}: {task.episodes} episodes\n")
    task.env.end(0)
    return 1.0 / median(times[1:])


def main() -> None:
    """Prints the steps per second of each way."""
    given = json.loads(Path(sys.argv[1]).read_text())
    rates = {way: rate(given["scenes"], given["about"], way, given["repeats"]) for way in WAYS}
    sys.stdout.write("\n" + json.dumps(rates) + "\n")


if __name__ == "__main__":
    main()
