"""Saves what is intact of a damaged bag, and says how much is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nics_drl_bridge.config import parse_yaml, read_text
from nics_drl_bridge.errors import BridgeError, RecordingError
from nics_drl_bridge.kinematics.bag_file import COMPRESSED, DATABASE, METADATA, is_storage
from nics_drl_bridge.kinematics.bag_messages import typestore
from nics_drl_bridge.kinematics.bag_sink import Storage, bag_sink
from nics_drl_bridge.kinematics.mcap_salvage import intact
from nics_drl_bridge.kinematics.packing import unpack
from nics_drl_bridge.kinematics.sqlite_salvage import intact_rows

ZSTD = b"\x28\xb5\x2f\xfd"
"""What a message begins with that was compressed on its own; one of ROS begins with 0."""
LATEST_NS = 1 << 62


@dataclass(frozen=True)
class Salvage:
    """What was saved of a bag.

    Attributes:
        kept: messages by topic.
        promised: how many there were, by topic; None where nothing tells.
        span_s: from the first message kept to the last one [s].
    """

    kept: Mapping[str, int]
    promised: Mapping[str, int] | None
    span_s: float

    @property
    def lost(self) -> int | None:
        """How many messages are lost; None where nothing tells."""
        if self.promised is None:
            return None
        return sum(max(n - self.kept.get(topic, 0), 0) for topic, n in self.promised.items())

    def lines(self) -> tuple[str, ...]:
        """One line for all, and one for each topic."""
        kept = sum(self.kept.values())
        if self.promised is None:
            head = f"{kept} messages are kept; how many there were, nothing in the bag tells"
            return f"{head}; they span {self.span_s:.3f} s", *self._topics()
        total, lost = sum(self.promised.values()), self.lost or 0
        share = 100.0 * lost / total if total else 0.0
        head = f"{kept} messages are kept and {lost} of {total} are lost ({share:.1f} %)"
        return f"{head}; they span {self.span_s:.3f} s", *self._topics()

    def _topics(self) -> Iterator[str]:
        promised = self.promised or {}
        for topic in sorted({*self.kept, *promised}):
            of = f" of {promised[topic]}" if topic in promised else ""
            yield f"  {topic}: {self.kept.get(topic, 0)}{of}"


@dataclass
class _Found:
    """What the files of a bag still hold."""

    kinds: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    messages: list[tuple[str, int, bytes]] = field(default_factory=list)
    promised: Counter[str] = field(default_factory=Counter)
    told: bool = True


def salvage(path: str | Path, out: str | Path, storage: Storage = "mcap") -> Salvage:
    """Writes what is intact of a bag as a bag of its own.

    Of an MCAP file these are all chunks whose checksum is right, or, where there are none, all
    messages before the damage of each chunk; of an SQLite file all rows that can be read. What
    can't be decoded is left out. It also takes the hidden folder that a killed recorder leaves.

    Args:
        path: folder or file of the damaged bag.
        out: folder to make.
        storage: format of the new bag.

    Raises:
        RecordingError: nothing is left, or `out` is there already.
    """
    path, found = Path(path), _Found()
    for file in _files(path):
        _read(file, found)
    messages = sorted(_decodable(found), key=lambda message: message[1])
    if not messages:
        raise RecordingError(f"{path}: holds no message that is intact; record the drive anew.")
    with bag_sink(out, storage) as sink:
        for topic, kind in found.kinds.items():
            sink.add_topic(topic, kind, definition=found.definitions.get(kind))
        for topic, ns, data in messages:
            sink.write(topic, ns, data)
    promised = _promised(path) or (found.promised if found.told else None)
    span = (messages[-1][1] - messages[0][1]) * 1e-9
    return Salvage({t: n for t, n in sink.counts.items() if n}, promised, span)


@contextmanager
def salvaged(path: Path, wanted: bool) -> Iterator[tuple[Path, tuple[str, ...]]]:
    """Gives the bag itself; or, if that is wanted, what is intact of it and what is to be said."""
    if not wanted:
        yield path, ()
        return
    with TemporaryDirectory() as folder:
        out = Path(folder) / "salvaged"
        lines = salvage(path, out).lines()
        try:
            yield out, lines
        except RecordingError as error:  # it names the copy, of which the user knows nothing
            raise RecordingError(str(error).replace(str(out), str(path))) from None


def _files(path: Path) -> list[Path]:
    """The files of a bag; a folder that a killed recorder left holds them one deeper."""
    if not path.exists():
        raise RecordingError(f"{path}: no such bag; check the path.")
    files = [path] if path.is_file() else sorted(path.rglob("*"), key=_number)
    found = [file for file in files if file.is_file() and is_storage(file)]
    if not found:
        raise RecordingError(f"{path}: holds no .mcap or .db3 file; give the folder of a rosbag2.")
    for file in found:
        if file.suffix in COMPRESSED:
            raise RecordingError(f"{file}: is compressed as a whole; unpack it with `zstd -d`.")
    return found


def _number(file: Path) -> tuple[int, str]:
    """Orders `drive_10` after `drive_9`."""
    digits = file.stem.rpartition("_")[2]
    return int(digits) if digits.isdecimal() else -1, str(file)


def _read(file: Path, found: _Found) -> None:
    if file.suffix == DATABASE:
        topics, definitions, rows = intact_rows(file)
        found.definitions |= definitions
        found.kinds |= dict(topics.values())
        found.messages += [(topics[key][0], ns, data) for key, ns, data in rows if key in topics]
        found.told = False
        return
    told, messages, promised = intact(file)
    names = {key: channel.topic for key, channel in told.channels.items()}
    for channel in told.channels.values():
        schema = told.schemas.get(channel.schema)
        if schema is not None:
            found.kinds[channel.topic] = schema.name
            found.definitions[schema.name] = schema.text
    found.messages += [(names[m.channel], m.time_ns, m.data) for m in messages]
    found.told = found.told and bool(promised)
    for key, count in promised.items():
        found.promised[names.get(key, f"unknown channel {key}")] += count


def _decodable(found: _Found) -> Iterator[tuple[str, int, bytes]]:
    """Messages of known topics, unpacked, without those that can't be decoded."""
    store = typestore()
    for topic, ns, data in found.messages:
        kind = found.kinds.get(topic)
        if kind is None or not 0 <= ns < LATEST_NS:
            continue
        try:
            plain = _unpacked(data)
            if kind in store.fielddefs:
                store.deserialize_cdr(plain, kind)
        except Exception:  # noqa: BLE001, S112 - damaged bytes break the decoder in any way
            continue
        yield topic, ns, plain


def _unpacked(data: bytes) -> bytes:
    if not data.startswith(ZSTD):
        return data
    return unpack(data, "zstd")


def _promised(path: Path) -> dict[str, int] | None:
    """How many messages of each topic there were by the bag's metadata, if they can be read."""
    file = (path if path.is_dir() else path.parent) / METADATA
    try:
        data: Any = parse_yaml(read_text(file), str(file))
        topics = data["rosbag2_bagfile_information"]["topics_with_message_count"]
        return {t["topic_metadata"]["name"]: int(t["message_count"]) for t in topics}
    except (BridgeError, OSError, ValueError, TypeError, KeyError):
        return None
