"""Guesses the mapping of a recording by names and motion, as a first one to edit."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array, east_and_north
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording.mapped import POSES
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.recording import along_path, clockwise_line, led_along
from nics_drl_bridge.recording.survey import Survey, TableSurvey, unit_in, words_of
from nics_drl_bridge.robot.spec import find_kind, kind_names
from nics_drl_bridge.robot.template import names_of

GUESSED = "# guessed"
UNIT_LENGTH = 0.01  # by which a quaternion may differ from length 1
# Words of names: of a place, and what goes with x; of headings, and of neither.
AXES = {"x": "y", "px": "py", "tx": "ty", "posx": "posy", "easting": "northing", "east": "north"}
GLOBE = {"longitude": "latitude", "lon": "lat", "lng": "lat", "long": "lat"}
AXES |= GLOBE
HEADINGS = {"yaw", "heading", "theta", "psi", "th", "angle", "orientation", "hdg"}
NOT_PLACES = {"linear", "angular", "twist", "velocity", "vel", "acc", "accel", "acceleration"}
NOT_PLACES |= {"gyro", "mag", "cmd", "command", "steer", "steering", "rate", "speed", "wheel"}
TURNS = {"q", "quat", "quaternion", "rotation", "orientation"}
TRACKERS = {"pose", "vicon", "mocap", "vrpn", "optitrack", "gt", "truth", "tracker", "amcl", "pf"}
COMMANDING = {"cmd", "command", "commanded", "commands", "ref", "setpoint", "target", "desired"}
COMMANDING |= {"control", "drive", "input"}
MEASURING = {"odom", "odometry", "imu", "measured", "encoder", "feedback", "model"}
TICKS = {"tick", "ticks", "encoder", "enc", "count", "counts"}
NO_VALUES = {"header", "stamp", "seq", "covariance", "index", "id", "row"}
# Words that mean a command, each set of them alone.
MEANINGS: dict[str, tuple[set[str], ...]] = {
    "throttle": ({"throttle"}, {"gas"}, {"accelerator"}, {"pedal"}, {"pwm"}),
    "steering": ({"steering"}, {"steer"}, {"delta"}, {"phi"}, {"servo"}),
    "traction": ({"traction"},),
    "speed": ({"speed"}, {"velocity"}, {"vel"}, {"v"}, {"vx"}, {"linear"}),
    "side": ({"vy"}, {"linear", "y"}),
    "turn": ({"angular"}, {"omega"}, {"yawrate"}, {"yaw", "rate"}, {"wz"}, {"w"}, {"turn"}),
    "left": ({"left"}, {"l"}, {"lw"}, {"wl"}, {"vl"}),
    "right": ({"right"}, {"r"}, {"rw"}, {"wr"}, {"vr"}),
    "front_left": ({"fl"}, {"front", "left"}, {"lf"}),
    "front_right": ({"fr"}, {"front", "right"}, {"rf"}),
    "rear_left": ({"rl"}, {"rear", "left"}, {"bl"}, {"back", "left"}),
    "rear_right": ({"rr"}, {"rear", "right"}, {"br"}, {"back", "right"}),
}  # fmt: skip
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
# Commands of a kind of robot, by meaning, and its names for them; other kinds have `words`.
KINDS = (
    ("mecanum", {wheel: f"{wheel}_wheel" for wheel in WHEELS}),
    ("omnidirectional", {"speed": "vx", "side": "vy", "turn": "wz"}),
    ("ackermann_throttle", {"throttle": "throttle", "steering": "steering"}),
    ("ackermann", {"speed": "speed_command", "steering": "steering_command"}),
    ("differential", {"speed": "forward_command", "turn": "turn_command"}),
    ("differential_wheels", {"left": "left_wheel", "right": "right_wheel"}),
)
NOT_USED, MOST_LISTED = "# not used", 20  # of a table
WHY_NOT = " (no numbers)", " (constant)"
MOST_COMMANDS = 4  # of columns that only might be commands
USUAL_WHEEL = 5.0  # [rad/s], by which the ticks of a turn are guessed
RADIUS = 0.2  # of a robot [m], unless it is as large as a car, since
FAST_CAR, FAR_AWAY, BIG_RADIUS = 10.0, 1e4, 2.0  # it is faster [m/s], or so far from 0 [m]
LARGEST_ANGLE = 1.6  # of a steering [rad]
ALONG = 0.9  # share to which columns without names lead along their heading


class Guess(NamedTuple):
    """Part of a mapping."""

    table: TableSurvey
    keys: dict[str, str]  # key -> column


def guess_pose(tables: Sequence[TableSurvey]) -> Guess | None:
    """Finds x, y and heading, or a quaternion: by their names, else by how they move."""
    found: list[Guess] = []
    for table in tables:
        named = {tuple(unit_in(c.name)[0]): c.name for c in table.numbers if "[" not in c.name[-3:]}
        for words, name in named.items():
            for x, y in AXES.items():
                other = named.get(tuple(y if word == x else word for word in words))
                if x not in words or other is None or {*words} & (NOT_PLACES | TURNS):
                    continue
                if turned := _turned(table, words, named):
                    found.append(Guess(table, {"x": name, "y": other, **turned}))
    found = found or [guess for table in tables for guess in _unnamed(table)]
    return max(found, key=_trust, default=None)


def _trust(pose: Guess) -> int:
    words = {*words_of(f"{pose.table.name} {pose.keys['x']}")}
    return 2 * bool(words & TRACKERS) - 2 * bool(words & MEASURING) + ("quaternion" in pose.keys)


def _turned(
    table: TableSurvey, place: tuple[str, ...], named: dict[tuple[str, ...], str]
) -> dict[str, str]:
    """Returns the quaternion or the heading that shares most words with a place."""
    found: list[tuple[int, dict[str, str]]] = []
    for words in named:
        near = len({*words} & {*place})
        if words and words[-1] in ("w", "qw"):
            each = [(*words[:-1], words[-1][:-1] + axis) for axis in "xyzw"]
            if all(one in named for one in each) and each[0] != place:
                columns = ", ".join(named[one] for one in each)
                found.append((100 + near, {"quaternion": f"[{columns}]"}))
        elif words and words[-1] in HEADINGS and not {*words} & NOT_PLACES:
            found.append((near, {"heading": named[words]}))
    z = named.get((*place[:-1], "z")) if place[-1] == "x" and "position" not in place else None
    low, high = next(((c.low, c.high) for c in table.columns if c.name == z), (0.0, 0.0))
    if not found and -3.3 < low < high < 6.4 and high - low > 0.5 and z is not None:
        return {"heading": z}
    return max(found, key=lambda each: each[0])[1] if found else {}


def _unnamed(table: TableSurvey) -> Iterator[Guess]:
    """Yields a quaternion after x, y, z, or x, y, heading that lead along, side by side."""
    names = [c.name for c in table.numbers if c.name not in table.stamp_columns]
    columns = [table.data[name].astype(np.float64) for name in names]
    place = [name for word in ("x", "y") for name in names if unit_in(name)[0] == [word]]
    for k in range(2, len(names) - 3):
        four = columns[k : k + 4]
        if len({len(each) for each in four}) > 1:
            continue  # of several streams
        turns = any(np.ptp(each) > 0.0 for each in four)
        if turns and np.nanmax(np.abs(np.linalg.norm(four, axis=0) - 1.0)) < UNIT_LENGTH:
            turn = names[k : k + 4]
            turn = [*turn[1:], turn[0]] if recordings.w_first(np.stack(four, axis=1)) else turn
            own = [name for name in place if name not in turn]
            x, y = own if len(own) == 2 else names[max(k - 3, 0) :][:2]
            yield Guess(table, {"x": x, "y": y, "quaternion": f"[{', '.join(turn)}]"})
    for k in range(len(names) - 2):
        if len({len(each) for each in columns[k : k + 3]}) > 1:
            continue
        pose = np.stack(columns[k : k + 3], axis=1)
        pose = pose[np.isfinite(pose).all(axis=1)][:: max(1, len(pose) // 200)]
        shares = [led_along(pose, scale) for scale in (1.0, np.pi / 180.0)] if len(pose) else [0.0]
        if (np.ptp(pose, axis=0) > 0.0).all() and max(shares) > ALONG > led_along(pose, 0.0):
            yield Guess(table, dict(zip(("x", "y", "heading"), names[k : k + 3], strict=True)))


def guess_command(
    tables: Sequence[TableSurvey], pose: Guess | None
) -> tuple[str, dict[str, tuple[TableSurvey, Survey]]]:
    """Finds columns that drive a robot of a known kind; else any that may be commands."""
    taken = _columns_of(pose) if pose else []
    scored = [
        (_merit(table, column), table, column) for table in tables for column in table.numbers
        if not {*words_of(column.name)} & NO_VALUES
        and not (pose and table is pose.table and column.name in taken)
        and column.name not in table.stamp_columns
    ]  # fmt: skip
    own = [(name, kind.template.words) for name in kind_names() if (kind := find_kind(name))]
    fitting = [(kind, _by_meaning(names, scored)) for kind, names in (*own, *KINDS) if names]
    # A column that was zero throughout may be a command that was not used, if all others fit.
    still = [sum(_is_still(c) for _, c in found.values()) for _, found in fitting]
    known = [k for k, (_, found) in enumerate(fitting) if still[k] < len(found)]
    if known:
        return fitting[min(known, key=lambda k: still[k])]
    some = [e for e in scored if e[0] > 1 and e[2].low < e[2].high]
    some = [e for e in some if not {*words_of(e[2].name)} & TICKS] or some
    maybe = [e for e in scored if e[0] >= 0 and e[2].low < e[2].high]
    best = max((e[0] for e in maybe), default=0)
    some = some or [e for e in maybe if e[0] == best][:MOST_COMMANDS]
    return "free", {f"command_{k}": each[1:] for k, each in enumerate(some)}


def _by_meaning(
    names: Mapping[str, str], scored: Sequence[tuple[int, TableSurvey, Survey]]
) -> dict[str, tuple[TableSurvey, Survey]]:
    """Finds a column for each of a kind's commands; none if one is missing or serves twice."""
    found = {}
    for meaning, name in names.items():
        fitting = [e for e in scored if e[0] >= 0 and _means(meaning, e[1], e[2].name)]
        if fitting:
            best = max(fitting, key=lambda e: (not _is_still(e[2]), e[0], e[2].low < e[2].high))
            found[name] = best[1:]
    columns = {(id(table), column.name) for table, column in found.values()}
    return found if len(found) == len(names) == len(columns) else {}


