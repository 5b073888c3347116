"""Recovery of the intact messages of a damaged bag, with a count of the lost ones."""

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

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording import mcap
from nics_drl_bridge.recording.bag_file import (
    COMPRESSED,
    DATABASE,
    is_storage,
    metadata_of,
)
from nics_drl_bridge.recording.messages import typestore
from nics_drl_bridge.recording.write import Storage, bag_sink

ZSTD = b"\x28\xb5\x2f\xfd"  # begins a message compressed on its own; a plain one begins with 0
LATEST_NS = 1 << 62
SMALLEST_ROW = 16  # minimum size of a message [bytes], which bounds their number
SMALLEST_PAGE = 512
BESIDE = (
    "-wal",
    "-journal",
)  # next to an unclosed database; SQLite needs them to recover it
CHUNK_OP = bytes([Opcode.CHUNK])


@dataclass(frozen=True)
class Salvage:
    """Result of a salvage."""

    kept: Mapping[str, int]  # number of saved messages by topic
    promised: (
        Mapping[str, int] | None
    )  # original number of messages by topic; None if unknown
    span_s: float  # from the first saved message to the last one [s]

    @property
    def lost(self) -> int | None:
        """Number of lost messages; None if unknown."""
        if self.promised is None:
            return None
        return sum(
            max(n - self.kept.get(topic, 0), 0) for topic, n in self.promised.items()
        )

    def lines(self) -> tuple[str, ...]:
        """Returns one line for the whole bag and one per topic."""
        promised = self.promised or {}
        lost = "; how many there were, nothing in the bag tells"
        if self.lost is not None:
            total = sum(promised.values())
            share = 100.0 * self.lost / max(total, 1)
            lost = f" and {self.lost} of {total} are lost ({share:.1f} %)"
        head = f"{sum(self.kept.values())} messages are kept{lost}; they span {self.span_s:.3f} s"
        of = {topic: f" of {count}" for topic, count in promised.items()}
        names = sorted({*self.kept, *promised})
        return head, *(
            f"  {name}: {self.kept.get(name, 0)}{of.get(name, '')}" for name in names
        )


@dataclass
class _Found:
    kinds: dict[str, str] = field(default_factory=dict)  # type by topic
    definitions: dict[str, str] = field(default_factory=dict)  # text by type
    messages: list[tuple[str, int, bytes]] = field(
        default_factory=list
    )  # topic, receipt, data
    promised: Counter[str] = field(
        default_factory=Counter
    )  # original number of messages by topic
    told: bool = True  # False if a file does not contain that number


def salvage(path: str | Path, out: str | Path, storage: Storage = "mcap") -> Salvage:
    """Writes a bag's intact messages to a new bag; RecordingError if none is, or `out` exists."""
    path = Path(path)
    found = _Found()
    for file in _files(path):
        (_read_database if file.suffix == DATABASE else _read_mcap)(file, found)
    messages = sorted(_decodable(found), key=lambda message: message[1])
    if not messages:
        raise RecordingError(
            f"{path}: holds no message that is intact; record the drive anew."
        )
    with bag_sink(out, storage) as sink:
        for topic, kind in found.kinds.items():
            sink.add_topic(topic, kind, definition=found.definitions.get(kind))
        for topic, ns, data in messages:
            sink.write(topic, ns, data)
    promised = _promised(path) or (found.promised if found.told else None)
    span = (messages[-1][1] - messages[0][1]) * 1e-9
    return Salvage({t: n for t, n in sink.counts.items() if n}, promised, span)


