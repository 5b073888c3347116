"""Surveys a recording of any form: tables, their stamps and what is odd in them, columns."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.mapping import UNITS, is_place_on_earth
from nics_drl_bridge.recording.names import split_words, word_set, write_reference
from nics_drl_bridge.recording.recording import (
    IRREGULAR,
    UNITS_OF_STEP,
    guess_time_unit,
)
from nics_drl_bridge.recording.table import Column, Source, Table
from nics_drl_bridge.recording.values import parse_dates

GAP = 5.0  # a gap is longer than this many usual steps
MOST_COLUMNS = 200  # of a table
# stamps that would be closer are not in the unit that their name says
SHORTEST_STEP_S = 1e-4
MOST_BACK = 0.05  # share of steps of a column of stamps that may go back
TIMES = word_set("""
    time times stamp timestamp t s sec secs seconds elapsed ms us ns millis
    micros nanos date datetime
""")
# Units as they end a name (`yaw_deg`, `v_m_s`), the longest first.
ENDINGS: dict[tuple[str, ...], str] = {
    ("m", "per", "s"): "m/s",
    ("rad", "per", "s"): "rad/s",
    ("deg", "per", "s"): "deg/s",
    ("m", "s"): "m/s",
    ("rad", "s"): "rad/s",
    ("deg", "s"): "deg/s",
    ("mm", "s"): "mm/s",
    ("cm", "s"): "cm/s",
    ("km", "h"): "km/h",
    ("m",): "m",
    ("cm",): "cm",
    ("mm",): "mm",
    ("meters",): "m",
    ("metres",): "m",
    ("rad",): "rad",
    ("radians",): "rad",
    ("deg",): "deg",
    ("degrees",): "deg",
    ("mps",): "m/s",
    ("kmh",): "km/h",
    ("kph",): "km/h",
    ("mph",): "mph",
    ("rads",): "rad/s",
    ("radps",): "rad/s",
    ("degps",): "deg/s",
    ("dps",): "deg/s",
    ("rpm",): "rpm",
    ("pct",): "%",
    ("percent",): "%",
}
# Units as they stand in brackets, `x(m)` or `omega [rad s^-1]`, beside those of a mapping.
IN_BRACKETS = {
    "meter": "m",
    "meters": "m",
    "metre": "m",
    "metres": "m",
    "radian": "rad",
    "radians": "rad",
    "degree": "deg",
    "degrees": "deg",
    "°": "deg",
    "sec": "s",
    "seconds": "s",
    "µs": "us",
    "m/sec": "m/s",
    "m s^-1": "m/s",
    "m*s^-1": "m/s",
    "rad/sec": "rad/s",
    "rad s^-1": "rad/s",
    "rad*s^-1": "rad/s",
    "deg s^-1": "deg/s",
    "°/s": "deg/s",
    "kmph": "km/h",
    "m/s2": "m/s^2",
    "m/s²": "m/s^2",
    "m s^-2": "m/s^2",
    "m*s^-2": "m/s^2",
    "percent": "%",
}
NO_UNIT = ("", "-", "1", "none", "unitless")


def split_unit(name: str) -> tuple[list[str], str | None]:
    """Returns the words of a name, and the unit that it ends with: `x(m)`, `x [mm]`, `yaw_deg`."""
    if bracket := re.search(r"[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$", name):
        said = bracket[1]
        unit = said if said in UNITS else IN_BRACKETS.get(said.lower())
        unitless = said.lower() in NO_UNIT and not said.isdecimal()
        if unit is not None and said != "1":
            return split_words(name[: bracket.start()]), unit
        if unitless:
            return split_words(name[: bracket.start()]), None
    words = split_words(name) or [""]
    if "rpm" in words:
        return [word for word in words if word != "rpm"], "rpm"
    for ending, unit in ENDINGS.items():
        if len(words) > len(ending) and tuple(words[-len(ending) :]) == ending:
            return words[: -len(ending)], unit
    return words, None


class Survey(NamedTuple):
    """A column: its range, and what it may be."""

    name: str  # as a mapping refers to it within its table
    low: float  # NaN for text
    high: float

    @property
    def is_place_on_earth(self) -> bool:
        """True if it seems to be a latitude or longitude."""
        return is_place_on_earth(self.name, self.low, self.high)


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
    kind: str = ""  # message type, of a topic

    @property
    def time(self) -> str | None:
        """The stamps for a mapping, as `t`, `[s, ns]` or `{from: t, unit: ms}`."""
        if self.stamps is None:
            return None
        columns = [write_reference(column) for column in self.stamp_columns]
        listed = columns[0] if len(columns) == 1 else f"[{', '.join(columns)}]"
        return f"{{from: {listed}, unit: {self.unit}}}" if self.unit else listed

    @property
    def numbers(self) -> list[Survey]:
        """The columns that hold numbers."""
        return [column for column in self.columns if np.isfinite(column.low)]

    @property
    def stamp_columns(self) -> list[str]:
        """The columns of the stamps."""
        if self.stamps is None:
            return []
        split = re.fullmatch(r"\[(.+), (.+)\]", self.stamps)
        return [split[1], split[2]] if split else [self.stamps]

    @property
    def regularity(self) -> list[str]:
        """Sentences on rate, gaps, stamps that run backwards, repeated rows and missing values."""
        if self.t is None or len(self.t) < 2:
            return []
        return list(_describe_regularity(self.t, self.data))

    def list_words(self, column: str) -> list[str]:
        """Returns the words of a column, of `data` those of the table."""
        words = split_unit(column)[0]
        if words == ["data"]:
            return split_words(self.name)
        return words

    def refer_to(self, column: str, alone: bool) -> str:
        """Returns how a mapping refers to a column."""
        return write_reference(column if alone else f"{self.name}:{column}")


def inspect_tables(source: Source) -> list[TableSurvey]:
    """Surveys every table of a source; RecordingError if none is readable."""
    found = []
    unread = None
    for name in source.names:
        try:
            found.append(_inspect_table(name, source.get_table(name)))
        except RecordingError as error:  # one unreadable table leaves the others
            found.append(TableSurvey(name, 0, [], findings=[str(error)]))
            unread = unread or error
    if unread is not None and not any(table.columns for table in found):
        raise unread
    # Units of stamps are such that all tables last about as long as those in seconds.
    lasting = [
        float(np.ptp(each.t)) for each in found if each.t is not None and not each.unit
    ]
    for table in found:
        if table.t is None or not table.unit or not lasting:
            continue
        raw = table.t / UNITS[table.unit].factor
        ratio = {
            u: np.ptp(raw) * UNITS[u].factor / np.median(lasting)
            for u in ("ms", "us", "ns")
        }
        table.unit = min(ratio, key=lambda unit: abs(np.log(max(ratio[unit], 1e-30))))
        table.t = raw * UNITS[table.unit].factor
    return found


def _inspect_table(name: str, table: Table) -> TableSurvey:
    columns = []
    data = {}
    for k, title in list(enumerate(table.names))[:MOST_COLUMNS]:
        which = title if title and table.names.count(title) == 1 else str(k)
        data[which] = column = table.column(which)
        columns.append(Survey(which, *_find_range(column)))
    rows = max((len(column) for column in data.values()), default=0)
    found = TableSurvey(name, rows, columns, findings=list(table.notes), data=data)
    found.kind = table.kind
    given = table.stamps("")
    if given is not None:
        found.t = given.t
    else:
        found.stamps, raw = _guess_stamps(data)
        if raw is not None:
            raw = raw[np.isfinite(raw)]
            found.unit = guess_time_unit(raw) or _guess_unit_by_name(
                found.stamps or "", raw
            )
            found.t = raw * UNITS[found.unit or "s"].factor
    return found


def _guess_unit_by_name(name: str, raw: Array) -> str | None:
    """Returns the unit below a second that a name says of its stamps, as `time_ms`."""
    said = split_unit(name)[1] or (split_words(name) or [""])[-1]
    step = np.diff(raw)
    usual = float(np.median(step[step > 0.0])) if (step > 0.0).any() else 0.0
    if said not in UNITS_OF_STEP or usual * UNITS[said].factor < SHORTEST_STEP_S:
        return None
    return said


def _find_range(column: Column) -> tuple[float, float]:
    values = np.zeros(0) if column.dtype.kind in "US" else column.astype(np.float64)
    if not np.isfinite(values).any():
        return np.nan, np.nan
    return float(np.nanmin(values)), float(np.nanmax(values))


def _guess_stamps(data: dict[str, Column]) -> tuple[str | None, Array | None]:
    """Guesses the column of stamps: by its name, and by how steadily it rises."""
    for seconds, rest in stamping.SPLIT:
        if all(
            each in data and data[each].dtype.kind not in "US"
            for each in (seconds, rest)
        ):
            return f"[{seconds}, {rest}]", stamping.join_stamps(
                data[seconds], data[rest]
            )

    def score_column(name: str) -> float:
        step = np.diff(values[name][np.isfinite(values[name])])
        if not len(step) or np.mean(step < 0.0) > MOST_BACK or not (step > 0.0).any():
            return 0.0
        named = bool(TIMES & set(split_unit(name)[0]))
        counts = bool((step == 1.0).all())  # an index, unless its name says otherwise
        anonymous = name.isdecimal() and not counts
        return (named + 0.5 * anonymous) * float(np.mean(step > 0.0))

    numbers = {
        name: c.astype(np.float64)
        for name, c in data.items()
        if c.dtype.kind not in "US"
    }
    texts = {name: parse_dates(c) for name, c in data.items() if c.dtype.kind in "US"}
    values = numbers | {
        name: dates for name, dates in texts.items() if dates is not None
    }
    best = max(values, key=score_column, default=None)
    return (
        (None, None)
        if best is None or score_column(best) < 0.25
        else (best, values[best])
    )


def _describe_regularity(t: Array, data: dict[str, Column]) -> Iterator[str]:
    """Yields sentences on rate, gaps, stamps that run backwards, and rows that lack or repeat."""
    step = np.diff(t)
    usual = float(np.median(step[step > 0.0])) if (step > 0.0).any() else np.nan
    yield f"{1.0 / usual:.4g} Hz, {float(np.ptp(t)):.1f} s"
    if gaps := int((step > GAP * usual).sum()):
        where = float(t[int(np.argmax(step))] - t[0])
        yield f"gaps: {gaps}, the longest of {step.max():.3g} s after {where:.1f} s"
    if back := int((step < 0.0).sum()):
        yield f"stamps that run backwards: {back}"
    numbers = {
        name: c.astype(np.float64)
        for name, c in data.items()
        if c.dtype.kind not in "US"
    }
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
