"""Guesses which columns of a recording are the pose of the robot, by names, units and types."""

import re
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.names import split_words, word_set
from nics_drl_bridge.recording.recording import measure_alignment
from nics_drl_bridge.recording.survey import TableSurvey, split_unit

# Words of the first coordinate, with the matching word of the second
AXES = {
    "x": "y",
    "px": "py",
    "tx": "ty",
    "posx": "posy",
    "easting": "northing",
    "east": "north",
}
GLOBE = {"longitude": "latitude", "lon": "lat", "lng": "lat", "long": "lat"}
ALL_AXES = AXES | GLOBE
HEADINGS = (
    "yaw",
    "heading",
    "theta",
    "psi",
    "th",
    "hdg",
    "orientation",
    "angle",
    "phi",
)
# Words of columns that hold places of something else, motions, sensor data or deviations
OTHERS = word_set("""
    goal target waypoint waypoints ref reference setpoint desired initialpose
    marker markers obstacle obstacles landmark landmarks person people leg
    detection detections tag plan path cmd command
""")
NOT_PLACES = OTHERS | word_set("""
    linear angular twist velocity vel acc accel acceleration speed rate gyro mag
    magnetic magnetometer gravity force torque jerk steer steering wheel joy
    axes user pixel image camera laser scan lidar range beam info map error err
    std stddev sigma var variance cov covariance
""")
TURNS = word_set("q quat quaternion rotation orientation")
# Words for the source of a pose: trackers rank before localisers, localisers before odometry.
TRACKERS = word_set("vicon mocap vrpn optitrack qualisys gt truth groundtruth tracker")
LOCALISERS = word_set("pose amcl pf slam cartographer rtabmap filtered fused ekf")
SENSORS = word_set("odom odometry imu gyro measured encoder wheel feedback model")
SOURCES = TRACKERS | LOCALISERS | SENSORS | {"ground"}
# Message types that hold positions of something else, or of a goal
OTHER_PLACES = re.compile(
    r"^(visualization|actionlib|action|move_base|map)_msgs/"
    r"|/(Path|OccupancyGrid|MapMetaData|PoseArray|GridCells|Imu|Joy|LaserScan|MagneticField)$"
)
UNIT_LENGTH = 0.01  # maximum difference of a quaternion's length from 1
ALONG = 0.9  # minimum alignment of the path of columns without names with their heading
CONFIRMED = 0.7  # minimum alignment of a path with the quaternion that follows it
NEARLY_A_TURN = 5.5  # minimum change between two rows where an angle wraps [rad]
PIECES = 30  # number of steps over the extent of a path
MOST_COMPARED = 200  # approximate number of poses
ELEMENT = re.compile(r"\[\d+\]")


