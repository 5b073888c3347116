"""Random commands at random intervals: does the gate ever exceed a limit?

The whole gate decides, on an injected clock. What it publishes is judged by finite differences
against the limits of the YAML file, by code that shares nothing with the gate: value (speed and
steering), its rate (acceleration and steering rate), the rate's rate (jerk). A stop has to be
exactly zero. Among the commands are NaN, inf and absurd ones, after which nothing may move; some
ticks come late, and now and then somebody presses the emergency stop. A part of the steps is driven
with limits drawn at random, from plausible ones to 1e-308 and 1e308; there what is published has to
be numbers within them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from campaign import Given, Result, at_least, at_most, run_campaign
from numpy.typing import NDArray
from parts.gates import gate_config

from nics_drl_bridge.config import find_config, parse_yaml, read_text
from nics_drl_bridge.gate.assurance.limit_judge import VIOLATIONS, LimitJudge
from nics_drl_bridge.gate.gate_loop import Gate
from nics_drl_bridge.gate.inputs import Press
from nics_drl_bridge.gate.limits import Limits
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

ROBOTS = ("ackermann", "differential", "mecanum")
LIDAR = LidarSpec(
    beams=8, angle_min=-3.0, angle_max=3.0, range_min=0.05, range_max=3.0, rate=10.0
)
SHORTEST_S = 1e-3
LONGEST_S = 0.22
ODD = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e3])
LEAST_MOTION = 0.8
"""Of the steps within shipped limits are to be in motion; a late tick stops it for 0.2 s."""
RANDOM_SHARE, WITH_ONE = 4, 200
"""One in so many steps has random limits, which are redrawn after so many steps."""
FASTEST = 50.0
"""What odometry shows at most [m/s, rad/s]."""
Array = NDArray[np.float64]


def read_limits(spec: RobotSpec, shipped: Limits) -> Limits:
    """The limits as they stand in the YAML file, past the code that reads them for the gate."""
    path = find_config(spec.name, "limits")
    rows = parse_yaml(read_text(path), str(path))["commands"]
    each = [rows[variable.name] for variable in spec.command]
    low, high, rate, jerk = (
        np.array([row[key] for row in each]) for key in ("min", "max", "rate", "jerk")
    )
    return replace(shipped, low=low, high=high, rate=rate, jerk=jerk)


def random_limits(spec: RobotSpec, shipped: Limits, rng: np.random.Generator) -> Limits:
    """Limits of a robot: plausible ones, or of any size that a float has."""
    widest = 1.0 if rng.random() < 0.5 else 308.0
    low, high, rate, jerk = 10.0 ** rng.uniform(-widest, widest, (4, len(spec.command)))
    return replace(shipped, low=-low, high=high, rate=rate, jerk=jerk)


def drive(
    spec: RobotSpec, steps: int, rng: np.random.Generator, control: str, random: bool
) -> tuple[dict[str, int], int]:
    """Violations by name of so many steps, and at how many of them the robot moved."""
    config = gate_config(spec, LIDAR)
    assert config.limits is not None
    drawn = random_limits(spec, config.limits, rng) if random else None
    limits = drawn or config.limits
    judged = drawn or read_limits(spec, config.limits)
    # Of limits of any size, rounding may be all there is to a slope.
    judge = LimitJudge(spec, judged, slopes=drawn is None)
    if control == "no_limits":
        wide = {
            key: 100.0 * getattr(limits, key) for key in ("low", "high", "rate", "jerk")
        }
        limits = replace(limits, **wide)
    gate = Gate(replace(config, limits=limits), LIDAR)
    ranges = np.ones(LIDAR.beams, np.float32)
    pose = np.zeros(3)
    twist = np.zeros(3)

    gate.witness = judge.see
    sensed = -np.inf
    moving = 0
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
            wish = spec.to_cmd_vel(_wish(judged, whim, rng))
            wish = np.zeros(3) if control == "standing" else wish
            reach = 50.0 * np.maximum(-judged.low, judged.high)
            asked = np.abs(spec.from_cmd_vel(wish)) < reach
            judge.sane = bool(np.isfinite(wish).all() and asked.all())
            gate.command(wish)
        elif whim > 1.0 - 1e-4:
            gate.give(Press())
        decision = gate.tick()
        if decision.publish:
            twist = np.clip(np.nan_to_num(decision.twist), -FASTEST, FASTEST)
        moving += bool(decision.twist.any())
    return judge.violations, moving


def _wish(limits: Limits, whim: float, rng: np.random.Generator) -> Array:
    """A command (C,): within the limits, at them, beyond them, or nonsense."""
    low = limits.low
    high = limits.high
    share = rng.random(len(low))
    wish = low * share + high * (1.0 - share)
    if whim < 0.2:
        wish = np.where(rng.random(len(low)) < 0.5, low, high)
    elif whim < 0.3:
        wish = wish * rng.uniform(1.0, 9.0)
    elif whim < 0.31:
        wish[rng.integers(len(wish))] = rng.choice(ODD)
    return np.asarray(wish)


def measure(given: Given) -> Result:
    """Drives each robot within its shipped limits, and for some steps within random ones."""
    total: Counter[str] = Counter(dict.fromkeys(VIOLATIONS, 0))
    steps = Counter[bool]()
    moving = Counter[bool]()
    for index, robot in enumerate(ROBOTS):
        rng = np.random.default_rng([given.seed, index])
        spec = load_robot(robot)
        own = given.steps // len(ROBOTS) + (index < given.steps % len(ROBOTS))
        others = own // RANDOM_SHARE
        parts = [(own - others, False)]
        parts += [(WITH_ONE, True)] * (others // WITH_ONE)
        parts += [(others % WITH_ONE, True)]
        for count, random in parts:
            with np.errstate(over="ignore", invalid="ignore"):
                violations, moved = drive(spec, count, rng, given.control or "", random)
            total.update(violations)
            steps[random] += count
            moving[random] += moved
    return {
        "steps": given.steps,
        "violations": sum(total.values()),
        "in_motion": moving[False] + moving[True],
        "share_in_motion": moving[False] / max(steps[False], 1),
        "in_motion_with_random_limits": moving[True],
        "by": dict(total),
    }


BARS = {
    "violations": at_most(0),
    "share_in_motion": at_least(LEAST_MOTION),
    "in_motion_with_random_limits": at_least(1),
}

if __name__ == "__main__":
    run_campaign(measure, BARS, {"steps": 100_000, "seed": 0})
