"""Parameters of `command_gate`."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rclpy.node import Node

from nics_drl_bridge.gate.limits import Limits, load_limits
from nics_drl_bridge.gate.state import GateConfig, ShieldConfig
from nics_drl_bridge.gate.stopping import doubtful, require_possible, shield_config
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.nodes.runner import declare, declare_model

SCAN_PERIODS = 1.75
"""For a slow lidar, the default age limit of a command's scan, in periods of the lidar."""
DEFAULTS = GateConfig((), None, np.zeros(0), (0.0, 0.0, 0.0), 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class GateParameters:
    """Values of the parameters of `command_gate`.

    Attributes:
        config: of the rules.
        robot: name of the robot behind it.
        lidar: of the robot.
        black_box: folder of the recordings of stops.
        shield_said: a sentence about the shield.
    """

    config: GateConfig
    robot: str
    lidar: LidarSpec
    black_box: Path
    shield_said: str


def declare_gate(node: Node) -> GateParameters:
    """Declares the parameters of a gate, and reads them.

    Raises:
        ConfigError: a value can't be used, or would never let the robot move.
    """
    get = partial(declare, node, read_only=True)

    def share(name: str, default: float, description: str, low: float, high: float) -> float:
        return float(get(name, default, description, low=low, high=high))

    def seconds(name: str, default: float, description: str) -> float:
        return float(get(name, default, f"{description} [s].", low=0.01, high=10.0))

    model = declare_model(node)
    lidar, robot = model.lidar, model.robot
    limits = get("limits", "", "Limits of the robot: a shipped file, or a YAML file; no default.")
    needs_e_stop = "Whether e_stop must have been heard before arming; false in simulations alone."
    needs_estimate = "Whether arming needs odometry/filtered."
    folder = "Where a stop's last 30 s are written, by namespace; ~/.ros/black_box if empty."
    scan_age = max(DEFAULTS.scan_age_s, SCAN_PERIODS / lidar.rate)
    bounds = load_limits(limits, robot) if limits else None
    shield, said = _declare_shield(node, model, bounds, limits)
    config = GateConfig(
        fields=tuple(int(i) for i in np.flatnonzero(robot.to_cmd_vel(np.ones(len(robot.command))))),
        limits=bounds,
        beam_angles=lidar.angles,
        mount=lidar.mount,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        scan_rate=lidar.rate,
        odom_rate=get("odom_rate", 1.0 / model.control_period, "Of odom [Hz].", low=0.1, high=1e4),
        scan_age_s=seconds("scan_age", scan_age, "Oldest scan, and behind a command"),
        odom_age_s=seconds("odom_age", DEFAULTS.odom_age_s, "Oldest odometry"),
        command_age_s=seconds("command_age", DEFAULTS.command_age_s, "Oldest command"),
        rate_tolerance=share(
            "rate_tolerance", DEFAULTS.rate_tolerance, "Of both rates.", 0.01, 0.9
        ),
        clock_rate=share(
            "clock_rate", 1.0, "Of stamps: simulated seconds per second.", 0.01, 100.0
        ),
        simulated=bool(node.get_parameter("use_sim_time").value),
        e_stop_required=get("e_stop_required", DEFAULTS.e_stop_required, needs_e_stop),
        e_stop_silence_s=seconds("e_stop_silence", DEFAULTS.e_stop_silence_s, "Silence of e_stop"),
        estimate_required=get("estimate_required", True, needs_estimate),
        estimate_std=share("estimate_std", DEFAULTS.estimate_std, "Greatest [m, rad].", 1e-3, 1e3),
        odom_std=model.noise.odometry,
        shield=shield,
    )
    require_possible(config)
    doubt = doubtful(config, model.control_period)
    if doubt:
        node.get_logger().warning(doubt)
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    # Gates of other namespaces have their own folders, so that none removes another's files.
    black_box = Path(get("black_box", "", folder) or home / "black_box")
    black_box /= node.get_namespace().strip("/")
    return GateParameters(config, robot.name, lidar, black_box, said)


def _declare_shield(
    node: Node, model: SimulatorModel, limits: Limits | None, file: str
) -> tuple[ShieldConfig | None, str]:
    """Returns the shield, None if it is off, and a sentence about it for the log."""

    def get(name: str, description: str) -> float:
        about = f"{description}; .nan: by the limits' file, or derived from the model."
        return float(declare(node, f"shield_{name}", math.nan, about, read_only=True))

    on = declare(node, "shield", True, "Whether to stop before obstacles.", read_only=True)
    values = {
        "latency": get("latency", "Until the robot has taken up a command, measured [s]"),
        "deceleration": get("deceleration", "Of the robot, measured [m/s^2]"),
        "margin": get("margin", "Kept free around the footprint [m]"),
        "obstacle_speed": get("obstacle_speed", "At which what moves may come on [m/s]"),
    }
    if not on:
        return None, "the shield is off: obstacles do not stop the robot"
    given = {name: value for name, value in values.items() if not math.isnan(value)}
    return shield_config(model, limits, file, given)
