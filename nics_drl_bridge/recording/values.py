"""Values of a recording in SI, with their stamps, according to its mapping."""

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
    DriveMapping,
    Measured,
    Reference,
    UnitOfData,
    Value,
)
from nics_drl_bridge.recording.recording import Stream, guess_time_unit
from nics_drl_bridge.recording.table import Column, Source, Table, is_text, read_numbers

ZONE = re.compile(r"(?:Z|([+-])(\d\d):?(\d\d))$")  # offset of a date from UTC
CLOCK = re.compile(r"\d\d:\d\d:\d\d")  # a time of day
AT_ONCE = 0.25  # rows closer than this fraction of the mean step count as simultaneous
MOST_LISTED = 20  # maximum number of tables listed in an error
CLOSE = 1e-9  # maximum difference of a flag from the number that it equals


class Series(NamedTuple):
    """A value in SI at the times at which it is known."""

    t: Array  # (T,) [s]
    values: Array  # (T,)
    clock: str


class StampedRows(NamedTuple):
    """Rows of a table in the order of their stamps."""

    t: Array  # (T,) [s]
    rows: NDArray[np.intp]  # (T,)
    clock: str  # empty if unknown
    total: int  # number of rows of the table, including those without a stamp


@dataclass
class MappedReader:
    """Reads values of a source, and collects sentences on repairs in `notes`."""

    source: Source
    mapping: DriveMapping

    def __post_init__(self) -> None:
        self.notes: list[str] = []
        self._stamped_rows: dict[tuple[str, str], StampedRows] = {}

    def add_notes(self, *notes: str) -> None:
        """Adds sentences, each once."""
        self.notes += [note for note in notes if note and note not in self.notes]

    def locate(
        self, reference: Reference, within: str | None = None
    ) -> tuple[Table, Reference]:
        """Returns the table and the column of a reference.

        Raises RecordingError if there is no such table, ConfigError if none is named.
        """
        names = self.source.names
        text = str(reference)
        colons = [k for k, sign in enumerate(text) if sign == ":"]
        for k in colons:
            name = _match_table(text[:k], names)
            if name is not None:
                return self._read_table(name), text[k + 1 :]
        default = within or self.mapping.in_
        if default is None and len(names) == 1:
            default = names[0]
        if default is not None:
            name = _match_table(default, names)
            if name is not None:
                table = self._read_table(name)
                if not colons or reference in table.names:
                    return table, reference
        if colons:
            default = text.rpartition(":")[0]
        if default is not None:
            hint = suggest(default, names)
            raise RecordingError(f"{self.source.place}: has no {default!r}; {hint}")
        advice = f"write it as TABLE:{reference}, or add `in: TABLE`"
        tables = ", ".join(names[:MOST_LISTED])
        raise ConfigError(
            f"{self.source.place}: {reference!r} names no table; {advice}; its tables "
            f"are {tables}."
        )

    def _read_table(self, name: str) -> Table:
        table = self.source.get_table(name)
        self.add_notes(*table.notes)
        return table

    def stamp_rows(
        self, table: Table, column: Column, time: schema.Time | None
    ) -> StampedRows:
        """Returns the rows of a column in the order of their stamps."""
        time = time or self.mapping.time
        count = len(column)
        if time is not None and time.rate is not None:
            rows = np.arange(count)
            return StampedRows(rows / time.rate, rows, "", count)
        key = table.place, repr(time)
        if key not in self._stamped_rows:
            if time is None or time.from_ in (schema.HEADER, schema.ARRIVAL):
                self._stamped_rows[key] = self._take_stamps(table, time)
            else:
                self._stamped_rows[key] = self._read_stamps(table, time)
        stamped = self._stamped_rows[key]
        if stamped.total != count:
            raise RecordingError(
                f"{table.place}: has {stamped.total} stamps for {count} values; choose "
                "the right ones with `time:` next to `from:`."
            )
        return stamped

    def _take_stamps(self, table: Table, time: schema.Time | None) -> StampedRows:
        """Returns the stamps that come with the rows of a table, as with a bag's messages."""
        stream = table.stamps("" if time is None else str(time.from_))
        if stream is None:
            raise RecordingError(
                f"{table.place}: which column is the time? Write `time: t`, `time: [s, "
                "ns]`, or `time: {rate: 50}` if there is none."
            )
        self.add_notes(*table.notes)
        default_clock = stamping.RECEIVE
        if getattr(self.mapping.time, "from_", None) == schema.HEADER:
            default_clock = stamping.HEADER
        clock = "" if stream.clock == default_clock else stream.clock
        rows = stream.values[:, 0].astype(np.intp)
        return StampedRows(stream.t, rows, clock, len(table.column(0)))

    def _read_stamps(self, table: Table, time: schema.Time) -> StampedRows:
        """Reads stamps from columns of a table, and repairs typical faults of loggers."""
        names = [self._locate_beside(table, column)[1] for column in time.columns]
        column = table.column(names[0])
        dates = parse_dates(column) if is_text(column) and len(names) == 1 else None
        raw = read_numbers(table, names[0]) if dates is None else dates
        if len(names) == 2:
            raw = stamping.join_stamps(raw, read_numbers(table, names[1]))
        rows = np.flatnonzero(np.isfinite(raw))
        t = raw[rows]
        _check_whole_seconds(table, time, t)
        name = table.place.rpartition("/")[2]
        if len(rows) < len(raw):
            missing = len(raw) - len(rows)
            self.add_notes(f"{name}: {missing} rows without a stamp were left out.")
        t, note = stamping.remove_overflow(t, name)
        self.add_notes(note)
        unit = guess_time_unit(t)
        if time.unit is None and unit is not None:
            column_name = time.columns[0]
            raise RecordingError(
                f"{table.place}: the stamps {column_name!r} are "
                f"{np.median(np.diff(t)):.4g} apart, which can't be seconds; write "
                f"`time: {{from: {column_name}, unit: {unit}}}` into the mapping "
                "(`unit: s` if they are)."
            )
        t = t * schema.UNITS[time.unit or "s"].factor
        t, order, note = stamping.repair_order(t, name)
        self.add_notes(note)
        return StampedRows(t, rows[order], "", len(raw))

    def _locate_beside(
        self, table: Table, reference: Reference
    ) -> tuple[Table, Reference]:
        """Returns table and column of a reference; without a table it refers to this one."""
        if ":" in str(reference) and reference not in table.names:
            return self.locate(reference)
        return table, reference

    def read_series(
        self,
        name: str,
        value: Value,
        stream: Measured | None,
        held: bool,
        allow_infinite: bool = False,
    ) -> Series:
        """Returns a value in SI, or the rate of a counter.

        A `held` value counts from its stamp to the next; others are interpolated. Infinite numbers
        are refused, or left out with `allow_infinite`.
        """
        stream = stream or Measured()
        table, column_name = self.locate(value.from_, stream.in_)
        time = value.time or stream.time
        raw = read_numbers(table, column_name)
        stamped = self.stamp_rows(table, raw, time)
        raw = raw[stamped.rows]
        infinite = stamped.rows[np.isinf(raw)]
        if len(infinite) and not allow_infinite:
            raise RecordingError(
                f"{table.place}: {table.row(int(infinite[0]))}: column {column_name!r} "
                "is infinite; correct or remove the row."
            )
        is_finite = np.isfinite(raw)
        if not is_finite.any():
            raise RecordingError(
                f"{table.place}: {column_name!r} contains no number; choose another "
                "column."
            )
        if not is_finite.all():
            self.add_notes(
                f"{name}: {int((~is_finite).sum())} of {len(raw)} rows have no value, "
                "and were left out."
            )
        clocks = (value.clock, stream.clock, self.mapping.clock, stamped.clock)
        clock = next(filter(None, clocks), schema.ROBOT_CLOCK)
        series = Series(stamped.t[is_finite], raw[is_finite], clock)
        series = self._count(name, value, series, held)
        factor = get_unit(value).factor * value.scale
        if value.maximum is not None:
            factor *= value.maximum
        series = series._replace(values=series.values * factor + value.offset)
        if value.when:
            return self._apply_flags(value, series, table, time)
        return series

    def _count(self, name: str, value: Value, series: Series, held: bool) -> Series:
        """Returns the rate of a counter; refuses counters and speeds that are confused."""
        if value.wrap is not None or value.counts:
            series = self._unwrap(name, value, series)
        elif get_unit(value).si in ("", "rad/s", "m/s", "ticks/s"):
            behaviour = stamping.describe_counter(series.values)
            if behaviour:
                raise RecordingError(
                    f"{self.source.place}: {value.from_!r} is a counter that "
                    f"{behaviour}, not a speed: write `{{from: {value.from_}, unit: ticks, "
                    f"ticks_per_turn: ...}}` for {name}."
                )
        if not value.counts:
            return series
        if stamping.is_oscillating(series.values):
            raise RecordingError(
                f"{self.source.place}: {value.from_!r} goes up and down like a "
                "speed, so it is not a counter: write `unit: "
                f"{value.unit or 'ticks'}/s` for {name}."
            )
        return _derive_rate(series, held)

    def _unwrap(self, name: str, value: Value, series: Series) -> Series:
        """Continues a counter across its overflows; an absolute angle starts near zero."""
        size = value.wrap
        origin = ""
        if size is None:
            size = stamping.find_overflow(series.values, (1.0,), stamping.BITS)
            origin = ", as it seems"
        if size is None:
            return series
        values, count = stamping.unwrap_counter(series.values, size)
        if not value.counts:
            values = values - size * np.round(values[0] / size)
        if count:
            self.add_notes(
                f"{name}: the counter overflowed {stamping.format_times(count)}, at "
                f"{size:.10g}{origin}, and was continued."
            )
        return series._replace(values=values)

    def _apply_flags(
        self, value: Value, series: Series, table: Table, time: schema.Time | None
    ) -> Series:
        """Replaces the value by `otherwise` in rows whose flags do not match `when`."""
        counts = np.ones(len(series.t), dtype=np.bool_)
        for reference, wanted in value.when.items():
            flag_table, flag = self._locate_beside(table, reference)
            column = flag_table.column(flag)
            flag_time = None
            if flag_table is table:
                flag_time = time
            stamped = self.stamp_rows(flag_table, column, flag_time)
            row = np.searchsorted(stamped.t, series.t, side="right") - 1
            matches = match_values(column, wanted)[stamped.rows]
            counts &= matches[np.clip(row, 0, None)] & (row >= 0)
        if not counts.any():
            conditions = " and ".join(
                f"{flag} is {wanted!r}" for flag, wanted in value.when.items()
            )
            raise RecordingError(
                f"{table.place}: {value.from_!r} is never valid: there is no row in "
                f"which {conditions}; check `when:`."
            )
        values = np.where(counts, series.values, value.otherwise)
        return series._replace(values=values)


