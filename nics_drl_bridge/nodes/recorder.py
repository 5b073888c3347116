"""The part of `nics record` around `record_node`: preview, drive, and next steps.

It imports ROS 2 only to drive, so that a drive can be previewed without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.errors import MISSING_ROS, BackendError, ConfigError
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.identify.excitation import coverage
from nics_drl_bridge.recording.excite import DrivePlan
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.topic_roles import topic_roles
from nics_drl_bridge.recording.write import check_out
from nics_drl_bridge.report.pictures import drive_picture
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

NODE = "nics_drl_bridge.nodes.record_node"
ARGUMENTS = ("namespace", "remap")  # options that are no parameters of the node


@dataclass(frozen=True)
class RecordOrder:
    """Options of `nics record`."""

    robot: str  # name or YAML file
    out: Path  # `.npz` file, or folder of a rosbag2
    bound: float = 2.0  # radius of the circle around the start to keep within [m]
    duration: float = 60.0  # of the drive [s]
    speed: float = 1.0  # share of the greatest speeds and rates to use
    seed: int = 0  # of the pattern
    namespace: str = ""  # of the robot's topics
    remap: tuple[str, ...] = ()  # rules `NAME:=OTHER` for topics
    topics: Path | None = None  # YAML file that names joints
    stamped: bool = False  # `cmd_vel` is a TwistStamped
    use_sim_time: bool = False  # time comes from `/clock`

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters for `record_node`."""
        given = {name: value for name, value in vars(self).items() if name not in ARGUMENTS}
        return given | {"out": str(self.out), "topics": str(self.topics or "")}

    @property
    def arguments(self) -> list[str]:
        """Command line for `record_node`. Raises ConfigError for a malformed remapping rule."""
        rules = [f"__ns:=/{self.namespace.strip('/')}"] if self.namespace.strip("/") else []
        for rule in self.remap:
            if not all(rule.partition(":=")):
                raise ConfigError(
                    f"--remap {rule!r}: must be NAME:=OTHER, as in odom:=/wheel_odom."
                )
            rules.append(rule)
        flags = [word for rule in rules for word in ("-r", rule)]
        return ["nics", "--ros-args", *flags] if flags else ["nics"]


def require_ros() -> None:
    """Imports ROS 2. Raises ConfigError if it is not installed."""
    try:
        import_module(NODE)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("nics_drl_bridge"):
            raise
        raise ConfigError(f"nics record {MISSING_ROS.format(module=error.name)}") from None


def preview(order: RecordOrder) -> tuple[str, ...]:
    """Draws the expected drive next to the recording; returns lines for people.

    Raises ConfigError if the order can't be carried out.
    """
    robot, out = load_robot(order.robot), check_out(order.out)
    topic_roles(order.topics)  # reports a wrong file before the robot moves
    plan = DrivePlan(robot, order.bound, order.duration, order.speed, order.seed)
    pattern = plan.preview()
    picture = out.parent / f"{out.stem}_preview.png"
    write_bytes(picture, drive_picture(pattern, robot))
    return (*pattern.lines(), f"its path is drawn in {picture}")


def drive(order: RecordOrder) -> tuple[tuple[str, ...], bool]:
    """Drives the robot and records it; returns lines for people, and False if it was interrupted.

    Raises BridgeError if the drive failed, with the reason and what was saved.
    """
    outcome = import_module(NODE).record(order.parameters, order.arguments)
    if outcome.failure is not None:
        raise BackendError(outcome.line)
    lines: tuple[str, ...] = (outcome.line,)
    if outcome.recording is not None:
        lines += summary(outcome.recording, load_robot(order.robot), order)
    return lines, outcome.complete


def summary(recording: Recording, robot: RobotSpec, order: RecordOrder) -> tuple[str, ...]:
    """Returns lines about the robot's path, the coverage of each command, and the next step."""
    place = recording.pose.values[:, :2] - recording.pose.values[0, :2]
    path, reach = np.hypot(*np.diff(place, axis=0).T).sum(), np.hypot(*place.T).max()
    return (
        f"measured: a path of {path:.1f} m, up to {reach:.2f} m from the start",
        *(each.line() for each in coverage(recording, robot)),
        f"next: nics generate {order.out} --robot {order.robot} --out {order.out.stem}_model",
    )
