"""Guesses by name the switches, the episodes and the gyro's yaw rate among a recording's columns.

A switch is a column of two values, one of which enables the commands.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.recording.imu_axis import AXES, UpAxis, find_table_axis
from nics_drl_bridge.recording.names import split_words, word_set
from nics_drl_bridge.recording.survey import Survey, TableSurvey, split_unit
from nics_drl_bridge.recording.table import Column, is_text

ENABLING = word_set("""
    safety enable enabled armed active activated auto autonomous autonomy
    deadman engaged engage
""")
DISABLING = word_set("estop emergency kill stop stopped disabled manual fault")
POWER = word_set("on power powered")
POWERED = word_set("motor motors drive drives")
ON_WORDS = word_set("auto autonomous autonomy enabled on armed active offboard run")
MODES = ENABLING | word_set("mode state status safety switch")
EPISODES = word_set("episode ep trial traj trajectory rollout run")
MIN_MEAN_EPISODE_ROWS = 20  # minimum number of rows of an episode, on average
OF_MESSAGE = "angular_velocity.z"  # a field of sensor_msgs/Imu
TURNING = (
    {"gyro", "z"},
    {"gz"},
    {"gyroz"},
    {"gyro", "yaw"},
    {"yaw", "rate"},
    {"yawrate"},
)
TURNING_OF_IMU = (*TURNING, {"w"}, {"wz"}, {"omega"}, {"angular", "z"}, {"z", "rate"})
NOT_OF_GYRO = word_set("""
    cmd command commanded ref setpoint target desired covariance
    odom odometry vicon mocap gt truth
