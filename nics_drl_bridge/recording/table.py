"""Table: named columns of a file, a topic or an archive, as a mapping refers to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError, nearest
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.robot.noise import Latency

Column = NDArray[Any]  # (T,) numbers, or text


class Table(Protocol):
    """Columns with a place for errors; those of a bag come with stamps."""

    @property
    def place(self) -> str:
        """Path, and topic, for errors."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its columns; "" for one without a name."""

    @property
    def notes(self) -> Sequence[str]:
        """A sentence on each thing that reading mended."""

    def column(self, which: str | int) -> Column:
        """Returns a column by its name or number from 0; RecordingError if there is none."""

    def row(self, k: int) -> str:
        """Names a row for errors."""

    def stamps(self, which: str) -> Stream | None:
        """Returns stamps that come with the rows, and in `values` (T, 1) these rows, if any."""


class Source(Protocol):
    """A recording of any format, as tables."""

    @property
    def place(self) -> str:
        """Path, for errors."""

    @property
    def latency(self) -> Latency:
        """Delays of scan and odometry, if they show."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all tables."""

    def table(self, name: str) -> Table:
        """Reads a table; RecordingError if there is none of that name, or it is unreadable."""


@dataclass(frozen=True)
class Columns:
    """A table in memory."""

    place: str
    names: tuple[str, ...]
    data: tuple[Column, ...]
    lines: NDArray[np.intp] | None = None  # (T,) line of the file in which each row stands
    notes: tuple[str, ...] = ()

    def column(self, which: str | int) -> Column:
        """Returns a column by its name or number from 0; RecordingError if there is none."""
        return self.data[number_of(self, which)]

    def row(self, k: int) -> str:
        """Names a row for errors."""
        return f"row {k}" if self.lines is None else f"line {self.lines[k]}"

    def stamps(self, which: str) -> Stream | None:
        """Returns None: the stamps of such a table are among its columns."""
        return None


def number_of(table: Table, which: str | int) -> int:
    """Returns the number of a column that is given by name or number."""
    names = table.names
    if isinstance(which, str) and which in names:
        if (count := Counter(names)[which]) > 1:
            numbers = [str(k) for k, name in enumerate(names) if name == which]
            fault = f"{count} columns are called {which!r}"
            advice = f"give the number of the one you mean: {' or '.join(numbers)}"
            raise RecordingError(f"{table.place}: {fault}; {advice}.")
        return names.index(which)
    if isinstance(which, int) or which.isdecimal():
        if 0 <= int(which) < len(names):
            return int(which)
        fault = f"has no column {which}"
        raise RecordingError(f"{table.place}: {fault}; its columns are 0 to {len(names) - 1}.")
    named = [name for name in names if name]
    hint = nearest(which, named) if named else "they have no names: give its number, from 0"
    raise RecordingError(f"{table.place}: has no column {which!r}; {hint}")


def numbers_of(table: Table, which: str | int) -> Array:
    """Returns a column of numbers (T,), NaN where there is none; RecordingError for text."""
    column = table.column(which)
    if column.dtype.kind not in "USO":
        return column.astype(np.float64)
    for k, text in enumerate(column):
        try:
            float(text or "nan")
        except ValueError:
            fault = f"{which!r} is {str(text)[:40]!r}, which is no number"
            advice = "mend or remove the row, or choose another column"
            raise RecordingError(f"{table.place}: {table.row(k)}: {fault}; {advice}.") from None
    return np.array([float(text or "nan") for text in column])


def flattened(arrays: Mapping[str, Column]) -> Iterator[tuple[str, Column]]:
    """Yields columns of arrays: 1-D as they are, `name[k]` of 2-D, the fields of records."""
    for name, array in arrays.items():
        if array.dtype.names:
            inner = {f"{name}.{field}".lstrip("."): array[field] for field in array.dtype.names}
            yield from flattened(inner)
        elif array.ndim == 1:
            yield name, array
        elif array.ndim > 1:
            flat = array.reshape(len(array), -1)
            for k in range(flat.shape[1]):
                yield (f"{name}[{k}]" if name else ""), flat[:, k]
