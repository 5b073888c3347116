"""DriveLog: what was sent to a robot and heard from it, until it becomes a Recording."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from nics_drl_bridge.errors import BackendError, RecordingError
from nics_drl_bridge.kinematics.joints import JointMessage, Joints, gather, state_of, wheels_of
from nics_drl_bridge.kinematics.recording import Recording, check, save_recording
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.stamping import TopicData, streams
from nics_drl_bridge.kinematics.topic_roles import TopicRoles
from nics_drl_bridge.nodes import conversions

Array = NDArray[np.float64]
PLACE = "recording"


class _Rows:
    """The messages of one topic."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._receive: list[int] = []
        self._header: list[int] = []
        self._values: list[Array] = []

    def __len__(self) -> int:
        return len(self._values)

    def add(self, receive_ns: int, header_ns: int, values: Array) -> None:
        self._receive.append(receive_ns)
        self._header.append(header_ns)
        self._values.append(values)

    def data(self) -> TopicData:
        receive, header = (np.array(ns, dtype=np.int64) for ns in (self._receive, self._header))
        return TopicData(self._topic, receive, header, np.array(self._values))


class DriveLog:
    """Keeps everything in memory; times of receipt never run backwards.

    Args:
        spec: the robot.
        roles: may name the joints of state and wheels.
    """

    def __init__(self, spec: RobotSpec, roles: TopicRoles) -> None:
        self._spec, self._roles = spec, roles
        self._commands, self._odom, self._poses = _Rows("cmd_vel"), _Rows("odom"), _Rows("pose")
        self._joints: list[JointMessage] = []
        self._origin_ns = time.time_ns() - time.monotonic_ns()

    @property
    def seconds(self) -> float:
        """How long commands were sent [s]."""
        receive = self._commands.data().receive_ns
        return float(np.ptp(receive)) / conversions.NANO if len(receive) else 0.0

    def _now(self) -> int:
        """The system's time when this began, continued by the steady clock [ns]."""
        return self._origin_ns + time.monotonic_ns()

    def command(self, command: Array) -> None:
        """Notes a command (C,) that is sent now."""
        self._commands.add(self._now(), 0, command)

    def odometry(self, message: Odometry) -> Array | None:
        """Notes an odometry; returns its pose (3,), or None if it holds NaN or inf."""
        pose, _ = conversions.odometry_from_ros(message)
        if not np.isfinite(pose).all():
            return None
        self._odom.add(self._now(), conversions.stamp_from_ros(message.header.stamp), pose)
        return pose

    def pose(self, message: PoseStamped) -> None:
        """Notes a pose of motion capture or localisation, unless it holds NaN or inf."""
        place = message.pose
        heading = conversions.heading_from_ros(place.orientation)
        pose = np.array([place.position.x, place.position.y, heading])
        if np.isfinite(pose).all():
            self._poses.add(self._now(), conversions.stamp_from_ros(message.header.stamp), pose)

    def joints(self, message: JointState) -> None:
        """Notes what the joints report."""
        stamp = conversions.stamp_from_ros(message.header.stamp)
        self._joints.append(
            JointMessage(
                self._now(), stamp, message.name, list(message.position), list(message.velocity)
            )
        )

    def _table(self) -> Joints | None:
        return gather("joint_states", self._joints) if self._joints else None

    def check_state(self) -> None:
        """Makes sure, before the robot moves, that a state that has to be measured is.

        Raises:
            BackendError, RecordingError: it is not.
        """
        table = self._table()
        if table is not None:
            state_of(table, self._spec, self._roles, PLACE)
            return
        measured = [v.name for v in self._spec.state if v.follows is None]
        if measured or self._roles.state:
            raise BackendError(
                f"topic 'joint_states': nothing has arrived, but {(measured or ['the state'])[0]} "
                f"of robot {self._spec.name!r} has to be measured; start the joints' publisher, "
                "or remap the topic."
            )

    def recording(self) -> Recording:
        """All streams on their clocks; the pose is that of `pose` where that topic spoke.

        Raises:
            RecordingError: too little, or nothing that can be used, was received.
        """
        pose = self._poses if len(self._poses) else self._odom
        if len(pose) < 2 or len(self._commands) < 2:
            raise RecordingError("recording: nothing was received that could be saved.")
        data = {"command": self._commands.data(), "pose": pose.data()}
        table = self._table()
        if table is not None:
            parts = {
                "state": state_of(table, self._spec, self._roles, PLACE),
                "wheels": wheels_of(table, self._roles, PLACE),
            }
            data |= {name: part for name, part in parts.items() if part is not None}
        made = streams(data, self._roles.stamps, PLACE)
        return Recording(**made, source=PLACE, variables=self._spec.variable_names)

    def save(self, path: Path) -> None:
        """Writes the recording as `.npz`, whole or not at all."""
        save_recording(check(self.recording(), self._spec), path)
