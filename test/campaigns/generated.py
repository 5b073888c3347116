"""Whether a simulator generated from a drive in a physics engine predicts the robot's true motion.

Each shipped robot drives at random in MuJoCo, DART and PyBullet, and records what its driver would
publish: commands, encoders, and a pose by odometry. Where wheels skid, odometry takes the turn rate
from a gyro with noise and bias. A model is made of that drive as `nics generate` makes it. Then the
robot drives again by other commands, by which alone the model predicts its true pose 5 s ahead.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from campaign import Given, Result, at_least, at_most, run_campaign, some_of, tell
from fidelity import average_drives
from transfer import SIMULATORS, find_engines, make_simulator

from nics_drl_bridge.extras.physics.simulator import PhysicsSimulator
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.sim.world import load_world

ROBOTS = ("ackermann", "differential", "jackal", "mecanum")
GYRO = {"gyro_bias": 0.001, "gyro_noise": 0.01}  # [rad/s]
WIDE = load_world("empty").model_copy(update={"size": (400.0, 400.0)})
ROW_S = 0.05  # between two rows of a recording
BEAMS = 8  # of a lidar that nothing here reads
HOLD_S = 0.5
UNSEEN_HOLDS_S = (0.4, 0.8, 1.6)  # of the unseen drives, in turn
UNSEEN_SEED = 201
EACH = {
    "position_error_over_path": at_most(0.02, "error over the path"),
    "mean_path_m": at_least(0.1, "path of 5 s [m]"),
}
BARS = {"engines": {"*": {"*": EACH}}}


def record(
    simulator: PhysicsSimulator, seed: int, duration: float, hold: float, is_true: bool
) -> Recording:
    """Drives at random with commands held [s]; the pose is the true one, or by odometry."""
    spec = simulator.model.robot
    rng = np.random.default_rng(seed)
    simulator.reset([seed], starts=np.zeros((1, 1, 3)))
    data = simulator.data
    held = rng.uniform(
        spec.command_low, spec.command_high, (round(duration / hold), len(spec.command))
    )
    commands = np.repeat(held, round(hold / ROW_S), axis=0)
    poses = []
    states = []
    for command in commands:
        poses.append((data.pose if is_true else data.odom)[0, 0].copy())
        states.append(data.state[0, 0].copy())
        simulator.step(command[None, None])
    t = ROW_S * np.arange(len(commands))
    streams = (Stream(t, np.array(each)) for each in (commands, poses, states))
    return Recording(
        *streams,
        source=f"{spec.name} in {type(simulator).__name__}",
        variables=spec.variable_names,
        measured_by="truth" if is_true else "odometry",
    )


def judge_generated(engine: str, robot: str, given: Given) -> dict[str, float]:
    """Records, generates, and returns the errors on unseen drives."""
    model = builtin_model(robot)
    lidar = model.lidar.model_copy(update={"beams": BEAMS})
    table = bake(lidar, model.table.shapes)
    model = replace(model, control_period=ROW_S, lidar=lidar, table=table)
    simulator: Any = make_simulator(engine, model, WIDE, **GYRO)
    spec = model.robot
    found = identify(
        record(simulator, given.seed, given.train, HOLD_S, is_true=False),
        spec,
        alpha="auto",
    )
    if given.control == "standing":
        still = replace(found.model, coefficients=1e-9 * found.model.coefficients)
        found = replace(found, model=still)
    unseen = [
        record(simulator, UNSEEN_SEED + n, given.unseen, hold, is_true=True)
        for n, hold in enumerate(UNSEEN_HOLDS_S)
    ]
    return average_drives(found, unseen, spec)


def measure(given: Given) -> Result:
    """Generates a model of each robot in each engine that is installed."""
    engines, left_out = find_engines(given.engines)
    result: Result = {engine: {} for engine in engines}
    for engine, robot in product(engines, given.robots):
        figures = judge_generated(engine, robot, given)
        tell(f"{robot} in {engine}: {figures}")
        result[engine][robot] = figures
    return {"engines": result, "left_out": left_out}


OPTIONS = {
    "engines": some_of(tuple(SIMULATORS)),
    "robots": some_of(ROBOTS),
    "train": (120.0, "recorded seconds"),
    "unseen": (30.0, "seconds of each unseen drive"),
    "seed": 7,
}

if __name__ == "__main__":
    run_campaign(measure, BARS, OPTIONS)
