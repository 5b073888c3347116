"""MCAP files: records parsed by the library `mcap`, and the checks that its readers leave out."""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from mmap import ACCESS_READ, ACCESS_WRITE, mmap
from pathlib import Path
from typing import IO, Any, NamedTuple, cast
from zlib import crc32

from mcap import records as kinds
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader

MAGIC = b"\x89MCAP0\r\n"
PRIVATE = 0x80  # opcodes from here on are reserved for private records
PREFIX = 9  # bytes of opcode and length in front of a record
CHUNK_CRC = 24  # offset of a chunk's checksum in its content
COMPRESSIONS = ("", "lz4", "zstd")
INSIDE = (
    kinds.Schema,
    kinds.Channel,
    kinds.Message,
)  # records that may occur in a chunk
MOST_UNPACKED = (
    256 * 2**20
)  # maximum size of one chunk or message, decompressed [bytes]
MOST_PACKED_SHARE = (
    1000  # compression ratio of a file that decompresses to more than that
)
_PART = 2**20


class DamageError(ValueError):
    """Damage of a file: byte offset of the record, what is wrong, offset of the next record."""

    def __init__(self, offset: int, what: str, end: int | None = None) -> None:
        super().__init__(f"byte {offset}: {what}")
        self.offset = offset
        self.what = what
        self.end = end


class Record(NamedTuple):
    """One record."""

    offset: int  # of its opcode, from the start of the file or of the chunk
    end: int  # offset of the next record
    content: Any  # one of `mcap.records`, with views of the data for bytes; None if it is private


class _View:
    """Bytes for the library, without copies; reading beyond their end fails, as in no file."""

    def __init__(self, data: memoryview, place: int) -> None:
        self._data = data
        self.place = place

    def read(self, size: int) -> memoryview:
        start = self.place
        self.place = self.place + size
        if not start <= self.place <= len(self._data):
            raise EndOfFile
        return self._data[start : self.place]


def records(data: memoryview, place: int = 0) -> Iterator[Record]:
    """Yields the records from an offset until a footer or the end; DamageError at a broken one."""
    stream = _View(data, place)
    source = cast("IO[bytes]", stream)
    parsed = StreamReader(
        source, skip_magic=True, emit_chunks=True, record_size_limit=None
    ).records
    while place < len(data):
        start = place + PREFIX
        op, size = (
            struct.unpack_from("<BQ", data, place) if start <= len(data) else (0, start)
        )
        end = start + size
        content: kinds.McapRecord | None = None
        if end > len(data):
            raise DamageError(place, "a record is cut off")
        if not Opcode.HEADER <= op <= Opcode.DATA_END and op < PRIVATE:
            raise DamageError(place, f"there is no record of kind {op}")
        if op < PRIVATE:
            try:
                content = next(parsed)
            except UnicodeDecodeError:
                raise DamageError(place, "a text is not UTF-8", end) from None
            except EndOfFile:
                stream.place = len(data) + 1
            if stream.place != end:
                raise DamageError(place, "a record is shorter than its fields", end)
        yield Record(place, end, content)
        if isinstance(content, kinds.Footer):
            return
        place = end


@dataclass
class McapSummary:
    """Contents of a file, gathered from the records read so far."""

    schemas: dict[int, kinds.Schema] = field(default_factory=dict)  # by id
    channels: dict[int, kinds.Channel] = field(default_factory=dict)  # by id
    counts: Counter[int] = field(
        default_factory=Counter
    )  # number of messages by channel
    span: tuple[int, int] | None = (
        None  # first and last time [ns]; None before the first message
    )

    def see(self, record: Record) -> kinds.Message | None:
        """Registers a schema, a channel or a message; returns the message."""
        found = record.content
        if isinstance(found, kinds.Message):
            if found.channel_id not in self.channels:
                fault = f"a message of the unknown channel {found.channel_id}"
                raise DamageError(record.offset, fault)
            first, last = self.span or (found.log_time, found.log_time)
            self.span = min(first, found.log_time), max(last, found.log_time)
            self.counts[found.channel_id] += 1
            return found
        known: dict[int, Any] = (
            self.schemas if isinstance(found, kinds.Schema) else self.channels
        )
        if known.setdefault(found.id, found) != found:
            kind = type(found).__name__.lower()
            raise DamageError(record.offset, f"a second {kind} with the id {found.id}")
        return None


