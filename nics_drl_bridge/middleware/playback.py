"""Runs a recorded drive through the middleware in order of receipt, reproducibly."""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError, suggest
from nics_drl_bridge.files import hash_bytes, write_bytes, write_text
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.sectors import Reader, match_reader
from nics_drl_bridge.lidar.spec import ScanHeader
from nics_drl_bridge.middleware.intake import Intake
from nics_drl_bridge.middleware.measurement import CMD_VEL, IMU, ODOM, POSE, SCAN
from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.recording.bag_file import BagFile, Message, open_bag
from nics_drl_bridge.recording.messages import get_stamp, read_robot_command

SCAN_TYPE = "sensor_msgs/msg/LaserScan"
TYPES: Mapping[str, tuple[str, ...]] = {
    SCAN: (SCAN_TYPE,),
    ODOM: (topic_roles.ODOMETRY,),
    CMD_VEL: topic_roles.TYPES["cmd_vel"],
    POSE: (topic_roles.POSE, topic_roles.POSE_COVARIANCE),
    IMU: (topic_roles.IMU,),
}
# Roles that are played if the bag has them; others are played only on request
DEFAULT_ROLES = (SCAN, ODOM, CMD_VEL)
MAX_OFFSET_S = 1.0  # between stamps of one clock that are received at the same time
COLUMNS = ("x", "y", "heading", "vx", "vy", "wz")


