"""DriveLog: data sent to a robot and received from it, until they become a Recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from nics_drl_bridge.errors import BackendError, RecordingError
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.recording.bag_reader import JointMessage, Joints, gather, state_of, wheels_of
from nics_drl_bridge.recording.messages import imu_row, pose_row, stamp, twist_row
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.stamping import TopicData, streams
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
PLACE = "recording"
FEWEST = 2
SAME_PACE = (0.8, 1.25)
"""Limits of the stamps' rate relative to receipt; beyond them it is another kind of time."""


class _Rows:
    """The messages of one topic, in the order of their stamps."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._receive: list[int] = []
        self._header: list[int] = []
        self._values: list[Array] = []

    def __len__(self) -> int:
        return len(self._values)

    def add(self, receive_ns: int, header_ns: int, values: Array) -> bool:
        """Adds a message; returns False if it is not finite, or not newer than the last."""
        stale = header_ns != 0 and len(self._header) > 0 and header_ns <= self._header[-1]
        if stale or not np.isfinite(values).all():
            return False
        self._receive.append(receive_ns)
        self._header.append(header_ns)
        self._values.append(values)
        return True

    @property
    def spans(self) -> tuple[int, int]:
        """Time from the first message to the last, by receipt and by stamp [ns]."""
        if not self._values:
            return 0, 0
        return self._receive[-1] - self._receive[0], self._header[-1] - self._header[0]

    @property
    def pace(self) -> float:
        """Seconds by stamp per second of receipt; 1 if it can't be determined.

        It is determined by the least delayed message of each half, because delays vary.
        """
        heard, stamped = self.spans
        if heard <= 0 or stamped <= 0:
            return 1.0
        delay = np.array(self._receive, np.int64) - np.array(self._header, np.int64)
        half = len(delay) // 2
        apart = heard * half / (len(delay) - 1)
        return 1.0 - float(delay[half:].min() - delay[:half].min()) / apart

    def data(self) -> TopicData:
        receive, header = (np.array(ns, dtype=np.int64) for ns in (self._receive, self._header))
        return TopicData(self._topic, receive, header, np.array(self._values))


class DriveLog:
    """Keeps a drive in memory.

    Args:
        spec: the robot.
        roles: may name the joints of state and wheels.
        now: returns the time of receipt [ns], on the clock that stamps are compared with.
    """

    def __init__(self, spec: RobotSpec, roles: TopicRoles, now: Callable[[], int]) -> None:
        self._spec, self._roles, self._now = spec, roles, now
        self._commands, self._odom, self._twist = _Rows("cmd_vel"), _Rows("odom"), _Rows("odom")
        self._pose, self._imu = _Rows("pose"), _Rows("imu")
        self._joints: list[JointMessage] = []

    @property
    def seconds(self) -> float:
        """Time over which commands were sent [s]."""
        return self._commands.spans[0] / NS_PER_S

    def command(self, command: Array) -> None:
        """Records a command (C,) that is sent now."""
        self._commands.add(self._now(), 0, command)

    def odometry(self, message: Odometry) -> Array | None:
        """Records an odometry; returns its pose (3,), or None if it is old, NaN or inf."""
        now, header, pose = self._now(), stamp(message), np.array(pose_row(message))
        if not self._odom.add(now, header, pose):
            return None
        self._twist.add(now, header, np.array(twist_row(message)))
        return pose

    def pose(self, message: Any) -> None:
        """Records a pose from motion capture or localisation."""
        self._pose.add(self._now(), stamp(message), np.array(pose_row(message)))

    def imu(self, message: Any) -> None:
        """Records accelerations and yaw rate."""
        self._imu.add(self._now(), stamp(message), np.array(imu_row(message)))

    def joints(self, message: JointState) -> None:
        """Records the data of the joints."""
        self._joints.append(
            JointMessage(
                self._now(),
                stamp(message),
                message.name,
                list(message.position),
                list(message.velocity),
            )
        )

    def check(self) -> None:
        """Checks, before the robot moves, that the recording will be usable.

        Raises:
            BackendError, RecordingError: a state that has to be measured is not, or stamps run at
                another rate than the time of receipt.
        """
        measured = [v.name for v in self._spec.state if v.follows is None]
        if self._joints:
            state_of(self._table(), self._spec, self._roles, PLACE)
        elif measured or self._roles.state:
            raise BackendError(
                f"topic 'joint_states': nothing has arrived, but {(measured or ['the state'])[0]} "
                f"of robot {self._spec.name!r} has to be measured; start the joints' publisher, "
                "or remap the topic."
            )
        pace, heard = self._odom.pace, self._odom.spans[0] / NS_PER_S
        if not SAME_PACE[0] <= pace <= SAME_PACE[1]:
            raise BackendError(
                f"topic 'odom': its stamps went on by {pace * heard:.2f} s within "
                f"{heard:.2f} s; where a simulator is the robot, take its time: "
                "--use-sim-time, or -p use_sim_time:=true."
            )

    def _table(self) -> Joints:
        return gather("joint_states", self._joints)

    def recording(self) -> Recording:
        """Returns all streams on their clocks; the pose is that of `pose` if that topic was heard.

        In addition to such a pose, the twist of the odometry is kept, to determine its noise.

        Raises:
            RecordingError: too little was received.
        """
        pose = self._pose if len(self._pose) >= FEWEST else self._odom
        if len(pose) < FEWEST or len(self._commands) < FEWEST:
            raise RecordingError("recording: nothing was received that could be saved.")
        commands = self._commands.data()
        data = {
            "command": TopicData(commands.topic, commands.receive_ns, None, commands.values),
            "pose": pose.data(),
        }
        if pose is self._pose and len(self._twist) >= FEWEST:
            data["odometry"] = self._twist.data()
        if len(self._imu) >= FEWEST:
            data["imu"] = self._imu.data()
        if len(self._joints) >= FEWEST:
            table = self._table()
            state = state_of(table, self._spec, self._roles, PLACE)
            wheels = wheels_of(table, self._roles, PLACE)
            data |= {n: d for n, d in (("state", state), ("wheels", wheels)) if d is not None}
        return Recording(**self._streams(data), source=PLACE, variables=self._spec.variable_names)

    def _streams(self, data: dict[str, TopicData]) -> dict[str, Any]:
        try:
            return dict(streams(data, self._roles.stamps, PLACE))
        except RecordingError:
            # Poorer stamps are better than no recording of a drive that is over.
            return dict(streams(data, "receive", PLACE))
