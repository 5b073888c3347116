"""Guesses which columns of a recording are the pose of the robot, by names, units and types."""

import re
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.names import split_words, word_set
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
NEARLY_A_TURN = 5.5  # minimum change between two rows where an angle wraps [rad]
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
    """Finds x, y and heading or quaternion by their names."""
    poses: list[PoseGuess] = []
    for table in tables:
        # The names of several tables show what they hold.
        if len(tables) == 1 or OTHERS.isdisjoint(split_words(table.name)):
            poses.extend(_find_named_poses(table))
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
            if not orientation:
                heading = _find_heading_called_z(table, words, names)
                if heading is None:
                    continue
                orientation = {"heading": heading}
            yield PoseGuess(table, x, y, **orientation)


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
    """Returns the column z next to x and y if it wraps as only an angle does, not a height."""
    if place[-1] != "x" or "position" in place:
        return None
    z = names.get((*place[:-1], "z"))
    if z is None or not _is_in(z, ["rad"]):
        return None
    values = table.get_numbers(z)
    values = values[np.isfinite(values)]
    is_angle = np.all((values > -3.3) & (values < 6.4))
    if is_angle and (np.abs(np.diff(values)) > NEARLY_A_TURN).any():
        return z
    return None
