"""Recovery of the intact messages of a damaged bag, with a count of the lost ones."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from mmap import mmap
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import Chunk, Message, Statistics

from nics_drl_bridge.config import parse_yaml, read_text
from nics_drl_bridge.errors import BridgeError, RecordingError
from nics_drl_bridge.recording.bag_file import COMPRESSED, DATABASE, METADATA, is_storage
from nics_drl_bridge.recording.mcap import (
    COMPRESSIONS,
    INSIDE,
    MAGIC,
    PREFIX,
    DamageError,
    McapSummary,
    Record,
    mapped,
    records,
    unpacked,
)
from nics_drl_bridge.recording.messages import typestore
from nics_drl_bridge.recording.packing import unpack
from nics_drl_bridge.recording.write import Storage, bag_sink

ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of an individually compressed message; a plain ROS message begins with 0."""
LATEST_NS = 1 << 62
CHUNK_OP = bytes([Opcode.CHUNK])


@dataclass(frozen=True)
class Salvage:
    """Result of a salvage.

    Attributes:
        kept: number of saved messages by topic.
        promised: original number of messages by topic; None if unknown.
        span_s: from the first saved message to the last one [s].
    """

    kept: Mapping[str, int]
    promised: Mapping[str, int] | None
    span_s: float

    @property
    def lost(self) -> int | None:
        """Number of lost messages; None if unknown."""
        if self.promised is None:
            return None
        return sum(max(n - self.kept.get(topic, 0), 0) for topic, n in self.promised.items())

    def lines(self) -> tuple[str, ...]:
        """Returns one line for the whole bag and one per topic."""
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
    """Remaining contents of a bag's files."""

    kinds: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    messages: list[tuple[str, int, bytes]] = field(default_factory=list)
    promised: Counter[str] = field(default_factory=Counter)
    told: bool = True


def salvage(path: str | Path, out: str | Path, storage: Storage = "mcap") -> Salvage:
    """Writes the intact messages of a bag to a new bag.

    From an MCAP file these are all chunks with a correct checksum, or, in chunks without one, all
    messages before the damage; from an SQLite file all readable rows. Messages that can't be
    decoded are dropped. The hidden folder that a killed recorder leaves is accepted too.

    Args:
        path: folder or file of the damaged bag.
        out: folder to create.
        storage: format of the new bag.

    Raises:
        RecordingError: nothing is intact, or `out` exists already.
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
    """Yields the bag itself; or, if wanted, its intact part and the lines to report."""
    if not wanted:
        yield path, ()
        return
    with TemporaryDirectory() as folder:
        out = Path(folder) / "salvaged"
        lines = salvage(path, out).lines()
        try:
            yield out, lines
        except RecordingError as error:  # it names the copy, which the user does not know
            raise RecordingError(str(error).replace(str(out), str(path))) from None


def _files(path: Path) -> list[Path]:
    """Returns the files of a bag; in the folder of a killed recorder they are one level deeper."""
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
    """Returns a sort key that orders `drive_10` after `drive_9`."""
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
        schema = told.schemas.get(channel.schema_id)
        if schema is not None:
            found.kinds[channel.topic] = schema.name
            found.definitions[schema.name] = str(schema.data, "utf-8", "replace")
    found.messages += [(names[m.channel_id], m.log_time, bytes(m.data)) for m in messages]
    found.told = found.told and bool(promised)
    for key, count in promised.items():
        found.promised[names.get(key, f"unknown channel {key}")] += count


def _decodable(found: _Found) -> Iterator[tuple[str, int, bytes]]:
    """Yields the decodable messages of known topics, decompressed."""
    store = typestore()
    for topic, ns, data in found.messages:
        kind = found.kinds.get(topic)
        if kind is None or not 0 <= ns < LATEST_NS:
            continue
        try:
            plain = unpack(data, "zstd") if data.startswith(ZSTD) else data
            if kind in store.fielddefs:
                store.deserialize_cdr(plain, kind)
        except Exception:  # noqa: BLE001, S112 - the decoder can raise anything on damaged bytes
            continue
        yield topic, ns, plain


def _promised(path: Path) -> dict[str, int] | None:
    """Returns the messages per topic by the bag's metadata; None if it can't be read."""
    file = (path if path.is_dir() else path.parent) / METADATA
    try:
        data: Any = parse_yaml(read_text(file), str(file))
        topics = data["rosbag2_bagfile_information"]["topics_with_message_count"]
        return {t["topic_metadata"]["name"]: int(t["message_count"]) for t in topics}
    except (BridgeError, OSError, ValueError, TypeError, KeyError):
        return None


def intact(path: Path) -> tuple[McapSummary, list[Message], dict[int, int]]:
    """Reads all intact messages of an MCAP file.

    A chunk with a checksum is kept as a whole or not at all; a chunk without one is kept up to its
    damage. After damage the file is searched for the next chunk.

    Returns:
        The file's schemas and channels, its intact messages, and the number of messages of each
        channel by its statistics; that is empty if it has none.
    """
    told, promised, waiting = McapSummary(), {}, []
    data = mapped(path) if path.stat().st_size else memoryview(b"")
    place = len(MAGIC)
    while place < len(data):
        whole = False
        try:
            record = next(records(data, place))
            whole, end = isinstance(record.content, Chunk), record.end
            if whole:
                waiting += _inside(record)
            elif isinstance(record.content, INSIDE):
                waiting.append(record)
            elif isinstance(record.content, Statistics):
                promised = record.content.channel_message_counts
        except DamageError as damage:
            waiting += _cut_chunk(data, place)
            end = damage.end or len(data)
        # The length of anything but a whole chunk may be damaged: it must not swallow a chunk.
        place = end if whole else _next_chunk(data, place + 1, end)
    return told, _messages(told, waiting), promised


def _inside(record: Record) -> list[Record]:
    """Returns the intact records of a chunk."""
    with suppress(DamageError):
        chunk = record.content
        span = chunk.message_start_time, chunk.message_end_time
        return list(_until_damage(unpacked(record), span))
    return []


def _cut_chunk(data: memoryview, place: int) -> list[Record]:
    """Returns the records of a plain chunk that is cut off or whose length is wrong."""
    start = place + PREFIX + 40
    if data[place] != Opcode.CHUNK or start >= len(data):
        return []
    first, last, size, crc, letters = struct.unpack_from("<QQQII", data, place + PREFIX)
    content = data[start : start + size]
    compressed = letters > 0
    if compressed or (len(content) == size and crc and crc32(content) != crc):
        return []
    return list(_until_damage(content, (first, last)))


def _until_damage(data: memoryview, span_ns: tuple[int, int]) -> Iterator[Record]:
    """Yields records up to the first wrong length; messages only within the chunk's time span."""
    place: int | None = 0
    while place is not None:
        try:
            for record in records(data, place):
                if not isinstance(record.content, INSIDE):
                    return
                time = getattr(record.content, "log_time", span_ns[0])
                if span_ns[0] <= time <= span_ns[1]:
                    yield record
            return
        except DamageError as damage:
            place = damage.end


