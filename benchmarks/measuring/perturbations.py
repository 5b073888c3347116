"""Perturbations of a policy's robot, one at a time."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.policy.train.settings import load_training
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation

PERTURBATIONS = ("noise", "drop-out", "latency", "response", "drift", "footprint")
LIDAR = "rplidar_a2"  # of a robot that has none of its own
FOOTPRINT = 0.05  # how much larger the outline is than the policy and the gate believe
RESPONSE = 1.25  # how many times as long the time constants are at least


def load_declared(robot: str) -> Randomisation:
    """Returns the randomisation by which the shipped policy of a robot was trained."""
    name = load_training(f"shipped_{robot}").randomisation
    return Randomisation(name="none") if name is None else load_randomisation(name)


def single_out(
    whole: Randomisation, perturbation: str, times: float, lidar_noise: float = 0.0
) -> Randomisation:
    """Returns one perturbation alone, `times` as large as its greatest declared value.

    Args:
        whole: the declared ranges.
        perturbation: one of `PERTURBATIONS`.
        times: multiple of the declared range.
        lidar_noise: that the lidar has anyway [m], below which its noise does not fall.
    """
    given: dict[str, Any] = {"name": f"{perturbation} x {times:g}"}

    def get_most(group: Any, names: Sequence[str]) -> dict[str, tuple[float, float]]:
        spans = {name: getattr(group, name) for name in names}
        return {name: (times * span[1],) * 2 for name, span in spans.items() if span}

    if perturbation == "noise":
        given["lidar"] = get_most(whole.lidar, ["noise_std", "noise_proportional"])
        std = given["lidar"].get("noise_std", (0.0, 0.0))
        given["lidar"]["noise_std"] = tuple(max(end, lidar_noise) for end in std)
    elif perturbation == "drop-out":
        lost = get_most(whole.lidar, ["dropout", "dropout_far"])
        given["lidar"] = {
            name: (min(span[0], 1.0 / len(lost)),) * 2 for name, span in lost.items()
        }
    elif perturbation == "latency":
        given |= get_most(whole, ["action_latency", "observation_latency"])
    elif perturbation == "response":
        kinematics = whole.kinematics
        low, high = (1.0 + times * (end - 1.0) for end in kinematics.scale)
        slow = 1.0 + times * (max(kinematics.response[1], RESPONSE) - 1.0)
        given["kinematics"] = {
            "scale": (max(low, 0.05), high),
            "response": (slow, slow),
        }
    elif perturbation == "drift":
        levels = ["odom_linear", "odom_angular", "position_drift", "heading_drift"]
        given["odometry"] = get_most(whole.odometry, levels)
    return Randomisation.model_validate(given)


def grow_footprint(model: SimulatorModel, factor: float) -> SimulatorModel:
    """Returns the model of a robot with a footprint that is larger by a factor."""
    robot = model.robot
    data = robot.model_dump(exclude={"footprint", "footprint_radius"})
    if robot.footprint is None:
        data["footprint_radius"] = factor * robot.footprint_radius
    else:
        data["footprint"] = (factor * np.array(robot.footprint)).tolist()
    return replace(model, robot=RobotSpec.model_validate(data))


def describe(whole: Randomisation) -> dict[str, str]:
    """Returns the greatest value of each perturbation, in words."""
    late = whole.action_latency[1]
    seen = whole.observation_latency[1]
    kinematics = whole.kinematics
    odometry = whole.odometry
    lidar = whole.lidar
    drift = odometry.position_drift or (0.0, 0.0), odometry.heading_drift or (0.0, 0.0)
    return {
        "noise": f"{1000 * (lidar.noise_std or (0.0, 0.0))[1]:g} mm on each range",
        "drop-out": f"{100 * (lidar.dropout or (0.0, 0.0))[1]:g} % of the beams",
        "latency": f"{late:g} + {seen:g} control periods",
        "response": f"time constants x {max(kinematics.response[1], RESPONSE):g}, coefficients "
        f"x {kinematics.scale[0]:g} to {kinematics.scale[1]:g}",
        "drift": f"{100 * drift[0][1]:g} cm and {drift[1][1]:g} rad per root second",
        "footprint": f"{100 * FOOTPRINT:g} % larger than believed",
    }


def open_real_model(robot: str) -> SimulatorModel:
    """Returns the model of a shipped robot with a real lidar: its own, or `LIDAR`."""
    model = open_model(robot)
    if model.robot.lidar is not None:
        return model
    lidar = load_lidar(LIDAR)
    return replace(model, lidar=lidar, table=bake(lidar, model.table.shapes))