def _is_still(column: Survey) -> bool:
    return column.low == column.high == 0.0


def _look_alikes(kind: str) -> list[str]:
    """Returns the other kinds of robots that have the same commands."""
    each = {name: find_kind(name) for name in kind_names()}
    ways = {n: [{*names_of(way)} for way in k.template.commands] for n, k in each.items() if k}
    return [n for n in ways if n != kind and any(way in ways[n] for way in ways.get(kind, ()))]


def _merit(table: TableSurvey, column: Survey) -> int:
    words = {*words_of(f"{table.name} {column.name}")}
    ticks = bool(words & TICKS)
    return 2 * bool(words & COMMANDING) + ticks - (0 if ticks else 1) * bool(words & MEASURING)


def _means(meaning: str, table: TableSurvey, name: str) -> bool:
    own = words_of(name)
    words = {*(own if own != ["data"] else words_of(table.name))}
    if words & {"x", "y", "z"} and not words & {"linear", "angular"}:
        return False
    off = {"speed": {"y", "z"}, "turn": {"x", "y"}}.get(meaning, set())
    return any(each <= words for each in MEANINGS[meaning]) and not words & off


def first_mapping(tables: Sequence[TableSurvey]) -> str:
    """Writes a first mapping in YAML; guesses are marked, and what was not found says so."""
    alone, pose = len(tables) == 1, guess_pose(tables)
    kind, commands = guess_command(tables, pose)
    times = [t.time for t in tables if t.time is not None]
    common = max(times, key=times.count) if times else None
    where = _pose_lines(pose, alone, common) if pose else ["pose:", "  x: ", "  y: "]
    radius = _radius(_values(pose, where) if pose else None)
    alike = "".join(f", or {each}" for each in _look_alikes(kind))
    lines = [f"robot: {{kind: {kind}, footprint_radius: {radius}}}  {GUESSED}{alike}; radius in m"]
    if common is not None:
        lines.append(f"time: {common}  {GUESSED}")
    elif any(table.t is None and table.rows for table in tables):
        lines.append(f"time: {{rate: 50}}  {GUESSED}: no stamps were found; rows a second")
    if pose is None:
        lines.append("# no pose was found: give x, y, and heading or quaternion, or `pose: /tf`")
    lines += where
    lines += _clock_lines(pose, commands)
    lines.append("command:" if commands else "command:  # none was found: NAME: COLUMN")
    for name, (table, column) in commands.items():
        keys = [f"from: {table.reference(column.name, alone)}", *_unit_keys(name, table, column)]
        if table.time not in (common, None):
            keys.append(f"time: {table.time}")
        value = f"{{{', '.join(keys)}}}" if len(keys) > 1 else keys[0].removeprefix("from: ")
        lines.append(f"  {name}: {value}  {GUESSED}{'; it is 0' * _is_still(column)}")
    return "\n".join([*lines, *_not_used(tables, pose, commands)]) + "\n"


