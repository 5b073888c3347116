"""Output of a drive: an `.npz` file, or the folder of a rosbag2, written without ROS."""

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.files import (
    begin_folder,
    check_above,
    make_hidden_name,
    remove_leftovers,
    sync_folder,
)
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.recording import messages as msgs
from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.recording.recording import Recording, Stream, save_recording
from nics_drl_bridge.robot.spec import RobotSpec

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer
    from rosbags.typesys.store import Typestore

Content = dict[str, Any]  # of a message, by field
Storage = Literal["mcap", "sqlite3"]

NPZ = ".npz"
START_NS = 1_700_000_000 * NS_PER_S  # time stamp of second 0 of the commands' clock
# Offset of other clocks, too large to be mistaken for a delay
APART_NS = 3600 * NS_PER_S
FRAMES = ("odom", "base_link")
NO_HASH = f"RIHS01_{'0' * 64}"  # hash of a type that is known only by its definition
# Damage costs a whole chunk, because a checksum covers a whole chunk.
CHUNK_BYTES = 1 << 16


def check_out(path: str | Path) -> Path:
    """Checks the path of an output.

    Raises ConfigError if it exists or has a wrong suffix, RecordingError if a library is missing.
    """
    path = Path(path)
    if path.exists():
        raise ConfigError(f"{path}: already exists; give another name, or remove it.")
    if path.suffix not in (NPZ, ""):
        raise ConfigError(
            f"{path}: unknown kind of recording {path.suffix!r}; name a file *{NPZ}, "
            "or the folder of a rosbag2 without suffix."
        )
    if path.suffix != NPZ:
        msgs.check_libraries(path, "writing", f", or name a file *{NPZ}")
    return path


def write_drive(recording: Recording, path: str | Path, spec: RobotSpec) -> None:
    """Writes a recording atomically, as `.npz`, which names its robot, or as a rosbag2."""
    if Path(path).suffix == NPZ:
        save_recording(replace(recording, robot=spec.model_dump(mode="json")), path)
    else:
        write_bag(recording, path, spec)


def write_bag(
    recording: Recording,
    path: str | Path,
    spec: RobotSpec,
    storage: Storage = defaults.BAG_STORAGE,
) -> None:
    """Writes a recording as a bag that `open_drive` reads back; for errors see `open_bag_sink`."""
    # Commands become `/cmd_vel`, state or wheels `/joint_states`, the IMU `/imu`. The pose becomes
    # `/odom`, or `/pose` if it has its own clock or odometry was recorded as well.
    command = recording.command
    with open_bag_sink(path, storage) as sink:
        for topic, kind, stream, write_content in _list_topics(recording, spec):
            sink.add_topic(topic, kind)
            receive = np.round(stream.t * NS_PER_S).astype(np.int64) + START_NS
            late_ns = 0
            if stream.clock != command.clock:
                # Streams of other clocks are received from the first command's time on.
                shift_ns = round(float(command.t[0] - stream.t[0]) * NS_PER_S)
                receive += shift_ns
                late_ns = shift_ns + APART_NS
            for receive_ns, values in zip(receive.tolist(), stream.values, strict=True):
                content = write_content(values)
                seconds, nanoseconds = divmod(receive_ns - late_ns, NS_PER_S)
                stamp = {"sec": seconds, "nanosec": nanoseconds}
                content["header"] = {"stamp": stamp, "frame_id": FRAMES[0]}
                message = _make_message(sink.store, kind, content)
                data = bytes(sink.store.serialize_cdr(message, kind))
                sink.write(topic, receive_ns, data)


