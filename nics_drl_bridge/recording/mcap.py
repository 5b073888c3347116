"""Records of an MCAP file, parsed by the library `mcap`, with what its readers leave unchecked.

They skip records of unknown kinds, and accept fields that are cut off or overlap the next record.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from mmap import ACCESS_READ, ACCESS_WRITE, mmap
from pathlib import Path
from typing import IO, Any, NamedTuple, cast
from zlib import crc32

from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader

from nics_drl_bridge.recording.packing import unpack

MAGIC = b"\x89MCAP0\r\n"
PRIVATE = 0x80
"""Opcodes from here on are reserved for private records."""
PREFIX = 9
"""Bytes of opcode and length in front of a record."""
CHUNK_CRC = 24
"""Offset of a chunk's checksum in its content."""
COMPRESSIONS = ("", "lz4", "zstd")
INSIDE = (Schema, Channel, Message)
"""Records that may occur in a chunk."""


class DamageError(ValueError):
    """Damage of a file, with its byte offset.

    Attributes:
        offset: of the damaged record.
        what: is wrong with it.
        end: offset of the next record, if it is known in spite of the damage.
    """

    def __init__(self, offset: int, what: str, end: int | None = None) -> None:
        super().__init__(f"byte {offset}: {what}")
        self.offset, self.what, self.end = offset, what, end


class Record(NamedTuple):
    """One record.

    Attributes:
        offset: of its opcode, from the start of the file or of the chunk.
        end: offset of the next record.
        content: one of `mcap.records`, with views of the data for bytes; None if it is private.
    """

    offset: int
    end: int
    content: Any


class _View:
    """Bytes for the library, without copies; reading beyond their end fails, as in no file."""

    def __init__(self, data: memoryview, place: int) -> None:
        self._data, self.place = data, place

    def read(self, size: int) -> memoryview:
        start, self.place = self.place, self.place + size
        if not start <= self.place <= len(self._data):
            raise EndOfFile
        return self._data[start : self.place]


def records(data: memoryview, place: int = 0) -> Iterator[Record]:
    """Yields the records from an offset on, until the end of the data or a footer.

    Raises:
        DamageError: a record is truncated, of an unknown kind, or shorter than its fields.
    """
    stream = _View(data, place)
    source = cast("IO[bytes]", stream)
    reader = StreamReader(source, skip_magic=True, emit_chunks=True, record_size_limit=None)
    parsed = reader.records
    while place < len(data):
        start = place + PREFIX
        op, size = struct.unpack_from("<BQ", data, place) if start <= len(data) else (0, start)
        end = start + size
        content: McapRecord | None = None
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
        if isinstance(content, Footer):
            return
        place = end


@dataclass
class McapSummary:
    """Contents of a file, gathered from the records read so far.

    Attributes:
        schemas: by id.
        channels: by id.
        counts: number of messages by channel.
        span: first and last time [ns]; None before the first message.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    span: tuple[int, int] | None = None

    def see(self, record: Record) -> Message | None:
        """Registers a schema, a channel or a message; returns the message."""
        found = record.content
        if isinstance(found, Message):
            if found.channel_id not in self.channels:
                raise DamageError(
                    record.offset, f"a message of the unknown channel {found.channel_id}"
                )
            first, last = self.span or (found.log_time, found.log_time)
            self.span = min(first, found.log_time), max(last, found.log_time)
            self.counts[found.channel_id] += 1
            return found
        known: dict[int, Any] = self.schemas if isinstance(found, Schema) else self.channels
        if known.setdefault(found.id, found) != found:
            kind = type(found).__name__.lower()
            raise DamageError(record.offset, f"a second {kind} with the id {found.id}")
        return None


def unpacked(record: Record) -> memoryview:
    """Decompresses the records of a chunk and verifies size and checksum.

    Raises:
        DamageError: it can't be decompressed, or size or checksum is wrong.
    """
    chunk: Chunk = record.content
    if chunk.compression not in COMPRESSIONS:
        raise DamageError(record.offset, f"there is no compression {chunk.compression!r}")
    try:
        plain = chunk.data
        if chunk.compression:
            plain = unpack(bytes(plain), chunk.compression, chunk.uncompressed_size)
    except Exception as error:  # noqa: BLE001 - the library can raise anything on a damaged chunk
        raise DamageError(record.offset, f"a chunk can't be unpacked ({error})") from None
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
        if isinstance(record.content, Chunk):
            struct.pack_into("<I", data, content + CHUNK_CRC, crc32(unpacked(record)))
        elif isinstance(record.content, DataEnd):
            struct.pack_into("<I", data, content, crc32(data[: record.offset]))
        elif isinstance(record.content, Footer) and (summary := record.content.summary_start):
            struct.pack_into("<I", data, record.end - 4, crc32(data[summary : record.end - 4]))
