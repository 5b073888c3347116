"""The navigation task in ir-sim or irsim-x, in an environment of their own: see peers.py.

Reads a JSON file of scenes, says the ranges of each scene, and then answers each line that it
reads with the times of one more round. What is told on standard output is JSON, an object a line.
"""

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

SCANS = 20
"""That are timed in a round, each in the next scene."""
PERIODS = 50
"""Control periods that are timed together; the first begins an episode in the next scene."""


def content_of(scene: dict, about: dict) -> dict:
    """A world of circles and four walls, around a robot that collides as ours does."""
    lidar = {
        "name": "lidar2d",
        "number": about["beams"],
        "angle_range": about["angle_range"],
        "range_min": about["range_min"],
        "range_max": about["range_max"],
    }
    robot = {
        "kinematics": {"name": "diff"},
        "shape": {"name": "circle", "radius": about["footprint"]},
        "state": [0.0, 0.0, 0.0],
        "sensors": [lidar],
    }
    obstacles = [
        {"shape": {"name": "circle", "radius": about["radius"]}, "state": [x, y, 0.0]}
        for x, y in scene["circles"]
    ]
    x, y = about["half"]
    corners = [[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]]
    room = {
        "shape": {"name": "linestring", "vertices": corners},
        "state": [0.0, 0.0, 0.0],
    }
    obstacles.append(room)
    side = 4.0 * about["range_max"]
    field = {
        "width": side,
        "height": side,
        "offset": [-0.5 * side, -0.5 * side],
        "collision_mode": "stop",
        "step_time": about["period"] / about["substeps"],
    }
    return {"world": field, "robot": [robot], "obstacle": obstacles}


class Simulator:
    """One of the two, whose steps can be taken apart."""

    def __init__(self, scene: dict, about: dict) -> None:
        import irsim  # it prints while it is loaded

        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "world.yaml"
            file.write_text(yaml.safe_dump(content_of(scene, about)))
            self.env = irsim.make(
                str(file), display=False, disable_all_plot=True, log_level="ERROR"
            )
        self.compiled = getattr(self.env, "_cpp", None)
        # What their step calls, so that a scan alone is the same work as the scan within a step.
        self.scan = (
            self.env._objects_sensor_step
            if self.compiled is None
            else self.compiled._fast_sensor_step
        )

    def begin(self, scene: dict) -> None:
        """Begins an episode in another scene, by no more than it takes: `reset` would draw."""
        for circle, (x, y) in zip(self.env.obstacle_list, scene["circles"]):  # noqa: B905
            circle.set_state([x, y, 0.0], init=True)
        self.env.robot.set_state(scene["start"], init=True)
        self.env.robot.reset()
        if self.compiled is not None:
            self.compiled.build()
        self.env.refresh()

    def step(self, action: np.ndarray) -> None:
        """What they offer to users: a motion and a scan."""
        self.env.step(action)

    def move(self, action: np.ndarray) -> None:
        """A motion and its collision by their inner functions, past what they offer to users."""
        if self.compiled is not None:
            self.compiled._w.step(np.append(action, 0.0).astype(np.float32), 3)
            return
        self.env.robot.step(action, sensor_step=False)
        self.env.robot.check_status()

    @property
    def touched(self) -> bool:
        """Whether the robot has collided."""
        return bool(self.env.robot.collision_flag)


