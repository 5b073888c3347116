"""Values of a recording in SI, with their stamps, as its mapping says."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError, RecordingError, suggest
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.recording import mapping as schema
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.mapping import (
    Mapping,
    Measured,
    Reference,
    UnitOfData,
    Value,
)
from nics_drl_bridge.recording.recording import Stream, guess_time_unit
from nics_drl_bridge.recording.table import Column, Source, Table, read_numbers

ZONE = re.compile(r"(Z|[+-]\d\d:?\d\d)$")
CLOCK = re.compile(r"\d\d:\d\d:\d\d")  # a time of day
AT_ONCE = 0.25  # rows so much closer than usual come at once
CLOSE = 1e-9  # a flag equals a number within this


class Series(NamedTuple):
    """A value in SI, where it is known."""

    t: Array  # (T,) [s]
    values: Array  # (T,)
    clock: str


class Stamped(NamedTuple):
    """Rows of a table in the order of their stamps."""

    t: Array  # (T,) [s]
    rows: NDArray[np.intp]  # (T,)
    clock: str  # empty if nothing tells it
    total: int  # rows of the table, before those without a stamp were left out


@dataclass
class MappedReader:
    """Reads values of a source; collects what was mended in `notes`."""

    source: Source
    mapping: Mapping

    def __post_init__(self) -> None:
        self.notes: list[str] = []
        self._stamped: dict[tuple[str, str], Stamped] = {}

    def add_notes(self, *notes: str) -> None:
        """Adds sentences, each once."""
        self.notes += [note for note in notes if note and note not in self.notes]

    def locate(
        self, reference: Reference, within: str | None = None
    ) -> tuple[Table, Reference]:
        """Returns the table of a reference, and the column there; RecordingError: no such table."""
        names = self.source.names
        if isinstance(reference, str):
            for k in (k for k, sign in enumerate(reference) if sign == ":"):
                if (name := _match_table(reference[:k], names)) is not None:
                    return self._read_table(name), reference[k + 1 :]
        wanted = within or self.mapping.in_ or (names[0] if len(names) == 1 else None)
        name = None if wanted is None else _match_table(wanted, names)
        if name is not None:
            table = self._read_table(name)
            if (
                not isinstance(reference, str)
                or ":" not in reference
                or reference in table.names
            ):
                return table, reference
        if isinstance(reference, str) and ":" in reference:
            wanted = reference.rpartition(":")[0]
        if wanted is not None:
            hint = suggest(wanted, names)
            raise RecordingError(f"{self.source.place}: has no {wanted!r}; {hint}")
        advice = f"write it as TABLE:{reference}, or add `in: TABLE`"
        listed = ", ".join(names[:20])
        fault = f"{self.source.place}: {reference!r} is of no table"
        raise ConfigError(f"{fault}; {advice}; its tables are {listed}.")

    def _read_table(self, name: str) -> Table:
        table = self.source.get_table(name)
        self.add_notes(*table.notes)
        return table

    def stamp_rows(
        self, table: Table, column: Column, time: schema.Time | None
    ) -> Stamped:
        """Returns the rows of a column in order, by their stamps."""
        time = time or self.mapping.time
        count = len(column)
        if time is not None and time.rate is not None:
            return Stamped(np.arange(count) / time.rate, np.arange(count), "", count)
        key = table.place, repr(time)
        if key not in self._stamped:
            self._stamped[key] = self._read_stamps(table, time)
        found = self._stamped[key]
        if found.total != count:
            fault = (
                f"{table.place}: {found.total} stamps can't be those of {count} values"
            )
            raise RecordingError(f"{fault}; say which are, by `time:` beside `from:`.")
        return found

    def _read_stamps(self, table: Table, time: schema.Time | None) -> Stamped:
        which = "" if time is None else str(time.from_)
        if time is None or which in (schema.HEADER, schema.ARRIVAL):
            given = table.stamps(which)
            if given is None:
                example = "as in `time: t`, `time: [s, ns]`, or `time: {rate: 50}` if there is none"
                raise RecordingError(
                    f"{table.place}: which column is the time? Say {example}."
                )
            self.add_notes(*table.notes)
            rows = given.values[:, 0].astype(np.intp)
            asked = getattr(self.mapping.time, "from_", None) == schema.HEADER
            main = (
                stamping.HEADER if asked else stamping.RECEIVE
            )  # the mapping's own clock
            clock = "" if given.clock == main else given.clock
            return Stamped(given.t, rows, clock, len(table.column(0)))
        raw = self._read_raw_stamps(table, time)
        name = table.place.rpartition("/")[2]
        known = np.flatnonzero(np.isfinite(raw))
        alone = len(time.columns) == 1 and time.unit in (None, "s")
        if alone and (each := stamping.count_rows_a_second(raw[known])):
            column = time.columns[0]  # lacks the part below a second
            rest = (b for a, b in stamping.SPLIT if a == column and b in table.names)
            line = next(
                (f"time: [{column}, {b}]" for b in rest), f"time: {{rate: {each}}}"
            )
            fault = f"{table.place}: the stamps {column!r} are whole seconds, of {each} rows each"
            fix = f"write `{line}` into the mapping, or choose another column"
            raise RecordingError(f"{fault}; {fix}.")
        if len(known) < len(raw):
            self.add_notes(
                f"{name}: {len(raw) - len(known)} rows without a stamp were left out."
            )
        t, note = stamping.remove_overflow(raw[known], name)
        self.add_notes(note)
        if (unit := guess_time_unit(t)) is not None and time.unit is None:
            usual = f"{np.median(np.diff(t)):.4g} apart, which can't be seconds"
            fault = f"{table.place}: the stamps {time.columns[0]!r} are {usual}"
            advice = f"write `time: {{from: {time.columns[0]}, unit: {unit}}}` into the mapping"
            raise RecordingError(f"{fault}; {advice} (`unit: s` if they are).")
        t, order, note = stamping.repair_order(
            t * schema.UNITS[time.unit or "s"].factor, name
        )
        self.add_notes(note)
        return Stamped(t, known[order], "", len(raw))

    def _read_raw_stamps(self, table: Table, time: schema.Time) -> Array:
        first, *others = time.columns
        which = self._locate_beside(table, first)[1]
        if others:
            nanoseconds = read_numbers(table, self._locate_beside(table, others[0])[1])
            return stamping.join_stamps(read_numbers(table, which), nanoseconds)
        column = table.column(which)
        if column.dtype.kind in "US":
            dates = parse_dates(column)
            return read_numbers(table, which) if dates is None else dates
        return column.astype(np.float64)

    def _locate_beside(
        self, table: Table, reference: Reference
    ) -> tuple[Table, Reference]:
        """Returns table and column of a reference that, without a table, is of the values'."""
        if (
            isinstance(reference, str)
            and ":" in reference
            and reference not in table.names
        ):
            return self.locate(reference)
        return table, reference

    def read_series(
        self,
        name: str,
        value: Value,
        stream: Measured | None,
        held: bool,
        infinite: bool = False,
    ) -> Series:
        """Returns a value in SI; of a counter its rate, `held` from stamp to stamp or between.

        What is `infinite` is refused, or else unknown.
        """
        stream = stream or Measured()
        table, which = self.locate(value.from_, stream.in_)
        column = read_numbers(table, which)
        time = value.time or stream.time
        at = self.stamp_rows(table, column, time)
        clock = (
            value.clock
            or stream.clock
            or self.mapping.clock
            or at.clock
            or schema.ROBOT_CLOCK
        )
        raw = column[at.rows]
        for k in np.flatnonzero(np.isinf(raw) & (not infinite))[:1]:
            where = f"{table.place}: {table.row(int(at.rows[k]))}"
            raise RecordingError(
                f"{where}: column {which!r} is infinite; mend or remove the row."
            )
        known = np.isfinite(raw)
        if not known.any():
            fault = f"{table.place}: {which!r} holds no number"
            raise RecordingError(f"{fault}; choose another column.")
        if not known.all():
            missing = f"{int((~known).sum())} of {len(raw)} rows have no value"
            self.add_notes(f"{name}: {missing}, and were left out.")
        made = Series(at.t[known], raw[known], clock)
        plain = (
            get_unit(value).si in ("", "rad/s", "m/s", "ticks/s") and value.wrap is None
        )
        if (
            plain
            and not value.counts
            and (does := stamping.describe_counter(made.values))
        ):
            fault = f"{table.place}: {which!r} is a counter that {does}"
            advice = f"write `{{from: {which}, unit: ticks, ticks_per_turn: ...}}`"
            raise RecordingError(f"{fault}, no speed: {advice} for {name}.")
        made = self._convert_to_si(name, value, made, held)
        return self._apply_flags(value, made, table, time) if value.when else made

    def _convert_to_si(
        self, name: str, value: Value, raw: Series, held: bool
    ) -> Series:
        factor = get_unit(value).factor * value.scale
        factor *= 1.0 if value.maximum is None else value.maximum
        if value.wrap is not None or value.counts:
            raw = self._unwrap(name, value, raw)
        if value.counts and stamping.is_oscillating(raw.values):
            fault = (
                f"{self.source.place}: {value.from_!r} goes up and down like a speed"
            )
            advice = f"write `unit: {value.unit or 'ticks'}/s` for {name}"
            raise RecordingError(f"{fault}, and is no counter: {advice}.")
        if value.counts:
            raw = _derive_rate(raw, held)
        return raw._replace(values=raw.values * factor + value.offset)

    def _unwrap(self, name: str, value: Value, raw: Series) -> Series:
        """Continues a counter over its overflows; an absolute angle begins near zero."""
        size = value.wrap or stamping.find_overflow(raw.values, (1.0,), stamping.BITS)
        if size is None:
            return raw
        values, count = stamping.unwrap_counter(raw.values, size)
        if not value.counts:
            values = values - size * np.round(values[0] / size)
        if count:
            found = "" if value.wrap else ", as it seems"
            end = f"{stamping.format_times(count)}, at {size:.10g}{found}"
            self.add_notes(f"{name}: the counter overflowed {end}, and was continued.")
        return raw._replace(values=values)

    def _apply_flags(
        self, value: Value, made: Series, table: Table, time: schema.Time | None
    ) -> Series:
        """Puts `otherwise` where a flag is not as it must be."""
        on = np.ones(len(made.t), dtype=np.bool_)
        for reference, wanted in value.when.items():
            other, which = self._locate_beside(table, reference)
            column = other.column(which)
            at = self.stamp_rows(other, column, time if other is table else None)
            row = np.searchsorted(at.t, made.t, side="right") - 1
            on &= _match_values(column, wanted)[at.rows][np.clip(row, 0, None)] & (
                row >= 0
            )
        if not on.any():
            wanted = " and ".join(
                f"{name} is {each!r}" for name, each in value.when.items()
            )
            fault = (
                f"{table.place}: {value.from_!r} never counts: there is no row in which"
            )
            raise RecordingError(f"{fault} {wanted}; check `when:`.")
        return made._replace(values=np.where(on, made.values, value.otherwise))


