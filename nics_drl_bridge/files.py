"""Atomic writes and checksums: a reader finds the old or the new file, and detects damage."""

import ctypes
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from nics_drl_bridge.errors import ConfigError, ModelError

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_POSIX = hasattr(os, "O_DIRECTORY")  # Windows can't open folders


def _fsync(path: Path) -> None:
    if not _POSIX:
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: str | Path, data: bytes) -> None:
    """Writes a file via a temporary one, fsynced and renamed; creates its folder if missing."""
    write_parts(path, [data])


def write_parts(path: str | Path, parts: Iterable[bytes]) -> None:
    """Writes a file like `write_bytes`, but in parts, so that it need not fit into memory."""
    with (
        _name_path_in_errors(Path(path)),
        write_whole_file(path) as temporary,
        temporary.open("wb") as file,
    ):
        file.writelines(parts)


# Unfinished output is kept in a hidden folder next to the final path. Its writer holds a
# lock on the folder, which the system releases when the writer ends, even if it crashes. `tempfile`
# would make files that only their owner can read; here the umask applies.

UNFINISHED = "unfinished"
REPLACED = "replaced"
_HIDDEN = re.compile(rf"\.(.+)\.[0-9a-f]{{8}}\.({UNFINISHED}|{REPLACED})", re.DOTALL)


def make_hidden_name(path: Path, ending: str = "") -> Path:
    """Returns a new hidden path next to a path; `ending` marks what a crash may leave behind."""
    return path.parent / f".{path.name}.{secrets.token_hex(4)}{ending and f'.{ending}'}"


def begin_folder(path: Path) -> tuple[Path, int | None]:
    """Makes a hidden folder next to a path; returns it and its descriptor, which holds the lock.

    The descriptor is None on Windows.
    """
    while True:
        temporary = make_hidden_name(path, UNFINISHED)
        temporary.mkdir()
        if not _POSIX:
            return temporary, None
        with suppress(FileNotFoundError):  # removed as a leftover before it was locked
            descriptor = os.open(temporary, os.O_RDONLY)
            if _lock_new(temporary, descriptor):
                return temporary, descriptor
            os.close(descriptor)


def _lock_new(path: Path, descriptor: int) -> bool:
    """Locks a new folder; False if another process removed it as a leftover."""
    if fcntl is None:
        return True
    # On a file system without locks, leftovers are not removed, so no lock is needed.
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def lock_file(path: Path, file: BinaryIO) -> None:
    """Locks an open file until it is closed. Raises ConfigError if another process has it."""
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ConfigError(
            f"{path}: another process is writing it; wait for it to end, or choose "
            "another place."
        ) from None
    except OSError:  # a file system without locks
        pass


def remove_leftovers(folder: Path) -> None:
    """Removes what killed writers left in a folder, never what a live writer is still writing."""
    if fcntl is None:
        return
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _HIDDEN.fullmatch(entry.name)
            if match is None or entry.is_symlink():
                continue
            # If the writer was killed while swapping, this may be the only version left.
            if match[2] == REPLACED and not (folder / match[1]).exists():
                continue
            _remove_if_left(Path(entry.path))


def _remove_if_left(path: Path) -> None:
    with suppress(OSError):  # another process removes it, or its writer is alive
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.path.samestat(os.stat(path), os.fstat(descriptor)):
                return
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
        finally:
            os.close(descriptor)


