"""Keeps the sent and received messages of a drive in memory, and makes a recording of them."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge.errors import BackendError, RecordingError
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.recording.bag_file import Message
from nics_drl_bridge.recording.messages import get_stamp, read_pose, read_twist
from nics_drl_bridge.recording.recording import MeasuredBy, Recording
from nics_drl_bridge.recording.role_mapping import read_joint_streams
from nics_drl_bridge.recording.stamping import Nanoseconds, TopicData, stamp_streams
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.robot.spec import RobotSpec

COMMAND = "cmd_vel"
PLACE = "recording"
FEWEST = 2
# plausible rate of stamps relative to receipt; otherwise they are of another kind of time
SAME_PACE = (0.8, 1.25)


class DriveLog:
    """Messages of a drive; `now` returns the time of receipt [ns], on the clock of the stamps."""

    def __init__(
        self, spec: RobotSpec, roles: TopicRoles, now: Callable[[], int]
    ) -> None:
        self._spec = spec
        self._roles = roles
        self._now = now
        # Topic, or `odom twist` -> receipt [ns], stamp [ns] or 0, and values of each message.
        self.rows: dict[str, list[tuple[int, int, Array]]] = defaultdict(list)
        self._joints: list[Message] = []

    @property
    def seconds(self) -> float:
        """Time over which commands were sent [s]."""
        return (self.rows[COMMAND][-1][0] - self.rows[COMMAND][0][0]) / NS_PER_S

    def add(self, topic: str, header_ns: int, values: ArrayLike) -> bool:
        """Adds a message; returns False if it is not finite or not newer than the last one."""
        rows = self.rows[topic]
        values = np.asarray(values, np.float64)
        if (rows and 0 != header_ns <= rows[-1][1]) or not np.isfinite(values).all():
            return False
        rows.append((self._now(), header_ns, values))
        return True

    def take_odometry(self, message: Any) -> Array | None:
        """Adds an odometry; returns its pose (3,), or None if it is old, NaN or inf."""
        header = get_stamp(message)
        pose = np.array(read_pose(message))
        if not self.add("odom", header, pose):
            return None
        self.add("odom twist", header, read_twist(message))
        return pose

    def take_joints(self, message: Any) -> None:
        """Adds a JointState."""
        self._joints.append(Message(self._now(), message))

    def check(self) -> None:
        """Raises BridgeError if a state is not measured or stamps run at another rate."""
        measured = [v.name for v in self._spec.state if v.must_be_measured]
        if self._joints:
            self._read_joints()
        elif measured or self._roles.state:
            what = f"{(measured or ['the state'])[0]} of robot {self._spec.name!r}"
            fix = "has to be measured; start the joints' publisher, or remap the topic."
            raise BackendError(
                f"topic 'joint_states': nothing has arrived, but {what} {fix}"
            )
        receive, header = np.array([row[:2] for row in self.rows["odom"]]).T
        heard = (receive[-1] - receive[0]) / NS_PER_S
        rate = estimate_pace(receive, header)
        if not SAME_PACE[0] <= rate <= SAME_PACE[1]:
            off = f"its stamps advanced by {rate * heard:.2f} s within {heard:.2f} s"
            fix = "take the time of a simulator by --use-sim-time, or -p use_sim_time:=true."
            raise BackendError(f"topic 'odom': {off}; {fix}")

    def _read_joints(self) -> dict[str, TopicData]:
        return read_joint_streams(
            "joint_states", self._joints, self._spec, self._roles, PLACE
        )

    def make_recording(self) -> Recording:
        """Returns all streams on their clocks. Raises RecordingError if too little was received."""
        topics = {"command": COMMAND, "pose": "odom", "imu": "imu"}
        measured_by: MeasuredBy = "odometry"
        if len(self.rows["pose"]) >= FEWEST:
            measured_by = "tracker"
            # for the noise of the odometry
            topics |= {"pose": "pose", "odometry": "odom twist"}
        data: dict[str, TopicData] = {}
        for name, topic in topics.items():
            if len(self.rows[topic]) >= FEWEST:
                times_and_values = map(np.array, zip(*self.rows[topic], strict=True))
                data[name] = TopicData(topic.removesuffix(" twist"), *times_and_values)
        if not data.keys() >= {"command", "pose"}:
            raise RecordingError("recording: nothing was received that could be saved.")
        if len(self._joints) >= FEWEST:
            data |= self._read_joints()
        try:
            kept: Any = stamp_streams(data, self._roles.stamps, PLACE)
        except RecordingError:
            # The drive is over: a recording with poorer stamps is better than none.
            kept = stamp_streams(data, "receive", PLACE)
        return Recording(
            **kept,
            source=PLACE,
            variables=self._spec.variable_names,
            measured_by=measured_by,
        )


def estimate_pace(receive: Nanoseconds, header: Nanoseconds) -> float:
    """Returns stamped seconds per second of receipt.

    Only the least delayed message of each half is used, because others waited on the way.
    """
    heard = receive[-1] - receive[0]
    stamped = header[-1] - header[0]
    if heard <= 0 or stamped <= 0:
        return 1.0
    delay = receive - header
    half = len(receive) // 2
    apart = heard * half / (len(delay) - 1)
    return float(1.0 - (delay[half:].min() - delay[:half].min()) / apart)
