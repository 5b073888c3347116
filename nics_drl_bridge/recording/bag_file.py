"""Opens a rosbag2 recording and verifies that it is complete.

Bag readers return what they still find in a damaged bag, often silently. So the database is
checked page by page, and the messages of each topic are compared with the bag's summary. Data
without a checksum, such as a flipped bit inside a number, can't be verified.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nics_drl_bridge.config import no_device, parse_yaml, read_text
from nics_drl_bridge.errors import LONGEST_NAME, BridgeError, RecordingError, shortened
from nics_drl_bridge.recording.mcap import DamageError, check_message, check_packed
from nics_drl_bridge.recording.mcap_check import check_mcap
from nics_drl_bridge.recording.messages import Offer, offers_of, typestore

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

METADATA = "metadata.yaml"
DATABASE = ".db3"
SUFFIXES = (".mcap", DATABASE)
COMPRESSED = (".zst", ".zstd")
URI_SIGNS = "?#%"


@dataclass(frozen=True)
class Message:
    """A message of a bag.

    Attributes:
        receive_ns: time of receipt by the recorder [ns].
        content: the decoded message, with the fields of its type.
    """

    receive_ns: int
    content: Any


def is_bag(path: str | Path) -> bool:
    """True if a path is a rosbag2 recording: its folder, or one of its files."""
    path = Path(path)
    if path.is_dir():
        return (path / METADATA).is_file() or any(is_storage(p) for p in path.iterdir())
    return is_storage(path)


def is_storage(path: Path) -> bool:
    """True if a file has the name of a bag file, compressed or not."""
    plain = path.with_suffix("") if path.suffix in COMPRESSED else path
    return plain.suffix in SUFFIXES


@contextmanager
def opened(path: str | Path) -> Iterator[BagFile]:
    """Opens a bag; any exception that a damaged bag causes in rosbags becomes one sentence.

    Args:
        path: the bag's folder, or its only file.

    Raises:
        RecordingError: there is no such bag, it is damaged, empty or was not closed, or the
            library rosbags is not installed.
    """
    try:
        from rosbags.rosbag2 import Reader
    except ImportError:
        raise RecordingError(
            f"{path}: reading a bag needs the library rosbags; install it with "
            "pip install 'nics_drl_bridge[bags]'."
        ) from None
    path = Path(path)
    try:
        place = _place(path)
        _check_name(place)
        for file in (place, *(place.iterdir() if place.is_dir() else ())):
            no_device(file)
        if place.is_dir():
            _check_metadata(place / METADATA)
        with Reader(place) as reader:
            for storage in _storages(reader):
                _check_storage(path, Path(str(storage.path)))
            _check_summary(path, reader)
            _check_topics(path, reader)
            yield BagFile(reader, str(path))
    except BridgeError:
        raise
    except Exception as error:  # noqa: BLE001 - the reader can raise anything on a damaged file
        raise RecordingError(
            f"{path}: can't be read as a bag ({_reason(error)}); it is damaged or was not closed: "
            "save the rest with `nics bag salvage`, try `ros2 bag reindex`, or record anew."
        ) from None


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]}..."


def _check_name(path: Path) -> None:
    """Refuses paths with characters at which rosbags, which opens databases by URI, cuts them."""
    name = str(path)
    if DATABASE in path.suffixes or (path.is_dir() and any(path.glob(f"*{DATABASE}*"))):
        for sign in (one for one in URI_SIGNS if one in name):
            raise RecordingError(
                f"{path}: SQLite can't open what has {sign!r} in its path; rename the folder."
            )


def _place(path: Path) -> Path:
    """Returns what to open: the folder if it has metadata, which give the expected counts."""
    if not path.exists():
        raise RecordingError(f"{path}: no such bag; check the path.")
    folder = path if path.is_dir() else path.absolute().parent
    files = [p for p in sorted(folder.iterdir()) if is_storage(p)]
    if (folder / METADATA).is_file() and (path.is_dir() or len(files) == 1):
        return folder
    if path.is_dir() and len(files) != 1:
        raise RecordingError(
            f"{path}: holds {len(files)} bag files and no {METADATA}; write it with "
            "`ros2 bag reindex`."
        )
    file = files[0] if path.is_dir() else path
    if file.suffix in COMPRESSED:
        raise RecordingError(
            f"{file}: is compressed; unpack it with `zstd -d`, or give the bag's folder with its "
            f"{METADATA}."
        )
    return file


def _check_metadata(file: Path) -> None:
    """Reads a bag's metadata within the limits of `strict_yaml`, which rosbags lacks.

    Raises:
        ValueError: it is not YAML or exceeds the limits, or a file would unpack to too much.
    """
    try:
        data = parse_yaml(read_text(file), file.name)
    except BridgeError as error:
        raise ValueError(str(error)) from None
    about = data.get("rosbag2_bagfile_information")
    if isinstance(about, dict) and str(about.get("compression_mode", "")).lower() == "file":
        for packed in sorted(file.parent.iterdir()):
            if packed.suffix in COMPRESSED:
                check_packed(packed)


def _storages(reader: Reader) -> list[Any]:
    """Returns the readers of an open bag's files, decompressed if need be."""
    return list(getattr(reader.storage, "storages", [reader.storage]))


def _check_storage(path: Path, file: Path) -> None:
    if file.suffix == DATABASE:
        _check_database(path, file)
        return
    try:
        check_mcap(file)
    except DamageError as damage:
        raise RecordingError(
            f"{path}: {file.name} is damaged at {damage}; save the rest with `nics bag salvage`, "
            "or record anew."
        ) from None


