"""Safe decompression of parts of bags: a few bytes can unpack to terabytes."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

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
                raise ValueError(f"{path.name} unpacks to more than {MOST_PACKED_SHARE} times")
    return out


def check_message(data: bytes) -> None:
    """Raises ValueError for a compressed message whose stated size is missing or too large."""
    size = _zstd().get_frame_info(data).decompressed_size
    if size is None or size > MOST_UNPACKED:
        raise ValueError(f"a message unpacks to {size or 'unknown'} bytes")
