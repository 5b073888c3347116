"""Guesses by name which column of a recording is the yaw rate of a gyro."""

from collections.abc import Iterator, Sequence

import numpy as np

from nics_drl_bridge.recording.imu_axis import AXES, UpAxis, find_up_axis
from nics_drl_bridge.recording.names import split_words, word_set
from nics_drl_bridge.recording.survey import Survey, TableSurvey, split_unit

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
NOT_MEASURED = word_set("cmd command commanded ref setpoint target desired covariance")
NOT_OF_GYRO = word_set("odom odometry vicon mocap gt truth")
USUAL_NAMES = ("/imu", "/imu/data")  # topics; the first one in the bag is chosen
FASTEST_RADPS = 20.0  # faster rates are in degrees per second


def guess_yaw_rate(tables: Sequence[TableSurvey]) -> tuple[TableSurvey, Survey] | None:
    """Finds the yaw rate of a gyro; None if no column is named like one."""
    rates = [*_find_in_messages(tables)] or [*_find_in_columns(tables)]
    for table, column in rates:
        if table.name in USUAL_NAMES:
            return table, column
    return next(iter(rates), None)


def write_imu_line(
    table: TableSurvey, column: Survey, alone: bool, common: str | None
) -> str:
    """Returns a mapping's line for a yaw rate; `common` are the stamps of the whole mapping."""
    keys = [f"from: {table.refer_to(column.name, alone)}"]
    if (
        column.name.startswith("angular_velocity.")
        and _find_message_axis(table).sign < 0.0
    ):
        keys.append("scale: -1")
    unit = split_unit(column.name)[1]
    if unit == "deg" or max(-column.low, column.high) > FASTEST_RADPS:
        keys.append("unit: deg/s")
    if table.time not in (common, None):
        keys.append(f"time: {table.time}")
    if len(keys) > 1:
        value = f"{{{', '.join(keys)}}}"
    else:
        value = keys[0].removeprefix("from: ")
    return f"imu: {{yaw_rate: {value}}}"


def _find_in_messages(
    tables: Sequence[TableSurvey],
) -> Iterator[tuple[TableSurvey, Survey]]:
    for table in tables:
        names = {column.name for column in table.columns}
        if {OF_MESSAGE, "linear_acceleration.x"} <= names:
            wanted = f"angular_velocity.{AXES[_find_message_axis(table).place]}"
            for column in table.numbers:
                if column.name == wanted and column.low < column.high:
                    yield table, column


def _find_message_axis(table: TableSurvey) -> UpAxis:
    """Returns the axis of an IMU's messages that points up; z without accelerations."""
    names = [f"linear_acceleration.{axis}" for axis in AXES]
    if not all(name in table.data for name in names):
        return UpAxis()
    columns = [table.data[name].astype(np.float64) for name in names]
    return find_up_axis(np.array([float(np.nanmedian(column)) for column in columns]))


def _find_in_columns(
    tables: Sequence[TableSurvey],
) -> Iterator[tuple[TableSurvey, Survey]]:
    for table in tables:
        for column in table.numbers:
            words = {*split_words(column.name)}
            around = words | {*split_words(table.name)}
            wanted = TURNING_OF_IMU if around & {"imu", "gyro"} else ()
            is_named = any(names <= words for names in wanted)
            is_other = bool(around & (NOT_MEASURED | NOT_OF_GYRO))
            if is_named and not is_other and column.low < column.high:
                yield table, column
