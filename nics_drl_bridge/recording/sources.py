"""Sources: files, folders and bags of any format, as tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from nics_drl_bridge.config import no_device
from nics_drl_bridge.errors import RecordingError, nearest
from nics_drl_bridge.recording.table import Columns, Source, Table
from nics_drl_bridge.recording.text_table import read_text_table

Reader = Callable[[Path], Columns]
TEXTS = (".csv", ".tsv", ".txt", ".dat", ".tum", ".log", ".data", ".asc")
READERS: dict[str, Reader] = {}
MOST_FILES = 500  # of a folder


def reader_of(path: Path) -> Reader:
    """Returns the function that reads a file; text if its suffix says nothing else."""
    return READERS.get(path.suffix.lower(), read_text_table)


@dataclass
class Files:
    """A file, or the files of a folder."""

    place: str
    files: dict[str, Path]
    _read: dict[str, Columns] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all tables."""
        return tuple(self.files)

    def table(self, name: str) -> Table:
        """Reads a table; RecordingError if there is none of that name, or it is unreadable."""
        if name not in self.files:
            raise RecordingError(f"{self.place}: has no file {name!r}; {nearest(name, self.files)}")
        if name not in self._read:
            self._read[name] = reader_of(self.files[name])(self.files[name])
        return self._read[name]


def open_source(path: Path) -> Source:
    """Opens a recording of any format; RecordingError if there is nothing to read."""
    no_device(path)
    if path.is_file():
        return Files(str(path), {path.name: path})
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    known = (*TEXTS, *READERS)
    inside = sorted(file for file in path.rglob("*") if file.suffix.lower() in known)
    files = {file.relative_to(path).as_posix(): file for file in inside[:MOST_FILES]}
    if not files:
        raise RecordingError(f"{path}: holds no file of a known format ({', '.join(known)}).")
    return Files(str(path), files)