def _check_database(path: Path, database: Path) -> None:
    journal = database.with_name(f"{database.name}-wal")
    if journal.is_file() and journal.stat().st_size > 0:
        raise RecordingError(
            f"{path}: was not closed, part of it is still in {journal.name}; stop the recorder, "
            f"or close it with `sqlite3 {database.name} .quit`."
        )
    place = f"{database.absolute().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(place, uri=True)) as base:
        (verdict,) = base.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        reason = " ".join(verdict.split())
        raise RecordingError(
            f"{path}: is damaged ({reason:.200}); save the rest with `nics bag salvage`, or "
            "record the drive anew."
        )


def _check_summary(path: Path, reader: Reader) -> None:
    counted = sum(connection.msgcount for connection in reader.connections)
    held = sum(storage.metadata.message_count for storage in _storages(reader))
    if held != counted:
        raise RecordingError(
            f"{path}: its summary speaks of {counted} messages, its files hold {held}; it is "
            "damaged: save the rest with `nics bag salvage`, or record anew."
        )
    if reader.message_count != counted:
        raise RecordingError(
            f"{path}: its summary speaks of {reader.message_count} messages, those of its topics "
            f"add up to {counted}; it is damaged: try `ros2 bag reindex`, or record anew."
        )
    if counted == 0:
        raise RecordingError(f"{path}: holds no messages; record a drive of 20 s or more.")


def _check_topics(path: Path, reader: Reader) -> None:
    """Compares the topics of a bag's summary with those of its files."""
    told: Counter[tuple[str, str]] = Counter()
    held: Counter[tuple[str, str]] = Counter()
    for connection in reader.connections:
        if not (isinstance(connection.topic, str) and connection.topic):
            raise RecordingError(
                f"{path}: its summary has lost the name of a topic; it is damaged: try `ros2 bag "
                "reindex`, save the rest with `nics bag salvage`, or record anew."
            )
        told[connection.topic, connection.msgtype] += connection.msgcount
    for storage in _storages(reader):
        for connection in storage.connections:
            held[connection.topic, connection.msgtype] += connection.msgcount
    for topic, kind in sorted(set(told + held), key=str):
        if told[topic, kind] != held[topic, kind]:
            raise RecordingError(
                f"{path}: topic {_short(topic)} of type {_short(kind)} has {held[topic, kind]} "
                f"messages in its files, {told[topic, kind]} by its summary; it is damaged: try "
                "`ros2 bag reindex`, save the rest with `nics bag salvage`, or record anew."
            )
    if reader.compression_mode == "message":
        for storage in _storages(reader):
            for _, _, data in storage.messages(storage.connections):
                check_message(data)


def _short(name: object) -> str:
    return repr(shortened(str(name), LONGEST_NAME))


class BagFile:
    """An open bag whose topics are read completely or not at all.

    Attributes:
        place: its name, for errors.
        types: message type of each topic; several are joined by `and`.
        empty: topics without messages.
    """

    def __init__(self, reader: Reader, place: str) -> None:
        self._reader, self._store, self.place = reader, typestore(), place
        self._connections: dict[str, list[Connection]] = {}
        for connection in reader.connections:
            self._connections.setdefault(connection.topic, []).append(connection)
        self.types = {
            topic: " and ".join(sorted({c.msgtype for c in some}))
            for topic, some in self._connections.items()
        }
        self.empty = frozenset(
            topic for topic, some in self._connections.items() if not sum(c.msgcount for c in some)
        )

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time of receipt, from the bag's summary [ns]."""
        return self._reader.start_time, self._reader.end_time - 1

    def offers(self, topic: str) -> tuple[Offer, ...]:
        """Returns the offers of a topic's publishers, as far as the bag contains them."""
        found = (offers_of(c.ext.offered_qos_profiles) for c in self._connections[topic])  # type: ignore[union-attr]
        return tuple(offer for some in found for offer in some)

    def knows(self, topic: str) -> bool:
        """True if messages of the topic can be decoded."""
        return self.types[topic] in self._store.fielddefs

    def messages(self, topic: str) -> list[Message]:
        """Returns all messages of a topic; count and time span are checked by the bag's summary.

        Raises:
            RecordingError: messages are missing, outside of the time span, or damaged.
        """
        raw = self._raw(topic)
        return [Message(ns, self._decoded(topic, k, t, d)) for k, (t, ns, d) in enumerate(raw)]

    def serialized(self, topic: str) -> list[tuple[int, bytes]]:
        """Returns the same messages undecoded: time of receipt [ns] and bytes."""
        return [(ns, bytes(data)) for _, ns, data in self._raw(topic)]

    def _raw(self, topic: str) -> list[tuple[str, int, bytes]]:
        connections = self._connections[topic]
        raw = [(c.msgtype, ns, data) for c, ns, data in self._reader.messages(connections)]
        promised = sum(connection.msgcount for connection in connections)
        if len(raw) != promised:
            raise RecordingError(
                f"{self.place}: topic {topic!r} has {len(raw)} messages where the bag's summary "
                f"promises {promised}; the bag is cut off or damaged: save the rest with "
                "`nics bag salvage`, or record the drive anew."
            )
        first, last = self.span_ns
        if any(not first <= ns <= last for _, ns, _ in raw):
            raise RecordingError(
                f"{self.place}: topic {topic!r} has messages outside of the time span that the "
                "bag's summary gives; the bag is damaged: save the rest with `nics bag salvage`, "
                "or record the drive anew."
            )
        return raw

    def _decoded(self, topic: str, k: int, kind: str, data: bytes) -> Any:
        try:
            return self._store.deserialize_cdr(data, kind)
        except Exception as error:  # noqa: BLE001 - the decoder can raise anything on damaged bytes
            raise RecordingError(
                f"{self.place}: topic {topic!r}: message {k} can't be decoded as {kind} "
                f"({_reason(error)}); it is damaged: save the rest with `nics bag "
                "salvage`, or record the drive anew."
            ) from None
