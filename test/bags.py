"""Bags for tests: messages of any kind, as a robot's own recorder would write them."""

import sqlite3
import struct
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.recording import topic_roles as kinds
from nics_drl_bridge.recording.messages import make_typestore

STORE = make_typestore()
START_S = 1_700_000_000.0
STEP_S = 0.02
DURATION_S = 6.0

Row = tuple[float, Any]
"""Time of receipt [s after START_S], and message."""


def new(kind: str, *values: Any) -> Any:
    """A message, or a part of one."""
    package, name = kind.replace("/msg/", "/").split("/")
    return STORE.types[f"{package}/msg/{name}"](*values)


def ns(seconds: float) -> int:
    """Seconds after START_S as nanoseconds of the recorder's clock."""
    return round(START_S) * NS_PER_S + round(seconds * NS_PER_S)


def header(seconds: float | None, frame: str = "world") -> Any:
    """A header stamped some seconds after START_S, or not at all."""
    stamp = 0 if seconds is None else ns(seconds)
    return new(
        "std_msgs/Header",
        new("builtin_interfaces/Time", stamp // NS_PER_S, stamp % NS_PER_S),
        frame,
    )


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    return new("geometry_msgs/Vector3", x, y, z)


def twist(x: float, y: float, turn: float) -> Any:
    return new(kinds.TWIST, vector(x, y), vector(z=turn))


def twist_stamped(t: float | None, *velocity: float) -> Any:
    return new(kinds.TWIST_STAMPED, header(t), twist(*velocity))


def ackermann(speed: float, steering: float) -> Any:
    return new(kinds.ACKERMANN, steering, 0.0, speed, 0.0, 0.0)


def ackermann_stamped(t: float | None, speed: float, steering: float) -> Any:
    return new(kinds.ACKERMANN_STAMPED, header(t), ackermann(speed, steering))


def turned(heading: float) -> Any:
    half = heading / 2.0
    return new(
        "geometry_msgs/Quaternion", 0.0, 0.0, float(np.sin(half)), float(np.cos(half))
    )


def pose(x: float, y: float, heading: float) -> Any:
    return new(
        "geometry_msgs/Pose", new("geometry_msgs/Point", x, y, 0.0), turned(heading)
    )


def pose_stamped(t: float | None, *place: float) -> Any:
    return new(kinds.POSE, header(t), pose(*place))


def pose_with_covariance(t: float | None, *place: float) -> Any:
    inner = new("geometry_msgs/PoseWithCovariance", pose(*place), np.zeros(36))
    return new(kinds.POSE_COVARIANCE, header(t), inner)


def odometry(t: float | None, *place: float) -> Any:
    return moving_odometry(t, place, (0.0, 0.0, 0.0))


def moving_odometry(
    t: float | None,
    place: Sequence[float],
    velocity: Sequence[float],
    frames: tuple[str, str] = ("odom", "base_link"),
    covariance: float = 0.0,
) -> Any:
    """Odometry with the same covariance everywhere in its matrices."""
    known = np.full(36, covariance)
    inner = new("geometry_msgs/PoseWithCovariance", pose(*place), known)
    speed = new("geometry_msgs/TwistWithCovariance", twist(*velocity), known)
    return new(kinds.ODOMETRY, header(t, frames[0]), frames[1], inner, speed)


def scan(t: float | None, beams: int = 4, time_increment: float = 0.0) -> Any:
    ranges = np.ones(beams, np.float32)
    return new(
        "sensor_msgs/LaserScan",
        header(t, "laser"),
        -1.0,
        1.0,
        2.0 / (beams - 1),
        time_increment,
        0.1,
        0.05,
        3.0,
        ranges,
        np.zeros(0, np.float32),
    )


def scan_of(
    lidar: Any, t: float | None, ranges: Any, frame: str = "laser", **changed: float
) -> Any:
    """A scan of a lidar; `changed` are values of its header."""
    values = (lidar.header._asdict() | changed).values()
    return new(
        "sensor_msgs/LaserScan",
        header(t, frame),
        *map(float, values),
        np.array(ranges, np.float32),
        np.zeros(0, np.float32),
    )


def transform(
    t: float | None, place: Iterable[float], frame: str = "world", child: str = "car"
) -> Any:
    x, y, heading = place
    moved = new("geometry_msgs/Transform", vector(x, y), turned(heading))
    return new(kinds.TRANSFORM, header(t, frame), child, moved)


def transforms(*some: Any) -> Any:
    return new(kinds.TRANSFORMS, list(some))


def joints(
    t: float | None,
    names: list[str],
    position: Iterable[float],
    velocity: Iterable[float],
) -> Any:
    return new(
        kinds.JOINTS,
        header(t, ""),
        names,
        np.array(position),
        np.array(velocity),
        np.zeros(0),
    )


def imu(t: float | None, ax: float, ay: float, turn: float) -> Any:
    return new(
        kinds.IMU,
        header(t),
        turned(0.0),
        np.zeros(9),
        vector(z=turn),
        np.zeros(9),
        vector(ax, ay, 9.81),
        np.zeros(9),
    )


def place_at(t: float) -> tuple[float, float, float]:
    """Where a car on a circle is: 0.5 m/s, 0.25 rad/s."""
    return 2.0 * float(np.sin(0.25 * t)), 2.0 - 2.0 * float(np.cos(0.25 * t)), 0.25 * t


def times(step: float = STEP_S, duration: float = DURATION_S) -> list[float]:
    return [float(t) for t in np.arange(0.0, duration, step)]


def every(step: float, message: Callable[..., Any]) -> list[Row]:
    """Messages of each time."""
    return [(t, message(t)) for t in times(step)]


def along(message: Callable[..., Any], step: float = STEP_S) -> list[Row]:
    """Messages about where the car is."""
    return every(step, lambda t: message(t, *place_at(t)))


def commands(delay: float = 0.0) -> list[Row]:
    """Twists at 10 Hz."""
    return [(delay + t, twist(0.5, 0.0, 0.1)) for t in times(0.1)]


def poses(delay: float = 0.0, offset: float = 0.0) -> list[Row]:
    """Poses whose headers are of a clock that is `offset` ahead, 2 ms before their receipt."""
    return [
        (delay + t, pose_stamped(delay + t + offset - 0.002, *place_at(delay + t)))
        for t in times()
    ]


def drive(delay: float = 0.0) -> dict[str, list[Row]]:
    """A drive of few topics, 360 messages in six seconds."""
    return {"/cmd_vel": commands(delay), "/pose": poses(delay)}


def write(
    path: Path,
    topics: dict[str, list[Row]],
    storage: str = "mcap",
    compression: str = "none",
    version: int = 9,
    kinds_of: dict[str, str] | None = None,
    store: Any = STORE,
) -> Path:
    """Writes a bag of types in `store`; an empty topic needs its type in `kinds_of`."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(path, version=version, storage_plugin=plugin)
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        for topic, rows in topics.items():
            kind = rows[0][1].__msgtype__ if rows else (kinds_of or {})[topic]
            connection = writer.add_connection(topic, kind, typestore=store)
            for t, message in rows:
                writer.write(connection, ns(t), store.serialize_cdr(message, kind))
    return path


def storage_file(bag: Path) -> Path:
    """The only file of a bag beside its metadata."""
    (file,) = (p for p in bag.iterdir() if p.name != "metadata.yaml")
    return file


def unfinished_messages(folder: Path) -> int:
    """Number of messages in the only file of a bag that was never closed."""
    (file,) = (p for p in folder.iterdir() if p.suffix in (".mcap", ".db3"))
    if file.suffix == ".db3":
        with closing(sqlite3.connect(file)) as base:
            (count,) = base.execute("SELECT COUNT(*) FROM messages").fetchone()
        return int(count)
    count = 0
    # The library reports a cut-off record in either way.
    with file.open("rb") as stream, suppress(EndOfFile, struct.error):
        for record in StreamReader(stream).records:
            count += isinstance(record, Message)
    return count
