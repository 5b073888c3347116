"""MCAP files: read by the library `mcap`, with the checks that its readers omit."""

import struct
from collections.abc import Iterator
from importlib import import_module
from mmap import ACCESS_READ, ACCESS_WRITE, mmap
from pathlib import Path
from typing import IO, Any, cast
from zlib import crc32

from mcap.exceptions import EndOfFile
from mcap.records import Chunk, DataEnd, Footer, McapRecord
from mcap.stream_reader import StreamReader

COMPRESSIONS = ("", "lz4", "zstd")
CRC_BYTES = 4
DATA_END_BYTES = 13
# maximum size of one chunk or message, decompressed [bytes]
MOST_UNPACKED = 256 * 2**20
# maximum compression ratio of a file that decompresses to more than that
MOST_PACKED_SHARE = 1000
_PART = 2**20


def read_records(data: mmap) -> Iterator[tuple[int, McapRecord]]:
    """Yields the records of a file, with chunks unopened, and the offset after each.

    Raises ValueError, or an error of the library, at a broken one.
    """
    source = cast("IO[bytes]", data)
    records = StreamReader(source, emit_chunks=True, validate_crcs=True).records
    try:
        for record in records:
            yield data.tell(), record
    except EndOfFile:
        raise ValueError("it is cut off or was not closed") from None


def unpack_chunk(chunk: Chunk) -> bytes:
    """Decompresses the records of a chunk. Raises ValueError if size or checksum is wrong."""
    if chunk.compression not in COMPRESSIONS:
        raise ValueError(f"there is no compression {chunk.compression!r}")
    plain = chunk.data
    if chunk.compression:
        plain = unpack(plain, chunk.compression, chunk.uncompressed_size)
    if len(plain) != chunk.uncompressed_size:
        raise ValueError("a chunk does not have its stated length")
    if chunk.uncompressed_crc and crc32(plain) != chunk.uncompressed_crc:
        raise ValueError("a chunk's checksum is wrong")
    return plain


def write_checksums(path: Path) -> None:
    """Adds the checksums of chunks, data and summary to a file that was written without them."""
    with (
        path.open("r+b") as file,
        mmap(file.fileno(), 0, access=ACCESS_WRITE) as data,
        memoryview(data) as view,
    ):
        for end, record in read_records(data):
            crc = None
            place = end - CRC_BYTES
            if isinstance(record, Chunk):
                crc = crc32(unpack_chunk(record))
                # It is followed by two lengths, the compression and the data.
                place -= 12 + len(record.compression) + len(record.data)
            elif isinstance(record, DataEnd):
                crc = crc32(view[: end - DATA_END_BYTES])
            elif isinstance(record, Footer) and record.summary_start:
                crc = crc32(view[record.summary_start : place])
            if crc is not None:
                struct.pack_into("<I", data, place, crc)


def check_mcap(path: Path) -> None:
    """Checks chunks, order and checksums of a file. Raises ValueError at the first fault.

    Index and statistics are not compared with the messages; `BagFile` compares counts and times.
    """
    with (
        path.open("rb") as file,
        mmap(file.fileno(), 0, access=ACCESS_READ) as data,
        memoryview(data) as view,
    ):
        for end, record in read_records(data):
            if isinstance(record, Chunk):
                unpack_chunk(record)
            elif isinstance(record, Footer) and record.summary_crc:
                crc = crc32(view[record.summary_start : end - CRC_BYTES])
                if crc != record.summary_crc:
                    raise ValueError("the checksum of its summary is wrong")
        if data.tell() != len(data):
            raise ValueError("it contains data after its end")


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
