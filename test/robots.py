"""A robot whose motion is known in closed form: each command is a component of its twist."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.noise import Level, Noise
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.sim.world import World

FOOTPRINT = 0.2
RADIUS = 0.25

DIRECT = RobotSpec.model_validate(
    {
        "name": "direct",
        "footprint_radius": FOOTPRINT,
        "command": [
            {
                "name": "forward",
                "unit": "m/s",
                "min": -2.0,
                "max": 2.0,
                "cmd_vel": "linear.x",
            },
            {
                "name": "left",
                "unit": "m/s",
                "min": -2.0,
                "max": 2.0,
                "cmd_vel": "linear.y",
            },
            {
                "name": "turn",
                "unit": "rad/s",
                "min": -2.0,
                "max": 2.0,
                "cmd_vel": "angular.z",
            },
        ],
    }
)


def lidar(**changes) -> LidarSpec:
    """A lidar with few beams all around."""
    data = {
        "beams": 72,
        "angle_min": -np.pi,
        "angle_max": np.pi,
        "range_min": 0.05,
        "range_max": 3.0,
        "rate": 10.0,
    }
    return LidarSpec.model_validate(data | changes)


def direct_model(
    latency: float = 0.0,
    odometry: tuple[float, float] = (0.0, 0.0),
    sensor: LidarSpec | None = None,
) -> SimulatorModel:
    """A model without state, whose twist is its command; steps of 10 ms, periods of 0.1 s."""
    sensor = sensor or lidar()
    kinematics = TaylorModel(
        variables=DIRECT.variable_names,
        dofs=DIRECT.dof_names,
        dof_units=DIRECT.dof_units,
        powers=np.eye(3, dtype=np.int64),
        coefficients=np.eye(3),
        dt=0.01,
        low=DIRECT.command_low,
        high=DIRECT.command_high,
    )
    return SimulatorModel(
        DIRECT,
        kinematics,
        Calibration(command_latency_s=latency),
        sensor,
        bake(sensor, (Circle(radius=RADIUS), Circle(radius=FOOTPRINT))),
        Noise(
            odom_linear=Level(std=odometry[0], unit="m/s"),
            odom_angular=Level(std=odometry[1], unit="rad/s"),
        ),
    )


def noisy_model(**changes) -> SimulatorModel:
    """The same with noise of odometry and lidar; `changes` are of the lidar."""
    sensor = lidar(noise_std=0.01, **changes)
    return direct_model(latency=0.03, odometry=(0.05, 0.03), sensor=sensor)


def circles(count: int, radii: tuple[float, ...] = (RADIUS,), gap: float = 0.3) -> dict:
    """A group of round obstacles."""
    shapes = [{"kind": "circle", "radius": radius} for radius in radii]
    return {"shapes": shapes, "count": count, "gap": gap}


def field(size: float | None = 6.0, count: int = 0, **changes) -> World:
    """A square field with `count` obstacles; without a size, `bounds` are needed."""
    data = {
        "name": "field",
        "size": size and [size, size],
        "obstacles": [circles(count)],
        "clearance": 0.1,
        "goal_distance": [1.0, 3.0],
    }
    return World.model_validate(data | changes)


def open_field(folder: Path) -> str:
    """The file of a world with room for a drive: 20 x 20 m, and robots begin in the middle."""
    file = folder / "open_field.yaml"
    file.write_text(
        "name: open field\nsize: [20.0, 20.0]\ngoal_distance: [1.0, 3.0]\n"
        "starts: {at: [[0.0, 0.0, 0.0]]}\n"
    )
    return str(file)