def unpacked(record: Record) -> memoryview:
    """Decompresses the records of a chunk and verifies size and checksum (DamageError)."""
    chunk: kinds.Chunk = record.content
    if chunk.compression not in COMPRESSIONS:
        raise DamageError(
            record.offset, f"there is no compression {chunk.compression!r}"
        )
    try:
        plain = chunk.data
        if chunk.compression:
            plain = unpack(bytes(plain), chunk.compression, chunk.uncompressed_size)
    except Exception as error:  # noqa: BLE001 - the library can raise anything on a damaged chunk
        raise DamageError(
            record.offset, f"a chunk can't be unpacked ({error})"
        ) from None
    if len(plain) != chunk.uncompressed_size:
        raise DamageError(record.offset, "a chunk is not as long as it says")
    if chunk.uncompressed_crc and crc32(plain) != chunk.uncompressed_crc:
        raise DamageError(record.offset, "a chunk's checksum is wrong")
    return memoryview(plain)


def mapped(path: Path, access: int = ACCESS_READ) -> memoryview:
    """Maps a file into memory; the mapping lasts until its last view is released."""
    with path.open("rb" if access == ACCESS_READ else "r+b") as file:
        return memoryview(mmap(file.fileno(), 0, access=access))


def seal(path: Path) -> None:
    """Adds the checksums of chunks, data and summary to a file that was written without them."""
    data = mapped(path, ACCESS_WRITE)
    for record in records(data, len(MAGIC)):
        content = record.offset + PREFIX
        if isinstance(record.content, kinds.Chunk):
            struct.pack_into("<I", data, content + CHUNK_CRC, crc32(unpacked(record)))
        elif isinstance(record.content, kinds.DataEnd):
            struct.pack_into("<I", data, content, crc32(data[: record.offset]))
        elif isinstance(record.content, kinds.Footer) and (
            start := record.content.summary_start
        ):
            struct.pack_into(
                "<I", data, record.end - 4, crc32(data[start : record.end - 4])
            )


@dataclass
class _Walk:
    data: McapSummary = field(default_factory=McapSummary)  # of the data section
    summary: McapSummary = field(default_factory=McapSummary)  # of the summary
    data_end: int = 0  # offset of the summary; 0 within the data
    # Offset, length and time span of each chunk, by the data and by the summary.
    chunks: set[tuple[int, ...]] = field(default_factory=set)
    indexed: set[tuple[int, ...]] = field(default_factory=set)
    statistics: Record | None = None
    # Time and offset in the last chunk of its messages, by channel.
    places: dict[int, list[tuple[int, int]]] = field(default_factory=dict)


def check_mcap(path: Path) -> None:
    """Checks a file (https://mcap.dev/spec) from its first byte to its last (DamageError)."""
    if path.stat().st_size < len(MAGIC):
        raise DamageError(0, "the file is empty or ends at once")
    data = mapped(path)
    walk = _Walk()
    end = len(data) - len(MAGIC)
    if data[: len(MAGIC)] != MAGIC:
        raise DamageError(0, "it does not begin as an MCAP file")
    if end <= len(MAGIC) or data[end:] != MAGIC:
        fault = "it does not end as an MCAP file: it is cut off or was not closed"
        raise DamageError(len(data), fault)
    for record in records(data[:end], len(MAGIC)):
        if record.offset == len(MAGIC) and not isinstance(record.content, kinds.Header):
            raise DamageError(record.offset, "the header is missing")
        if walk.data_end:
            _in_summary(walk, record)
        else:
            _in_data(walk, record, data)
    footer = record.content
    if not isinstance(footer, kinds.Footer) or record.end != end:
        raise DamageError(record.offset, "its end has no footer")
    summary = data[footer.summary_start : record.end - 4]
    if (
        footer.summary_start
        and not walk.data_end <= footer.summary_start <= record.offset
    ):
        raise DamageError(record.offset, "the footer points to no summary")
    if (
        footer.summary_start
        and footer.summary_crc
        and crc32(summary) != footer.summary_crc
    ):
        raise DamageError(record.offset, "the checksum of its summary is wrong")
    _agree(walk)


def _in_data(walk: _Walk, record: Record, data: memoryview) -> None:
    found = record.content
    if isinstance(found, INSIDE):
        walk.data.see(record)
    elif isinstance(found, kinds.Chunk):
        try:
            _in_chunk(walk, record)
        except DamageError as damage:
            raise DamageError(record.offset, damage.what) from None
    elif isinstance(found, kinds.MessageIndex):
        if sorted(found.records) != sorted(walk.places.pop(found.channel_id, [])):
            raise DamageError(
                record.offset, "the index of a chunk does not fit its messages"
            )
    elif isinstance(found, kinds.DataEnd):
        if (
            found.data_section_crc
            and crc32(data[: record.offset]) != found.data_section_crc
        ):
            raise DamageError(record.offset, "the checksum of its data is wrong")
        walk.data_end = record.end
    elif isinstance(found, (kinds.Footer, kinds.ChunkIndex, kinds.Statistics)):
        raise DamageError(record.offset, "the summary begins before the data end")


