"""Guesses which columns of a recording are the pose of the robot, by names, units and types."""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.names import split_words, word_set
from nics_drl_bridge.recording.recording import measure_alignment
from nics_drl_bridge.recording.survey import TableSurvey, split_unit

# Words of the first coordinate, and of the second beside it.
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
# Words of columns that are places of something else, and of motions, sensors and deviations.
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
# The source of a pose by its name: a tracker before a localiser before odometry.
TRACKERS = word_set("vicon mocap vrpn optitrack qualisys gt truth groundtruth tracker")
LOCALISERS = word_set("pose amcl pf slam cartographer rtabmap filtered fused ekf")
SENSORS = word_set("odom odometry imu gyro measured encoder wheel feedback model")
SOURCES = TRACKERS | LOCALISERS | SENSORS | {"ground"}
# Types of messages that hold positions of something else, or of a goal.
OTHER_PLACES = re.compile(
    r"^(visualization|actionlib|action|move_base|map)_msgs/"
    r"|/(Path|OccupancyGrid|MapMetaData|PoseArray|GridCells|Imu|Joy|LaserScan|MagneticField)$"
)
UNIT_LENGTH = 0.01  # by which a quaternion may differ from length 1
ALONG = 0.9  # share to which columns without names lead along their heading
CONFIRMED = 0.7  # share to which a place leads along the quaternion that follows it
NEARLY_A_TURN = 5.5  # [rad] from one row to the next
PIECES = 30  # of the extent of a path, in which it is compared with a heading
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
    """Finds x, y and heading, or a quaternion: by their names, else where the motion shows them."""
    beside = len(tables) > 1  # then the names of tables tell what they hold
    mine = [
        table
        for table in tables
        if not (beside and {*split_words(table.name)} & OTHERS)
    ]
    found = [guess for table in mine for guess in _find_named_poses(table)]
    if not found:
        found = [guess for table in mine for guess in _find_unnamed_poses(table)]
    return max(found, key=_rank_pose, default=None)


def _rank_pose(pose: PoseGuess) -> float:
    """Returns how far a pose is to be preferred to others, by what its names say."""
    words = {*split_words(pose.x)}
    if (
        pose.table.kind or not words & SOURCES
    ):  # else the column itself says more than its file
        words |= {*split_words(pose.table.name)}
    trust = 0.0
    if words & TRACKERS or {"ground", "truth"} <= words:
        trust += 3.0
    elif words & LOCALISERS:
        trust += 2.0
    if words & SENSORS:
        trust -= 2.0
    if pose.table.kind.endswith("/TFMessage"):
        trust -= 1.0
    return trust + 0.5 * bool(pose.quaternion)


def _find_named_poses(table: TableSurvey) -> Iterator[PoseGuess]:
    """Yields the poses whose x, y and heading say so by their names."""
    if OTHER_PLACES.search(table.kind):
        return
    named: dict[tuple[str, ...], str] = {}
    for column in table.numbers:
        if not ELEMENT.search(column.name):
            named.setdefault(tuple(split_unit(column.name)[0]), column.name)
    moving = {column.name for column in table.numbers if column.low < column.high}
    for words, x in named.items():
        for first, second in ALL_AXES.items():
            y = named.get(tuple(second if word == first else word for word in words))
            if first not in words or y is None or not {x, y} & moving:
                continue
            if {*words} & (NOT_PLACES | TURNS) or not _is_in(
                x, first in GLOBE, "m", "rad"
            ):
                continue
            turned = _find_heading(table, words, named)
            if turned is not None:
                heading, quaternion = turned
                yield PoseGuess(table, x, y, heading, quaternion)


def _is_in(name: str, also_angle: bool, *kinds: str) -> bool:
    """True if a name has no unit, or one of these kinds; of angles only where they may be."""
    unit = split_unit(name)[1]
    if unit is None:
        return True
    si = UNITS[unit].si
    return si in kinds and (also_angle or si != "rad")


def _find_heading(
    table: TableSurvey, place: tuple[str, ...], named: dict[tuple[str, ...], str]
) -> tuple[str | None, tuple[str, ...]] | None:
    """Returns the heading, or the quaternion, that shares most words with a place."""
    best: tuple[float, str | None, tuple[str, ...]] | None = None
    for words, name in named.items():
        if not words or {*words} & SENSORS - {*place}:
            continue  # of another source than the place
        shared = float(len({*words} & {*place}))
        if words[-1] in ("w", "qw"):
            each = [(*words[:-1], words[-1][:-1] + axis) for axis in "xyzw"]
            if all(one in named for one in each) and each[0] != place:
                quaternion = tuple(named[one] for one in each)
                if best is None or 100.0 + shared > best[0]:
                    best = 100.0 + shared, None, quaternion
        elif (
            words[-1] in HEADINGS
            and not {*words} & NOT_PLACES
            and _is_in(name, True, "rad")
        ):
            rank = shared - 0.1 * HEADINGS.index(words[-1])
            if best is None or rank > best[0]:
                best = rank, name, ()
    if best is not None:
        return best[1], best[2]
    if place[-1] == "x" and "position" not in place:
        z = named.get((*place[:-1], "z"))
    else:
        z = None
    low, high = next(
        ((c.low, c.high) for c in table.columns if c.name == z), (0.0, 0.0)
    )
    if (
        z is not None
        and _is_in(z, True, "rad")
        and -3.3 < low < high < 6.4
        and high - low > 0.5
        and _is_heading(table, place, z)
    ):
        return z, ()
    return None


