"""Writing files so that a reader finds the old one or the new one, whole."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError

_LOCAL_HEADER = struct.Struct("<4s5H3L2H")
"""Of a zip entry; the last two are the lengths of its name and of its further fields."""


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file through a temporary one, fsynced and renamed.

    Args:
        path: the file; its folder is made when missing.
        data: the whole content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    _fsync(path.parent)


def write_text(path: Path, text: str) -> None:
    """Writes a UTF-8 text file through a temporary one, fsynced and renamed."""
    write_bytes(path, text.encode())


def check_folder(path: Path, marker: str) -> Path:
    """Makes sure that `whole_folder` can make a folder, without making anything.

    Returns:
        The path without links: a link stays, the folder behind it is replaced.

    Raises:
        ConfigError: `path` is a file, a folder of another kind, or lies where nothing can be
            written.
    """
    path = path.resolve()
    if path.exists() and not path.is_dir():
        raise ConfigError(f"{path}: is a file, not a folder; give the name of a folder.")
    if path.is_dir() and any(path.iterdir()) and not (path / marker).exists():
        raise ConfigError(
            f"{path}: holds other files and no {marker!r}; give a new folder, or empty this one."
        )
    check_above(path)
    return path


def check_above(path: Path) -> None:
    """Makes sure that something can be made at a path, without making anything.

    Raises:
        ConfigError: it lies where nothing can be written.
    """
    above = next(parent for parent in path.resolve().parents if parent.exists())
    if not above.is_dir():
        raise ConfigError(f"{path}: {above} is a file, not a folder; choose another place.")
    if not os.access(above, os.W_OK | os.X_OK):
        raise ConfigError(f"{path}: {above} can't be written to; choose another place.")


@contextmanager
def whole_folder(path: Path, marker: str) -> Iterator[Path]:
    """Gives a temporary folder that takes the place of `path` when the block ends well.

    Args:
        path: the folder to make. An existing one is replaced only if it is empty or holds
            `marker`, so that a wrong `--out` never removes somebody's work.
        marker: a file name that a folder of this kind always holds.

    Yields:
        The temporary folder, beside `path`. After an error nothing is left of it.

    Raises:
        ConfigError: see `check_folder`.
    """
    path = check_folder(path, marker)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        yield temporary
        sync_folder(temporary)
        temporary.chmod(0o755)
        _swap(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _swap(new: Path, path: Path) -> None:
    """Puts `new` at `path`; the old folder is moved away first and removed last."""
    old = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.old."))
    try:
        if path.exists():
            os.replace(path, old)
        try:
            os.replace(new, path)
        except BaseException:
            if not path.exists():
                os.rename(old, path)
            raise
        _fsync(path.parent)
    finally:
        shutil.rmtree(old, ignore_errors=True)


def sync_folder(folder: Path) -> None:
    """Makes sure that a folder and all in it are on the disk."""
    for file in (*folder.rglob("*"), folder):
        _fsync(file)


def sha256(data: bytes) -> str:
    """The SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


DAMAGE = (
    AttributeError,  # a plain `.npy` file
    EOFError,
    KeyError,
    MemoryError,
    NotImplementedError,
    OSError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    TypeError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What reading a damaged `.npz` file may raise besides ValueError."""
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
    return buffer.getvalue()


def npz_mapped(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` file, mapped into memory: processes that map it share its pages.

    They are copied when written to, the file stays. What is compressed is read instead.

    Raises:
        ValueError: the file is damaged.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
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


def _array_header(file: BinaryIO, version: tuple[int, int]) -> tuple[Any, bool, np.dtype[Any]]:
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    return np.lib.format.read_array_header_2_0(file)


def npz_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` file's content. Raises ValueError when it is damaged."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except DAMAGE as error:
        raise ValueError(str(error) or type(error).__name__) from None
