"""Opens a bag of ROS 2 or 1 and verifies that it is complete, because readers ignore damage."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from nics_drl_bridge.config import check_no_device, parse_yaml, read_text
from nics_drl_bridge.errors import BridgeError, RecordingError, shorten
from nics_drl_bridge.recording.messages import (
    Offer,
    check_libraries,
    collect_types,
    convert_offers,
    get_stamp,
)
from nics_drl_bridge.recording.stamping import Nanoseconds

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader

    AnyBag = Reader | Ros1Reader

METADATA = "metadata.yaml"
METADATA_KEY = "rosbag2_bagfile_information"
DATABASE = ".db3"
SUFFIXES = (".mcap", DATABASE)
ROS_1 = ".bag"
COMPRESSED = (".zst", ".zstd")
URI_SIGNS = "?#%"
BAGS = "a bag is the folder of a rosbag2, or a file *.mcap, *.db3 or *.bag."
LONGEST_REASON = 260  # maximum length of a fault [characters]


@dataclass(frozen=True)
class Message:
    """A message of a bag."""

    receive_ns: int  # time of receipt by the recorder [ns]
    content: Any  # the decoded message, with the fields of its type


def is_bag(path: str | Path) -> bool:
    """True if a path is a bag: the folder or a file of a rosbag2, or the file of a rosbag1."""
    path = Path(path)
    if path.is_dir():
        return (path / METADATA).is_file() or any(is_storage(p) for p in path.iterdir())
    return is_storage(path)


def is_storage(path: Path) -> bool:
    """True if a file has the name of a bag file, compressed or not."""
    if path.suffix in COMPRESSED:
        return path.with_suffix("").suffix in SUFFIXES
    return path.suffix in (*SUFFIXES, ROS_1)


@contextmanager
def open_bag(path: str | Path) -> "Iterator[BagFile]":
    """Opens a bag, given by its folder or its only file.

    Raises RecordingError if the bag is missing, damaged or empty, or if a library is missing.
    Errors of the block that reads it are not converted.
    """
    path = Path(path)
    check_libraries(path, "reading")
    if path.is_file() and not is_storage(path):
        raise RecordingError(f"{path}: is not a bag; {BAGS}")
    with ExitStack() as stack:
        with _refuse_damage(path):
            reader: Any = _open_ros_1(path) if _is_ros_1(path) else _open_ros_2(path)
            bag = BagFile(stack.enter_context(reader), path)
        yield bag


@contextmanager
def _refuse_damage(path: Path) -> Iterator[None]:
    """Converts any error of a reader on a damaged file to a RecordingError."""
    try:
        yield
    except BridgeError:
        raise
    except Exception as error:  # noqa: BLE001 - the reader can raise anything on a damaged file
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        fault = f"can't be read as a bag ({shorten(reason, LONGEST_REASON)})"
        advice = "try `mcap recover` or `ros2 bag reindex` on a copy, or record again"
        if _is_ros_1(path):
            advice = "repair it with `rosbag reindex`, or record again"
        raise RecordingError(
            f"{path}: {fault}; it is damaged or was not closed: {advice}."
        ) from None


def _is_ros_1(path: Path) -> bool:
    return path.suffix == ROS_1


def _open_ros_1(path: Path) -> "Ros1Reader":
    from rosbags.rosbag1 import Reader

    if not check_no_device(path).is_file():
        raise RecordingError(f"{path}: no such bag; check the path.")
    return Reader(path)


@contextmanager
def _open_ros_2(path: Path) -> "Iterator[Reader]":
    from rosbags.rosbag2 import Reader

    place = _find_place(path)
    files = [place]
    if place.is_dir():
        files += place.iterdir()
    # rosbags opens databases by URI, which these characters truncate.
    sign = next((sign for sign in URI_SIGNS if sign in str(place)), None)
    if sign and any(DATABASE in file.suffixes for file in files):
        raise RecordingError(
            f"{place}: SQLite can't open what has {sign!r} in its path; rename the "
            "folder."
        )
    for file in files:
        check_no_device(file)
    # Checked before rosbags reads it, because rosbags unpacks chunks of any size.
    with TemporaryDirectory() as room:
        if place.is_dir():
            files = _list_files(place, Path(room))
        for file in files:
            _check_storage(file)
    with Reader(place) as reader:
        _check_summary(reader)
        yield reader


def _find_place(path: Path) -> Path:
    """Returns the path to open: the folder if it has metadata, which give the expected counts."""
    if not path.exists():
        raise RecordingError(f"{path}: no such bag; check the path.")
    folder = path
    if not path.is_dir():
        folder = path.absolute().parent
    files = [file for file in sorted(folder.iterdir()) if is_storage(file)]
    if (folder / METADATA).is_file() and (path.is_dir() or len(files) == 1):
        return folder
    file = path
    if path.is_dir():
        if len(files) != 1:
            if not files:
                raise RecordingError(f"{path}: contains no bag file; {BAGS}")
            raise RecordingError(
                f"{path}: contains {len(files)} bag files but no {METADATA}; write it "
                "with `ros2 bag reindex`."
            )
        file = files[0]
    if file.suffix in COMPRESSED:
        raise RecordingError(
            f"{file}: is compressed; unpack it with `zstd -d`, or give the folder with "
            f"{METADATA}."
        )
    return file


def read_metadata(folder: Path) -> dict[str, Any]:
    """Returns a bag's metadata, read within `parse_yaml`'s limits. Raises ValueError if broken."""
    try:
        metadata = parse_yaml(read_text(folder / METADATA), METADATA).get(METADATA_KEY)
    except BridgeError as error:
        raise ValueError(str(error)) from None
    if not isinstance(metadata, dict):
        raise ValueError(f"{METADATA}: lacks {METADATA_KEY}")
    return metadata


def _list_files(folder: Path, room: Path) -> list[Path]:
    """Returns the files of a bag; compressed files are unpacked to `room`."""
    metadata = read_metadata(folder)
    names = metadata.get("relative_file_paths") or ()
    files = [folder / Path(str(name)).name for name in names]
    files = [file for file in files if file.is_file()]
    if str(metadata.get("compression_mode", "")).lower() != "file":
        return files
    from nics_drl_bridge.recording.mcap import unpack_file

    return [unpack_file(file, room / file.stem) for file in files]


def _check_storage(file: Path) -> None:
    from nics_drl_bridge.recording.mcap import check_mcap

    if file.suffix != DATABASE:
        check_mcap(file)
        return
    journal = file.with_name(f"{file.name}-wal")
    if journal.is_file() and journal.stat().st_size > 0:
        raise ValueError(
            f"part of it is still in {journal.name}; stop the recorder, or close it "
            f"with `sqlite3 {file.name} .quit`"
        )
    place = f"{file.absolute().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(place, uri=True)) as base:
        (verdict,) = base.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise ValueError(f"its database is broken: {verdict}")


def _check_summary(reader: "Reader") -> None:
    """Refuses topics without a name and messages that are too large when unpacked.

    Whether a topic has as many messages as promised is checked when it is read.
    """
    from nics_drl_bridge.recording.mcap import check_message

    topics = [connection.topic for connection in reader.connections]
    if not all(isinstance(topic, str) and topic for topic in topics):
        raise ValueError("its summary has lost the name of a topic")
    if reader.compression_mode == "message":
        storage: Any = reader.storage
        for part in getattr(storage, "storages", [storage]):
            for _, _, data in part.messages(part.connections):
                check_message(data)


def read_times(messages: Sequence[Message]) -> tuple[Nanoseconds, Nanoseconds | None]:
    """Returns times of receipt and header stamps (T,) [ns]; these are None without headers."""
    receive = np.array([m.receive_ns for m in messages], dtype=np.int64)
    if not messages or not hasattr(messages[0].content, "header"):
        return receive, None
    return receive, np.array([get_stamp(m.content) for m in messages], dtype=np.int64)


class BagFile:
    """A bag opened by `open_bag`; RecordingError if messages of a topic are lost or damaged."""

    def __init__(self, reader: "AnyBag", path: Path) -> None:
        if not reader.message_count:
            raise RecordingError(
                f"{path}: contains no messages; record a drive of 20 s or more."
            )
        self._reader = reader
        self._path = path
        self._is_ros_1 = _is_ros_1(path)
        self._store = collect_types(reader.connections)
        self.place = str(path)  # its name, for errors
        self._connections: dict[str, list[Connection]] = {}
        for connection in reader.connections:
            self._connections.setdefault(connection.topic, []).append(connection)
        # Message type of each topic; several are joined by `and`.
        self.types: dict[str, str] = {}
        empty: list[str] = []
        for topic, connections in self._connections.items():
            kinds = {connection.msgtype for connection in connections}
            self.types[topic] = " and ".join(sorted(kinds))
            if not any(connection.msgcount for connection in connections):
                empty.append(topic)
        self.empty = frozenset(empty)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time of receipt, from the bag's summary [ns]."""
        return self._reader.start_time, self._reader.end_time - 1

    def offers(self, topic: str) -> tuple[Offer, ...]:
        """Returns the offers of a topic's publishers, as far as the bag contains them."""
        offers: list[Offer] = []
        for connection in self._connections[topic]:
            profiles = getattr(connection.ext, "offered_qos_profiles", ())
            offers += convert_offers(profiles)
        return tuple(offers)

    def can_decode(self, topic: str) -> bool:
        """True if messages of the topic can be decoded."""
        return self.types[topic] in self._store.fielddefs

    def get_definition(self, topic: str) -> str:
        """Returns the ROS 2 definition of a topic's type, with all types that it contains."""
        if self.can_decode(topic):
            with _refuse_damage(self._path):
                definition, _ = self._store.generate_msgdef(
                    self.types[topic], ros_version=2
                )
            return str(definition)
        return str(self._connections[topic][0].msgdef.data)

    def read_messages(self, topic: str) -> list[Message]:
        """Returns all messages of a topic."""
        messages = []
        decode = self._store.deserialize_cdr
        if self._is_ros_1:
            decode = self._store.deserialize_ros1
        with _refuse_damage(self._path):
            for k, (kind, receive_ns, data) in enumerate(self._read_raw(topic)):
                try:
                    messages.append(Message(receive_ns, decode(data, kind)))
                except Exception as error:  # noqa: BLE001 - damaged bytes break it in any way
                    raise ValueError(
                        f"topic {topic!r}: message {k} can't be decoded as {kind} ({error})"
                    ) from None
        return messages

    def read_serialized(self, topic: str) -> list[tuple[int, bytes]]:
        """Returns all messages of a topic as ROS 2 serializes them: receipt [ns] and bytes."""
        with _refuse_damage(self._path):
            raw = self._read_raw(topic)
            if not self._is_ros_1:
                return [(ns, bytes(data)) for _, ns, data in raw]
            types = collect_types(self._connections[topic], header=False)
            return [
                (ns, bytes(types.ros1_to_cdr(data, kind))) for kind, ns, data in raw
            ]

    def _read_raw(self, topic: str) -> list[tuple[str, int, bytes]]:
        connections = self._connections[topic]
        raw = [
            (c.msgtype, ns, data) for c, ns, data in self._reader.messages(connections)
        ]
        promised = sum(connection.msgcount for connection in connections)
        first, last = self.span_ns
        if len(raw) != promised:
            raise ValueError(
                f"topic {topic!r} has {len(raw)} messages, by the summary {promised}"
            )
        if any(not first <= ns <= last for _, ns, _ in raw):
            raise ValueError(
                f"topic {topic!r} has messages outside of the time span of its summary"
            )
        return raw