def _check_whole_seconds(table: Table, time: schema.Time, t: Array) -> None:
    """Refuses stamps (T,) in whole seconds that several rows share, having lost their fraction."""
    column = time.columns[0]
    if len(time.columns) > 1 or time.unit not in (None, "s"):
        return
    rows_a_second = stamping.count_rows_a_second(t)
    if not rows_a_second:
        return
    fix = f"time: {{rate: {rows_a_second}}}"
    for seconds, fraction in stamping.SPLIT:
        if seconds == column and fraction in table.names:
            fix = f"time: [{column}, {fraction}]"
            break
    raise RecordingError(
        f"{table.place}: the stamps {column!r} are whole seconds with {rows_a_second} "
        f"rows each; write `{fix}` into the mapping, or choose another column."
    )


def get_unit(value: Value) -> UnitOfData:
    """Returns the SI unit and the factor of a value; for a counter, of its rate."""
    unit = value.unit
    if unit is None and value.ticks_per_turn:
        unit = "ticks"
    if unit is None:
        return UnitOfData("", 1.0)
    si, factor = schema.UNITS[unit]
    if si in schema.TICKS and value.ticks_per_turn:
        si = schema.TICKS[si]
        factor = schema.TURN / value.ticks_per_turn
    if value.counts:
        si = schema.RATES.get(si, si)
    return UnitOfData(si, factor)


