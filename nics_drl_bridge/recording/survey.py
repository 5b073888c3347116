"""Surveys a recording in any format: its tables, their columns, stamps and irregularities."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.mapping import (
    UNITS,
    is_place_on_earth,
    split_words,
    word_set,
    write_reference,
)
from nics_drl_bridge.recording.recording import (
    IRREGULAR,
    UNITS_OF_STEP,
    compute_usual_step,
    guess_time_unit,
)
from nics_drl_bridge.recording.table import Column, Source, Table, is_text
from nics_drl_bridge.recording.values import parse_dates

GAP = 5.0  # a gap is longer than this many usual steps
MOST_COLUMNS = 200  # maximum number of columns of a table that are surveyed
# Stamps with smaller steps are not in the unit that their name states.
SHORTEST_STEP_S = 1e-4
LEAST_SCORE = 0.25  # minimum score of a column of stamps
MAX_BACKWARD_FRACTION = 0.05  # maximum fraction of backward steps of a column of stamps
TICKS = word_set("tick ticks encoder enc encoders count counts")
TIMES = word_set("""
    time times stamp timestamp t s sec secs seconds elapsed ms us ns millis
    micros nanos date datetime
""")


def _index_units(text: str) -> dict[str, str]:
    """Returns units by name from lines such as `m/s: mps, m per s`."""
    units = {}
    for line in text.strip().splitlines():
        unit, _, names = line.strip().partition(": ")
        for name in names.split(", "):
            units[name] = unit
    return units


# Units at the end of a name (`yaw_deg`, `v_m_s`)
ENDINGS = _index_units("""
    m: m, meters, metres
    cm: cm
    mm: mm
    rad: rad, radians
    deg: deg, degrees
    m/s: m per s, m s, mps
    cm/s: cm s
    mm/s: mm s
    km/h: km h, kmh, kph
    mph: mph
    rad/s: rad per s, rad s, rads, radps
    deg/s: deg per s, deg s, degps, dps
    rpm: rpm
    %: pct, percent
""")
# Units in brackets, `x(m)` or `omega [rad s^-1]`, in addition to those of a mapping
IN_BRACKETS = _index_units("""
    m: meter, meters, metre, metres
    rad: radian, radians
    deg: degree, degrees, °
    s: sec, seconds
    us: µs
    m/s: m/sec, m s^-1, m*s^-1
    rad/s: rad/sec, rad s^-1, rad*s^-1
    deg/s: deg s^-1, °/s
    km/h: kmph
    m/s^2: m/s2, m/s², m s^-2, m*s^-2
    %: percent
""")
NO_UNIT = ("", "-", "1", "none", "unitless")


def split_unit(name: str) -> tuple[list[str], str | None]:
    """Returns the words of a name, and the unit at its end: `x(m)`, `x [mm]`, `yaw_deg`."""
    bracket = re.search(r"[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$", name)
    if bracket:
        text = bracket[1]
        words = split_words(name[: bracket.start()])
        if text in UNITS and text != "1":
            return words, text
        if text.lower() in IN_BRACKETS:
            return words, IN_BRACKETS[text.lower()]
        if text.lower() in NO_UNIT and not text.isdecimal():
            return words, None
    words = split_words(name) or [""]
    if "rpm" in words:
        return [word for word in words if word != "rpm"], "rpm"
    for ending, unit in ENDINGS.items():
        if " ".join(words).endswith(f" {ending}"):
            return words[: -len(ending.split())], unit
    return words, None


@dataclass(frozen=True, eq=False)
class Field:
    """A column of a table."""

    table: "TableSurvey" = field(repr=False)
    name: str  # as a mapping refers to it within its table
    values: Column  # (T,)

    @cached_property
    def numbers(self) -> Array:
        """Values (T,) as numbers; NaN for text."""
        if is_text(self.values):
            return np.full(len(self.values), np.nan)
        return self.values.astype(np.float64)

    @cached_property
    def low(self) -> float:
        """Minimum of its numbers; NaN if there are none."""
        return float(np.fmin.reduce(self.numbers, initial=np.nan))

    @cached_property
    def high(self) -> float:
        """Maximum of its numbers; NaN if there are none."""
        return float(np.fmax.reduce(self.numbers, initial=np.nan))

    @property
    def moves(self) -> bool:
        """True if its numbers differ."""
        return self.low < self.high

    @property
    def is_place_on_earth(self) -> bool:
        """True if it looks like a latitude or longitude."""
        return is_place_on_earth(self.name, self.low, self.high)

    @property
    def name_words(self) -> set[str]:
        """Words of its name."""
        return {*split_words(self.name)}

    @property
    def words(self) -> list[str]:
        """Words of its name without the unit; for `data`, those of the table's name."""
        words = split_unit(self.name)[0]
        return split_words(self.table.name) if words == ["data"] else words

    @property
    def unit(self) -> str | None:
        """Unit that its name states."""
        return split_unit(self.name)[1]

    @property
    def counts(self) -> bool:
        """True if its name is that of ticks."""
        return not TICKS.isdisjoint(self.name_words)

    @property
    def reference(self) -> str:
        """How a mapping refers to it; in a single table, its name suffices."""
        table = "" if self.table.is_single else f"{self.table.name}:"
        return write_reference(f"{table}{self.name}")