def _messages(told: McapSummary, waiting: list[Record]) -> list[Message]:
    """Returns messages, after reading all channels: some may be in the summary only."""
    messages = []
    for record in sorted(waiting, key=lambda each: isinstance(each.content, Message)):
        with suppress(DamageError):
            message = told.see(record)
            if message is not None:
                messages.append(message)
    return messages


def _next_chunk(data: memoryview, start: int, end: int) -> int:
    """Returns the offset of the next record with the consistent lengths of a chunk, or the end."""
    file = data.obj
    if not isinstance(file, mmap):
        return end
    place = file.find(CHUNK_OP, start, end)
    while place >= 0 and not _looks_like_chunk(data, place):
        place = file.find(CHUNK_OP, place + 1, end)
    return place if place >= 0 else end


def _looks_like_chunk(data: memoryview, place: int) -> bool:
    head = PREFIX + 32
    if place + head > len(data):
        return False
    (length,) = struct.unpack_from("<Q", data, place + 1)
    (letters,) = struct.unpack_from("<I", data, place + PREFIX + 28)
    if not 40 <= length <= len(data) - place - PREFIX or letters > 4:
        return False
    if bytes(data[place + head : place + head + letters]) not in map(str.encode, COMPRESSIONS):
        return False
    (packed,) = struct.unpack_from("<Q", data, place + head + letters)
    return bool(packed + letters + 40 == length)


BATCH = 500
SMALLEST_ROW = 16
"""Minimum size of a message [bytes], which bounds their number."""
SMALLEST_PAGE = 512
BESIDE = ("-wal", "-journal")
"""Suffixes of the files next to an unclosed database, which SQLite needs to recover it."""

Row = tuple[int, int, bytes]
"""Topic id, time of receipt [ns], message."""


def intact_rows(path: Path) -> tuple[dict[int, tuple[str, str]], dict[str, str], list[Row]]:
    """Reads all readable rows.

    Returns:
        Name and type of each topic by its id, definition of each type, and the messages.
    """
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "bag.db3"
        shutil.copyfile(path, copy)
        _drop_cut_page(copy)
        for ending in BESIDE:
            with suppress(FileNotFoundError):
                shutil.copyfile(f"{path}{ending}", f"{copy}{ending}")
        with closing(sqlite3.connect(copy)) as base:
            base.text_factory = lambda raw: raw.decode("utf-8", "replace")
            # With this, SQLite opens a truncated file.
            base.execute("PRAGMA writable_schema = ON")
            try:
                found = base.execute("SELECT id, name, type FROM topics").fetchall()
            except sqlite3.Error:
                return {}, {}, []
            topics = {key: (name, kind) for key, name, kind in found}
            return topics, _definitions(base), _rows(base, copy.stat().st_size // SMALLEST_ROW)


def _drop_cut_page(copy: Path) -> None:
    """Removes a truncated last page, which SQLite would silently fill with zeros."""
    with copy.open("r+b") as file:
        size = int.from_bytes(file.read(18)[16:], "big")
        size = 65536 if size == 1 else size
        if size >= SMALLEST_PAGE and size & (size - 1) == 0:
            file.truncate(copy.stat().st_size // size * size)


def _definitions(base: sqlite3.Connection) -> dict[str, str]:
    with suppress(sqlite3.Error):
        ask = "SELECT topic_type, encoded_message_definition FROM message_definitions"
        return dict(base.execute(ask).fetchall())
    return {}


def _rows(base: sqlite3.Connection, bound: int) -> list[Row]:
    """Reads messages in batches, or one by one if a batch can't be read."""
    ask = "SELECT id, topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ?"
    rows: list[Row] = []
    with suppress(sqlite3.Error):
        bound = base.execute("SELECT MAX(id) FROM messages").fetchone()[0] or 0
    for first in range(1, bound + 1, BATCH):
        last = min(first + BATCH - 1, bound)
        try:
            batch = base.execute(ask, (first, last)).fetchall()
        except sqlite3.Error:
            batch = []
            for each in range(first, last + 1):
                with suppress(sqlite3.Error):
                    batch += base.execute(ask, (each, each)).fetchall()
        rows += [row[1:] for row in batch if _is_message(row)]
    return rows


def _is_message(row: tuple[Any, ...]) -> bool:
    return [type(value) for value in row[1:]] == [int, int, bytes]