@dataclass(frozen=True)
class EstimatedDrive:
    """Estimates over a drive, one after each of T odometries that were used and not late."""

    stamp_ns: NDArray[np.int64]  # (T,)
    pose: Array  # (T, 3) x [m], y [m], heading [rad] in `map`
    twist: Array  # (T, 3) vx, vy [m/s], wz [rad/s]
    covariance: Array  # (T, 3, 3) of the pose
    rejected: Mapping[str, int]  # number of data by reason

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all numbers, to compare two runs bit for bit."""
        arrays = (self.stamp_ns, self.pose, self.twist, self.covariance)
        return hash_bytes(
            b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
        )


def estimate(
    path: str | Path, model: SimulatorModel, topics: Mapping[str, str]
) -> EstimatedDrive:
    """Runs a bag through the middleware, with `topics` by role, see `choose_topics`.

    The estimate is bit-identical on every machine with the same versions. Raises RecordingError if
    the bag is damaged, a topic is missing or of a wrong type, no odometry can be used, or the data
    are stamped by several clocks.
    """
    messages = read_messages(path, topics, model.gyro)
    playback = Playback(model, POSE in messages)
    rows = []
    middleware = playback.middleware
    for role, message in merge_messages(messages):
        used = playback.take(role, message.receive_ns, message.content)
        if used and role == ODOM:
            stamp_ns = max(get_stamp(message.content), middleware.estimator.time_ns)
            view = middleware.view(stamp_ns)
            covariance = middleware.estimator.covariance
            rows.append((stamp_ns, view.pose, view.twist, covariance[:3, :3]))
    if not rows:
        raise RecordingError(
            "no odometry of the bag could be used; see `nics bag info`."
        )
    stamps, poses, twists, covariances = zip(*rows, strict=True)
    return EstimatedDrive(
        np.array(stamps, dtype=np.int64),
        np.array(poses),
        np.array(twists),
        np.array(covariances),
        {str(why): count for why, count in middleware.cache.rejected.items()},
    )


def add_gyro_topic(path: str | Path, topics: Mapping[str, str]) -> Mapping[str, str]:
    """Returns topics by role; adds a gyro topic of a usual name if none is given."""
    if IMU in topics:
        if topics[IMU].strip("/") != topic_roles.NONE:
            return topics
        return {role: topic for role, topic in topics.items() if role != IMU}
    with open_bag(path) as bag:
        for name in topic_roles.IMU_NAMES:
            topic = f"/{name}"
            if bag.types.get(topic) == topic_roles.IMU and topic not in bag.empty:
                return {**topics, IMU: topic}
    return topics


def read_messages(
    path: str | Path, topics: Mapping[str, str], use_gyro: bool = False
) -> dict[str, list[Message]]:
    """Returns the messages of each role that is played. Raises as `estimate` does."""
    if use_gyro:
        topics = add_gyro_topic(path, topics)
    with open_bag(path) as bag:
        roles = choose_topics(bag, topics)
        messages = {role: bag.read_messages(topic) for role, topic in roles.items()}
    _check_clocks(str(path), roles, messages)
    return messages


def choose_topics(bag: BagFile, topics: Mapping[str, str]) -> dict[str, str]:
    """Returns the topic of each role that is played.

    `DEFAULT_ROLES` are played from topics of the same names, unless `topics` names others. Other
    roles are played only if `topics` names them. Raises RecordingError if a topic is missing, empty
    or of a wrong type.
    """
    roles = {}
    for role, kinds in TYPES.items():
        topic = topics.get(role) or (f"/{role}" if f"/{role}" in bag.types else "")
        if role not in topics and (
            role not in DEFAULT_ROLES or not topic or topic in bag.empty
        ):
            continue
        if topic not in bag.types:
            hint = suggest(topic, bag.types)
            raise RecordingError(
                f"{bag.place}: has no topic {topic!r} ({role}); {hint}"
            )
        if bag.types[topic] not in kinds or topic in bag.empty:
            fault = "empty" if topic in bag.empty else f"of type {bag.types[topic]}"
            needed = f"{role} needs messages of {' or '.join(kinds)}."
            raise RecordingError(
                f"{bag.place}: the topic {topic!r} is {fault}; {needed}"
            )
        roles[role] = topic
    if ODOM not in roles:
        fix = "name its topic, as in --topic odom=/wheel_odom"
        names = ", ".join(sorted(bag.types))
        raise RecordingError(
            f"{bag.place}: has no odometry; {fix}; its topics are {names}."
        )
    return roles


def _check_clocks(
    place: str, roles: Mapping[str, str], messages: Mapping[str, list[Message]]
) -> None:
    stamps = {}
    for role, sent in messages.items():
        if hasattr(sent[0].content, "header"):
            pairs = [(part.receive_ns, get_stamp(part.content)) for part in sent]
            stamps[role] = np.array(pairs, dtype=np.int64)
    for role, times in stamps.items():
        if not times[:, 1].any():
            if role == CMD_VEL:
                continue
            fix = "have the driver stamp them: the middleware orders data by their stamps."
            raise RecordingError(
                f"{place}: topic {roles[role]!r} is not stamped; {fix}"
            )
        clock = stamps[ODOM]
        expected = clock[0, 1] + np.interp(
            times[:, 0], clock[:, 0], clock[:, 1] - clock[0, 1]
        )
        offset_s = float(np.median(times[:, 1] - expected)) * 1e-9
        if abs(offset_s) > MAX_OFFSET_S:
            raise RecordingError(
                f"{place}: the stamps of {roles[role]!r} are {offset_s:+.3f} s off "
                f"those of {roles[ODOM]!r}, so they come from two clocks; synchronise "
                "the clocks (NTP, or use_sim_time on all nodes or none) and record "
                "again, or leave the topic out."
            )


class Playback(Intake):
    """Feeds the middleware from a bag, as the nodes do.

    With `any_lidar`, the first scan determines the `lidar`.
    """

    def __init__(
        self, model: SimulatorModel, has_pose: bool, any_lidar: bool = False
    ) -> None:
        super().__init__(model, has_pose)
        self._takes[CMD_VEL] = self._take_command
        self.lidar = model.lidar
        self._reader: Reader | None = None
        if not any_lidar:
            self._reader = Reader(model.lidar, backwards=False)
        self._any_lidar = any_lidar

    def find_reader(self, scan: Any) -> Reader | None:
        """Return the reader of the first scan; with `any_lidar`, None for other beams."""
        beams = len(scan.ranges)
        if self._reader is None:
            values = (float(getattr(scan, name)) for name in ScanHeader._fields)
            self._reader = match_reader(ScanHeader(*values), beams, self._model.lidar)
            self.lidar = self._reader.lidar
            self.middleware.expect_beams(self.lidar.beams)
        if self._any_lidar and beams != self.lidar.beams:
            return None
        return self._reader

    def _take_command(self, _: int, message: Any) -> bool:
        command = read_robot_command(message, self._model.robot)
        stamp_ns = get_stamp(message) if hasattr(message, "header") else 0
        self.middleware.command(stamp_ns or None, command)
        return True


def merge_messages(
    messages: Mapping[str, list[Message]],
) -> Iterator[tuple[str, Message]]:
    """Yields all messages with their roles, in the order of receipt."""
    merged: list[tuple[str, Message]] = []
    for role in sorted(messages):
        merged += [(role, message) for message in messages[role]]
    # The sort is stable, so equal times keep the order of the roles.
    yield from sorted(merged, key=lambda entry: entry[1].receive_ns)


def write_estimate(drive: EstimatedDrive, path: str | Path) -> None:
    """Writes an estimate as `.npz` or, with any other suffix, as CSV in full precision."""
    if Path(path).suffix == ".npz":
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            stamp_ns=drive.stamp_ns,
            pose=drive.pose,
            twist=drive.twist,
            covariance=drive.covariance,
        )
        write_bytes(path, buffer.getvalue())
        return
    lines = [",".join(("stamp_ns", *COLUMNS))]
    for ns, pose, twist in zip(drive.stamp_ns, drive.pose, drive.twist, strict=True):
        numbers = (repr(float(value)) for value in (*pose, *twist))
        lines.append(",".join((str(ns), *numbers)))
    write_text(path, "\n".join(lines) + "\n")