def _clock_lines(
    pose: Guess | None, commands: Mapping[str, tuple[TableSurvey, Survey]]
) -> list[str]:
    """Returns the line that gives the pose a clock of its own, if it has one by its stamps."""
    if pose is None or (t := pose.table.t) is None or not pose.table.stamps:
        return []
    others = [(each.unit, np.sort(each.t)) for each, _ in commands.values() if each.t is not None]
    whys = {
        "shares no time with the commands": [u[-1] < min(t) or u[0] > max(t) for _, u in others],
        "one counts from its first row, and in another unit": [
            unit != pose.table.unit and 0.0 in (u[0], t[0]) for unit, u in others
        ],
    }
    said = [f"  clock: tracker  {GUESSED}: {why}" for why, each in whys.items() if all(each)]
    return said[:1] if others else []


def _not_used(
    tables: Sequence[TableSurvey], pose: Guess | None,
    commands: Mapping[str, tuple[TableSurvey, Survey]],
) -> Iterator[str]:  # fmt: skip
    """Yields a comment for each table that names the columns of values that a mapping lacks."""
    taken = {(id(table), column.name) for table, column in commands.values()}
    taken |= {(id(pose.table), each) for each in _columns_of(pose)} if pose else set()
    for table in tables:
        rest = [
            c.name + ("" if c.low < c.high else WHY_NOT[c.low == c.high]) for c in table.columns
            if not {*words_of(c.name)} & NO_VALUES
            and (id(table), c.name) not in taken and c.name not in table.stamp_columns
        ]  # fmt: skip
        place = "" if len(tables) == 1 else f"{table.name}: "
        more = f" and {len(rest) - MOST_LISTED} more" if len(rest) > MOST_LISTED else ""
        if rest:
            yield f"{NOT_USED}: {place}{', '.join(rest[:MOST_LISTED])}{more}"