def get_unit(value: Value) -> UnitOfData:
    """Returns the unit in SI and the factor of a value, of a counter those of its rate."""
    unit = value.unit or ("ticks" if value.ticks_per_turn else None)
    si, factor = (
        schema.to_si(unit, value.ticks_per_turn) if unit else UnitOfData("", 1.0)
    )
    return UnitOfData(schema.RATES.get(si, si) if value.counts else si, factor)


def _match_table(wanted: str, names: Sequence[str]) -> str | None:
    """Returns a table by its name, by its name without suffix, or by a topic without slash."""
    alike = (
        name
        for name in names
        if name.rpartition(".")[0] == wanted or name == f"/{wanted}"
    )
    return wanted if wanted in names else next(alike, None)


def parse_dates(column: Column) -> Array | None:
    """Returns seconds since 1970 of dates like 2024-05-01 12:00:00.5; None if they are none."""
    text = [ZONE.sub("", str(each)).replace("/", "-") for each in column]
    if text and CLOCK.match(text[0]):
        text = [f"1970-01-01T{each}" for each in text]
    try:
        ns = np.array(text, dtype="datetime64[ns]").astype(np.int64)
    except ValueError:
        return None
    return stamping.join_stamps(
        ns // NS_PER_S, ns % NS_PER_S
    )  # exact to a quarter of a microsecond