def _in_chunk(walk: _Walk, record: Record) -> None:
    """Walks through a chunk and keeps its messages for the index records that follow it."""
    walk.places = {}
    times: list[int] = []
    for inner in records(unpacked(record)):
        if not isinstance(inner.content, INSIDE):
            kind = type(inner.content).__name__
            raise DamageError(record.offset, f"a chunk holds a record of kind {kind}")
        message = walk.data.see(inner)
        if message is not None:
            times.append(message.log_time)
            walk.places.setdefault(message.channel_id, []).append(
                (message.log_time, inner.offset)
            )
    span = record.content.message_start_time, record.content.message_end_time
    if times and (min(times), max(times)) != span:
        raise DamageError(
            record.offset, "a chunk's messages are not of the time that it names"
        )
    walk.chunks.add((record.offset, record.end - record.offset, *span))


def _in_summary(walk: _Walk, record: Record) -> None:
    found = record.content
    if isinstance(found, (kinds.Chunk, kinds.Message)):
        raise DamageError(record.offset, "there are data behind their end")
    if isinstance(found, kinds.DataEnd):
        raise DamageError(record.offset, "its data end twice")
    if isinstance(found, (kinds.Schema, kinds.Channel)):
        walk.summary.see(record)
    elif isinstance(found, kinds.ChunkIndex):
        span = found.message_start_time, found.message_end_time
        walk.indexed.add((found.chunk_start_offset, found.chunk_length, *span))
    elif isinstance(found, kinds.Statistics):
        walk.statistics = record


def _agree(walk: _Walk) -> None:
    data = walk.data
    summary = walk.summary
    for name in ("schemas", "channels"):
        ours = getattr(data, name)
        theirs = getattr(summary, name)
        if theirs and any(theirs.get(key) != value for key, value in ours.items()):
            raise DamageError(
                walk.data_end, f"the {name} of its summary are not those of its data"
            )
    for channel in data.channels.values():
        if channel.schema_id and channel.schema_id not in data.schemas:
            raise DamageError(
                walk.data_end, f"the channel {channel.topic!r} has no schema"
            )
    if walk.indexed and walk.indexed != walk.chunks:
        raise DamageError(walk.data_end, "the index of its chunks does not fit them")
    if walk.statistics is None:
        return
    told: kinds.Statistics = walk.statistics.content
    counts = Counter({key: n for key, n in told.channel_message_counts.items() if n})
    if not (
        told.message_count == data.counts.total()
        and (not counts or counts == data.counts)
        and told.chunk_count in (0, len(walk.chunks))
        and data.span in (None, (told.message_start_time, told.message_end_time))
    ):
        raise DamageError(
            walk.statistics.offset, "its statistics do not fit its messages"
        )


def _zstd() -> Any:
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module(
            "backports.zstd"
        )  # a dependency of rosbags before Python 3.14


def unpack(data: bytes, compression: str, most: int = MOST_UNPACKED) -> bytes:
    """Unpacks `lz4` or `zstd`; ValueError: cut off, or above `most` bytes (may be terabytes)."""
    if compression == "zstd":
        unpacker = _zstd().ZstdDecompressor()
    else:
        unpacker = import_module("lz4.frame").LZ4FrameDecompressor()
    most = min(most, MOST_UNPACKED)
    plain = bytes(unpacker.decompress(data, max_length=most + 1))
    if len(plain) > most:
        raise ValueError(f"it unpacks to more than {most} bytes")
    if not unpacker.eof:
        raise ValueError("it is cut off")
    return plain


def unpack_file(path: Path, out: Path) -> Path:
    """Decompresses a file. Raises ValueError if it becomes far larger than it was."""
    most = max(MOST_UNPACKED, MOST_PACKED_SHARE * path.stat().st_size)
    length = 0
    with _zstd().open(path, "rb") as file, out.open("wb") as plain:
        while part := file.read(_PART):
            length += plain.write(part)
            if length > most:
                raise ValueError(
                    f"{path.name} unpacks to more than {MOST_PACKED_SHARE} times"
                )
    return out


def check_message(data: bytes) -> None:
    """Raises ValueError for a compressed message whose stated size is missing or too large."""
    size = _zstd().get_frame_info(data).decompressed_size
    if size is None or size > MOST_UNPACKED:
        raise ValueError(f"a message unpacks to {size or 'unknown'} bytes")