def _columns_of(pose: Guess) -> list[str]:
    named = list(pose.keys.values())
    return [*named, *re.split(r"[\[\], ]+", ", ".join(named))]


def _unit_keys(name: str, table: TableSurvey, column: Survey) -> Iterator[str]:
    words, unit = unit_in(column.name)
    if {*words} & TICKS:
        counters = [table.data[c.name] for c in table.numbers if {*words_of(c.name)} & TICKS]
        step = np.abs(np.concatenate([np.diff(each.astype(np.float64)) for each in counters]))
        yield "unit: ticks"
        if "steer" in name:
            yield "differentiate: false"
        if (t := table.t) is not None and np.ptp(t) > 0.0 and (step > 0.0).any():
            rate = float(np.median(step[step > 0.0])) * len(t) / float(np.ptp(t))
            yield f"ticks_per_turn: {2 ** round(np.log2(2.0 * np.pi * rate / USUAL_WHEEL))}"
    elif unit is not None:
        yield f"unit: {unit}" if unit != "%" else 'unit: "%"'
    elif name == "steering_command" and max(-column.low, column.high) > LARGEST_ANGLE:
        yield "unit: deg"


def _pose_lines(pose: Guess, alone: bool, common: str | None) -> list[str]:
    table, keys = pose.table, pose.keys
    if table.stamps is None and keys["x"] in (form[0].format("x") for form in POSES[:4]):
        return [f"pose: {table.name}  {GUESSED}"]  # a message whose fields are known
    lines = [f"pose:  {GUESSED}", *([] if alone else [f"  in: {table.name}"])]
    for key, column in keys.items():
        many = column.startswith("[")
        lines.append(f"  {key}: {column if many else table.reference(column, True)}")
    if table.time not in (common, None):
        lines.append(f"  time: {table.time}")
    place = "deg" if {*words_of(keys["x"])} & {*GLOBE} else unit_in(keys["x"])[1]
    units = {"unit": place, "heading_unit": unit_in(keys.get("heading", ""))[1]}
    said = [f"  {key}: {unit}  {GUESSED}" for key, unit in units.items() if unit]
    for _ in range(0 if said else len(units)):
        found = _values(pose, said)
        fault = recordings.implausible_pose(*found, radius=_radius(found, 0.0)) if found else None
        if fault is not None and not fault.line.startswith("time"):
            said.append(f"  {fault.line}  {GUESSED}: else {fault.reason}")
    return [_turned_round(line, pose, said) for line in lines] + said


