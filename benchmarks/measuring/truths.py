"""What is true of a robot, and how near an identification came to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.robot.kernels import SERIES, make_terms, simulate_rollouts
from nics_drl_bridge.robot.taylor import TaylorModel

STANDARD_ERRORS = 3.0  # by how many a mounting may be off
# absolute; shares of the true value
LATENCY_S = 0.005
DEAD_ZONE = 0.1
WHEELS = 0.02
SETTLED_S = 8.0  # until a model has settled
SLOW = 2.0  # a wheel speed [rad/s]


@dataclass(frozen=True)
class Truth:
    """What is known of a robot apart from its recording; None is not known or not defined."""

    latency_s: float | None = None  # from a command's stamp to its effect
    mounting: dict[str, float] = field(
        default_factory=dict
    )  # by names of the uncertainties
    dead_zone: float | None = None  # greatest throttle at which it stands
    wheels: dict[str, tuple[float, float]] = field(default_factory=dict)  # ranges [m]


def compared(found: Identified, truth: Truth) -> dict[str, dict[str, Any]]:
    """Returns each true value with the one found, and whether it is near enough."""
    rows = {}
    calibration = found.calibration
    values = {
        "rotation_rad": calibration.rotation_rad,
        "lever_arm_x_m": calibration.lever_arm_m[0],
        "lever_arm_y_m": calibration.lever_arm_m[1],
    }
    for name, true in truth.mounting.items():
        sigma = calibration.uncertainty.get(name, float("nan"))
        told = not np.isnan(sigma)
        near = (
            abs(values[name] - true) <= STANDARD_ERRORS * sigma
            if told
            else values[name] == 0.0
        )
        rows[name] = {
            "true": true,
            "found": values[name],
            "sigma": sigma,
            "near": bool(near),
        }
    if truth.latency_s is not None and "command_latency_s" in calibration.uncertainty:
        rows["latency_s"] = _row(
            truth.latency_s, calibration.command_latency_s, LATENCY_S
        )
    if truth.dead_zone is not None:
        width = DEAD_ZONE * truth.dead_zone
        rows["dead_zone"] = _row(truth.dead_zone, dead_zone_of(found), width)
    sizes = wheels_of(found.model) if truth.wheels else {}
    for name, (low, high) in truth.wheels.items():
        near = (1.0 - WHEELS) * low <= sizes[name] <= (1.0 + WHEELS) * high
        rows[name] = {"true": [low, high], "found": sizes[name], "near": bool(near)}
    return rows


def _row(true: float, value: float, width: float) -> dict[str, Any]:
    return {"true": true, "found": value, "near": abs(value - true) <= width}


def dead_zone_of(found: Identified) -> float:
    """Returns the dead zone of the first command, NaN as long as there is none in the model."""
    # The seam to `identify`: the input curve of a command.
    return float(getattr(found, "dead_zone", float("nan")))


def wheels_of(model: TaylorModel) -> dict[str, float]:
    """Returns radii and base [m] by which a model of two wheel speeds moves its robot."""
    left, right = (_per_command(model, wheel) for wheel in range(2))
    with np.errstate(divide="ignore", invalid="ignore"):
        base = -left[0] / left[2] + right[0] / right[2]
    return {"left_m": -left[2] * base, "right_m": right[2] * base, "base_m": base}


def _per_command(model: TaylorModel, place: int) -> Array:
    """Returns the change (3,) of the settled body twist per change of one command."""
    size = model.state_size
    steps = round(SETTLED_S / model.dt)
    command = np.zeros((2, steps, len(model.variables) - size))
    command[0, :, place] = SLOW
    command[1, :, place] = -SLOW
    poses = np.zeros((2, steps + 1, 3))
    states = np.zeros((2, steps + 1, size))
    simulate_rollouts(poses, states, command, make_terms(model), SERIES, model.dt)
    twist = geometry.log(geometry.between(poses[:, -2], poses[:, -1])) / model.dt
    return np.asarray((twist[0] - twist[1]) / (2.0 * SLOW))
