"""The parameters of `record_node`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rclpy.node import Node

from nics_drl_bridge.kinematics.drive_file import check_out
from nics_drl_bridge.kinematics.drive_plan import DrivePlan
from nics_drl_bridge.kinematics.spec import load_robot
from nics_drl_bridge.kinematics.topic_roles import TopicRoles, topic_roles
from nics_drl_bridge.nodes.runner import declare


@dataclass(frozen=True)
class DriveParameters:
    """What `record_node` is to do.

    Attributes:
        plan: of the drive.
        out: where the recording goes.
        odom_timeout: silence of odometry that stops the robot [s].
        stamped: whether `cmd_vel` is a TwistStamped.
        roles: may name the joints of state and wheels.
    """

    plan: DrivePlan
    out: Path
    odom_timeout: float
    stamped: bool
    roles: TopicRoles


def declare_drive(node: Node) -> DriveParameters:
    """Declares the parameters of a drive, and reads them.

    Raises:
        ConfigError: a value can't be used.
    """
    get = partial(declare, node, read_only=True)
    robot = load_robot(get("robot", "ackermann", "A shipped robot, or its YAML file."))
    out = check_out(
        Path(get("out", "drive.npz", "File *.npz of the recording, or folder of a rosbag2."))
    )
    plan = DrivePlan(
        robot,
        bound=get("bound", 2.0, "Radius of the circle around the start to keep within [m]."),
        duration=get("duration", 60.0, "Of the drive [s]."),
        speed=get("speed", 1.0, "Share of the greatest speeds to use."),
        seed=get("seed", 0, "Of the pattern."),
    )
    topics = get("topics", "", "YAML file that names joints; none if empty.")
    silence = "Stops after this silence of odom [s]."
    return DriveParameters(
        plan,
        out,
        odom_timeout=get("odom_timeout", 0.5, silence, low=0.05, high=10.0),
        stamped=get("stamped", False, "Whether cmd_vel is a TwistStamped."),
        roles=topic_roles(Path(topics) if topics else None),
    )
