"""Tables of files: text with any separator and what loggers leave in it, numpy's, Parquet."""

import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.config import check_no_device
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.table import (
    Column,
    Source,
    Table,
    flatten_arrays,
    make_table,
)

TEXTS = (".csv", ".tsv", ".txt", ".dat", ".tum", ".log", ".data", ".asc")
MOST_FILES = 500  # of a folder
SEPARATORS = (",", ";", "\t", "|", None)  # None: any white space
NO_SEPARATOR = re.compile(r"[\w\s.,;|+\"'#-]")
MOST_BYTES = 256 * 2**20
# longest in characters
MOST_ROWS = 2_000_000
LONGEST_ROW = 20_000
TRIED = 400  # lines from which separator and header are found
MOST_SAMPLED = 50_000  # rows from which their usual width is found
MOST_BROKEN = 0.01  # share of rows with another number of fields that are left out
COMMENTS = ("#", "//", "%")
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
TUM_SUFFIX = ".tum"
DATE = re.compile(r"(\d{4}[-/]\d\d[-/]\d\d|\d\d:\d\d:\d\d)")
MISSING = ("", "na", "n/a", "null", "none", "-", "--", "#n/a")
WORDS = {"true": "1", "false": "0", **dict.fromkeys(MISSING, "nan")}


def read_text_table(path: Path) -> Table:
    """Reads a table; RecordingError names the file, the line and the fix."""
    lines, comments = _read_lines(path)
    separator = _find_separator([text for _, text in lines[:TRIED]])
    at = np.array([line for line, _ in lines], dtype=np.intp)
    rows = [_split(text, separator) for _, text in lines]
    first, width = _find_first_row(path, rows)
    above = rows[:first]
    rows, at, notes = _keep_one_width(path, rows[first:], at[first:], above, width)
    columns = [list(column) for column in zip(*rows, strict=True)]
    # The last title that has most names: one of units, below it, repeats some.
    titles = [row for row in above if len(row) > 1 or width == 1]
    head = max(reversed(titles), key=lambda row: len(set(row)), default=None)
    if head is None and comments:
        head = _find_title(comments[-1], separator, width)
    if (
        head is None
        and width == len(TUM)
        and (separator is None or path.suffix == TUM_SUFFIX)
    ):
        head = list(TUM) if _is_tum(columns) else None
    if head is None and (named := _split_labels(columns)):
        columns, head = named
    columns = [_replace_commas(column) for column in columns]
    names = tuple([*(head or ()), *[""] * len(columns)][: len(columns)])
    return make_table(
        str(path), names, tuple(map(_convert_column, columns)), at, tuple(notes)
    )


