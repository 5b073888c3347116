"""Drives of robots and simulators of any engine."""

import numpy as np

from nics_drl_bridge.extras.physics.simulator import (
    PhysicsRobot,
    PhysicsSimulator,
    Reading,
)
from nics_drl_bridge.generator import SimulatorModel


def drive_steadily(
    robot: PhysicsRobot, command, settle_s: float = 1.0
) -> tuple[np.ndarray, np.ndarray, Reading]:
    """Mean twist (3,) and state of half a second under a command, and the last reading."""
    robot.reset(np.zeros(3))
    robot.step(command, settle_s)
    readings = [robot.step(command, 0.01) for _ in range(50)]
    twist = np.mean([reading.twist for reading in readings], axis=0)
    state = np.mean([reading.state for reading in readings], axis=0)
    return twist, state, readings[-1]


def forward(model: SimulatorModel, speed: float, robots: int = 1) -> np.ndarray:
    """A command straight ahead for each robot (1, M, C)."""
    command = np.zeros((1, robots, len(model.robot.command)))
    command[..., 0] = speed
    return command


def drive(simulator: PhysicsSimulator, command: np.ndarray, steps: int) -> None:
    for _ in range(steps):
        simulator.step(command)