@dataclass
class TableSurvey:
    """A table: how its rows are stamped, and its columns."""

    name: str
    kind: str = ""  # message type, of a topic
    findings: list[str] = field(default_factory=list)
    columns: list[Field] = field(default_factory=list)
    # columns of the stamps (one, or seconds and nanoseconds); empty if stamps come with
    # the rows
    stamp_columns: Sequence[str] = ()
    unit: str | None = None  # unit of the stamps, unless seconds
    t: Array | None = None  # (T,) [s]
    is_single: bool = True  # False if there are other tables

    @property
    def rows(self) -> int:
        """Number of rows."""
        return max((len(column.values) for column in self.columns), default=0)

    @property
    def words(self) -> set[str]:
        """Words of its name."""
        return {*split_words(self.name)}

    @property
    def by_name(self) -> dict[str, Field]:
        """Its columns by name."""
        return {column.name: column for column in self.columns}

    @property
    def facts(self) -> dict[str, Any]:
        """The survey as plain data."""
        columns = [(c.name, c.low, c.high) for c in self.columns]
        stamps = ", ".join(self.stamp_columns)
        return {
            "name": self.name,
            "rows": self.rows,
            "stamps": f"[{stamps}]" if len(self.stamp_columns) > 1 else stamps or None,
            "unit": self.unit,
            "findings": self.findings,
            "kind": self.kind,
            "columns": columns,
            "regularity": self.regularity,
        }

    @property
    def time(self) -> str | None:
        """The stamps for a mapping, such as `t`, `[s, ns]` or `{from: t, unit: ms}`."""
        if not self.stamp_columns:
            return None
        text = ", ".join(map(write_reference, self.stamp_columns))
        if len(self.stamp_columns) > 1:
            text = f"[{text}]"
        return f"{{from: {text}, unit: {self.unit}}}" if self.unit else text

    @property
    def numbers(self) -> list[Field]:
        """The columns that hold numbers."""
        return [column for column in self.columns if np.isfinite(column.low)]

    @property
    def regularity(self) -> list[str]:
        """Returns sentences on rate, gaps, backward stamps, repeated rows and missing values."""
        if self.t is None or len(self.t) < 2:
            return []
        columns = [column for column in self.columns if not is_text(column.values)]
        return list(_describe_regularity(self.t, columns))


def inspect_tables(source: Source) -> list[TableSurvey]:
    """Surveys every table of a source. Raises RecordingError if none is readable."""
    tables = []
    first_error = None
    for name in source.names:
        try:
            tables.append(_inspect_table(name, source.get_table(name)))
        except RecordingError as error:  # one unreadable table leaves the others
            tables.append(TableSurvey(name, findings=[str(error)]))
            first_error = first_error or error
    if first_error is not None and not any(table.columns for table in tables):
        raise first_error
    _correct_units(tables)
    for survey in tables:
        survey.is_single = len(tables) == 1
    return tables


def _correct_units(tables: Sequence[TableSurvey]) -> None:
    """Corrects units of stamps so that each table lasts about as long as the tables in seconds."""
    durations = [
        float(np.ptp(table.t))
        for table in tables
        if table.t is not None and not table.unit
    ]
    for table in tables:
        if table.t is None or not table.unit or not durations:
            continue
        raw = table.t / UNITS[table.unit].factor
        ratio = max(float(np.ptp(raw) / np.median(durations)), 1e-30)
        table.unit = min(
            UNITS_OF_STEP, key=lambda unit: abs(np.log(ratio * UNITS[unit].factor))
        )
        table.t = raw * UNITS[table.unit].factor


