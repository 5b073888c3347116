"""MCAP files: records parsed by the library `mcap`, and the checks that its readers omit."""

import struct
from collections.abc import Iterator
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
# records that may occur in a chunk
INSIDE = (kinds.Schema, kinds.Channel, kinds.Message)
# maximum size of one chunk or message, decompressed [bytes]
MOST_UNPACKED = 256 * 2**20
# maximum compression ratio of a file that decompresses to more than that
MOST_PACKED_SHARE = 1000
_PART = 2**20


class DamageError(ValueError):
    """Damage of a file: byte offset of the record, and what is wrong."""

    def __init__(self, offset: int, what: str) -> None:
        super().__init__(f"byte {offset}: {what}")
        self.offset = offset
        self.what = what


class Record(NamedTuple):
    """One record."""

    offset: int  # place of its opcode, from the start of the file or of the chunk
    end: int  # offset of the next record
    content: Any  # one of `mcap.records`, with views of the data for bytes; None if it is private


class _View:
    """Bytes for the library, without copies; unlike in a file, reading past their end fails."""

    def __init__(self, data: memoryview, place: int) -> None:
        self._data = data
        self.place = place

    def read(self, size: int) -> memoryview:
        start = self.place
        self.place = self.place + size
        if not start <= self.place <= len(self._data):
            raise EndOfFile
        return self._data[start : self.place]


def read_records(data: memoryview, place: int = 0) -> Iterator[Record]:
    """Yields records from an offset to a footer or the end. Raises DamageError at a broken one."""
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
                raise DamageError(place, "a text is not UTF-8") from None
            except EndOfFile:
                stream.place = len(data) + 1
            if stream.place != end:
                raise DamageError(place, "a record is shorter than its fields")
        yield Record(place, end, content)
        if isinstance(content, kinds.Footer):
            return
        place = end


def unpack_chunk(record: Record) -> memoryview:
    """Decompresses the records of a chunk. Raises DamageError if size or checksum is wrong."""
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


def map_file(path: Path, access: int = ACCESS_READ) -> memoryview:
    """Maps a file into memory; the mapping lasts until its last view is released."""
    with path.open("rb" if access == ACCESS_READ else "r+b") as file:
        return memoryview(mmap(file.fileno(), 0, access=access))


def write_checksums(path: Path) -> None:
    """Adds the checksums of chunks, data and summary to a file that was written without them."""
    data = map_file(path, ACCESS_WRITE)
    for record in read_records(data, len(MAGIC)):
        content = record.offset + PREFIX
        if isinstance(record.content, kinds.Chunk):
            struct.pack_into(
                "<I", data, content + CHUNK_CRC, crc32(unpack_chunk(record))
            )
        elif isinstance(record.content, kinds.DataEnd):
            struct.pack_into("<I", data, content, crc32(data[: record.offset]))
        elif isinstance(record.content, kinds.Footer):
            start = record.content.summary_start
            end = record.end - 4
            if start:
                struct.pack_into("<I", data, end, crc32(data[start:end]))


def check_mcap(path: Path) -> None:
    """Checks all records, chunks and checksums of a file. Raises DamageError at the first fault.

    Index and statistics are not compared with the messages; `BagFile` compares counts and times.
    """
    if path.stat().st_size < len(MAGIC):
        raise DamageError(0, "the file is empty or ends at once")
    data = map_file(path)
    end = len(data) - len(MAGIC)
    if data[: len(MAGIC)] != MAGIC:
        raise DamageError(0, "it does not begin as an MCAP file")
    if end <= len(MAGIC) or data[end:] != MAGIC:
        fault = "it does not end as an MCAP file: it is cut off or was not closed"
        raise DamageError(len(data), fault)
    data_end = 0  # offset of the summary; 0 until the end of the data
    for record in read_records(data[:end], len(MAGIC)):
        content = record.content
        if record.offset == len(MAGIC) and not isinstance(content, kinds.Header):
            raise DamageError(record.offset, "the header is missing")
        if isinstance(content, kinds.Chunk):
            _check_chunk(record)
        elif isinstance(content, kinds.DataEnd):
            data_end = record.end
            _check_crc(record, data[: record.offset], content.data_section_crc, "data")
    footer = record.content
    if not isinstance(footer, kinds.Footer) or record.end != end:
        raise DamageError(record.offset, "its end has no footer")
    if not footer.summary_start:
        return
    if not data_end <= footer.summary_start <= record.offset:
        raise DamageError(record.offset, "the footer points to no summary")
    summary = data[footer.summary_start : record.end - 4]
    _check_crc(record, summary, footer.summary_crc, "summary")


def _check_crc(record: Record, data: memoryview, crc: int, name: str) -> None:
    if crc and crc32(data) != crc:
        raise DamageError(record.offset, f"the checksum of its {name} is wrong")


def _check_chunk(record: Record) -> None:
    """Checks a chunk, which may hold only schemas, channels and messages (DamageError)."""
    try:
        for inner in read_records(unpack_chunk(record)):
            if not isinstance(inner.content, INSIDE):
                kind = type(inner.content).__name__
                raise DamageError(
                    record.offset, f"a chunk holds a record of kind {kind}"
                )
    except DamageError as damage:
        raise DamageError(record.offset, damage.what) from None


def _import_zstd() -> Any:
    try:
        return import_module("compression.zstd")
    except ImportError:
        # A dependency of rosbags before Python 3.14.
        return import_module("backports.zstd")


def unpack(data: bytes, compression: str, most: int = MOST_UNPACKED) -> bytes:
    """Unpacks `lz4` or `zstd`. Raises ValueError if cut off, or above `most` bytes unpacked."""
    if compression == "zstd":
        unpacker = _import_zstd().ZstdDecompressor()
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
    """Decompresses a file to `out`. Raises ValueError if it becomes implausibly large."""
    most = max(MOST_UNPACKED, MOST_PACKED_SHARE * path.stat().st_size)
    length = 0
    with _import_zstd().open(path, "rb") as file, out.open("wb") as plain:
        while part := file.read(_PART):
            length += plain.write(part)
            if length > most:
                raise ValueError(
                    f"{path.name} unpacks to more than {MOST_PACKED_SHARE} times"
                )
    return out


def check_message(data: bytes) -> None:
    """Raises ValueError for a compressed message whose stated size is missing or too large."""
    size = _import_zstd().get_frame_info(data).decompressed_size
    if size is None or size > MOST_UNPACKED:
        raise ValueError(f"a message unpacks to {size or 'unknown'} bytes")
