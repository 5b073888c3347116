"""Records of an MCAP file, to find damage that readers overlook.

MCAP readers follow the index at the end of the file: messages that a damaged index omits are lost
silently. Here the file is walked from its first byte to its last, as laid out in its specification
(https://mcap.dev/spec); counts, times and index must agree, and every checksum present must match.

Safe decompression of parts of bags: a few bytes can unpack to terabytes.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from mmap import ACCESS_READ, ACCESS_WRITE, mmap
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

Bytes = bytes | memoryview

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET = range(9, 15)
DATA_END = 15
PRIVATE = 0x80
"""Opcodes from here on are reserved for private records."""
PREFIX = 9
"""Bytes of opcode and length in front of a record."""
FOOTER_BYTES = PREFIX + 20
CHUNK_CRC = 24
"""Offset of a chunk's checksum in its content."""
COMPRESSIONS = ("", "lz4", "zstd")
INSIDE = (SCHEMA, CHANNEL, MESSAGE)
"""Records that may occur in a chunk."""


class DamageError(ValueError):
    """Damage of a file, with its byte offset."""

    def __init__(self, offset: int, what: str) -> None:
        super().__init__(f"byte {offset}: {what}")
        self.offset, self.what = offset, what


class Record(NamedTuple):
    """One record.

    Attributes:
        offset: of its opcode, from the start of the file or of the chunk.
        op: its opcode.
        content: bytes after the length.
    """

    offset: int
    op: int
    content: memoryview

    @property
    def end(self) -> int:
        """Offset of the next record."""
        return self.offset + PREFIX + len(self.content)


class McapSchema(NamedTuple):
    """A message type: name, encoding of its definition, definition."""

    name: str
    encoding: str
    text: str


class Channel(NamedTuple):
    """A topic: schema id, name, encoding of its messages, further keys."""

    schema: int
    topic: str
    encoding: str
    metadata: tuple[tuple[str, str], ...]


class McapMessage(NamedTuple):
    """A message as it was recorded."""

    channel: int
    time_ns: int
    data: bytes