@contextmanager
def salvaged(path: Path) -> Iterator[tuple[Path, tuple[str, ...]]]:
    """Yields the intact part of a bag and the lines to report."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "salvaged"
        lines = salvage(path, out).lines()
        try:
            yield out, lines
        except (
            RecordingError
        ) as error:  # it names the copy, which the user does not know
            raise RecordingError(str(error).replace(str(out), str(path))) from None


def _files(path: Path) -> list[Path]:
    # In the hidden folder that a killed recorder leaves, the files are one level deeper.
    if not path.exists():
        raise RecordingError(f"{path}: no such bag; check the path.")
    files = [path] if path.is_file() else sorted(path.rglob("*"), key=_number)
    found = [file for file in files if file.is_file() and is_storage(file)]
    if not found:
        raise RecordingError(
            f"{path}: holds no .mcap or .db3 file; give the folder of a rosbag2."
        )
    for file in found:
        if file.suffix in COMPRESSED:
            raise RecordingError(
                f"{file}: is compressed as a whole; unpack it with `zstd -d`."
            )
    return found


def _number(file: Path) -> tuple[int, str]:
    digits = file.stem.rpartition("_")[2]  # `drive_10` comes after `drive_9`
    return int(digits) if digits.isdecimal() else -1, str(file)


def _decodable(found: _Found) -> Iterator[tuple[str, int, bytes]]:
    store = typestore()
    for topic, ns, data in found.messages:
        kind = found.kinds.get(topic)
        if kind is None or not 0 <= ns < LATEST_NS:
            continue
        try:
            plain = mcap.unpack(data, "zstd") if data.startswith(ZSTD) else data
            if kind in store.fielddefs:
                store.deserialize_cdr(plain, kind)
        except Exception:  # noqa: BLE001, S112 - the decoder can raise anything on damaged bytes
            continue
        yield topic, ns, plain


def _promised(path: Path) -> dict[str, int] | None:
    try:
        topics = metadata_of(path if path.is_dir() else path.parent)[
            "topics_with_message_count"
        ]
        return {t["topic_metadata"]["name"]: int(t["message_count"]) for t in topics}
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _read_mcap(file: Path, found: _Found) -> None:
    told = mcap.McapSummary()
    waiting = list[mcap.Record]()
    promised = dict[int, int]()
    data = mcap.mapped(file) if file.stat().st_size else memoryview(b"")
    place = len(mcap.MAGIC)
    while place < len(data):
        whole = False
        try:
            record = next(mcap.records(data, place))
            whole = isinstance(record.content, Chunk)
            end = record.end
            if whole:
                span = (
                    record.content.message_start_time,
                    record.content.message_end_time,
                )
                with suppress(mcap.DamageError):
                    waiting += _until_damage(mcap.unpacked(record), span)
            elif isinstance(record.content, mcap.INSIDE):
                waiting.append(record)
            elif isinstance(record.content, Statistics):
                promised = record.content.channel_message_counts
        except mcap.DamageError as damage:
            waiting += _cut_chunk(data, place)
            end = damage.end or len(data)
        # The length of anything but a whole chunk may be damaged: it must not swallow a chunk.
        place = end if whole else _next_chunk(data, place + 1, end)
    # Some channels may be in the summary only, behind all messages.
    for record in sorted(waiting, key=lambda each: isinstance(each.content, Message)):
        with suppress(mcap.DamageError):
            message = told.see(record)
            if message is not None:
                topic = told.channels[message.channel_id].topic
                found.messages.append((topic, message.log_time, bytes(message.data)))
    for channel in told.channels.values():
        schema = told.schemas.get(channel.schema_id)
        if schema is not None:
            found.kinds[channel.topic] = schema.name
            found.definitions[schema.name] = str(schema.data, "utf-8", "replace")
    found.told = found.told and bool(promised)
    for key, count in promised.items():
        known = told.channels.get(key)
        found.promised[known.topic if known else f"unknown channel {key}"] += count


def _cut_chunk(data: memoryview, place: int) -> list[mcap.Record]:
    start = place + mcap.PREFIX + 40
    if data[place] != Opcode.CHUNK or start >= len(data):
        return []
    first, last, size, crc, letters = struct.unpack_from(
        "<QQQII", data, place + mcap.PREFIX
    )
    content = data[start : start + size]
    compressed = letters > 0
    if compressed or (len(content) == size and crc and crc32(content) != crc):
        return []
    return list(_until_damage(content, (first, last)))


def _until_damage(data: memoryview, span_ns: tuple[int, int]) -> Iterator[mcap.Record]:
    place: int | None = 0
    while place is not None:
        try:
            for record in mcap.records(data, place):
                found = record.content
                if not isinstance(found, mcap.INSIDE):
                    return
                if (
                    not isinstance(found, Message)
                    or span_ns[0] <= found.log_time <= span_ns[1]
                ):
                    yield record
            return
        except mcap.DamageError as damage:
            place = damage.end


def _next_chunk(data: memoryview, start: int, end: int) -> int:
    file = data.obj
    place = start - 1
    while (
        isinstance(file, mmap) and (place := file.find(CHUNK_OP, place + 1, end)) >= 0
    ):
        if _looks_like_chunk(data, place):
            return place
    return end


def _looks_like_chunk(data: memoryview, place: int) -> bool:
    name = place + mcap.PREFIX + 32
    if name + 12 > len(data):
        return False
    *_, letters = struct.unpack_from("<QQQII", data, place + mcap.PREFIX)
    if letters > 4 or bytes(data[name : name + letters]) not in map(
        str.encode, mcap.COMPRESSIONS
    ):
        return False
    (length,) = struct.unpack_from("<Q", data, place + 1)
    (packed,) = struct.unpack_from("<Q", data, name + letters)
    return bool(packed + letters + 40 == length <= len(data) - place - mcap.PREFIX)


def _read_database(file: Path, found: _Found) -> None:
    found.told = False
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "bag.db3"
        shutil.copyfile(file, copy)
        _drop_cut_page(copy)
        for ending in BESIDE:
            with suppress(FileNotFoundError):
                shutil.copyfile(f"{file}{ending}", f"{copy}{ending}")
        bound = (
            sum(each.stat().st_size for each in Path(folder).iterdir()) // SMALLEST_ROW
        )
        with closing(sqlite3.connect(copy)) as base, suppress(sqlite3.Error):
            base.text_factory = lambda raw: raw.decode("utf-8", "replace")
            # With this, SQLite opens a truncated file.
            base.execute("PRAGMA writable_schema = ON")
            topics = dict(base.execute("SELECT id, name FROM topics").fetchall())
            found.kinds |= dict(
                base.execute("SELECT name, type FROM topics").fetchall()
            )
            for row in _rows(base, bound):
                key, ns, data = row
                if [type(value) for value in row] == [
                    int,
                    int,
                    bytes,
                ] and key in topics:
                    found.messages.append((topics[key], ns, data))
            ask = (
                "SELECT topic_type, encoded_message_definition FROM message_definitions"
            )
            found.definitions |= dict(base.execute(ask).fetchall())


def _drop_cut_page(copy: Path) -> None:
    with copy.open("r+b") as file:  # SQLite would silently fill a cut page with zeros
        size = int.from_bytes(file.read(18)[16:], "big")
        size = 65536 if size == 1 else size
        if size >= SMALLEST_PAGE and size & (size - 1) == 0:
            file.truncate(copy.stat().st_size // size * size)


def _rows(base: sqlite3.Connection, bound: int) -> list[tuple[Any, ...]]:
    ask = "SELECT topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ?"
    rows = list[tuple[Any, ...]]()
    waiting = [(1, bound)]
    with suppress(sqlite3.Error):
        waiting = [base.execute("SELECT MIN(id), MAX(id) FROM messages").fetchone()]
    for _ in range(2 * bound):  # damaged numbers can promise rows without end
        if not waiting:
            break
        first, last = waiting.pop()
        try:
            rows += base.execute(ask, (first, last)).fetchall()
        except sqlite3.Error:
            if isinstance(first, int) and isinstance(last, int) and first < last:
                middle = (first + last) // 2
                waiting += [(middle + 1, last), (first, middle)]
    return rows