def _match_table(wanted: str, names: Sequence[str]) -> str | None:
    """Returns a table by its name, its name without suffix, or a topic without its slash."""
    if wanted in names:
        return wanted
    for name in names:
        if name.rpartition(".")[0] == wanted or name == f"/{wanted}":
            return name
    return None


def parse_dates(column: Column) -> Array | None:
    """Returns seconds since 1970 of dates like 2024-05-01 12:00:00.5; None for other text.

    Dates with an offset such as +02:00 are converted to UTC; others are taken as UTC.
    """
    text = [ZONE.sub("", str(date)).replace("/", "-") for date in column]
    if text and CLOCK.match(text[0]):
        text = [f"1970-01-01T{time}" for time in text]
    try:
        ns = np.array(text, dtype="datetime64[ns]").astype(np.int64)
    except ValueError:
        return None
    ns -= np.array([_read_offset(str(date)) for date in column]) * NS_PER_S
    # This is exact to a quarter of a microsecond.
    return stamping.join_stamps(ns // NS_PER_S, ns % NS_PER_S)


def _read_offset(date: str) -> int:
    """Returns the offset from UTC that a date states [s]."""
    zone = ZONE.search(date)
    if zone is None or zone[1] is None:
        return 0
    offset = 3600 * int(zone[2]) + 60 * int(zone[3])
    return -offset if zone[1] == "-" else offset


def _derive_rate(counter: Series, held: bool) -> Series:
    """Differentiates a counter between stamps, so that the rate's integral is exact.

    Of simultaneous rows, only the last is used, because ticks between them would take
    no time.
    """
    is_last = np.ones(len(counter.t), dtype=np.bool_)
    if len(counter.t) > 1:
        span = np.diff(counter.t)
        is_last[:-1] = span > AT_ONCE * span.mean()
    t = counter.t[is_last]
    rate = np.diff(counter.values[is_last]) / np.diff(t)
    if held:
        return Series(t[:-1], rate, counter.clock)
    return Series((t[:-1] + t[1:]) / 2.0, rate, counter.clock)


def match_values(column: Column, wanted: schema.Condition) -> NDArray[np.bool_]:
    """Selects rows (T,) in which a flag has one of the wanted values."""
    matches = np.zeros(len(column), dtype=np.bool_)
    if not isinstance(wanted, list):
        wanted = [wanted]
    for value in wanted:
        if is_text(column):
            matches |= np.char.lower(column) == str(value).lower()
        elif not isinstance(value, str):
            matches |= np.abs(column.astype(np.float64) - float(value)) < CLOSE
    return matches


def combine_series(name: str, parts: Sequence[Series], held: bool) -> Stream:
    """Joins values into a stream: commands are held, others interpolated at the first's stamps."""
    clocks = sorted({part.clock for part in parts})
    if len(clocks) > 1:
        raise ConfigError(
            f"{name}: its values have the clocks {' and '.join(clocks)}; a stream "
            "needs one clock."
        )
    t = parts[0].t
    columns = [part.values for part in parts]
    if not all(np.array_equal(t, part.t) for part in parts):
        start = max(part.t[0] for part in parts)
        stop = min(part.t[-1] for part in parts)
        if held:
            t = np.unique(np.concatenate([part.t for part in parts]))
            stop = np.inf
        t = t[(t >= start) & (t <= stop)]
        if not len(t):
            raise RecordingError(f"{name}: the times of its values do not overlap.")
        columns = [np.interp(t, part.t, part.values) for part in parts]
        if held:
            rows = [np.searchsorted(part.t, t, side="right") - 1 for part in parts]
            columns = [part.values[row] for part, row in zip(parts, rows, strict=True)]
    return Stream(t, np.stack(columns, axis=1), clocks[0])
