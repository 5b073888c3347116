"""Bits of the fast simulator where its bodies lie in cells, and where scans are late and skewed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.sim.barn import barn_world
from nics_drl_bridge.sim.simulator import FastSimulator, Sizes
from nics_drl_bridge.sim.world import World

from .projection import Found, joined

HELD_STEPS = 10  # for which a random command is held
BARN_NUMBERS = (1, 100, 299)
BARN_STEPS = 300
# Of coefficients: the last digits of a fit depend on the processor, and so does a beam at an edge.
DIGITS = 10
CROWD_ROBOTS = 40
CROWD_OBSTACLES = 70
CROWD_STEPS = 60
TEAM_TASKS = {"cooperative_reaching": {"robots": 3}, "pursuit_evasion": {}}
TEAM_STEPS = 80
SCAN_STEPS = 100
LONGEST_AGE = 15  # of scan and odometry [substeps]
SKEWS = ("none", "counter_clockwise", "clockwise")


def barn() -> Found:
    """A robot among the cylinders of some BARN worlds, which lie in order in their cells."""
    model = round_coefficients(builtin_model("jackal"))
    found: Found = {}
    for number in BARN_NUMBERS:
        simulator = FastSimulator(model, barn_world(number), worlds=2, renderer="auto")
        commands = forward_commands(model, (2, 1), BARN_STEPS, seed=number)
        found[f"world {number}"] = drive(simulator, commands, episode_steps=100)
    return found


def round_coefficients(model: SimulatorModel) -> SimulatorModel:
    """Returns a model that is the same on all processors."""
    kinematics = model.kinematics
    digits = [float(f"{value:.{DIGITS}g}") for value in kinematics.coefficients.ravel()]
    rounded = np.reshape(digits, kinematics.coefficients.shape)
    return replace(model, kinematics=replace(kinematics, coefficients=rounded))


def team() -> Found:
    """Robots that see and touch each other: a crowd of them in cells, and small teams."""
    found: Found = {"crowd in cells": crowd_in_cells()}
    for task, options in TEAM_TASKS.items():
        found[task] = drive_team(task, options)
    return found


def crowd_in_cells() -> list[float]:
    """Many robots among many obstacles."""
    sizes = Sizes(1, CROWD_ROBOTS, CROWD_OBSTACLES, longest_delay=0, longest_age=0)
    assert sizes.crowded, "so few robots and obstacles are not sorted into cells"
    model = builtin_model("differential")
    world = field(size=16.0, obstacles=CROWD_OBSTACLES)
    simulator = FastSimulator(
        model, world, worlds=1, robots=CROWD_ROBOTS, renderer="auto"
    )
    commands = forward_commands(model, (1, CROWD_ROBOTS), CROWD_STEPS, seed=4)
    return drive(simulator, commands, episode_steps=CROWD_STEPS)


def drive_team(task: str, options: dict[str, int]) -> list[float]:
    """What the robots of a team task observe and earn under random actions."""
    env = BridgeVectorEnv(
        4, "differential", "arena", task, task_options=options, max_episode_steps=30
    )
    observation, _ = env.reset(seed=8)
    rng = np.random.default_rng(9)
    arrays = [observation.copy()]
    for _ in range(TEAM_STEPS):
        action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        arrays += [observation.copy(), reward, terminated, truncated]
    env.close()
    return joined(arrays)


def scans() -> Found:
    """Scans of a lidar that turns while the robot moves, and that are late when they are seen."""
    found: Found = {}
    for skew in SKEWS:
        for renderer in ("exact", "baked"):
            found[f"{skew} {renderer}"] = drive_with_lidar(skew, renderer)
    return found


def drive_with_lidar(skew: str, renderer: str) -> list[float]:
    """A drive with a skewed, noisy lidar, whose scans are as old as each robot's own age."""
    model = with_lidar_faults(builtin_model("mecanum"), skew)
    simulator = FastSimulator(
        model,
        field(size=8.0, obstacles=6),
        worlds=3,
        robots=2,
        renderer=renderer,
        longest_age=LONGEST_AGE,
    )
    ages = np.random.default_rng(6).integers(
        0, LONGEST_AGE + 1, simulator.data.age.shape
    )
    simulator.data.age[:] = ages
    commands = forward_commands(model, (3, 2), SCAN_STEPS, seed=7)
    return drive(simulator, commands, episode_steps=40)


def with_lidar_faults(model: SimulatorModel, skew: str) -> SimulatorModel:
    """Returns a model whose lidar has faults."""
    faults = {
        "skew": skew,
        "dropout": 0.05,
        "dropout_far": 0.1,
        "noise_proportional": 0.01,
    }
    changed = model.lidar.model_dump() | {"noise_std": 0.01, "faults": faults}
    return replace(model, lidar=LidarSpec.model_validate(changed))


def field(size: float, obstacles: int) -> World:
    """A square field with round and rectangular obstacles."""
    shapes = [
        {"kind": "circle", "radius": 0.2},
        {"kind": "rectangle", "size": [0.4, 0.3]},
    ]
    group = {"shapes": shapes, "count": obstacles, "gap": 0.3}
    return World.model_validate(
        {
            "name": "field",
            "size": [size, size],
            "obstacles": [group],
            "clearance": 0.1,
            "goal_distance": [1.0, 4.0],
        }
    )


def forward_commands(
    model: SimulatorModel, shape: tuple[int, int], steps: int, seed: int
) -> Iterator[NDArray[np.float64]]:
    """Yields random commands (N, M, C), each held for some steps; the first one leads ahead."""
    rng = np.random.default_rng(seed)
    robot = model.robot
    low = robot.command_low.copy()
    low[0] = 0.2 * robot.command_high[0]
    for step in range(steps):
        if step % HELD_STEPS == 0:
            command = rng.uniform(low, robot.command_high, (*shape, len(low)))
        yield command


def drive(
    simulator: FastSimulator,
    commands: Iterator[NDArray[np.float64]],
    episode_steps: int,
) -> list[float]:
    """Digest of poses, odometry, ranges and contacts; a new episode begins now and then."""
    arrays = []
    contacts = 0
    worlds = len(simulator.data.steps)
    for step, command in enumerate(commands):
        if step % episode_steps == 0:
            simulator.reset(np.arange(worlds) + step)
        simulator.step(command)
        data = simulator.data
        contacts += int(data.collided.sum())
        for array in (data.pose, data.odom, data.twist, data.ranges, data.collided):
            arrays.append(array.copy())
    assert contacts > 0, "no robot touched anything"
    return joined(arrays)
