"""Surveys a recording of any form: what is there, and a first mapping whose guesses are marked."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.mapped import POSES
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.recording import IRREGULAR, implausible_pose
from nics_drl_bridge.recording.table import Column, Source, Table

GUESSED = "# guessed"
GAP = 5.0  # a gap is longer than this many usual steps
MOST_COLUMNS = 200  # of a table
UNIT_LENGTH = 0.01  # by which a quaternion may differ from length 1
MOST_BACK = 0.05  # share of steps of a column of stamps that may go back
TIMES = {"time", "times", "stamp", "timestamp", "t", "s", "sec", "secs", "seconds", "elapsed"}
SPLIT = (("s", "ns"), ("sec", "nanosec"), ("secs", "nsecs"), ("sec", "nsec"), ("sec", "nsecs"))
HEADINGS = ("yaw", "heading", "theta", "psi", "th", "angle")
TRACKERS = {"pose", "vicon", "mocap", "vrpn", "optitrack", "gt", "truth", "tracker", "amcl", "pf"}
COMMANDING = {"cmd", "command", "commanded", "commands", "ref", "setpoint", "target", "desired"}
COMMANDING |= {"control", "drive", "input"}
MEASURING = {"odom", "odometry", "imu", "measured", "encoder", "feedback", "model"}
WORDS = {
    "throttle": {"throttle", "gas", "accelerator", "pwm"},
    "steering": {"steering", "steer", "delta"},
    "speed": {"speed", "velocity", "vel", "v", "linear"},
    "turn": {"angular", "omega", "yawrate", "wz", "w"},
    "left": {"left", "l", "lw"},
    "right": {"right", "r", "rw"},
}
TICKS = {"tick", "ticks", "encoder", "enc", "count", "counts"}
# Commands of a kind of robot, by meaning, and its names for them.
KINDS = (
    ("ackermann_throttle", {"throttle": "throttle", "steering": "steering"}),
    ("ackermann", {"speed": "speed_command", "steering": "steering_command"}),
    ("differential", {"speed": "forward_command", "turn": "turn_command"}),
    ("differential_wheels", {"left": "left_wheel", "right": "right_wheel"}),
)


def words_of(name: str) -> list[str]:
    """Splits a name into its words: `vicon x`, `q.x`, `Left_Tick`, `cmdVel`."""
    parts = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return [word for word in re.split(r"[^A-Za-z]+", parts.lower()) if word]


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
    def stamp_columns(self) -> list[str]:
        """The columns of the stamps."""
        return (self.stamps or "").strip("[]").split(", ")

    @property
    def regularity(self) -> list[str]:
        """Sentences on rate, gaps, stamps that run backwards, and repeated rows."""
        known = self.t is not None and len(self.t) > 1
        return list(_regularity(self.t, self.data)) if known and self.t is not None else []

    def reference(self, column: str, alone: bool) -> str:
        """Returns how a mapping refers to a column."""
        text = column if alone else f"{self.name}:{column}"
        plain = re.fullmatch(r"[A-Za-z/][\w/. -]*(:[\w. -]+)?|\d+", text)
        return text if plain else f'"{text}"'


def survey(source: Source) -> list[TableSurvey]:
    """Surveys every table of a source."""
    found = []
    for name in source.names:
        try:
            found.append(_surveyed(name, source.table(name)))
        except RecordingError as error:  # one unreadable table leaves the others
            found.append(TableSurvey(name, 0, [], findings=[str(error)]))
    _units_by_span(found)
    return found


def _units_by_span(tables: Sequence[TableSurvey]) -> None:
    """Chooses units of stamps so that all tables last about as long as those in seconds."""
    lasting = [float(np.ptp(each.t)) for each in tables if each.t is not None and not each.unit]
    for table in tables:
        if table.t is None or not table.unit or not lasting:
            continue
        raw = table.t / UNITS[table.unit].factor
        ratio = {u: np.ptp(raw) * UNITS[u].factor / np.median(lasting) for u in ("ms", "us", "ns")}
        table.unit = min(ratio, key=lambda unit: abs(np.log(max(ratio[unit], 1e-30))))
        table.t = raw * UNITS[table.unit].factor


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
        found.t = None if raw is None else _in_seconds(found, raw)
    return found


def _range(column: Column) -> tuple[float, float]:
    if column.dtype.kind in "US" or not np.isfinite(column.astype(np.float64)).any():
        return np.nan, np.nan
    return float(np.nanmin(column)), float(np.nanmax(column))


def _time(data: dict[str, Column]) -> tuple[str | None, Array | None]:
    """Guesses the column of stamps: by its name, and by how steadily it rises."""
    for seconds, rest in SPLIT:
        if all(each in data and data[each].dtype.kind not in "US" for each in (seconds, rest)):
            return f"[{seconds}, {rest}]", stamping.joined(data[seconds], data[rest])

    def merit(name: str) -> float:
        values = data[name].astype(np.float64)
        step = np.diff(values[np.isfinite(values)])
        if not len(step) or np.mean(step < 0.0) > MOST_BACK or not (step > 0.0).any():
            return 0.0
        named = bool(TIMES & set(words_of(name)))
        counts = bool((step == 1.0).all())  # an index, unless its name says otherwise
        anonymous = name.isdecimal() and not counts
        return (named + 0.5 * anonymous) * float(np.mean(step > 0.0))

    numbers = [name for name, column in data.items() if column.dtype.kind not in "US"]
    best = max(numbers, key=merit, default=None)
    if best is None or merit(best) < 0.25:
        return None, None
    return best, data[best].astype(np.float64)


def _in_seconds(found: TableSurvey, raw: Array) -> Array:
    raw = raw[np.isfinite(raw)]
    if (unit := stamping.likely_unit(raw)) is None:
        return raw
    found.unit = unit
    return raw * UNITS[unit].factor


def _regularity(t: Array, data: dict[str, Column]) -> Iterator[str]:
    """Yields sentences on rate, gaps, stamps that run backwards, and repeated rows."""
    step = np.diff(t)
    usual = float(np.median(step[step > 0.0])) if (step > 0.0).any() else np.nan
    yield f"{1.0 / usual:.4g} Hz, {float(np.ptp(t)):.1f} s"
    if gaps := int((step > GAP * usual).sum()):
        where = float(t[int(np.argmax(step))] - t[0])
        yield f"gaps: {gaps}, the longest of {step.max():.3g} s after {where:.1f} s"
    if back := int((step < 0.0).sum()):
        yield f"stamps that run backwards: {back}"
    numbers = [c.astype(np.float64) for c in data.values() if c.dtype.kind not in "US"]
    same = np.all([c[1:] == c[:-1] for c in numbers if len(c) == len(t)], axis=0) & (step == 0.0)
    if again := int((step == 0.0).sum()):
        yield f"stamps like the one before: {again}, in rows that repeat all of it: {same.sum()}"
    if (np.abs(step - usual) > IRREGULAR * usual).mean() > IRREGULAR:
        yield "stamps are uneven: rows arrive in bursts"


class Guess(NamedTuple):
    """Part of a mapping."""

    table: TableSurvey
    keys: dict[str, str]  # key -> column


def guess_pose(tables: Sequence[TableSurvey]) -> Guess | None:
    """Finds x, y and heading, or a quaternion, under names that belong together."""
    found: list[tuple[int, Guess]] = []
    for table in tables:
        names = [column.name for column in table.columns if np.isfinite(column.low)]
        for name in names:
            keys = _position(name, names)
            keys |= _heading(keys["x"], table, names) if len(keys) == 2 else {}
            if len(keys) > 2:
                words = set(words_of(f"{table.name} {name}"))
                merit = 2 * bool(words & TRACKERS) - 2 * bool(words & MEASURING)
                found.append((merit + ("quaternion" in keys), Guess(table, keys)))
    if found:
        return max(found, key=lambda each: each[0])[1]
    return next((guess for table in tables if (guess := _by_quaternion(table))), None)


def _by_quaternion(table: TableSurvey) -> Guess | None:
    """Finds four columns side by side of length 1, after a position x, y, z, without names."""
    names = [column.name for column in table.columns if np.isfinite(column.low)]
    for k in range(3, len(names) - 3):
        four = [table.data[name].astype(np.float64) for name in names[k : k + 4]]
        turns = any(np.ptp(each) > 0.0 for each in four)
        if turns and np.nanmax(np.abs(np.linalg.norm(four, axis=0) - 1.0)) < UNIT_LENGTH:
            quaternion = f"[{', '.join(names[k : k + 4])}]"
            return Guess(table, {"x": names[k - 3], "y": names[k - 2], "quaternion": quaternion})
    return None


def _position(name: str, names: Sequence[str]) -> dict[str, str]:
    """Returns x and y if a name is of x, and the heading too if it is the first of three."""
    if name.endswith("[0]") and (TRACKERS | MEASURING) & set(words_of(name)):
        three = [name, *(name.replace("[0]", f"[{k}]") for k in (1, 2))]
        more = name.replace("[0]", "[3]") in names
        known = all(one in names for one in three) and not more
        return dict(zip(("x", "y", "heading"), three, strict=True)) if known else {}
    y = _like(name, "y", names)
    named = re.search(r"(^|[^A-Za-z]|t|p)x$", name, re.IGNORECASE) is not None
    return {"x": name, "y": y} if named and y is not None else {}


def _like(name: str, axis: str, names: Sequence[str]) -> str | None:
    other = name[:-1] + (axis.upper() if name[-1].isupper() else axis)
    return other if other in names else None


def _heading(x: str, table: TableSurvey, names: Sequence[str]) -> dict[str, str]:
    prefix = x[:-1].rstrip("tpTP ._")
    start = prefix.removesuffix("position").rstrip("._ ")
    turned = [f"{start}.orientation.x", f"{start}.rotation.x", "q.x", "qx", "q_x", f"{start}.q.x"]
    turned += [f"{start.removesuffix('translation')}rotation.x", "orientation.x"]
    for first in (each.lstrip(".") for each in turned):
        each = [first[:-1] + axis for axis in "xyzw"]
        if first != x and all(one in names for one in each):
            return {"quaternion": f"[{', '.join(each)}]"}
    for name in names:
        words = words_of(name)
        if name.startswith(prefix) and words and words[-1] in HEADINGS:
            return {"heading": name}
    z = _like(x, "z", names)
    low, high = next(((c.low, c.high) for c in table.columns if c.name == z), (0.0, 0.0))
    planar = z is not None and "position" not in x and -3.3 < low < high < 6.4 and high - low > 0.5
    return {"heading": z} if planar and z is not None else {}


def guess_command(tables: Sequence[TableSurvey]) -> tuple[str, dict[str, tuple[TableSurvey, str]]]:
    """Finds columns that drive a robot of a known kind; else any whose names say `command`."""
    scored = [
        (_merit(table, column), table, column) for table in tables for column in table.columns
        if np.isfinite(column.low) and column.name not in table.stamp_columns
    ]  # fmt: skip
    for kind, names in KINDS:
        found = {}
        for meaning, name in names.items():
            fitting = [e for e in scored if e[0] >= 0 and _means(meaning, e[1], e[2].name)]
            if fitting:
                _, table, column = max(fitting, key=lambda e: (e[0], e[2].low < e[2].high))
                found[name] = table, column.name
        if len(found) == len(names):
            return kind, found
    some = [(table, c.name) for merit, table, c in scored if merit > 0 and (c.low or c.high)]
    return "free", {f"command_{k}": each for k, each in enumerate(some)}


def _merit(table: TableSurvey, column: Survey) -> int:
    words = set(words_of(f"{table.name} {column.name}"))
    ticks = bool(words & TICKS)
    return 2 * bool(words & COMMANDING) + ticks - (0 if ticks else 1) * bool(words & MEASURING)


def _means(meaning: str, table: TableSurvey, name: str) -> bool:
    own = words_of(name)
    words = set(own if len(own) > 1 or own != ["data"] else words_of(table.name))
    if words & {"x", "y", "z"} and not words & {"linear", "angular"}:
        return False
    axis = {"speed": "y", "turn": "x"}.get(meaning)
    off = words & {"y", "z"} if axis == "y" else words & {"x", "y"} if axis == "x" else set()
    return bool(words & WORDS[meaning]) and not off


def first_mapping(tables: Sequence[TableSurvey]) -> str:
    """Writes a first mapping in YAML; guesses are marked, and what was not found says so."""
    alone = len(tables) == 1
    pose, (kind, commands) = guess_pose(tables), guess_command(tables)
    lines = [f"robot: {{kind: {kind}, footprint_radius: 0.2}}  {GUESSED}; radius in m"]
    times = [t.time for t in tables if t.time is not None]
    common = max(set(times), key=times.count) if times else None
    if common is not None:
        lines.append(f"time: {common}  {GUESSED}")
    elif any(table.t is None and table.rows for table in tables):
        lines.append("# time: which column? `time: {rate: 50}` if there is none")
    if pose is None:
        lines += ["pose:  # none was found: give x, y, and heading or quaternion", "  x: ", "  y: "]
    else:
        lines += _pose_lines(pose, alone, common)
    lines.append("command:" if commands else "command:  # none was found: NAME: COLUMN")
    for name, (table, column) in commands.items():
        keys = [f"from: {table.reference(column, alone)}"]
        if set(words_of(column)) & TICKS:
            keys.append("unit: ticks")
        if table.time not in (common, None):
            keys.append(f"time: {table.time}")
        value = f"{{{', '.join(keys)}}}" if len(keys) > 1 else keys[0].removeprefix("from: ")
        lines.append(f"  {name}: {value}  {GUESSED}")
    return "\n".join(lines) + "\n"


def _pose_lines(pose: Guess, alone: bool, common: str | None) -> Iterator[str]:
    if pose.table.stamps is None and pose.keys["x"] in (form[0].format("x") for form in POSES[:4]):
        yield f"pose: {pose.table.name}  {GUESSED}"  # a message whose fields are known
        return
    yield f"pose:  {GUESSED}"
    if not alone:
        yield f"  in: {pose.table.name}"
    for key, column in pose.keys.items():
        many = column.startswith("[")
        yield f"  {key}: {column if many else pose.table.reference(column, True)}"
    if pose.table.time not in (common, None):
        yield f"  time: {pose.table.time}"
    columns = [pose.table.data.get(pose.keys.get(key, ""), None) for key in ("x", "y", "heading")]
    known = [np.zeros(pose.table.rows) if c is None else c.astype(np.float64) for c in columns]
    whole = np.isfinite(values := np.stack(known, axis=1)).all(axis=1)
    if pose.table.t is not None and len(pose.table.t) == len(values) and whole.sum() > 2:
        fault = implausible_pose(pose.table.t[whole], values[whole])
        if fault is not None and not fault.line.startswith("time"):
            yield f"  {fault.line}  {GUESSED}: otherwise it {fault.reason}"