class Chunk(NamedTuple):
    """Header of a chunk, and its records, still compressed."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    records: memoryview


@dataclass
class McapSummary:
    """Contents of a file, gathered from the records read so far.

    Attributes:
        schemas: by id.
        channels: by id.
        counts: number of messages by channel.
        span: first and last time [ns]; None before the first message.
    """

    schemas: dict[int, McapSchema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    span: tuple[int, int] | None = None

    def see(self, record: Record) -> McapMessage | None:
        """Registers a schema, a channel or a message; returns the message."""
        if record.op == SCHEMA:
            key, schema = schema_of(record)
            if self.schemas.setdefault(key, schema) != schema:
                raise DamageError(record.offset, f"a second schema with the id {key}")
        elif record.op == CHANNEL:
            key, channel = channel_of(record)
            if self.channels.setdefault(key, channel) != channel:
                raise DamageError(record.offset, f"a second channel with the id {key}")
        elif record.op == MESSAGE:
            message = message_of(record)
            if message.channel not in self.channels:
                raise DamageError(
                    record.offset, f"a message of the unknown channel {message.channel}"
                )
            first, last = self.span or (message.time_ns, message.time_ns)
            self.span = min(first, message.time_ns), max(last, message.time_ns)
            self.counts[message.channel] += 1
            return message
        return None


class _Fields:
    """Sequential reader of the fields of a record."""

    def __init__(self, record: Record) -> None:
        self._content, self._at, self._offset = record.content, 0, record.offset

    def numbers(self, layout: str) -> tuple[int, ...]:
        form = struct.Struct(f"<{layout}")
        return form.unpack(self.take(form.size))

    def take(self, size: int) -> memoryview:
        if self._at + size > len(self._content):
            raise DamageError(self._offset, "a record is shorter than its fields")
        self._at += size
        return self._content[self._at - size : self._at]

    def text(self) -> str:
        (size,) = self.numbers("I")
        try:
            return str(self.take(size), "utf-8")
        except UnicodeDecodeError:
            raise DamageError(self._offset, "a text is not UTF-8") from None

    def inner(self) -> _Fields:
        """Returns the fields of a map or an array."""
        (size,) = self.numbers("I")
        return _Fields(Record(self._offset, 0, self.take(size)))

    @property
    def more(self) -> bool:
        return self._at < len(self._content)

    def rest(self) -> memoryview:
        return self.take(len(self._content) - self._at)

    def done(self) -> None:
        if self.more:
            raise DamageError(self._offset, "a record is longer than its fields")


def records(data: memoryview, start: int, end: int, base: int = 0) -> Iterator[Record]:
    """Yields the records from `start` to `end`; `base` is added to all offsets.

    Raises:
        DamageError: a record is truncated or of an unknown kind.
    """
    while start < end:
        if start + PREFIX > end:
            raise DamageError(base + start, "a record is cut off")
        op, size = struct.unpack_from("<BQ", data, start)
        if start + PREFIX + size > end:
            raise DamageError(base + start, "a record is cut off")
        if not HEADER <= op <= DATA_END and op < PRIVATE:
            raise DamageError(base + start, f"there is no record of kind {op}")
        content = data[start + PREFIX : start + PREFIX + size]
        yield Record(base + start, op, content)
        start += PREFIX + size


def schema_of(record: Record) -> tuple[int, McapSchema]:
    """Returns id and content of a schema."""
    fields = _Fields(record)
    (key,) = fields.numbers("H")
    schema = McapSchema(fields.text(), fields.text(), fields.text())
    fields.done()
    return key, schema


def channel_of(record: Record) -> tuple[int, Channel]:
    """Returns id and content of a channel."""
    fields = _Fields(record)
    key, schema = fields.numbers("HH")
    topic, encoding = fields.text(), fields.text()
    inner, metadata = fields.inner(), []
    while inner.more:
        metadata.append((inner.text(), inner.text()))
    fields.done()
    return key, Channel(schema, topic, encoding, tuple(metadata))


def message_of(record: Record) -> McapMessage:
    """Parses a message."""
    fields = _Fields(record)
    channel, _, time_ns, _ = fields.numbers("HIQQ")
    return McapMessage(channel, time_ns, bytes(fields.rest()))


def chunk_of(record: Record) -> Chunk:
    """Parses the header of a chunk."""
    fields = _Fields(record)
    start, end, size, crc = fields.numbers("QQQI")
    compression = fields.text()
    (packed,) = fields.numbers("Q")
    content = fields.take(packed)
    fields.done()
    return Chunk(start, end, size, crc, compression, content)


def unpacked(record: Record) -> Bytes:
    """Decompresses the records of a chunk and verifies size and checksum.

    Raises:
        DamageError: it can't be decompressed, or size or checksum is wrong.
    """
    chunk = chunk_of(record)
    if chunk.compression not in COMPRESSIONS:
        raise DamageError(record.offset, f"there is no compression {chunk.compression!r}")
    try:
        plain = _decompress(chunk)
    except Exception as error:  # noqa: BLE001 - the library can raise anything on a damaged chunk
        raise DamageError(record.offset, f"a chunk can't be unpacked ({error})") from None
    if len(plain) != chunk.size:
        raise DamageError(record.offset, "a chunk is not as long as it says")
    if chunk.crc and crc32(plain) != chunk.crc:
        raise DamageError(record.offset, "a chunk's checksum is wrong")
    return plain


def _decompress(chunk: Chunk) -> Bytes:
    if chunk.compression == "":
        return chunk.records
    return unpack(bytes(chunk.records), chunk.compression, chunk.size)


def inner_records(record: Record) -> Iterator[Record]:
    """Yields the records of a chunk, with their offsets in it.

    Raises:
        DamageError: it is damaged, or contains a record that is not allowed in a chunk.
    """
    plain = memoryview(unpacked(record))
    for inner in records(plain, 0, len(plain)):
        if inner.op not in INSIDE:
            raise DamageError(record.offset, f"a chunk holds a record of kind {inner.op}")
        yield inner


def message_index_of(record: Record) -> tuple[int, list[tuple[int, int]]]:
    """Returns channel, and time [ns] and offset in the chunk of each of its messages."""
    fields = _Fields(record)
    (channel,) = fields.numbers("H")
    inner, entries = fields.inner(), []
    while inner.more:
        time_ns, place = inner.numbers("QQ")
        entries.append((time_ns, place))
    fields.done()
    return channel, entries


def mapped(path: Path, access: int = ACCESS_READ) -> memoryview:
    """Maps a file into memory; the mapping lasts until its last view is released."""
    with path.open("rb" if access == ACCESS_READ else "r+b") as file:
        return memoryview(mmap(file.fileno(), 0, access=access))


def seal(path: Path) -> None:
    """Adds the checksums of chunks, data and summary to a file that was written without them."""
    data = mapped(path, ACCESS_WRITE)
    chunks, place, summary = [], 0, 0
    for record in records(data, len(MAGIC), len(data) - len(MAGIC)):
        if record.op == CHUNK:
            chunks.append((record.offset, crc32(unpacked(record))))
        elif record.op == DATA_END:
            place = record.offset
        elif record.op == FOOTER:
            (summary,) = struct.unpack_from("<Q", record.content)
    for offset, crc in chunks:
        struct.pack_into("<I", data, offset + PREFIX + CHUNK_CRC, crc)
    struct.pack_into("<I", data, place + PREFIX, crc32(data[:place]))
    end = len(data) - len(MAGIC) - 4
    if summary:
        struct.pack_into("<I", data, end, crc32(data[summary:end]))


MOST_UNPACKED = 256 * 2**20
"""Maximum size of one chunk or message, decompressed [bytes]."""
MOST_PACKED_SHARE = 1000
"""Maximum compression ratio of a file that decompresses to more than `MOST_UNPACKED`."""
_PART = 2**20


def _zstd() -> Any:
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")  # a dependency of rosbags before Python 3.14


def unpack(data: bytes, compression: str, most: int = MOST_UNPACKED) -> bytes:
    """Decompresses the content of a chunk.

    Args:
        data: compressed data.
        compression: `lz4` or `zstd`.
        most: maximum size of the result [bytes].

    Raises:
        ValueError: the result is larger, or the data is truncated. Other exceptions of the
            libraries on damaged data are passed on.
    """
    kinds = {"lz4": ("lz4.frame", "LZ4FrameDecompressor")}
    if compression == "zstd":
        unpacker = _zstd().ZstdDecompressor()
    else:
        module, name = kinds[compression]
        unpacker = getattr(import_module(module), name)()
    plain = bytes(unpacker.decompress(data, max_length=min(most, MOST_UNPACKED) + 1))
    if len(plain) > min(most, MOST_UNPACKED):
        raise ValueError(f"it unpacks to more than {min(most, MOST_UNPACKED)} bytes")
    if not unpacker.eof:
        raise ValueError("it is cut off")
    return plain


def check_packed(path: Path) -> None:
    """Raises ValueError for a file that would decompress to far more than its length."""
    most = max(MOST_UNPACKED, MOST_PACKED_SHARE * path.stat().st_size)
    length = 0
    with _zstd().open(path, "rb") as file:
        while part := file.read(_PART):
            length += len(part)
            if length > most:
                raise ValueError(f"{path.name} unpacks to more than {MOST_PACKED_SHARE} times")


def check_message(data: bytes) -> None:
    """Raises ValueError for a compressed message whose stated size is missing or too large."""
    size = _zstd().get_frame_info(data).decompressed_size
    if size is None or size > MOST_UNPACKED:
        raise ValueError(f"a message unpacks to {size or 'unknown'} bytes")