class PoseGuess(NamedTuple):
    """Columns of a pose; either a heading or a quaternion."""

    table: TableSurvey
    x: str
    y: str
    heading: str | None = None
    quaternion: tuple[str, ...] = ()  # x, y, z, w

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns that it uses."""
        if self.heading is None:
            return (self.x, self.y, *self.quaternion)
        return (self.x, self.y, self.heading)


def list_used_columns(table: TableSurvey, pose: PoseGuess | None) -> set[str]:
    """Returns the columns of a table that are stamps or belong to the pose."""
    used = {*table.stamp_columns}
    if pose is not None and pose.table is table:
        used.update(pose.columns)
    return used


def guess_pose(tables: Sequence[TableSurvey]) -> PoseGuess | None:
    """Finds x, y and heading or quaternion by their names, or by the motion."""
    if len(tables) > 1:  # then the names of tables show what they hold
        tables = [each for each in tables if OTHERS.isdisjoint(split_words(each.name))]
    poses = [pose for table in tables for pose in _find_named_poses(table)]
    if not poses:
        poses = [pose for table in tables for pose in _find_unnamed_poses(table)]
    return max(poses, key=_rank_pose, default=None)


def _rank_pose(pose: PoseGuess) -> float:
    """Ranks a pose by what its names say about its source."""
    words = {*split_words(pose.x)}
    # A column's name that states its source outweighs the file's name.
    if pose.table.kind or not words & SOURCES:
        words |= {*split_words(pose.table.name)}
    rank = 0.0
    if words & TRACKERS or {"ground", "truth"} <= words:
        rank += 3.0
    elif words & LOCALISERS:
        rank += 2.0
    if words & SENSORS:
        rank -= 2.0
    if pose.table.kind.endswith("/TFMessage"):
        rank -= 1.0
    return rank + 0.5 * bool(pose.quaternion)


def _find_named_poses(table: TableSurvey) -> Iterator[PoseGuess]:
    """Yields the poses whose names show x, y and heading."""
    if OTHER_PLACES.search(table.kind):
        return
    names = _name_by_words(table)
    moving = {column.name for column in table.numbers if column.low < column.high}
    for words, x in names.items():
        if {*words} & (NOT_PLACES | TURNS):
            continue
        for first, second in ALL_AXES.items():
            if first not in words:
                continue
            words_of_y = [second if word == first else word for word in words]
            y = names.get(tuple(words_of_y))
            kinds = ["m"] + ["rad"] * (first in GLOBE)
            if y is None or not {x, y} & moving or not _is_in(x, kinds):
                continue
            orientation = _find_orientation(words, names)
            if orientation:
                yield PoseGuess(table, x, y, **orientation)
            elif heading := _find_heading_called_z(table, words, names):
                yield PoseGuess(table, x, y, heading)


def _name_by_words(table: TableSurvey) -> dict[tuple[str, ...], str]:
    """Returns the names of numeric columns by their words, without elements of arrays."""
    names: dict[tuple[str, ...], str] = {}
    for column in table.numbers:
        if not ELEMENT.search(column.name):
            names.setdefault(tuple(split_unit(column.name)[0]), column.name)
    return names


def _is_in(name: str, kinds: Sequence[str]) -> bool:
    """True if a name has no unit, or a unit of one of these kinds."""
    unit = split_unit(name)[1]
    return unit is None or UNITS[unit].si in kinds


def _find_orientation(
    place: tuple[str, ...], names: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """Returns the quaternion, else the heading, that shares the most words with a place."""
    quaternions: list[tuple[int, tuple[str, ...]]] = []
    headings: list[tuple[float, str]] = []
    for words, name in names.items():
        if not words or {*words} & SENSORS - {*place}:
            continue  # from another source than the place
        *first, last = words
        shared = len({*words} & {*place})
        if last in ("w", "qw"):
            axes = [(*first, last[:-1] + axis) for axis in "xyzw"]
            if all(axis in names for axis in axes) and axes[0] != place:
                quaternions.append((shared, tuple(names[axis] for axis in axes)))
        elif last in HEADINGS and not {*words} & NOT_PLACES and _is_in(name, ["rad"]):
            headings.append((shared - 0.1 * HEADINGS.index(last), name))
    if quaternions:
        return {"quaternion": max(quaternions, key=itemgetter(0))[1]}
    if headings:
        return {"heading": max(headings, key=itemgetter(0))[1]}
    return {}


def _find_heading_called_z(
    table: TableSurvey, place: tuple[str, ...], names: dict[tuple[str, ...], str]
) -> str | None:
    """Returns the column z next to x and y if the path shows that it is a heading, not a height."""
    if place[-1] != "x" or "position" in place:
        return None
    z = names.get((*place[:-1], "z"))
    if z is None or not _is_in(z, ["rad"]):
        return None
    height = next(column for column in table.columns if column.name == z)
    is_angle = -3.3 < height.low < height.high < 6.4
    if not is_angle or height.high - height.low <= 0.5:
        return None
    x = names[place]
    y = names[(*place[:-1], "y")]
    pose = _stack_finite([table.data[name].astype(np.float64) for name in (x, y, z)])
    if pose is None:
        return None
    if (np.abs(np.diff(pose[:, 2])) > NEARLY_A_TURN).any():
        return z  # it wraps, as only an angle does
    pose = select_apart(pose)
    alignment = max(measure_alignment(pose, 1.0), measure_alignment(pose, -1.0))
    if len(pose) > 2 and alignment > CONFIRMED:
        return z
    return None


def _stack_finite(columns: Sequence[Array]) -> Array | None:
    """Returns the rows of columns without NaN; None for columns of several streams."""
    if len({len(column) for column in columns}) > 1:
        return None
    rows = np.stack(columns, axis=1)
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def select_apart(pose: Array) -> Array:
    """Returns poses of (T, 3) that are at least 1 / `PIECES` of the path's extent apart."""
    distance = np.ptp(pose[:, :2], axis=0).max() / PIECES
    kept = [0]
    for k in range(1, len(pose)):
        if np.hypot(*(pose[k, :2] - pose[kept[-1], :2])) > distance:
            kept.append(k)
    return np.asarray(pose[kept])