""")
USUAL_NAMES = ("/imu", "/imu/data")  # topics; the first one in the bag is chosen
FASTEST_RADPS = 20.0  # faster rates are in degrees per second


@dataclass(frozen=True)
class Place:
    """A column of a table."""

    table: TableSurvey
    column: Survey

    @property
    def key(self) -> tuple[int, str]:
        """Identifies the column among those of all tables."""
        return id(self.table), self.column.name

    @property
    def values(self) -> Column:
        """The values (T,) of the column."""
        return self.table.data[self.column.name]

    def refer_to(self, is_single: bool) -> str:
        """Returns how a mapping refers to the column; in a single table, its name suffices."""
        return self.table.refer_to(self.column.name, is_single)


@dataclass(frozen=True)
class Switch(Place):
    """A column that must have a certain value for the commands to count."""

    on: str  # the value, as written in a mapping

    def refer_to(self, is_single: bool) -> str:
        """Returns how a mapping refers to the column as a key."""
        text = super().refer_to(is_single)
        if ":" in text and not text.startswith('"'):
            return f'"{text}"'
        return text


def guess_switches(tables: Sequence[TableSurvey]) -> tuple[Switch, ...]:
    """Finds switches by the names of columns and values; none if they are never on together."""
    switches = []
    for table in tables:
        is_on = np.ones(table.rows, dtype=np.bool_)
        for column in table.columns:
            values = table.data[column.name]
            on = _find_on_value({*table.list_words(column.name)}, values)
            if on is None:
                continue
            switches.append(Switch(table, column, on))
            if len(values) == table.rows:
                is_on &= _equals(values, on)
        if table.rows and not is_on.any():
            return ()
    return tuple(switches)


def _equals(values: Column, on: str) -> NDArray[np.bool_]:
    if is_text(values):
        return np.array([str(value) == on for value in values])
    return np.asarray(values.astype(np.float64) == float(on))


def _find_on_value(words: set[str], values: Column) -> str | None:
    """Returns the value at which the commands count, from the names of column and values."""
    if is_text(values):
        texts = {str(value) for value in np.unique(values)}
        on = [text for text in texts if text.lower() in ON_WORDS]
        if words & MODES and len(texts) == 2 and len(on) == 1:
            return on[0]
        return None
    if values.dtype.kind not in "fiub":
        return None
    numbers = np.unique(values.astype(np.float64))
    numbers = numbers[np.isfinite(numbers)]
    if len(numbers) != 2 or numbers[0] != 0.0:
        return None
    if words & DISABLING or {"e", "stop"} <= words:
        return "0"
    is_powered = words & POWER and words & POWERED and numbers[1] == 1.0
    if words & ENABLING or {"dead", "man"} <= words or is_powered:
        return np.format_float_positional(numbers[1], trim="-")
    return None


def guess_episode(tables: Sequence[TableSurvey]) -> Place | None:
    """Finds the only column that numbers episodes; None if there is none, or several."""
    places = []
    for table in tables:
        for column in table.columns:
            if _numbers_episodes(table, column):
                places.append(Place(table, column))
    if len(places) != 1:
        return None
    return places[0]


def _numbers_episodes(table: TableSurvey, column: Survey) -> bool:
    """True for a column named like an episode that keeps each of its values for many rows."""
    words = table.list_words(column.name)
    if EPISODES.isdisjoint(words) or column.name in table.stamp_columns:
        return False
    values = table.data[column.name]
    count = len(np.unique(values))
    changes = np.flatnonzero(values[1:] != values[:-1])
    if not 1 < count == len(changes) + 1 <= len(values) / MIN_MEAN_EPISODE_ROWS:
        return False
    # `run` with two values may be a switch, unless the stamps restart with it.
    if "run" not in words or count > 2:
        return True
    row = int(changes[0])
    t = table.t
    return t is not None and row + 1 < len(t) and bool(t[row + 1] < t[row])


def guess_yaw_rate(tables: Sequence[TableSurvey]) -> Place | None:
    """Finds the yaw rate of a gyro; None if no column is named like one."""
    rates = [*_find_in_messages(tables)] or [*_find_in_columns(tables)]
    usual = [rate for rate in rates if rate.table.name in USUAL_NAMES]
    return next(iter(usual or rates), None)


def write_imu_line(rate: Place, is_single: bool, common_time: str | None) -> str:
    """Returns a mapping's line for a yaw rate; `common_time` is that of the whole mapping."""
    table = rate.table
    column = rate.column
    reference = rate.refer_to(is_single)
    keys = []
    is_of_message = column.name.startswith("angular_velocity.")
    if is_of_message and _find_message_axis(table).sign < 0.0:
        keys.append("scale: -1")
    unit = split_unit(column.name)[1]
    if unit == "deg" or max(-column.low, column.high) > FASTEST_RADPS:
        keys.append("unit: deg/s")
    if table.time not in (common_time, None):
        keys.append(f"time: {table.time}")
    if keys:
        reference = f"{{from: {reference}, {', '.join(keys)}}}"
    return f"imu: {{yaw_rate: {reference}}}"


def _find_in_messages(tables: Sequence[TableSurvey]) -> Iterator[Place]:
    for table in tables:
        if {OF_MESSAGE, "linear_acceleration.x"} <= table.data.keys():
            wanted = f"angular_velocity.{AXES[_find_message_axis(table).place]}"
            for column in table.numbers:
                if column.name == wanted and column.low < column.high:
                    yield Place(table, column)


def _find_message_axis(table: TableSurvey) -> UpAxis:
    """Returns the axis of an IMU's messages that points up; z without accelerations."""
    names = [f"linear_acceleration.{axis}" for axis in AXES]
    if not all(name in table.data for name in names):
        return UpAxis()
    return find_table_axis(table.get_numbers)


def _find_in_columns(tables: Sequence[TableSurvey]) -> Iterator[Place]:
    for table in tables:
        for column in table.numbers:
            words = {*split_words(column.name)}
            around = words | {*split_words(table.name)}
            wanted = TURNING_OF_IMU if around & {"imu", "gyro"} else ()
            is_named = any(names <= words for names in wanted)
            if is_named and not around & NOT_OF_GYRO and column.low < column.high:
                yield Place(table, column)
