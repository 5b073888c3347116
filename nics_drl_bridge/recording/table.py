"""Table: named columns of a file, a topic or an archive; Source: the tables of a recording."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError, suggest
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.robot.noise import Latency

Column = NDArray[Any]  # (T,) numbers, or text


@dataclass(frozen=True)
class Table:
    """Columns as a mapping refers to them; those of a bag come with stamps."""

    place: str  # path, and topic, for errors
    names: tuple[str, ...]  # "" for a column without one
    # by name, or number from 0; raises RecordingError if there is none
    column: Callable[[str | int], Column]
    row: Callable[[int], str]  # returns a row's name for errors
    notes: Sequence[str] = ()  # a sentence on each repair made while reading
    # stamps that come with the rows, if any; their `values` (T, 1) are the row numbers
    stamps: Callable[[str], Stream | None] = lambda _: None
    kind: str = ""  # message type, of a topic


def make_table(
    place: str,
    names: tuple[str, ...],
    data: Sequence[Column],
    lines: NDArray[np.intp] | None = None,  # (T,) line number of each row in the file
    notes: Sequence[str] = (),
) -> Table:
    """Makes a table from columns in memory."""

    def name_row(k: int) -> str:
        return f"row {k}" if lines is None else f"line {lines[k]}"

    return Table(
        place,
        names,
        lambda which: data[_find_column(place, names, which)],
        name_row,
        notes,
    )


class Source:
    """A recording in any format, as tables."""

    def __init__(self, place: str, names: Sequence[str]) -> None:
        self.place = place  # path, for errors
        self.names = tuple(names)  # names of its tables
        self._read: dict[str, Table] = {}

    @property
    def latency(self) -> Latency:
        """Delays of scan and odometry, if known."""
        return Latency()

    def use(self, mapping: Any) -> None:
        """Prepares for reading by a mapping."""

    def get_table(self, name: str) -> Table:
        """Returns a table. Raises RecordingError if it is unreadable."""
        if name not in self._read:
            self._read[name] = self.read(name)
        return self._read[name]

    def read(self, name: str) -> Table:
        """Reads a table."""
        raise NotImplementedError


def _find_column(place: str, names: Sequence[str], which: str | int) -> int:
    """Returns the number of a column that is given by name or number."""
    if isinstance(which, str) and which in names:
        count = Counter(names)[which]
        if count > 1:
            numbers = [str(k) for k, name in enumerate(names) if name == which]
            raise RecordingError(
                f"{place}: {count} columns are called {which!r}; choose one by number: "
                f"{' or '.join(numbers)}."
            )
        return names.index(which)
    if isinstance(which, int) or which.isdecimal():
        if 0 <= int(which) < len(names):
            return int(which)
        raise RecordingError(
            f"{place}: has no column {which}; its columns are 0 to {len(names) - 1}."
        )
    named = [name for name in names if name]
    if named:
        hint = suggest(which, named)
    else:
        hint = "they have no names: give its number, from 0."
    raise RecordingError(f"{place}: has no column {which!r}; {hint}")


def is_text(column: Column) -> bool:
    """True if a column contains text, not numbers."""
    return column.dtype.kind in "US"


def read_numbers(table: Table, which: str | int) -> Array:
    """Returns a column of numbers (T,), NaN where empty. Raises RecordingError for text."""
    column = table.column(which)
    if column.dtype.kind not in "USO":
        return column.astype(np.float64)
    for k, text in enumerate(column):
        try:
            float(text or "nan")
        except ValueError:
            raise RecordingError(
                f"{table.place}: {table.row(k)}: column {which!r} is "
                f"{str(text)[:40]!r}, which is not a number; correct or remove the "
                "row, or choose another column."
            ) from None
    return np.array([float(text or "nan") for text in column])


def flatten_arrays(arrays: Mapping[str, Column]) -> Iterator[tuple[str, Column]]:
    """Yields columns of arrays: 1-D as they are, others as `name[k]`, records by field."""
    for name, array in arrays.items():
        if array.dtype.names:
            inner = {
                f"{name}.{field}".lstrip("."): array[field]
                for field in array.dtype.names
            }
            yield from flatten_arrays(inner)
        elif array.ndim == 1:
            yield name, array
        elif array.ndim > 1:
            flat = array.reshape(len(array), math.prod(array.shape[1:]))
            for k in range(flat.shape[1]):
                yield (f"{name}[{k}]" if name else ""), flat[:, k]