def _inspect_table(name: str, table: Table) -> TableSurvey:
    survey = TableSurvey(name, table.kind, list(table.notes))
    for k, title in enumerate(table.names[:MOST_COLUMNS]):
        column = title
        if not title or table.names.count(title) > 1:
            column = str(k)
        survey.columns.append(Field(survey, column, table.column(column)))
    stream = table.stamps("")
    if stream is not None:
        survey.t = stream.t
        return survey
    survey.stamp_columns, raw = _guess_stamps(survey.columns)
    if survey.stamp_columns:
        raw = raw[np.isfinite(raw)]
        survey.unit = guess_time_unit(raw)
        if survey.unit is None and len(survey.stamp_columns) == 1:
            survey.unit = _guess_unit_by_name(survey.stamp_columns[0], raw)
        survey.t = raw * UNITS[survey.unit or "s"].factor
    return survey


def _guess_unit_by_name(name: str, raw: Array) -> str | None:
    """Returns the unit below a second that the name of stamps states, as in `time_ms`."""
    words, unit = split_unit(name)
    unit = unit or (words or [""])[-1]
    if unit not in UNITS_OF_STEP:
        return None
    is_too_short = compute_usual_step(raw) * UNITS[unit].factor < SHORTEST_STEP_S
    return None if is_too_short else unit


def _guess_stamps(columns: Sequence[Field]) -> tuple[Sequence[str], Array]:
    """Guesses the columns of stamps by their names and by how steadily they rise."""
    stamps: dict[str, Array] = {}
    for column in columns:
        times: Array | None = column.numbers
        if is_text(column.values):
            times = parse_dates(column.values)
        if times is not None:
            stamps[column.name] = times
    for split in stamping.SPLIT:
        if {*split} <= stamps.keys():
            return split, stamping.join_stamps(*(stamps[name] for name in split))
    scores = {name: _score_stamps(name, times) for name, times in stamps.items()}
    best = max(scores, key=lambda name: scores[name], default="")
    if scores.get(best, 0.0) < LEAST_SCORE:
        return (), np.zeros(0)
    return (best,), stamps[best]


def _score_stamps(name: str, values: Array) -> float:
    step = np.diff(values[np.isfinite(values)])
    if (
        not len(step)
        or np.mean(step < 0.0) > MAX_BACKWARD_FRACTION
        or not (step > 0.0).any()
    ):
        return 0.0
    has_name_of_time = not TIMES.isdisjoint(split_unit(name)[0])
    is_index = bool((step == 1.0).all())  # unless its name says otherwise
    is_nameless = name.isdecimal() and not is_index
    return (has_name_of_time + 0.5 * is_nameless) * float(np.mean(step > 0.0))


def _describe_regularity(t: Array, columns: Sequence[Field]) -> Iterator[str]:
    """Yields sentences on rate, gaps, backward stamps, repeated rows and missing values."""
    step = np.diff(t)
    usual = compute_usual_step(t) or np.nan
    yield f"{1.0 / usual:.4g} Hz, {float(np.ptp(t)):.1f} s"
    gaps = int((step > GAP * usual).sum())
    if gaps:
        after = f"after {t[np.argmax(step)] - t[0]:.1f} s"
        yield f"gaps: {gaps}, the longest of {step.max():.3g} s {after}"
    backward = int((step < 0.0).sum())
    if backward:
        yield f"stamps that run backwards: {backward}"
    repeated = int((step == 0.0).sum())
    if repeated:
        whole = [c.numbers for c in columns if len(c.values) == len(t)]
        is_same = np.all([c[1:] == c[:-1] for c in whole], axis=0) & (step == 0.0)
        yield (
            f"stamps like the one before: {repeated}, in rows that repeat all of it: "
            f"{is_same.sum()}"
        )
    if (np.abs(step - usual) > IRREGULAR * usual).mean() > IRREGULAR:
        yield "stamps are uneven: rows arrive in bursts"
    missing: dict[int, list[str]] = {}
    for column in columns:
        missing.setdefault(int(np.isnan(column.numbers).sum()), []).append(column.name)
    for count in sorted(missing.keys() - {0}):
        yield f"{count} of {len(t)} rows have no {', '.join(missing[count])}"