def _is_heading(table: TableSurvey, place: tuple[str, ...], z: str) -> bool:
    """True if a path leads along what is called z, as it is then a heading and no height."""
    y = (*place[:-1], "y")
    named = {tuple(split_unit(column.name)[0]): column.name for column in table.numbers}
    columns = [
        table.data[name].astype(np.float64) for name in (named[place], named[y], z)
    ]
    if len({len(each) for each in columns}) > 1:
        return False
    pose = np.stack(columns, axis=1)
    pose = pose[np.isfinite(pose).all(axis=1)]
    if (np.abs(np.diff(pose[:, 2])) > NEARLY_A_TURN).any():
        return True  # it wraps, as only an angle does
    pose = select_apart(pose)
    return (
        len(pose) > 2
        and max(measure_alignment(pose, 1.0), measure_alignment(pose, -1.0)) > CONFIRMED
    )


def select_apart(pose: Array) -> Array:
    """Returns the poses (of T, 3) that are a thirtieth of the path's extent from the one before."""
    apart = np.ptp(pose[:, :2], axis=0).max() / PIECES
    kept = [0]
    for k in range(1, len(pose)):
        if np.hypot(*(pose[k, :2] - pose[kept[-1], :2])) > apart:
            kept.append(k)
    return np.asarray(pose[kept])


def _find_unnamed_poses(table: TableSurvey) -> Iterator[PoseGuess]:
    """Yields a quaternion after a place, or x, y, heading, side by side, that the motion shows."""
    if table.kind:
        return  # the fields of messages have names
    names = [c.name for c in table.numbers if c.name not in table.stamp_columns]
    columns = [table.data[name].astype(np.float64) for name in names]
    for k in range(2, len(names) - 3):
        guess = _match_quaternion(table, names, columns, k)
        if guess is not None:
            yield guess
    for k in range(len(names) - 2):
        if not all(name.isdecimal() for name in names[k : k + 3]):
            continue
        if len({len(each) for each in columns[k : k + 3]}) > 1:
            continue
        pose = np.stack(columns[k : k + 3], axis=1)
        pose = pose[np.isfinite(pose).all(axis=1)][:: max(1, len(pose) // 200)]
        if not len(pose) or not (np.ptp(pose, axis=0) > 0.0).all():
            continue
        led = max(measure_alignment(pose, 1.0), measure_alignment(pose, np.pi / 180.0))
        if led > ALONG > measure_alignment(pose, 0.0):
            x, y, heading = names[k : k + 3]
            yield PoseGuess(table, x, y, heading)


def _match_quaternion(
    table: TableSurvey, names: Sequence[str], columns: Sequence[Array], k: int
) -> PoseGuess | None:
    """Returns the pose whose quaternion stands in four columns from k on, if they are one."""
    turn = list(names[k : k + 4])
    four = columns[k : k + 4]
    if not all(name.isdecimal() or {*split_words(name)} & TURNS for name in turn):
        return None
    if len({len(each) for each in four}) > 1:
        return None  # of several streams
    turns = any(np.ptp(each) > 0.0 for each in four)
    if (
        not turns
        or not np.nanmax(np.abs(np.linalg.norm(four, axis=0) - 1.0)) < UNIT_LENGTH
    ):
        return None
    if recordings.is_w_first(np.stack(four, axis=1)):
        turn = [*turn[1:], turn[0]]
        four = [*four[1:], four[0]]
    place = [
        name for word in ("x", "y") for name in names if split_unit(name)[0] == [word]
    ]
    place = [name for name in place if name not in turn]
    x, y = place if len(place) == 2 else names[max(k - 3, 0) :][:2]
    if {*split_words(f"{x} {y}")} & NOT_PLACES or {x, y} & {*turn}:
        return None
    where = [columns[names.index(name)] for name in (x, y)]
    if any(len(each) != len(four[0]) for each in where):
        return None
    heading = 2.0 * np.arctan2(four[2], four[3])
    pose = np.stack([*where, heading], axis=1)
    pose = pose[np.isfinite(pose).all(axis=1)][:: max(1, len(pose) // 200)]
    if len(pose) < 3 or measure_alignment(pose, 1.0) < CONFIRMED:
        return None
    return PoseGuess(table, x, y, None, tuple(turn))
