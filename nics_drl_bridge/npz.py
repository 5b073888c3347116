"""`.npz` files that are equal for equal arrays, mapped into memory, and sealed.

The seal is a SHA-256 of all that stands before it, in the comment at the end of the zip archive, so
that every flipped bit is noticed, also of a header.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

_LOCAL_HEADER = struct.Struct("<4s5H3L2H")
"""Of a zip entry; the last two are the lengths of its name and of its further fields."""
_SEAL = b"sha256 "
_SEAL_SIZE = len(_SEAL) + 64
DAMAGE = (
    AttributeError,  # a plain `.npy` file
    EOFError,
    KeyError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,  # of a way to pack that zipfile does not know, or a password
    SyntaxError,
    TypeError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What reading a damaged `.npz` file may raise besides ValueError."""
MOST_BYTES = 256 * 2**20
"""Of a file, and of what is unpacked of it: a day of driving, or the table of a thousand shapes."""
ALIGNMENT = 64
_PADDING = 0xD935
"""Id of a zip entry's field that only fills up, the one that Android's zipalign takes."""


def npz_bytes(arrays: Mapping[str, NDArray[Any]], packed: bool = True) -> bytes:
    """The content of an `.npz` file; equal arrays give equal bytes, unlike `numpy.savez`.

    Args:
        arrays: by name.
        packed: compressed; otherwise aligned so that `npz_mapped` can map them.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")  # dated 1980, not today
            member.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(array), allow_pickle=False)
            if not packed:
                begin = buffer.tell() + _LOCAL_HEADER.size + len(member.filename) + 4
                fill = -begin % ALIGNMENT
                member.extra = struct.pack("<HH", _PADDING, fill) + bytes(fill)
            archive.writestr(member, content.getvalue())
        archive.comment = _SEAL + bytes(64)
    data = buffer.getvalue()[:-64]
    return data + hashlib.sha256(data).hexdigest().encode()


def is_sealed(data: bytes) -> bool:
    """True if the content of an `.npz` file ends with a seal.

    Raises:
        ValueError: with one that does not fit the rest.
    """
    if not data[-_SEAL_SIZE:].startswith(_SEAL):
        return False
    if hashlib.sha256(data[:-64]).hexdigest().encode() != data[-64:]:
        raise ValueError("its checksum does not fit the rest")
    return True


def npz_mapped(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` file, mapped into memory: processes that map it share its pages.

    They are copied when written to, the file stays. What is compressed is read instead.

    Raises:
        ValueError: the file is damaged, or has no seal.
    """
    arrays = {}
    try:
        _check_seal(read_file(path))
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            _check_unpacked(archive)
            for member in archive.infolist():
                name = member.filename.removesuffix(".npy")
                if member.compress_type != zipfile.ZIP_STORED:
                    content = io.BytesIO(archive.read(member))
                    arrays[name] = np.lib.format.read_array(content, allow_pickle=False)
                    continue
                file.seek(member.header_offset)
                fields = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
                file.seek(fields[-2] + fields[-1], os.SEEK_CUR)
                version = np.lib.format.read_magic(file)
                shape, fortran, dtype = _array_header(file, version)
                size = int(np.prod(shape)) * dtype.itemsize
                if fortran or dtype.hasobject or file.tell() + size > path.stat().st_size:
                    raise ValueError(f"the array {name!r} is of a wrong kind or cut off")
                mapped = np.memmap(path, dtype, "c", file.tell(), shape) if size else None
                arrays[name] = np.zeros(shape, dtype) if mapped is None else np.asarray(mapped)
    except DAMAGE as error:
        raise ValueError(str(error) or type(error).__name__) from None
    return arrays


def read_file(path: Path) -> bytes:
    """The content of a file. Raises ValueError when it is larger than any `.npz` file here."""
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"it is larger than {MOST_BYTES // 2**20} MB")
    return path.read_bytes()


def _check_unpacked(archive: zipfile.ZipFile) -> None:
    """Raises ValueError for an archive that is small, but not what is packed in it."""
    size = sum(member.file_size for member in archive.infolist())
    if size > MOST_BYTES:
        raise ValueError(f"unpacked it is larger than {MOST_BYTES // 2**20} MB")


def _check_seal(data: bytes) -> None:
    if not is_sealed(data):
        raise ValueError("its end is missing or damaged: there is no checksum")


def _array_header(file: BinaryIO, version: tuple[int, int]) -> tuple[Any, bool, np.dtype[Any]]:
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    return np.lib.format.read_array_header_2_0(file)


def npz_arrays(data: bytes, seal_needed: bool = True) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` file's content.

    Raises:
        ValueError: it is damaged, or has no seal though one is needed.
    """
    try:
        if seal_needed:
            _check_seal(data)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            _check_unpacked(archive)
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except DAMAGE as error:
        raise ValueError(str(error) or type(error).__name__) from None