@contextmanager
def write_whole_file(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path of the same name; fsyncs it and renames it to `path`.

    If the block raises, nothing is left behind.
    """
    path = Path(path)
    with _make_hidden_folder(path) as folder:
        yield folder / path.name
        _fsync(folder / path.name)
        os.replace(folder / path.name, path)
        _fsync(path.parent)


@contextmanager
def _make_hidden_folder(path: Path) -> Iterator[Path]:
    """Yields a locked hidden folder next to a path; removes what killed writers left there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with _name_path_in_errors(path):
        remove_leftovers(path.parent)
        folder, descriptor = begin_folder(path)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if descriptor is not None:
            os.close(descriptor)


@contextmanager
def _name_path_in_errors(path: Path) -> Iterator[None]:
    """Replaces a temporary path in system errors by the requested one."""
    try:
        yield
    except OSError as error:
        if error.errno is not None:
            error.filename = str(path)
            del error.filename2
        raise


def write_text(path: str | Path, text: str) -> None:
    """Writes a UTF-8 text file via a temporary one, fsynced and renamed."""
    write_bytes(path, text.encode())


def format_json(data: Any, indent: int | None = None) -> str:
    """Formats data as JSON: null for non-finite numbers, `str` of other objects."""
    finite = json.loads(json.dumps(data, default=str), parse_constant=lambda _: None)
    return json.dumps(finite, allow_nan=False, indent=indent)


def check_folder(path: str | Path, marker: str, sign: str = "") -> Path:
    """Resolves a path without creating it. Raises ConfigError unless a folder can be written.

    An existing folder must be empty or contain the file `marker` with the text `sign`.
    """
    path = Path(path).resolve()
    if path.exists() and not path.is_dir():
        raise ConfigError(
            f"{path}: is a file, not a folder; give the name of a folder."
        )
    if path.is_dir() and any(path.iterdir()) and not (path / marker).exists():
        fix = "give a new folder, or empty this one."
        raise ConfigError(f"{path}: contains other files but no {marker!r}; {fix}")
    file = path / marker
    if sign and file.is_file() and sign.encode() not in file.read_bytes():
        reason = "was not written by this command"
        raise ConfigError(f"{file}: {reason}; give a new folder.")
    check_above(path)
    return path


def check_above(path: Path) -> None:
    """Raises ConfigError if a path can't be created, without creating anything."""
    above = next(parent for parent in path.resolve().parents if parent.exists())
    if not above.is_dir():
        raise ConfigError(
            f"{path}: {above} is a file, not a folder; choose another place."
        )
    if not os.access(above, os.W_OK | os.X_OK):
        raise ConfigError(f"{path}: {above} can't be written to; choose another place.")


@contextmanager
def write_whole_folder(
    path: str | Path,
    marker: str,
    is_own: Callable[[str], bool] = lambda _: True,
    sign: str = "",
) -> Iterator[Path]:
    """Yields a temporary folder that replaces `path` if the block succeeds, or else is removed.

    It replaces only an empty folder or one with the file `marker`, which all folders of this kind
    contain and whose text contains `sign`, so that a wrong `--out` never deletes work. A symbolic
    link is kept. The user's files are kept, too: those that the block did not write and whose
    relative path `is_own` rejects.
    Raises ConfigError, see `check_folder`.
    """
    path = check_folder(path, marker, sign)
    with _make_hidden_folder(path) as temporary:
        yield temporary
        if path.is_dir():
            _keep_others(path, temporary, is_own)
        sync_folder(temporary)
        _swap(temporary, path)


def _keep_others(old: Path, new: Path, is_own: Callable[[str], bool]) -> None:
    """Copies the user's own files from the old folder to the new one."""
    for folder, folders, names in os.walk(old):
        relative = Path(folder).relative_to(old)
        if not (folders or names or is_own(relative.as_posix())):
            (new / relative).mkdir(parents=True, exist_ok=True)
        links = [name for name in folders if Path(folder, name).is_symlink()]
        for name in (*names, *links):
            source = Path(folder, name)
            place = source.relative_to(old)
            if is_own(place.as_posix()) or os.path.lexists(new / place):
                continue
            (new / place).parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(source, new / place, follow_symlinks=False)
            except (OSError, NotImplementedError):  # a file system without links
                shutil.copy2(source, new / place, follow_symlinks=False)


def _swap(new: Path, path: Path) -> None:
    """Moves `new` to `path`, atomically if the system supports it; removes the previous folder."""
    if path.exists() and _exchange(new, path):
        _fsync(path.parent)
        return
    old = make_hidden_name(path, REPLACED)
    try:
        if path.exists():
            os.replace(path, old)
        try:
            os.replace(new, path)
        except BaseException:
            if not path.exists() and old.exists():
                os.rename(old, path)
            raise
        _fsync(path.parent)
    finally:
        shutil.rmtree(old, ignore_errors=True)


def _exchange(first: Path, second: Path) -> bool:
    """Exchanges two paths atomically; returns False if the system can't (only Linux can)."""
    library = ctypes.CDLL(None, use_errno=True) if _POSIX else None
    rename = getattr(library, "renameat2", None)
    if rename is None:
        return False
    source = (_AT_FDCWD, os.fsencode(first))
    target = (_AT_FDCWD, os.fsencode(second))
    if rename(*source, *target, _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOENT):
        return False
    raise OSError(code, os.strerror(code), str(second))


def sync_folder(folder: Path) -> None:
    """Syncs a folder and everything in it to disk."""
    for file in (*folder.rglob("*"), folder):
        _fsync(file)


# manifest of a folder, which `sha256sum -c SHA256SUMS` checks as well
SUMS = "SHA256SUMS"
# size limit of an array file: a day of driving, or a table of a thousand shapes
MOST_BYTES = 256 * 2**20
_SEAL = b"sha256 "
_PART = 2**20


def hash_bytes(data: bytes) -> str:
    """Returns the SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def _hash_next(file: BinaryIO, size: int) -> str:
    """Returns the SHA-256 of the next `size` bytes of a file, read in parts."""
    digest = hashlib.sha256()
    while size > 0 and (part := file.read(min(size, _PART))):
        digest.update(part)
        size -= len(part)
    return digest.hexdigest()


def seal(data: bytes) -> bytes:
    """Appends a checksum to data, for `check_sealed`."""
    return data + _SEAL + hash_bytes(data).encode()


def check_sealed(file: BinaryIO) -> None:
    """Verifies the checksum that `seal` appended, and rewinds. Raises ValueError."""
    size = file.seek(0, os.SEEK_END) - len(_SEAL) - 64
    file.seek(0)
    digest = _hash_next(file, size)
    if file.read() != _SEAL + digest.encode():
        raise ValueError("its checksum is missing or does not match")
    file.seek(0)


def read_file(path: Path) -> bytes:
    """Returns the content of a file. Raises ValueError if it is larger than `MOST_BYTES`."""
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"it is larger than {MOST_BYTES // 2**20} MB")
    return path.read_bytes()


def count_unpacked(file: BinaryIO) -> int:
    """Returns the size of a zip archive's members when unpacked [bytes]; 0 for other files."""
    size = 0
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
    file.seek(0)
    return size


def names_in_sums(folder: Path) -> set[str]:
    """Returns the names listed in a folder's `SHA256SUMS`; empty if it can't be read."""
    try:
        with (folder / SUMS).open("rb") as sums:
            lines = sums.read(_PART).decode(errors="replace").splitlines()
    except OSError:
        return set()
    return {line[66:] for line in lines}


def write_sums(folder: Path) -> None:
    """Writes the SHA-256 of every file in a folder and its subfolders to its `SHA256SUMS`."""
    files = sorted(
        path for path in folder.rglob("*") if path.is_file() and path != folder / SUMS
    )
    names = [path.relative_to(folder).as_posix() for path in files]
    write_parts(folder / SUMS, [_format_line(folder, name) for name in names])


def check_sums(folder: Path, names: Sequence[str], editable: str = "") -> None:
    """Checks files of a model or a lidar table against the `SHA256SUMS` of their folder.

    All names must be listed, except `editable`: a user may remove its line to edit it. Raises
    ModelError if a file is missing, too large or changed, or if any other file is listed.
    """
    with _open_file(folder / SUMS) as file:
        listed = file.readlines(_PART)
    expected = {name: _format_line(folder, name) for name in names}
    for name, line in expected.items():
        is_editable = name == editable
        if line in listed or (
            is_editable and not any(entry.endswith(line[64:]) for entry in listed)
        ):
            continue
        if is_editable:
            hint = (
                f"if you changed it yourself, remove its line from {SUMS}, otherwise "
            )
        else:
            hint = ""
        reason = (
            f"does not match its checksum in {SUMS}; {hint}generate the model again."
        )
        raise ModelError(f"{folder / name}: {reason}")
    for line in listed:
        if line not in expected.values():
            reason = f"line {line.decode(errors='replace')!r} names no file of a model; remove it."
            raise ModelError(f"{folder / SUMS}: the {reason}")


def _format_line(folder: Path, name: str) -> bytes:
    with _open_file(folder / name) as file:
        return f"{_hash_next(file, MOST_BYTES)}  {name}\n".encode()


def _open_file(path: Path) -> BinaryIO:
    """Opens a file of a model. Raises ModelError if it is missing, not a file, or too large."""
    reason = "missing, or not a file"
    try:
        if path.is_file():
            reason = f"larger than {MOST_BYTES // 2**20} MB"
            if path.stat().st_size <= MOST_BYTES:
                return path.open("rb")
    except OSError as error:
        reason = f"not readable ({error.strerror})"
    raise ModelError(f"{path}: is {reason}; generate the model again.")
