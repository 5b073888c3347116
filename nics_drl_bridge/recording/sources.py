"""Sources: files, folders and bags of any format, as tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from nics_drl_bridge.config import no_device
from nics_drl_bridge.errors import RecordingError, nearest
from nics_drl_bridge.recording.bag_file import is_bag, opened
from nics_drl_bridge.recording.bag_table import Bag, topics_used
from nics_drl_bridge.recording.mapping import Mapping
from nics_drl_bridge.recording.table import Columns, Source, flattened
from nics_drl_bridge.recording.text_table import read_text_table
from nics_drl_bridge.robot.noise import Latency

TEXTS = (".csv", ".tsv", ".txt", ".dat", ".tum", ".log", ".data", ".asc")
MOST_FILES = 500  # of a folder


def read_arrays(path: Path) -> Columns:
    """Reads an .npz or .npy file, of records too; RecordingError if it holds objects or damage."""
    try:
        with no_device(path).open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            arrays = {"": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except Exception as error:  # noqa: BLE001 - damage breaks numpy in any way
        advice = "write numbers with numpy.save or numpy.savez, without pickle"
        why = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: can't be read ({why}); {advice}.") from None
    columns = list(flattened(arrays))
    if not columns:
        raise RecordingError(f"{path}: holds no columns; give arrays of one value or more a row.")
    return Columns(str(path), tuple(name for name, _ in columns), tuple(c for _, c in columns))


def read_parquet(path: Path) -> Columns:
    """Reads a Parquet file; RecordingError if it is damaged, or pyarrow is missing."""
    if find_spec("pyarrow") is None:
        raise RecordingError(f"{path}: Parquet needs the library pyarrow; pip install pyarrow.")
    parquet = import_module("pyarrow.parquet")
    try:
        table = parquet.read_table(no_device(path))
        columns = [table.column(k).to_numpy() for k in range(table.num_columns)]
    except Exception as error:  # noqa: BLE001 - damage breaks the reader in any way
        why = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: can't be read as Parquet ({why}).") from None
    stamps = [c.astype("datetime64[ns]").astype(str) if c.dtype.kind == "M" else c for c in columns]
    texts = [c.astype(np.str_) if c.dtype.kind == "O" else c for c in stamps]
    return Columns(str(path), tuple(table.column_names), tuple(texts))


READERS: dict[str, Callable[[Path], Columns]] = {
    ".npz": read_arrays, ".npy": read_arrays, ".parquet": read_parquet, ".pq": read_parquet,
}  # fmt: skip


@dataclass
class Files:
    """A file, or the files of a folder."""

    place: str
    files: dict[str, Path]
    latency: Latency = field(default_factory=Latency)
    _read: dict[str, Columns] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all tables."""
        return tuple(self.files)

    def table(self, name: str) -> Columns:
        """Reads a table; RecordingError if there is none of that name, or it is unreadable."""
        if name not in self.files:
            raise RecordingError(f"{self.place}: has no file {name!r}; {nearest(name, self.files)}")
        if name not in self._read:
            file = self.files[name]
            self._read[name] = READERS.get(file.suffix.lower(), read_text_table)(file)
        return self._read[name]


@contextmanager
def open_source(path: Path, mapping: Mapping | None = None) -> Iterator[Source]:
    """Opens a recording of any format; RecordingError if there is nothing to read."""
    no_device(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    if is_bag(path):
        with opened(path) as file:
            bag = Bag(file)
            if mapping is not None:
                bag.frames = mapping.pose.frame, mapping.pose.child_frame
                given = mapping.model_dump(by_alias=True, exclude={"robot"}, exclude_none=True)
                bag.used = topics_used(given, bag.names)
            yield bag
        return
    known = (*TEXTS, *READERS)
    inside = [path] if path.is_file() else sorted(path.rglob("*"))
    some = [file for file in inside if file.suffix.lower() in known or file == path]
    if not some:
        raise RecordingError(f"{path}: holds no file of a known format ({', '.join(known)}).")
    root = path.parent if path.is_file() else path
    yield Files(str(path), {file.relative_to(root).as_posix(): file for file in some[:MOST_FILES]})