def _find_unnamed_poses(table: TableSurvey) -> Iterator[PoseGuess]:
    """Yields poses that the motion shows: x, y before a quaternion, or adjacent x, y, heading."""
    if table.kind:
        return  # the fields of messages have names
    names = [c.name for c in table.numbers if c.name not in table.stamp_columns]
    columns = [table.data[name].astype(np.float64) for name in names]
    for k in range(2, len(names) - 3):
        pose = _match_quaternion(table, names, columns, k)
        if pose is not None:
            yield pose
    for k in range(len(names) - 2):
        if not all(name.isdecimal() for name in names[k : k + 3]):
            continue
        values = _stack_finite(columns[k : k + 3])
        if values is None or not len(values) or not np.ptp(values, axis=0).all():
            continue
        values = values[:: max(1, len(values) // MOST_COMPARED)]
        in_radians = measure_alignment(values, 1.0)
        in_degrees = measure_alignment(values, np.pi / 180.0)
        if max(in_radians, in_degrees) > ALONG > measure_alignment(values, 0.0):
            x, y, heading = names[k : k + 3]
            yield PoseGuess(table, x, y, heading)


def _match_quaternion(
    table: TableSurvey, names: Sequence[str], columns: Sequence[Array], k: int
) -> PoseGuess | None:
    """Returns the pose whose quaternion is in four columns from `k` on; None if it is not one."""
    turn = list(names[k : k + 4])
    if not all(name.isdecimal() or {*split_words(name)} & TURNS for name in turn):
        return None
    parts = list(columns[k : k + 4])
    if len({len(part) for part in parts}) > 1 or not any(map(np.ptp, parts)):
        return None
    length = np.linalg.norm(parts, axis=0)
    if not np.nanmax(np.abs(length - 1.0)) < UNIT_LENGTH:
        return None
    if recordings.is_w_first(np.stack(parts, axis=1)):
        turn = [*turn[1:], turn[0]]
        parts = [*parts[1:], parts[0]]
    place = [
        name
        for axis in ("x", "y")
        for name in names
        if split_unit(name)[0] == [axis] and name not in turn
    ]
    if len(place) != 2:
        place = list(names[max(k - 3, 0) :][:2])
    if {*split_words(" ".join(place))} & NOT_PLACES or {*place} & {*turn}:
        return None
    heading = 2.0 * np.arctan2(parts[2], parts[3])
    x, y = place
    path = [columns[names.index(name)] for name in (x, y)]
    pose = _stack_finite([*path, heading])
    if pose is None:
        return None
    pose = pose[:: max(1, len(pose) // MOST_COMPARED)]
    if len(pose) < 3 or measure_alignment(pose, 1.0) < CONFIRMED:
        return None
    return PoseGuess(table, x, y, quaternion=tuple(turn))