class Task:
    """Control periods of the task by random commands, one episode after the other."""

    def __init__(self, simulator: Simulator, scenes: list, about: dict) -> None:
        self.simulator = simulator
        self.scenes = scenes
        self.about = about
        self.rng = np.random.default_rng(0)
        self.at = -1
        self.periods = 0
        self.ended = 0
        self.moved = 0.0
        self.changed = 0
        self.next()

    def next(self) -> None:
        """Begins the next episode."""
        self.at = self.at + 1
        self.steps = 0
        self.scene = self.scenes[self.at % len(self.scenes)]
        self.simulator.begin(self.scene)
        self.distance, bearing = self.towards()
        self.seen = self.observation(self.distance, bearing)

    def towards(self) -> tuple[float, float]:
        """Distance [m] and bearing [rad] of the goal."""
        x, y, heading = self.simulator.env.robot.state[:3, 0]
        dx = self.scene["goal"][0] - x
        dy = self.scene["goal"][1] - y
        return math.hypot(dx, dy), math.atan2(dy, dx) - heading

    def observation(self, distance: float, bearing: float) -> np.ndarray:
        """What our task shows: the scan in shares, where the goal is, and the twist."""
        robot = self.simulator.env.robot
        speed, turn = robot.velocity[:2, 0]
        rest = [distance, math.cos(bearing), math.sin(bearing), speed, 0.0, turn]
        shares = robot.lidar.range_data / self.about["range_max"]
        return np.concatenate([shares, rest]).astype(np.float32)

    def drive(self, action: np.ndarray) -> None:
        """The motion of a control period, and its scans."""
        substeps = self.about["substeps"]
        for _ in range(substeps - 1):
            self.simulator.move(action)
            if self.simulator.touched:
                break
        self.simulator.step(action)

    def periods_of(self, chunk: int) -> None:
        """So many control periods, from the begin of an episode."""
        self.next()
        for _ in range(chunk):
            self.period()

    def period(self) -> float:
        """Motion, scan, observation, reward, and the next episode's begin."""
        about = self.about
        before = self.distance
        robot = self.simulator.env.robot
        action = np.array([[self.rng.uniform(0.0, 1.0)], [self.rng.uniform(-2.0, 2.0)]])
        was_seen, (x, y) = self.seen, robot.state[:2, 0].tolist()
        self.drive(action)
        self.steps = self.steps + 1
        self.periods = self.periods + 1
        self.distance, bearing = self.towards()
        self.seen = self.observation(self.distance, bearing)
        beams = about["beams"]
        self.changed += int(np.count_nonzero(self.seen[:beams] != was_seen[:beams]))
        self.moved += math.hypot(robot.state[0, 0] - x, robot.state[1, 0] - y)
        touched = self.simulator.touched
        there = self.distance < about["goal_radius"]
        reward = before - self.distance - 0.01 + 10.0 * there - 10.0 * touched
        if touched or there or self.steps >= about["limit"]:
            self.ended += 1
            self.next()
        return reward


def timed(call: Callable[..., object], *arguments: object) -> float:
    """Seconds of the processor that a call takes: other work on the machine does not count."""
    begin = time.process_time()
    call(*arguments)
    return time.process_time() - begin


class Readings:
    """All readings, each a little further in every round."""

    def __init__(self, given: dict) -> None:
        self.scenes = given["scenes"]
        about = given["about"]
        self.simulator = Simulator(self.scenes[0], about)
        self.at = 0
        self.task = Task(Simulator(self.scenes[0], about), self.scenes, about)

    def ranges(self) -> list[list[float]]:
        """Of a scan at the start in each scene [m]."""
        found = []
        for scene in self.scenes:
            self.simulator.begin(scene)
            self.simulator.scan()
            found.append(
                [float(value) for value in self.simulator.env.robot.lidar.range_data]
            )
        return found

    def time_scans(self) -> list[float]:
        """Times of a scan alone, once its scene is in the caches [s]."""
        times = []
        for _ in range(SCANS):
            self.simulator.begin(self.scenes[self.at % len(self.scenes)])
            self.at += 1
            self.simulator.scan()
            times.append(timed(self.simulator.scan))
        return times

    def round(self) -> dict[str, list[float]]:
        """Times of every reading [s]."""
        times = {"scan": self.time_scans()}
        times["period"] = [timed(self.task.periods_of, PERIODS) / PERIODS]
        return times

    def drove(self) -> dict[str, float]:
        """What shows that the robots of the tasks moved and saw."""
        task = self.task
        return {
            "moved_m_per_period": task.moved / task.periods,
            "beams_changed_per_period": task.changed / task.periods,
            "episodes": task.ended,
        }


def main() -> None:
    """Answers until nothing more is asked."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever they print is no answer
    readings = Readings(json.loads(Path(sys.argv[1]).read_text()))
    answers.write(json.dumps({"ranges": readings.ranges()}) + "\n")
    answers.flush()
    for _ in sys.stdin:
        told = {"times": readings.round(), **readings.drove()}
        answers.write(json.dumps(told) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