def _list_topics(
    recording: Recording, spec: RobotSpec
) -> Iterator[tuple[str, str, Stream, Callable[[Array], Content]]]:
    """Yields for each topic its name, type, stream, and a function from a row to a message.

    The message has no header yet.
    """
    yield (
        "/cmd_vel",
        topic_roles.TWIST,
        recording.command,
        lambda row: _write_twist(spec.to_cmd_vel(row)),
    )
    odometry = recording.odometry
    if odometry is not None or recording.pose.clock != recording.command.clock:
        pose = recording.pose
        yield "/pose", topic_roles.POSE, pose, lambda row: {"pose": _write_pose(row)}
    else:
        yield "/odom", topic_roles.ODOMETRY, recording.pose, _write_odometry
    if odometry is not None:
        yield "/odom", topic_roles.ODOMETRY, odometry, _write_odometry_twist
    joints = recording.state or recording.wheels
    names = list(msgs.WHEELS)
    is_position = np.zeros(2, dtype=bool)
    if recording.state is not None:
        names = [v.name for v in spec.state]
        is_position = np.array([v.unit in msgs.POSITION_UNITS for v in spec.state])
    if joints is not None:
        yield (
            "/joint_states",
            topic_roles.JOINTS,
            joints,
            lambda row: {
                "name": names,
                "position": row * is_position,
                "velocity": row * ~is_position,
            },
        )
    if recording.imu is not None:
        yield "/imu", topic_roles.IMU, recording.imu, _write_imu


def _write_twist(row: Array) -> Content:
    x, y, w = row
    return {"linear": {"x": x, "y": y}, "angular": {"z": w}}


def _write_pose(row: Array) -> Content:
    x, y, heading = row
    orientation = {"z": np.sin(heading / 2.0), "w": np.cos(heading / 2.0)}
    return {"position": {"x": x, "y": y}, "orientation": orientation}


def _write_odometry(row: Array) -> Content:
    return {"child_frame_id": FRAMES[1], "pose": {"pose": _write_pose(row)}}


def _write_odometry_twist(row: Array) -> Content:
    """Returns the content of an odometry of which only the twist was recorded."""
    content = _write_odometry(np.zeros(3))
    content["pose"]["covariance"] = np.append(-1.0, np.zeros(35))
    return content | {"twist": {"twist": _write_twist(row)}}


def _write_imu(row: Array) -> Content:
    ax, ay, w = row
    return {
        "orientation": {"w": 1.0},
        "orientation_covariance": np.full(9, -1.0),
        "angular_velocity": {"z": w},
        "linear_acceleration": {"x": ax, "y": ay},
    }


def _make_message(store: "Typestore", kind: str, content: Content) -> Any:
    """Makes a message of a type from its content by field; all else is zero or empty."""
    values = []
    fields: Any = store.fielddefs[kind][1]
    for name, (node, detail) in fields:
        value = content.get(name)
        if node.name == "NAME":
            value = _make_message(store, detail, value or {})
        elif value is None and node.name == "BASE":
            value = "" if detail[0] == "string" else 0
        elif value is None:
            value = np.zeros(detail[1])
        values.append(value)
    return store.types[kind](*values)


class BagSink:
    """An open bag, created by `open_bag_sink` with an open writer of rosbags."""

    def __init__(self, writer: "Writer") -> None:
        self._writer = writer
        self.store = msgs.make_typestore()  # the known message types
        self._connections: dict[str, Connection] = {}
        self.counts: dict[str, int] = {}  # number of messages by topic
        # the first fault of the file or the database
        self.fault: BaseException | None = None

    def add_topic(
        self,
        topic: str,
        kind: str,
        offers: Sequence[msgs.Offer] = (),
        texts: Mapping[str, str] | None = None,
        definition: str | None = None,
    ) -> None:
        """Adds a topic of a type such as `nav_msgs/msg/Odometry`; unknown ones need definitions."""
        from rosbags.typesys import get_types_from_msg

        fields = self.store.fielddefs
        for name, text in (texts or {}).items() if kind not in fields else ():
            if name not in fields:
                self.store.register(get_types_from_msg(text, name))
        definitions = {}
        if kind not in fields:
            definitions = {"msgdef": definition or "", "rihs01": NO_HASH}
        profiles = [msgs.make_profile(offer) for offer in offers]
        with self._record_fault():
            self._connections[topic] = self._writer.add_connection(
                topic,
                kind,
                typestore=self.store,
                **definitions,
                offered_qos_profiles=profiles,
            )
        self.counts[topic] = 0

    def write(self, topic: str, receive_ns: int, data: bytes) -> None:
        """Writes a serialized message."""
        storage: Any = self._writer.storage
        with self._record_fault():
            self._writer.write(self._connections[topic], receive_ns, data)
            self.counts[topic] += 1
            if (
                hasattr(storage, "close_chunk")
                and storage.chunk.bio.tell() > CHUNK_BYTES
            ):
                storage.close_chunk()

    def flush(self) -> None:
        """Flushes written messages to the file, so that they survive a crash of this process."""
        storage: Any = self._writer.storage
        with self._record_fault():
            if hasattr(storage, "close_chunk"):
                if storage.chunk.msgs:
                    storage.close_chunk()
                storage.bio.flush()
            else:
                storage.conn.commit()

    @contextmanager
    def _record_fault(self) -> Iterator[None]:
        """Records a fault of the storage: SQLite's or the system's, such as a full disk."""
        try:
            yield
        except Exception as error:
            self.fault = self.fault or error
            raise


