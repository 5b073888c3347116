"""Tables from files: text with any separator and the quirks of loggers, numpy, Parquet."""

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
from nics_drl_bridge.files import count_unpacked
from nics_drl_bridge.recording.table import (
    Column,
    Source,
    Table,
    flatten_arrays,
    make_table,
)

TEXTS = (".csv", ".tsv", ".txt", ".dat", ".tum", ".log", ".data", ".asc")
MOST_FILES = 500  # maximum number of files that are read from a folder
SEPARATORS = (",", ";", "\t", "|", None)  # None: any white space
NO_SEPARATOR = re.compile(r"[\w\s.,;|+\"'#-]")
MAX_TABLE_BYTES = 256 * 2**20
# of an .npz file, whose arrays may be compressed a thousandfold
MAX_UNPACKED_BYTES = 2**30
# Maximum number of rows, and of characters in one
MOST_ROWS = 2_000_000
LONGEST_ROW = 20_000
TRIED = 400  # lines from which separator and header are found
MOST_SAMPLED = 50_000  # rows from which their usual width is found
MOST_BROKEN = 0.01  # maximum fraction of rows that are skipped because of their width
COMMENTS = ("#", "//", "%")
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
TUM_SUFFIX = ".tum"
DATE = re.compile(r"(\d{4}[-/]\d\d[-/]\d\d|\d\d:\d\d:\d\d)")
MISSING = ("", "na", "n/a", "null", "none", "-", "--", "#n/a")
WORDS = {"true": "1", "false": "0", **dict.fromkeys(MISSING, "nan")}


def read_text_table(path: Path) -> Table:
    """Reads a table. Raises RecordingError with the file, the line and the fix."""
    numbers, lines, comments = _read_lines(path)
    separator = _find_separator(lines[:TRIED])
    rows = [_split(line, separator) for line in lines]
    first, width = _find_first_row(path, rows)
    above = rows[:first]
    rows, numbers, notes = _keep_one_width(
        path, rows[first:], numbers[first:], above, width
    )
    # The last title with the most distinct names: a row of units below it repeats some.
    titles = [row for row in reversed(above) if len(row) > 1 or width == 1]
    head = max(titles, key=lambda row: len(set(row)), default=None)
    if head is None and comments:
        head = _find_title(comments[-1], separator, width)
    columns = [list(column) for column in zip(*rows, strict=True)]
    may_be_tum = separator is None or path.suffix == TUM_SUFFIX
    if head is None and may_be_tum and _is_tum(columns):
        head = list(TUM)
    if head is None:
        columns, head = _split_labels(columns)
    names = tuple([*head, *[""] * len(columns)][: len(columns)])
    values = [_convert_column(column) for column in columns]
    return make_table(str(path), names, values, numbers, tuple(notes))


