"""The part of `nics record` around `record_node`: preview, command line, and next steps.

It imports no ROS 2, so that a drive can be previewed without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.identify.excitation import coverage
from nics_drl_bridge.recording.excite import DrivePlan
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.topic_roles import topic_roles
from nics_drl_bridge.recording.write import check_out
from nics_drl_bridge.report.pictures import drive_picture
from nics_drl_bridge.robot.spec import load_robot


def arguments(namespace: str, remap: Sequence[str]) -> list[str]:
    """Returns the command line for `record_node`; ConfigError for a malformed remapping rule."""
    rules = [f"__ns:=/{namespace.strip('/')}"] if namespace.strip("/") else []
    for rule in remap:
        if not all(rule.partition(":=")):
            raise ConfigError(f"--remap {rule!r}: must be NAME:=OTHER, as in odom:=/wheel_odom.")
        rules.append(rule)
    flags = [word for rule in rules for word in ("-r", rule)]
    return ["nics", "--ros-args", *flags] if flags else ["nics"]


def preview(given: Mapping[str, Any]) -> tuple[str, ...]:
    """Draws the drive that `record_node` would make of its parameters; returns lines."""
    robot, out = load_robot(given["robot"]), check_out(Path(given["out"]))
    topic_roles(given["topics"] or None)  # reports a wrong file before the robot moves
    plan = DrivePlan(robot, *(given[name] for name in ("bound", "duration", "speed", "seed")))
    pattern = plan.preview()
    picture = out.parent / f"{out.stem}_preview.png"
    write_bytes(picture, drive_picture(pattern, robot))
    return (*pattern.lines(), f"its path is drawn in {picture}")


def summary(recording: Recording, given: Mapping[str, Any]) -> tuple[str, ...]:
    """Returns lines about the robot's path, the coverage of each command, and the next step."""
    out, place = Path(given["out"]), recording.pose.values[:, :2] - recording.pose.values[0, :2]
    path, reach = np.hypot(*np.diff(place, axis=0).T).sum(), np.hypot(*place.T).max()
    return (
        f"measured: a path of {path:.1f} m, up to {reach:.2f} m from the start",
        *(each.line() for each in coverage(recording, load_robot(given["robot"]))),
        f"next: nics generate {out} --robot {given['robot']} --out {out.stem}_model",
    )