@contextmanager
def open_bag_sink(
    path: str | Path, storage: Storage = defaults.BAG_STORAGE, keep: bool = False
) -> Iterator[BagSink]:
    """Yields a bag, which becomes a folder at the end.

    Until then it is in a hidden folder `.NAME.*` next to it. If the storage fails, for
    example on a full disk, the data written so far stay in such a folder.

    `keep` is for data that can't be reproduced, such as a recording. If the block
    raises, the bag is finished with the data written so far. The files of a killed
    process also stay. Without `keep`, the block leaves nothing if it raises, and the
    next write removes the files of a killed process.

    Raises RecordingError if the path exists or can't be made, or if a library is missing.
    """
    path = Path(path)
    msgs.check_libraries(path, "writing")
    from rosbags.rosbag2 import StoragePlugin, Writer

    if path.exists():
        raise RecordingError(f"{path}: already exists; give the name of a new folder.")
    check_above(path)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    beside, lock = begin_folder(path)
    if keep:
        beside = _set_apart(beside, path)
    unfinished = beside / path.name
    sink: BagSink | None = None
    raised: BaseException | None = None
    try:
        with Writer(unfinished, version=8, storage_plugin=plugin) as writer:
            sink = BagSink(writer)
            try:
                yield sink
            except BaseException as error:
                keepable = keep and sink.fault is None and any(sink.counts.values())
                if not keepable:
                    # The writer discards what was not flushed.
                    with suppress(Exception):
                        sink.flush()
                    raise
                raised = error
        _finish(unfinished, path, storage)
    except BaseException as error:
        written = sink is not None and any(sink.counts.values())
        fault = None if sink is None else sink.fault
        failed = isinstance(error, OSError | sqlite3.Error) or fault is not None
        if not written or not (failed or keep):
            shutil.rmtree(beside)
            if not failed:
                raise
        elif not keep:
            unfinished = _set_apart(beside, path) / path.name
        if not isinstance(error, Exception):  # Ctrl-C
            raise
        # A caller may have turned a fault of the storage into an error that names the path.
        raise _explain_failure(
            path, fault or error, unfinished if written else None
        ) from error
    finally:
        if lock is not None:
            os.close(lock)
    beside.rmdir()
    if raised is not None:
        raise raised


def _explain_failure(
    path: Path, error: BaseException, unfinished: Path | None
) -> RecordingError:
    """Returns the error of a bag that could not be written; `unfinished` contains its data."""
    reason = str(error) or type(error).__name__
    if isinstance(error, RecordingError):
        reason = error.reason or "could not be finished"
    elif isinstance(error, OSError) and error.strerror:
        reason = error.strerror  # without the path
    rest = "nothing was written; choose another place"
    if unfinished is not None:
        rest = (
            f"the data written so far are in {unfinished}: recover them with `mcap recover` or "
            "`ros2 bag reindex` on a disk with enough space"
        )
    return RecordingError(f"{path}: {reason}; {rest}.")


def _set_apart(unfinished: Path, path: Path) -> Path:
    """Gives an unfinished folder a name under which no later writer removes it."""
    apart = make_hidden_name(path)
    os.rename(unfinished, apart)
    return apart


def _finish(unfinished: Path, path: Path, storage: Storage) -> None:
    """Makes a closed bag safe on the disk and gives it its name."""
    from nics_drl_bridge.recording.mcap import write_checksums

    if storage == "mcap":
        write_checksums(unfinished / f"{path.name}.mcap")
    sync_folder(unfinished)
    if path.exists():
        reason = "was made meanwhile; give the name of a new folder"
        raise RecordingError(f"{path}: {reason}.", reason)
    os.rename(unfinished, path)
