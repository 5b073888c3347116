"""Random commands at random intervals: does the gate ever exceed a limit?

The whole gate decides, on an injected clock. What it publishes is judged by finite differences
against the limits of the YAML file, by code that shares nothing with the gate: value (speed and
steering), its rate (acceleration and steering rate), the rate's rate (jerk). A stop has to be
exactly zero. Among the commands are NaN, inf and absurd ones, after which nothing may move; some
ticks come late, and now and then somebody presses the emergency stop.
"""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np
from measuring.gates import Gate, gate_config
from numpy.typing import NDArray

from nics_drl_bridge.config import find_config, parse_yaml, read_text
from nics_drl_bridge.kinematics.spec import load_robot
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.safety.inputs import Press
from nics_drl_bridge.safety.state import Decision

ROBOTS = ("ackermann", "differential", "mecanum")
LIDAR = LidarSpec(beams=8, angle_min=-3.0, angle_max=3.0, range_min=0.05, range_max=3.0, rate=10.0)
SHORTEST_S, LONGEST_S = 1e-3, 0.22
TOLERANCE = 1e-6
"""Of a finite difference: rounding of the published values, divided by the interval."""
ODD = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e3])
Array = NDArray[np.float64]


class Judge:
    """Compares what is published with the limits of the file.

    Attributes:
        violations: how often a limit was exceeded, by its name.
        sane: whether the newest command is one.
    """

    def __init__(self, robot: str) -> None:
        spec, path = load_robot(robot), find_config(robot, "limits")
        rows = parse_yaml(read_text(path), str(path))["commands"]
        each = [rows[variable.name] for variable in spec.command]
        self._low, self._high, self._rate, self._jerk = (
            np.array([row[key] for row in each]) for key in ("min", "max", "rate", "jerk")
        )
        self._spec = spec
        self._value, self._slope = np.zeros(len(each)), np.zeros(len(each))
        self._time, self.sane = -np.inf, True
        self.violations = dict.fromkeys(("value", "rate", "jerk", "stop", "odd", "unused"), 0)

    def see(self, decision: Decision, now: float) -> None:
        """Judges one decision of the gate."""
        if not decision.publish:
            return
        value = self._spec.from_cmd_vel(decision.twist)
        unused = not np.array_equal(self._spec.to_cmd_vel(value), decision.twist)
        self._count("unused", unused)
        self._count("odd", not self.sane and decision.twist.any())
        if decision.cause is not None:
            self._count("stop", decision.twist.any())
            self._value, self._slope, self._time = value, np.zeros_like(value), now
            return
        passed = now - self._time
        slope = (value - self._value) / passed
        inside = (value >= self._low) & (value <= self._high)  # False for NaN
        self._count("value", not inside.all())
        self._count("rate", not (np.abs(slope) <= self._rate * (1 + TOLERANCE)).all())
        change = np.abs(slope - self._slope) / passed
        self._count("jerk", not (change <= self._jerk * (1 + TOLERANCE)).all())
        self._value, self._slope, self._time = value, slope, now

    def _count(self, name: str, violated: object) -> None:
        self.violations[name] += bool(violated)


def drive(robot: str, steps: int, rng: np.random.Generator) -> tuple[dict[str, int], int]:
    """Violations by name of so many steps, and at how many of them the robot moved."""
    spec, judge = load_robot(robot), Judge(robot)
    gate = Gate(gate_config(spec, LIDAR), LIDAR)
    ranges, pose, twist = np.ones(LIDAR.beams, np.float32), np.zeros(3), np.zeros(3)
    gate.witness = judge.see
    sensed, moving = -np.inf, 0
    gaps = np.exp(rng.uniform(np.log(SHORTEST_S), np.log(LONGEST_S), steps))
    whims = rng.random(steps)
    for gap, whim in zip(gaps, whims, strict=True):
        if not gate.state.armed:
            gate.arm(ranges, pose)
            sensed = gate.now
        gate.now += float(gap)
        pose = pose + twist * gap
        if gate.now - sensed > 0.05:
            ranges = rng.uniform(0.5, 2.5, LIDAR.beams).astype(np.float32)
            gate.sense(ranges, pose, twist)
            sensed = gate.now
        if whim < 0.6:
            wish = spec.to_cmd_vel(_wish(judge, whim, rng))
            judge.sane = bool((np.abs(np.nan_to_num(wish, nan=np.inf)) < 1e2).all())
            gate.command(wish)
        elif whim > 1.0 - 1e-4:
            gate.give(Press())
        decision = gate.tick()
        if decision.publish:
            twist = decision.twist
        moving += bool(twist.any())
    return judge.violations, moving


def _wish(judge: Judge, whim: float, rng: np.random.Generator) -> Array:
    """A command (C,): within the limits, at them, beyond them, or nonsense."""
    low, high = judge._low, judge._high
    wish = rng.uniform(low, high)
    if whim < 0.2:
        wish = np.where(rng.random(len(low)) < 0.5, low, high)
    elif whim < 0.3:
        wish = wish * rng.uniform(1.0, 9.0)
    elif whim < 0.31:
        wish[rng.integers(len(wish))] = rng.choice(ODD)
    return np.asarray(wish)


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 after a violation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    total: dict[str, int] = {}
    moving = 0
    for index, robot in enumerate(ROBOTS):
        rng = np.random.default_rng([given.seed, index])
        steps = given.steps // len(ROBOTS) + (index < given.steps % len(ROBOTS))
        violations, moved = drive(robot, steps, rng)
        moving += moved
        total = {name: total.get(name, 0) + count for name, count in violations.items()}
        if not given.json:
            counts = ", ".join(f"{name} {count}" for name, count in violations.items())
            sys.stdout.write(f"{robot:<14}{steps} steps, {moved} in motion; violations: {counts}\n")
    violated = sum(total.values())
    if given.json:
        result = {"steps": given.steps, "violations": violated, "in_motion": moving, "by": total}
        sys.stdout.write(json.dumps(result) + "\n")
    raise SystemExit(1 if violated else 0)


if __name__ == "__main__":
    main()