def _derive_rate(raw: Series, held: bool) -> Series:
    """Differentiates a counter: exact between two stamps, so that its integral stays.

    Of rows that come at once only the last is used: ticks between them would be of no time.
    """
    span = np.diff(raw.t)
    last = np.append(span > AT_ONCE * span.mean() if len(span) else span > 0.0, True)
    t = raw.t[last]
    values = raw.values[last]
    rate = np.diff(values) / np.diff(t)
    return Series(t[:-1] if held else (t[:-1] + t[1:]) / 2.0, rate, raw.clock)


def _match_values(column: Column, wanted: schema.Condition) -> NDArray[np.bool_]:
    """Selects rows (T,) in which a flag has one of the wanted values."""
    on = np.zeros(len(column), dtype=np.bool_)
    for each in wanted if isinstance(wanted, list) else [wanted]:
        if column.dtype.kind in "US":
            on |= np.char.lower(column) == str(each).lower()
        elif not isinstance(each, str):
            on |= np.abs(column.astype(np.float64) - float(each)) < CLOSE
    return on


def combine_series(name: str, parts: Sequence[Series], held: bool) -> Stream:
    """Joins values to a stream: commands hold, others are interpolated at the first's rows."""
    clocks = sorted({part.clock for part in parts})
    if len(clocks) > 1:
        fault = f"{name}: its values are of the clocks {' and '.join(clocks)}"
        raise ConfigError(f"{fault}; a stream needs one clock.")
    t = parts[0].t
    columns = [part.values for part in parts]
    if not all(np.array_equal(t, part.t) for part in parts):
        start = max(part.t[0] for part in parts)
        stop = min(part.t[-1] for part in parts)
        if held:
            t = np.unique(np.concatenate([part.t for part in parts]))
            t = t[t >= start]
        else:
            t = t[(t >= start) & (t <= stop)]
        if not len(t):
            raise RecordingError(
                f"{name}: its values are of times that do not overlap."
            )
        columns = [
            p.values[np.searchsorted(p.t, t, side="right") - 1]
            if held
            else np.interp(t, *p[:2])
            for p in parts
        ]
    return Stream(t, np.stack(columns, axis=1), clocks[0])