def _read_lines(path: Path) -> tuple[list[tuple[int, str]], list[str]]:
    """Returns the lines with their numbers, from 1, without empty ones, and those of comments."""
    check_no_device(path)
    try:
        if path.stat().st_size > MOST_BYTES:
            fault = f"is larger than {MOST_BYTES // 2**20} MB"
            raise RecordingError(f"{path}: {fault}; cut it, or keep fewer columns.")
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: can't be read ({error.strerror}).") from None
    try:
        text = data.decode("utf-16" if data[:2] in UTF_16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode(
            "latin-1"
        )  # as written by old tools: a degree sign in a header
    if "\0" in text:
        raise RecordingError(f"{path}: is not text; save it as CSV in UTF-8.")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if (count := text.count("\n")) > MOST_ROWS:
        raise RecordingError(
            f"{path}: has {count} rows; cut it to at most {MOST_ROWS}."
        )
    lines = [(k, line) for k, line in enumerate(text.split("\n"), 1) if line.strip()]
    for k, line in lines:
        if len(line) > LONGEST_ROW:
            fault = f"line {k} has {len(line)} characters, which no row has"
            raise RecordingError(f"{path}: {fault}; remove it.")
    comments = [
        line.lstrip("#/% ") for _, line in lines if line.lstrip().startswith(COMMENTS)
    ]
    return [
        each for each in lines if not each[1].lstrip().startswith(COMMENTS)
    ], comments


def _split(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    fields = line.split(separator)
    if '"' in line:
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return list(map(str.strip, fields))


def _find_title(comment: str, separator: str | None, width: int) -> list[str] | None:
    """Returns the names of the columns if a comment lists them; wide gaps may separate them."""
    for fields in (
        _split(comment, separator),
        re.split(r"\t+|\s{2,}", comment.strip()),
    ):
        if len(fields) == width:
            return fields
    return None


def _is_value(text: str) -> bool:
    """True for numbers, with decimal commas too, flags and dates."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return text.lower() in WORDS or bool(DATE.match(text))
    return True


def _find_separator(lines: Sequence[str]) -> str | None:
    """Returns the separator that leaves most numbers, and fewest fields that are none."""

    def score(separator: str | None) -> int:
        fields = [field for line in lines for field in _split(line, separator) if field]
        return sum(1 if _is_value(field) else -1 for field in fields)

    best = max(SEPARATORS, key=score)
    others = sorted(set(NO_SEPARATOR.sub("", "".join(lines))))
    return best if score(best) > 0 or not others else max(others, key=score)


def _find_first_row(path: Path, rows: list[list[str]]) -> tuple[int, int]:
    """Returns the first row of numbers, and how many fields the rows from there on have."""

    def is_numeric(row: Sequence[str]) -> bool:
        full = [field for field in row if field]
        return 2 * sum(map(_is_value, full)) > len(full)

    widths = Counter(
        len(row) for row in rows[:: 1 + len(rows) // MOST_SAMPLED] if is_numeric(row)
    )
    if not widths:
        advice = "give a table of numbers, a column each, with or without a header"
        raise RecordingError(f"{path}: holds no row of numbers; {advice}.")
    width = widths.most_common(1)[0][0]
    return next(
        k for k, row in enumerate(rows) if len(row) == width and is_numeric(row)
    ), width


def _keep_one_width(
    path: Path,
    rows: list[list[str]],
    at: NDArray[np.intp],
    above: list[list[str]],
    width: int,
) -> tuple[list[list[str]], NDArray[np.intp], list[str]]:
    """Leaves out headers that are repeated, and the few rows that were cut short."""
    file = path.name
    notes = []
    new = np.array([row not in above for row in rows], dtype=np.bool_)
    if not new.all():
        notes.append(
            f"{file}: {(~new).sum()} lines repeat the header, and were left out."
        )
    fits = np.array([len(row) == width for row in rows], dtype=np.bool_)
    broken = np.flatnonzero(new & ~fits)
    if len(broken) > max(1.0, MOST_BROKEN * new.sum()):
        fault = f"line {at[broken[0]]} has {len(rows[broken[0]])} fields"
        advice = f"where most lines have {width}; mend or remove it and those like it"
        raise RecordingError(f"{path}: {fault} {advice}.")
    if len(broken):
        where = ", ".join(map(str, at[broken[:5]]))
        notes.append(
            f"{file}: {len(broken)} lines of another length (line {where}) were left out."
        )
    kept = np.flatnonzero(new & fits)
    whole = [rows[k] for k in kept]
    while width > 1 and not any(row[width - 1] for row in whole):
        width -= 1  # after a separator at the end of each line
        whole = [row[:width] for row in whole]
    return whole, at[kept], notes


def _is_tum(columns: Sequence[Sequence[str]]) -> bool:
    """True for stamps that rise, and unit quaternions at the end."""
    try:
        values = np.array(columns, dtype=np.float64)
    except ValueError:
        return False
    norm = np.linalg.norm(values[4:], axis=0)
    return bool(
        np.median(np.abs(norm - 1.0)) < 0.01 and np.median(np.diff(values[0])) > 0.0
    )


def _split_labels(
    columns: Sequence[list[str]],
) -> tuple[list[list[str]], list[str]] | None:
    """Names columns by labels that stand in each row, as in `time: 1.2 ticks: 3 4`."""
    found: dict[str, list[list[str]]] = {}
    for column in columns:
        first = column[0]
        if first.endswith((":", "=")) and set(column) == {first}:
            found[label := first.rstrip(":=")] = []
        elif not found:
            return None
        else:
            found[label].append(column)
    names = [
        name if len(some) == 1 else f"{name}[{k}]"
        for name, some in found.items()
        for k in range(len(some))
    ]
    return list(chain.from_iterable(found.values())), names


def _replace_commas(column: list[str]) -> list[str]:
    """Writes decimal commas as points."""
    if not any("," in field for field in column):
        return column
    changed = [field.replace(",", ".") for field in column]
    return changed if all(map(_is_value, changed)) else column


def _convert_column(column: Sequence[str]) -> Column:
    """Returns numbers if all fields are, of true and false too, and else text."""
    for words in ({}, WORDS):
        try:
            return np.array([words.get(f.lower(), f) for f in column], dtype=np.float64)
        except ValueError:
            continue
    return np.array(column, dtype=np.str_)


def read_arrays(path: Path) -> Table:
    """Reads an .npz or .npy file, of records too; RecordingError if it holds objects or damage."""
    try:
        with check_no_device(path).open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            arrays = {"": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except Exception as error:  # noqa: BLE001 - damage breaks numpy in any way
        advice = "write numbers with numpy.save or numpy.savez, without pickle"
        why = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: can't be read ({why}); {advice}.") from None
    columns = list(flatten_arrays(arrays))
    if not columns:
        raise RecordingError(
            f"{path}: holds no columns; give arrays of one value or more a row."
        )
    return make_table(
        str(path), tuple(name for name, _ in columns), tuple(c for _, c in columns)
    )


def read_parquet(path: Path) -> Table:
    """Reads a Parquet file; RecordingError if it is damaged, or pyarrow is missing."""
    if find_spec("pyarrow") is None:
        raise RecordingError(
            f"{path}: Parquet needs the library pyarrow; pip install pyarrow."
        )
    parquet = import_module("pyarrow.parquet")
    try:
        table = parquet.read_table(check_no_device(path))
        columns = [table.column(k).to_numpy() for k in range(table.num_columns)]
    except Exception as error:  # noqa: BLE001 - damage breaks the reader in any way
        why = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: can't be read as Parquet ({why}).") from None
    stamps = [
        c.astype("datetime64[ns]").astype(str) if c.dtype.kind == "M" else c
        for c in columns
    ]
    texts = [
        np.array([*map(str, c)], np.str_) if c.dtype.kind == "O" else c for c in stamps
    ]
    return make_table(str(path), tuple(table.column_names), tuple(texts))


READERS: dict[str, Callable[[Path], Table]] = {
    ".npz": read_arrays,
    ".npy": read_arrays,
    ".parquet": read_parquet,
    ".pq": read_parquet,
}


class Files(Source):
    """A file, or the files of a folder; RecordingError if it holds none of a known format."""

    def __init__(self, path: Path) -> None:
        known = (*TEXTS, *READERS)
        inside = [path] if path.is_file() else sorted(path.rglob("*"))
        some = [file for file in inside if file.suffix.lower() in known or file == path]
        if not some:
            raise RecordingError(
                f"{path}: holds no file of a known format ({', '.join(known)})."
            )
        root = path.parent if path.is_file() else path
        self._files = {
            file.relative_to(root).as_posix(): file for file in some[:MOST_FILES]
        }
        super().__init__(str(path), tuple(self._files))

    def read(self, name: str) -> Table:
        """Reads a file."""
        file = self._files[name]
        return READERS.get(file.suffix.lower(), read_text_table)(file)
