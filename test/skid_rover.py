"""A skid-steer that turns more slowly than it drives: its turn rate lags, its speed has a limit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.spec import RobotSpec, build_robot
from nics_drl_bridge.robot.taylor import TaylorModel

FOOTPRINT = [[0.45, 0.34], [-0.45, 0.34], [-0.45, -0.34], [0.45, -0.34]]
PILLARS = (
    (2.5, 1.5, 0.3),
    (-2.0, 2.8, 0.2),
    (3.6, -2.2, 0.35),
    (-3.4, -2.6, 0.3),
    (0.6, 4.0, 0.25),
    (-4.2, 1.0, 0.2),
    (0.4, -3.6, 0.35),
    (4.2, 3.9, 0.2),
    (-1.4, -1.3, 0.2),
    (2.0, -4.6, 0.2),
)
"""Their x, y and radius [m]."""
LIMITS = """
robot: skid_rover
commands:
  forward_command: {min: -0.4, max: 0.8, rate: 2.0, jerk: 40.0}
  turn_command: {min: -1.2, max: 1.2, rate: 6.0, jerk: 120.0}
"""


def rover() -> RobotSpec:
    """The robot as its YAML file tells it."""
    return build_robot(
        {
            "name": "skid_rover",
            "kind": "free",
            "footprint": FOOTPRINT,
            "lidar_mount": [0.25, 0.0, 0.0],
            "command": [
                {
                    "name": "forward_command",
                    "unit": "m/s",
                    "min": -0.8,
                    "max": 0.8,
                    "cmd_vel": "linear.x",
                },
                {
                    "name": "turn_command",
                    "unit": "rad/s",
                    "min": -1.2,
                    "max": 1.2,
                    "cmd_vel": "angular.z",
                },
            ],
            "state": [
                {"name": "vx", "unit": "m/s", "min": -1.6, "max": 1.6, "twist": "vx"},
                {"name": "wz", "unit": "rad/s", "min": -2.4, "max": 2.4, "twist": "wz"},
            ],
        }
    )


def kinematics(unsure: bool = True) -> TaylorModel:
    """Its model, as it is learnt from a short drive, with standard errors if it is `unsure`."""
    robot = rover()
    coefficients = np.zeros((5, 4))
    coefficients[0, 0] = 1.0
    coefficients[2, 1] = 1.0
    coefficients[3, [0, 2]] = [-10.7, 10.6]
    coefficients[4, [1, 3]] = [-4.45, 3.21]
    errors = np.zeros((5, 4))
    if unsure:
        errors[3, [0, 2]] = 1.6
        errors[4, [1, 3]] = [0.84, 0.66]
    high = np.array([1.6, 2.4, 0.8, 1.2])
    return TaylorModel(
        robot.variable_names,
        robot.dof_names,
        robot.dof_units,
        np.eye(4, dtype=np.int64),
        coefficients,
        0.02,
        -high,
        high,
        std_errors=errors,
        limits=np.array([[-2.17, 2.11], [-np.inf, np.inf]]),
    )


def rover_model() -> SimulatorModel:
    """The robot with its lidar, which looks over 270 degrees, for pillars of all its radii."""
    lidar = LidarSpec.model_validate(
        {
            "beams": 271,
            "angle_min": -0.75 * np.pi,
            "angle_max": 0.75 * np.pi,
            "range_min": 0.1,
            "range_max": 10.0,
            "rate": 10.0,
        }
    )
    radii = sorted({radius for _, _, radius in PILLARS})
    table = bake(lidar, tuple(Circle(radius=radius) for radius in radii))
    return SimulatorModel(rover(), kinematics(), Calibration(), lidar, table, Noise())


def limits_in(folder: Path) -> str:
    """The file of the robot's limits, without a section of its shield."""
    file = folder / "skid_rover.yaml"
    file.write_text(LIMITS)
    return str(file)