def _turned_round(line: str, pose: Guess, said: Sequence[str]) -> str:
    """Returns the heading's line as that of a compass, if the path only leads along such a one."""
    found = _values(pose, said) if line.startswith("  heading: ") else None
    keys = clockwise_line(found[1][along_path(found[1], _radius(found))]) if found else ""
    if not keys:
        return line
    why = "else heading and path turn opposite ways"
    return f"  heading: {{from: {line.partition(': ')[2]}, {keys}}}  {GUESSED}: {why}"


def _values(pose: Guess, lines: Sequence[str]) -> tuple[Array, Array] | None:
    """Returns stamps (T,) and poses (T, 3) of a guess in the units of its lines, if known."""
    table = pose.table
    columns = [table.data.get(pose.keys.get(key, "")) for key in ("x", "y", "heading")]
    rows = 0 if table.t is None else len(table.t)
    known = [np.zeros(rows) if c is None else c.astype(np.float64) for c in columns]
    if any(len(each) != rows for each in known):  # of several streams
        return None
    values = np.stack(known, axis=1)
    whole = np.isfinite(values).all(axis=1)
    if table.t is None or whole.sum() < 3:
        return None
    for key, part in (("unit", np.s_[:, :2]), ("heading_unit", np.s_[:, 2])):
        if named := re.search(rf"^  {key}: (\S+)", "\n".join(lines), re.MULTILINE):
            values[part] *= UNITS[named[1]].factor
            if key == "unit" and UNITS[named[1]].si == "rad":
                values[part] = np.stack(east_and_north(*values[part].T), axis=1)
    return table.t[whole], values[whole]


def _radius(found: tuple[Array, Array] | None, fastest: float = FAR_AWAY) -> float:
    """Returns the radius of a robot [m]: of a car if it is as fast, or on a map of the land."""
    if found is None:
        return RADIUS
    t, pose = found
    way = np.hypot(*np.diff(pose[:: max(1, len(t) // 200), :2], axis=0).T).sum()
    surveyed = np.abs(pose[:, :2]).min() > FAR_AWAY and np.ptp(pose[:, :2], axis=0).max() < FAR_AWAY
    fast = FAST_CAR * float(np.ptp(t)) < way < fastest
    return BIG_RADIUS if surveyed or fast else RADIUS
