"""Unpacks parts of bags, of which a few bytes may say that they are terabytes."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

MOST_UNPACKED = 256 * 2**20
"""Bytes of one chunk or message, unpacked."""
MOST_PACKED_SHARE = 1000
"""So many times as long may a file be unpacked, once it is longer than `MOST_UNPACKED`."""
_PART = 2**20


def _zstd() -> Any:
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")  # of rosbags, before Python 3.14


def unpack(data: bytes, compression: str, most: int = MOST_UNPACKED) -> bytes:
    """The content of a chunk.

    Args:
        data: packed.
        compression: `lz4` or `zstd`.
        most: bytes that it may have.

    Raises:
        ValueError: it has more. What else the libraries raise at damaged data, they raise.
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
    """Raises ValueError for a file that would unpack to very many times its length."""
    most = max(MOST_UNPACKED, MOST_PACKED_SHARE * path.stat().st_size)
    length = 0
    with _zstd().open(path, "rb") as file:
        while part := file.read(_PART):
            length += len(part)
            if length > most:
                raise ValueError(f"{path.name} unpacks to more than {MOST_PACKED_SHARE} times")


def check_message(data: bytes) -> None:
    """Raises ValueError for a packed message that does not say how long it is, or is too long."""
    size = _zstd().get_frame_info(data).decompressed_size
    if size is None or size > MOST_UNPACKED:
        raise ValueError(f"a message unpacks to {size or 'unknown'} bytes")
