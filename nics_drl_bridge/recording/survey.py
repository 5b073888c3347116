"""Surveys a recording of any form: tables, their stamps and what is odd in them, columns."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.recording import IRREGULAR, likely_unit
from nics_drl_bridge.recording.table import Column, Source, Table
from nics_drl_bridge.recording.values import dates_of

GAP = 5.0  # a gap is longer than this many usual steps
MOST_COLUMNS = 200  # of a table
MOST_BACK = 0.05  # share of steps of a column of stamps that may go back
TIMES = {"time", "times", "stamp", "timestamp", "t", "s", "sec", "secs", "seconds", "elapsed"}
TIMES |= {"ms", "us", "ns", "millis", "micros", "nanos", "date", "datetime"}
SPOKEN = {"deg": "deg", "degrees": "deg", "mm": "mm", "cm": "cm", "rpm": "rpm", "kmh": "km/h"}
SPOKEN |= {"mps": "m/s", "rad": "rad", "m": "m", "pct": "%", "percent": "%"}


def words_of(name: str) -> list[str]:
    """Splits a name into its words: `vicon x`, `q.x`, `Left_Tick`, `cmdVel`."""
    parts = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return [word for word in re.split(r"[^A-Za-z]+", parts.lower()) if word]


def unit_in(name: str) -> tuple[list[str], str | None]:
    """Returns the words of a name, and the unit that it ends with, as `x [mm]`, `yaw_deg`."""
    if (bracket := re.search(r"[\[(]\s*([^\d\])]+?)\s*[\])]$", name)) and bracket[1] in UNITS:
        return words_of(name[: bracket.start()]), bracket[1]
    *words, last = words_of(name) or [""]
    if "rpm" in words:
        return [word for word in (*words, last) if word != "rpm"], "rpm"
    return (words, SPOKEN[last]) if words and last in SPOKEN else ([*words, last], None)


class Survey(NamedTuple):
    """A column: its range, and what it may be."""

    name: str  # as a mapping refers to it within its table
    low: float  # NaN for text
    high: float


@dataclass
class TableSurvey:
    """A table: how its rows are stamped, and its columns."""

    name: str
    rows: int
    columns: list[Survey]
    stamps: str | None = None  # column of the stamps; None if they come with the rows
    unit: str | None = None  # of these, other than seconds
    findings: list[str] = field(default_factory=list)
    t: Array | None = None  # (T,) [s]
    data: dict[str, Column] = field(default_factory=dict)

    @property
    def time(self) -> str | None:
        """The stamps for a mapping, as `t`, `[s, ns]` or `{from: t, unit: ms}`."""
        return f"{{from: {self.stamps}, unit: {self.unit}}}" if self.unit else self.stamps

    @property
    def numbers(self) -> list[Survey]:
        """The columns that hold numbers."""
        return [column for column in self.columns if np.isfinite(column.low)]

    @property
    def stamp_columns(self) -> list[str]:
        """The columns of the stamps."""
        return (self.stamps or "").strip("[]").split(", ")

    @property
    def regularity(self) -> list[str]:
        """Sentences on rate, gaps, stamps that run backwards, repeated rows and missing values."""
        return [] if self.t is None or len(self.t) < 2 else list(_regularity(self.t, self.data))

    def reference(self, column: str, alone: bool) -> str:
        """Returns how a mapping refers to a column."""
        text = column if alone else f"{self.name}:{column}"
        plain = re.fullmatch(r"[A-Za-z/][\w/. -]*(:[\w. -]+)?|\d+", text)
        return text if plain else f'"{text}"'


def survey(source: Source) -> list[TableSurvey]:
    """Surveys every table of a source; RecordingError if none is readable."""
    found, unread = [], None
    for name in source.names:
        try:
            found.append(_surveyed(name, source.table(name)))
        except RecordingError as error:  # one unreadable table leaves the others
            found.append(TableSurvey(name, 0, [], findings=[str(error)]))
            unread = unread or error
    if unread is not None and not any(table.columns for table in found):
        raise unread
    # Units of stamps are such that all tables last about as long as those in seconds.
    lasting = [float(np.ptp(each.t)) for each in found if each.t is not None and not each.unit]
    for table in found:
        if table.t is None or not table.unit or not lasting:
            continue
        raw = table.t / UNITS[table.unit].factor
        ratio = {u: np.ptp(raw) * UNITS[u].factor / np.median(lasting) for u in ("ms", "us", "ns")}
        table.unit = min(ratio, key=lambda unit: abs(np.log(max(ratio[unit], 1e-30))))
        table.t = raw * UNITS[table.unit].factor
    return found


def _surveyed(name: str, table: Table) -> TableSurvey:
    columns, data = [], {}
    for k, title in list(enumerate(table.names))[:MOST_COLUMNS]:
        which = title if title and table.names.count(title) == 1 else str(k)
        data[which] = column = table.column(which)
        columns.append(Survey(which, *_range(column)))
    rows = max((len(column) for column in data.values()), default=0)
    found = TableSurvey(name, rows, columns, findings=list(table.notes), data=data)
    given = table.stamps("")
    if given is not None:
        found.t = given.t
    else:
        found.stamps, raw = _time(data)
        if raw is not None:
            raw = raw[np.isfinite(raw)]
            found.unit = likely_unit(raw)
            found.t = raw * UNITS[found.unit or "s"].factor
    return found


def _range(column: Column) -> tuple[float, float]:
    values = np.zeros(0) if column.dtype.kind in "US" else column.astype(np.float64)
    if not np.isfinite(values).any():
        return np.nan, np.nan
    return float(np.nanmin(values)), float(np.nanmax(values))


def _time(data: dict[str, Column]) -> tuple[str | None, Array | None]:
    """Guesses the column of stamps: by its name, and by how steadily it rises."""
    for seconds, rest in stamping.SPLIT:
        if all(each in data and data[each].dtype.kind not in "US" for each in (seconds, rest)):
            return f"[{seconds}, {rest}]", stamping.joined(data[seconds], data[rest])

    def merit(name: str) -> float:
        step = np.diff(values[name][np.isfinite(values[name])])
        if not len(step) or np.mean(step < 0.0) > MOST_BACK or not (step > 0.0).any():
            return 0.0
        named = bool(TIMES & set(unit_in(name)[0]))
        counts = bool((step == 1.0).all())  # an index, unless its name says otherwise
        anonymous = name.isdecimal() and not counts
        return (named + 0.5 * anonymous) * float(np.mean(step > 0.0))

    numbers = {name: c.astype(np.float64) for name, c in data.items() if c.dtype.kind not in "US"}
    texts = {name: dates_of(c) for name, c in data.items() if c.dtype.kind in "US"}
    values = numbers | {name: dates for name, dates in texts.items() if dates is not None}
    best = max(values, key=merit, default=None)
    return (None, None) if best is None or merit(best) < 0.25 else (best, values[best])


def _regularity(t: Array, data: dict[str, Column]) -> Iterator[str]:
    """Yields sentences on rate, gaps, stamps that run backwards, and rows that lack or repeat."""
    step = np.diff(t)
    usual = float(np.median(step[step > 0.0])) if (step > 0.0).any() else np.nan
    yield f"{1.0 / usual:.4g} Hz, {float(np.ptp(t)):.1f} s"
    if gaps := int((step > GAP * usual).sum()):
        where = float(t[int(np.argmax(step))] - t[0])
        yield f"gaps: {gaps}, the longest of {step.max():.3g} s after {where:.1f} s"
    if back := int((step < 0.0).sum()):
        yield f"stamps that run backwards: {back}"
    numbers = {name: c.astype(np.float64) for name, c in data.items() if c.dtype.kind not in "US"}
    whole = [c for c in numbers.values() if len(c) == len(t)]
    same = np.all([c[1:] == c[:-1] for c in whole], axis=0) & (step == 0.0)
    if again := int((step == 0.0).sum()):
        yield f"stamps like the one before: {again}, in rows that repeat all of it: {same.sum()}"
    if (np.abs(step - usual) > IRREGULAR * usual).mean() > IRREGULAR:
        yield "stamps are uneven: rows arrive in bursts"
    missing = {name: int(np.isnan(c).sum()) for name, c in numbers.items()}
    for count in sorted({*missing.values()} - {0}):
        names = ", ".join(name for name, each in missing.items() if each == count)
        yield f"{count} of {len(t)} rows have no {names}"
