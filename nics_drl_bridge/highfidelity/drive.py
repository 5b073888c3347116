"""Records a drive of a robot in MuJoCo."""

from __future__ import annotations

import numpy as np

from nics_drl_bridge.highfidelity.robot import MujocoRobot
from nics_drl_bridge.kinematics.recording import Recording, Stream


def record(
    robot: MujocoRobot,
    rng: np.random.Generator,
    duration: float = 60.0,
    dt: float = 0.01,
    hold: float = 0.5,
) -> Recording:
    """Drives at random and records, as `textbook.record` does with the textbook's robot.

    Args:
        robot: is reset to the origin first.
        rng: draws the commands, uniform within their limits, anew every `hold` seconds.
        duration: of the drive [s].
        dt: sample period, a whole number of the robot's time steps [s].
        hold: how long a command is held [s].

    Returns:
        Command, pose and state on one clock.

    Raises:
        BackendError: the robot fell over.
    """
    spec = robot.spec
    per_hold, holds = round(hold / dt), int(np.ceil(duration / hold))
    held = rng.uniform(spec.command_low, spec.command_high, (holds, len(spec.command)))
    commands = np.repeat(held, per_hold, axis=0)
    reading = robot.reset(np.zeros(3))
    poses, states = [], []
    for command in commands:
        poses.append(reading.pose)
        states.append(reading.state)
        reading = robot.step(command, dt)
    t = np.asarray(np.arange(len(commands)) * dt, dtype=np.float64)
    return Recording(
        Stream(t, commands),
        Stream(t, np.array(poses)),
        Stream(t, np.array(states)),
        source=f"MuJoCo {spec.name}",
        variables=spec.variable_names,
    )
