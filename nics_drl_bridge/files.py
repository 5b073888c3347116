"""Writing files so that a reader finds the old one or the new one, whole."""

from __future__ import annotations

import ctypes
import errno
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from nics_drl_bridge.errors import ConfigError

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: str | Path, data: bytes) -> None:
    """Writes a file through a temporary one, fsynced and renamed.

    Args:
        path: the file; its folder is made when missing.
        data: the whole content.
    """
    write_parts(path, [data])


def write_parts(path: str | Path, parts: Iterable[bytes]) -> None:
    """Writes a file as `write_bytes` does, part by part, so that it is never whole in memory."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.writelines(parts)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    _fsync(path.parent)


def write_text(path: str | Path, text: str) -> None:
    """Writes a UTF-8 text file through a temporary one, fsynced and renamed."""
    write_bytes(path, text.encode())


def check_folder(path: str | Path, marker: str) -> Path:
    """Makes sure that `whole_folder` can make a folder, without making anything.

    Returns:
        The path without links: a link stays, the folder behind it is replaced.

    Raises:
        ConfigError: `path` is a file, a folder of another kind, or lies where nothing can be
            written.
    """
    path = Path(path).resolve()
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
def whole_folder(path: str | Path, marker: str) -> Iterator[Path]:
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
    """Puts `new` at `path`, in one step; what was there before is then removed."""
    if path.exists() and _exchange(new, path):
        _fsync(path.parent)
        return
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


def _exchange(one: Path, other: Path) -> bool:
    """Lets two paths change places in one step, so that no moment is without either.

    Returns:
        False where the system or the file system can't (renameat2 is Linux's).
    """
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    ends = os.fsencode(one), os.fsencode(other)
    if rename(_AT_FDCWD, ends[0], _AT_FDCWD, ends[1], _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOENT):
        return False
    raise OSError(code, os.strerror(code), str(other))


def sync_folder(folder: Path) -> None:
    """Makes sure that a folder and all in it are on the disk."""
    for file in (*folder.rglob("*"), folder):
        _fsync(file)


def sha256(data: bytes) -> str:
    """The SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


_SEAL = b"sha256 "
_PART = 2**20


def sealed(data: bytes) -> bytes:
    """Some bytes with their checksum behind them, for `check_sealed`."""
    return data + _SEAL + sha256(data).encode()


def check_sealed(file: BinaryIO) -> None:
    """Holds what was written as `sealed` against its checksum, without reading it at once.

    Args:
        file: open, at its beginning, where it is left again.

    Raises:
        ValueError: a bit of it has changed, or there is no checksum.
    """
    left = file.seek(0, os.SEEK_END) - len(_SEAL) - 64
    digest = hashlib.sha256()
    file.seek(0)
    while left > 0 and (part := file.read(min(left, _PART))):
        digest.update(part)
        left -= len(part)
    if left or file.read() != _SEAL + digest.hexdigest().encode():
        raise ValueError("its checksum is missing or does not fit the rest")
    file.seek(0)
