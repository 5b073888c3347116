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

from nics_drl_bridge.config import find_config, parse_yaml, read_text
from nics_drl_bridge.gate.assurance.episodes import configure_gate
from nics_drl_bridge.gate.assurance.limit_judge import VIOLATIONS, LimitJudge
from nics_drl_bridge.gate.gate_loop import Gate
from nics_drl_bridge.gate.inputs import Press
from nics_drl_bridge.gate.limits import Limits
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec

ROBOTS = ("ackermann", "differential", "mecanum")
LIDAR = LidarSpec(
    beams=8, angle_min=-3.0, angle_max=3.0, range_min=0.05, range_max=3.0, rate=10.0
)
GAPS_S = (1e-3, 0.22)
ODD = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e3])
# A late tick stops the robot for 0.2 s.
LEAST_MOTION = 0.8  # fraction of the steps within shipped limits
RANDOM_PARTS = 4  # one of so many steps has random limits
WITH_ONE = 200  # steps after which limits are drawn again
FASTEST = 50.0  # that odometry shows [m/s, rad/s]
KEYS = {"low": "min", "high": "max", "rate": "rate", "jerk": "jerk"}
BARS = {
    "violations": at_most(0),
    "share_in_motion": at_least(LEAST_MOTION),
    "in_motion_with_random_limits": at_least(1),
}


def read_limits(spec: RobotSpec, shipped: Limits) -> Limits:
    """Returns the limits as they stand in the YAML file, past the code that the gate uses."""
    path = find_config(spec.name, "limits")
    rows = parse_yaml(read_text(path), str(path))["commands"]
    own = [rows[variable.name] for variable in spec.command]
    values = {name: np.array([row[key] for row in own]) for name, key in KEYS.items()}
    return replace(shipped, **values)


def draw_limits(spec: RobotSpec, shipped: Limits, rng: np.random.Generator) -> Limits:
    """Returns limits of a robot: plausible ones, or of any size that a float has."""
    widest = 1.0 if rng.random() < 0.5 else 308.0
    low, high, rate, jerk = 10.0 ** rng.uniform(-widest, widest, (4, len(spec.command)))
    return replace(shipped, low=-low, high=high, rate=rate, jerk=jerk)


def drive(
    model: SimulatorModel,
    steps: int,
    rng: np.random.Generator,
    control: str,
    is_random: bool,
) -> tuple[dict[str, int], int]:
    """Returns the violations by name of so many steps, and at how many of them the robot moved."""
    spec = model.robot
    config = configure_gate(model, spec.name, shielded=False)
    limits = config.limits
    judged = read_limits(spec, limits)
    if is_random:
        limits = judged = draw_limits(spec, limits, rng)
    # Of limits of any size, rounding may be all there is to a slope.
    judge = LimitJudge(spec, judged, slopes=not is_random)
    if control == "no_limits":
        wide = {name: 100.0 * getattr(limits, name) for name in KEYS}
        limits = replace(limits, **wide)
    gate = Gate(replace(config, limits=limits), LIDAR)
    gate.witness = judge.see
    ranges = np.ones(LIDAR.beams, np.float32)
    pose = np.zeros(3)
    twist = np.zeros(3)
    sensed_s = -np.inf
    moving = 0
    for gap_s in np.exp(rng.uniform(*np.log(GAPS_S), steps)):
        whim = rng.random()
        if not gate.state.armed:
            gate.arm(ranges, pose)
            sensed_s = gate.now
        gate.now += float(gap_s)
        pose = pose + twist * gap_s
        if gate.now - sensed_s > 0.05:
            ranges = rng.uniform(0.5, 2.5, LIDAR.beams).astype(np.float32)
            gate.sense(ranges, pose, twist)
            sensed_s = gate.now
        if whim < 0.6:
            wish = spec.to_cmd_vel(draw_wish(judged, whim, rng))
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


def draw_wish(limits: Limits, whim: float, rng: np.random.Generator) -> Array:
    """Returns a command (C,): within the limits, at them, beyond them, or nonsense."""
    wish = rng.uniform(0.0, 1.0, len(limits.low))
    wish = limits.low * wish + limits.high * (1.0 - wish)
    if whim < 0.2:
        wish = np.where(rng.random(len(wish)) < 0.5, limits.low, limits.high)
    elif whim < 0.3:
        wish = wish * rng.uniform(1.0, 9.0)
    elif whim < 0.31:
        wish[rng.integers(len(wish))] = rng.choice(ODD)
    return np.asarray(wish)


def measure(given: Given) -> Result:
    """Drives each robot within its shipped limits, and for some steps within random ones."""
    total = Counter(dict.fromkeys(VIOLATIONS, 0))
    steps = Counter[bool]()
    moving = Counter[bool]()
    for index, robot in enumerate(ROBOTS):
        rng = np.random.default_rng([given.seed, index])
        model = replace(builtin_model(robot), lidar=LIDAR)
        own = given.steps // len(ROBOTS) + (index < given.steps % len(ROBOTS))
        others = own // RANDOM_PARTS
        parts = [(own - others, False), (others % WITH_ONE, True)]
        parts += [(WITH_ONE, True)] * (others // WITH_ONE)
        for count, is_random in parts:
            about = model, count, rng, given.control or "", is_random
            with np.errstate(over="ignore", invalid="ignore"):
                violations, moved = drive(*about)
            total.update(violations)
            steps[is_random] += count
            moving[is_random] += moved
    return {
        "steps": given.steps,
        "violations": total.total(),
        "in_motion": moving.total(),
        "share_in_motion": moving[False] / max(steps[False], 1),
        "in_motion_with_random_limits": moving[True],
        "by": dict(total),
    }


if __name__ == "__main__":
    run_campaign(measure, BARS, {"steps": 100_000, "seed": 0})