def _read_lines(path: Path) -> tuple[NDArray[np.intp], list[str], list[str]]:
    """Returns numbers from 1 and texts of the non-empty lines, and separately the comments."""
    check_no_device(path)
    try:
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise RecordingError(
                f"{path}: is larger than {MAX_TABLE_BYTES // 2**20} MB; cut it, or "
                "keep fewer columns."
            )
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: can't be read ({error.strerror}).") from None
    encoding = "utf-8-sig"
    if data[:2] in UTF_16:
        encoding = "utf-16"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        # Old tools write Latin-1, such as a degree sign in a header.
        text = data.decode("latin-1")
    if "\0" in text:
        raise RecordingError(f"{path}: is not text; save it as CSV in UTF-8.")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    count = text.count("\n")
    if count > MOST_ROWS:
        raise RecordingError(
            f"{path}: has {count} rows; cut it to at most {MOST_ROWS}."
        )
    lines = [(k, line) for k, line in enumerate(text.split("\n"), 1) if line.strip()]
    for k, line in lines:
        if len(line) > LONGEST_ROW:
            raise RecordingError(
                f"{path}: line {k} has {len(line)} characters, too many for a row; "
                "remove it."
            )
    comments = [
        line.lstrip("#/% ") for _, line in lines if line.lstrip().startswith(COMMENTS)
    ]
    rows = [(k, line) for k, line in lines if not line.lstrip().startswith(COMMENTS)]
    numbers = np.array([k for k, _ in rows], dtype=np.intp)
    return numbers, [line for _, line in rows], comments


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
    """True for numbers, also with decimal commas, flags and dates."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return text.lower() in WORDS or bool(DATE.match(text))
    return True


def _find_separator(lines: Sequence[str]) -> str | None:
    """Returns the separator that leaves the most numbers and the fewest other fields."""

    def score(separator: str | None) -> int:
        fields: list[str] = []
        for line in lines:
            fields += filter(None, _split(line, separator))
        return 2 * sum(map(_is_value, fields)) - len(fields)

    best = max(SEPARATORS, key=score)
    others = sorted(set(NO_SEPARATOR.sub("", "".join(lines))))
    if score(best) <= 0 and others:
        return max(others, key=score)
    return best


def _find_first_row(path: Path, rows: list[list[str]]) -> tuple[int, int]:
    """Returns the index of the first row of numbers, and the usual number of fields."""

    def is_numeric(row: Sequence[str]) -> bool:
        full = [field for field in row if field]
        return 2 * sum(map(_is_value, full)) > len(full)

    widths = Counter(
        len(row) for row in rows[:: 1 + len(rows) // MOST_SAMPLED] if is_numeric(row)
    )
    if not widths:
        raise RecordingError(
            f"{path}: contains no row of numbers; give a table of numbers in columns, "
            "with or without a header."
        )
    width = widths.most_common(1)[0][0]
    return next(
        k for k, row in enumerate(rows) if len(row) == width and is_numeric(row)
    ), width


def _keep_one_width(
    path: Path,
    rows: list[list[str]],
    line_numbers: NDArray[np.intp],
    above: list[list[str]],
    width: int,
) -> tuple[list[list[str]], NDArray[np.intp], list[str]]:
    """Skips repeated headers and the few rows of another length."""
    notes = []
    is_data = np.array([row not in above for row in rows], dtype=np.bool_)
    if not is_data.all():
        notes.append(
            f"{path.name}: {(~is_data).sum()} lines repeat the header, and were left "
            "out."
        )
    is_whole = np.array([len(row) == width for row in rows], dtype=np.bool_)
    broken = np.flatnonzero(is_data & ~is_whole)
    if len(broken) > max(1.0, MOST_BROKEN * is_data.sum()):
        raise RecordingError(
            f"{path}: line {line_numbers[broken[0]]} has {len(rows[broken[0]])} fields "
            f"where most lines have {width}; correct or remove all such lines."
        )
    if len(broken):
        where = ", ".join(map(str, line_numbers[broken[:5]]))
        notes.append(
            f"{path.name}: {len(broken)} lines of another length (line {where}) were "
            "left out."
        )
    kept = np.flatnonzero(is_data & is_whole)
    kept_rows = [rows[k] for k in kept]
    while width > 1 and not any(row[width - 1] for row in kept_rows):
        width -= 1  # lines may end with a separator
        kept_rows = [row[:width] for row in kept_rows]
    return kept_rows, line_numbers[kept], notes


def _is_tum(columns: Sequence[Sequence[str]]) -> bool:
    """True for rising stamps with unit quaternions at the end."""
    if len(columns) != len(TUM):
        return False
    try:
        values = np.array(columns, dtype=np.float64)
    except ValueError:
        return False
    norm = np.linalg.norm(values[4:], axis=0)
    return bool(
        np.median(np.abs(norm - 1.0)) < 0.01 and np.median(np.diff(values[0])) > 0.0
    )


def _split_labels(columns: list[list[str]]) -> tuple[list[list[str]], list[str]]:
    """Names columns by labels that are in each row, as in `time: 1.2 ticks: 3 4`, if any."""
    labelled: dict[str, list[list[str]]] = {}
    label = None
    for column in columns:
        first = column[0]
        if first.endswith((":", "=")) and set(column) == {first}:
            label = first.rstrip(":=")
            labelled[label] = []
        elif label is None:
            return columns, []
        else:
            labelled[label].append(column)
    names = []
    for name, values in labelled.items():
        if len(values) == 1:
            names.append(name)
        else:
            names += [f"{name}[{k}]" for k in range(len(values))]
    return list(chain.from_iterable(labelled.values())), names


def _convert_column(column: list[str]) -> Column:
    """Returns numbers if all fields are numbers, flags or missing values, else text.

    Decimal commas count as points if that leaves only values.
    """
    if any("," in field for field in column):
        with_points = [field.replace(",", ".") for field in column]
        if all(map(_is_value, with_points)):
            column = with_points
    for words in ({}, WORDS):
        try:
            return np.array([words.get(f.lower(), f) for f in column], dtype=np.float64)
        except ValueError:
            continue
    return np.array(column, dtype=np.str_)


def read_arrays(path: Path) -> Table:
    """Reads an .npz or .npy file, also of records. Raises RecordingError for objects or damage."""
    try:
        with check_no_device(path).open("rb") as file:
            if count_unpacked(file) > MAX_UNPACKED_BYTES:
                raise RecordingError(
                    f"{path}: unpacked it is larger than {MAX_UNPACKED_BYTES // 2**20} "
                    "MB; split it."
                )
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                loaded = {"": loaded}
            arrays = dict(loaded)
    except RecordingError:
        raise
    except Exception as error:  # noqa: BLE001 - damage breaks numpy in any way
        advice = "write numbers with numpy.save or numpy.savez, without pickle"
        why = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: can't be read ({why}); {advice}.") from None
    columns = list(flatten_arrays(arrays))
    if not columns:
        raise RecordingError(
            f"{path}: contains no columns; give arrays of one or more values per row."
        )
    return make_table(
        str(path), tuple(name for name, _ in columns), tuple(c for _, c in columns)
    )


def read_parquet(path: Path) -> Table:
    """Reads a Parquet file. Raises RecordingError if it is damaged or pyarrow is missing."""
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
    for k, column in enumerate(columns):
        if column.dtype.kind == "M":
            columns[k] = column.astype("datetime64[ns]").astype(str)
        elif column.dtype.kind == "O":
            columns[k] = np.array([str(value) for value in column], np.str_)
    return make_table(str(path), tuple(table.column_names), columns)


READERS: dict[str, Callable[[Path], Table]] = {
    ".npz": read_arrays,
    ".npy": read_arrays,
    ".parquet": read_parquet,
    ".pq": read_parquet,
}


class Files(Source):
    """A file, or the files of a folder. Raises RecordingError if no format is known."""

    def __init__(self, path: Path) -> None:
        self._files = {path.name: path}
        if not path.is_file():
            suffixes = (*TEXTS, *READERS)
            files = [
                file
                for file in sorted(path.rglob("*"))
                if file.suffix.lower() in suffixes
            ]
            if not files:
                raise RecordingError(
                    f"{path}: contains no file of a known format "
                    f"({', '.join(suffixes)})."
                )
            self._files = {
                file.relative_to(path).as_posix(): file for file in files[:MOST_FILES]
            }
        super().__init__(str(path), tuple(self._files))

    def read(self, name: str) -> Table:
        """Reads a file."""
        file = self._files[name]
        return READERS.get(file.suffix.lower(), read_text_table)(file)
