"""Conversion of messages to data and back, in pairs `x_to_ros`, `x_from_ros`; types by name."""

import array
import math
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs import msg as geometry
from nav_msgs.msg import OccupancyGrid, Odometry
from numpy.typing import ArrayLike, NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState, LaserScan
from std_msgs.msg import Header

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.sensor import Sensor
from nics_drl_bridge.lidar.spec import LidarSpec, to_device
from nics_drl_bridge.recording import messages
from nics_drl_bridge.robot.spec import RobotSpec

INITIAL_POSE = "initialpose"  # topic, as RViz sends it
# variance of z, roll and pitch, which a planar robot does not measure
UNUSED_VARIANCE = 1e6


def stamp_to_ros(time_ns: int) -> Time:
    """Return nanoseconds as a stamp."""
    return Time(sec=time_ns // NS_PER_S, nanosec=time_ns % NS_PER_S)


def stamp_from_ros(stamp: Time) -> int:
    """Return a stamp as nanoseconds."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def header_to_ros(time_ns: int, frame: str) -> Header:
    """Return the header of a message: its time [ns] and frame."""
    return Header(stamp=stamp_to_ros(time_ns), frame_id=frame)


def heading_to_ros(heading: float) -> geometry.Quaternion:
    """Return a heading [rad] as a quaternion."""
    return geometry.Quaternion(z=math.sin(heading / 2.0), w=math.cos(heading / 2.0))


def compute_heading(x: float, y: float, z: float, w: float) -> float:
    """Return the heading [rad] of a quaternion given by its components."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def twist_to_ros(twist: ArrayLike) -> geometry.Twist:
    """Return linear.x, linear.y, angular.z (3,) as a Twist."""
    message = geometry.Twist()
    message.linear.x, message.linear.y, message.angular.z = np.asarray(
        twist, np.float64
    ).tolist()
    return message


def stamped_to_ros(twist: ArrayLike, time_ns: int, frame: str) -> geometry.TwistStamped:
    """Return linear.x, linear.y, angular.z (3,) as a TwistStamped."""
    header = header_to_ros(time_ns, frame)
    return geometry.TwistStamped(header=header, twist=twist_to_ros(twist))


def twist_from_ros(message: geometry.Twist | geometry.TwistStamped) -> Array:
    """Return linear.x, linear.y, angular.z (3,) of a Twist, stamped or not."""
    return np.array(messages.read_command(message))


def scan_to_ros(
    spec: LidarSpec, ranges: NDArray[np.float32], now_ns: int, frame: str
) -> LaserScan:
    """Return ranges (B,) as the device's LaserScan; every header field follows from the spec."""
    message = LaserScan(header=header_to_ros(now_ns, frame))
    for field, value in spec.header._asdict().items():
        setattr(message, field, value)
    message.ranges = array.array("f", to_device(ranges, spec).tobytes())
    return message


def odometry_to_ros(
    pose: ArrayLike,
    twist: ArrayLike,
    time_ns: int,
    frames: Sequence[str],
    # variances of position, heading, linear and angular velocity [SI units]
    variance: tuple[float, float, float, float],
) -> Odometry:
    """Return a pose (3,) in a fixed frame and a body twist (3,) as an Odometry."""
    x, y, heading = np.asarray(pose, np.float64).tolist()
    header = header_to_ros(time_ns, frames[0])
    message = Odometry(header=header, child_frame_id=frames[1])
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation = heading_to_ros(heading)
    message.twist.twist = twist_to_ros(twist)
    for part, linear, angular in (
        (message.pose, *variance[:2]),
        (message.twist, *variance[2:]),
    ):
        part.covariance = covariance_to_ros(np.diag([linear, linear, angular]))
    return message


def odometry_from_ros(message: Odometry) -> tuple[Array, Array]:
    """Return pose (3,) and body twist (3,) of an Odometry message."""
    return np.array(messages.read_whole_pose(message)), np.array(
        messages.read_twist(message)
    )


def covariance_to_ros(planar: Array) -> Array:
    """Return a covariance (3, 3) of x, y, heading, or of their rates, as a message's (36,)."""
    whole = np.diag(np.full(6, UNUSED_VARIANCE))
    whole[messages.PLANAR] = planar
    return whole.ravel()


def read_initial_pose(
    message: geometry.PoseWithCovarianceStamped, map_frame: str
) -> Array:
    """Return the pose (3,) of `initialpose` in the map. Raises ConfigError if it can't be used."""
    frame = message.header.frame_id.strip("/")
    pose = np.array(messages.read_whole_pose(message))
    if frame not in ("", map_frame):
        fix = f"give it in {map_frame!r}, as RViz does if that is its fixed frame."
        raise ConfigError(f"a pose in the frame {frame!r} is refused; {fix}")
    if not np.isfinite(pose).all():
        fix = "give finite numbers and a quaternion of unit length."
        raise ConfigError(f"an invalid pose is refused; {fix}")
    return pose


def pose_to_ros(pose: ArrayLike, time_ns: int, frame: str) -> geometry.PoseStamped:
    """Return a pose (3,) in a frame as a PoseStamped."""
    x, y, heading = np.asarray(pose, np.float64).tolist()
    message = geometry.PoseStamped(header=header_to_ros(time_ns, frame))
    message.pose.position.x, message.pose.position.y = x, y
    message.pose.orientation = heading_to_ros(heading)
    return message


def map_to_ros(grid: GridMap, time_ns: int, frame: str) -> OccupancyGrid:
    """Return a map as an OccupancyGrid, measured and valid from a time [ns]."""
    header = header_to_ros(time_ns, frame)
    message = OccupancyGrid(header=header, data=array.array("b", grid.cells.tobytes()))
    x, y, heading = grid.origin
    info = message.info
    info.map_load_time = message.header.stamp
    info.resolution = grid.resolution
    info.height, info.width = grid.cells.shape
    info.origin.position.x, info.origin.position.y = x, y
    info.origin.orientation = heading_to_ros(heading)
    return message


def map_from_ros(message: OccupancyGrid) -> GridMap:
    """Return the map of an OccupancyGrid. Raises ConfigError if sizes do not fit."""
    info = message.info
    cells = np.array(message.data, np.int8)
    if (
        cells.size != info.height * info.width
        or not cells.size
        or not info.resolution > 0.0
    ):
        raise ConfigError(
            f"map: {cells.size} cells do not make {info.height} x {info.width} of "
            f"{info.resolution:g} m; check its publisher."
        )
    place = info.origin.position
    turn = info.origin.orientation
    origin = place.x, place.y, compute_heading(turn.x, turn.y, turn.z, turn.w)
    return GridMap(
        cells.reshape(info.height, info.width), float(info.resolution), origin
    )


class JointWriter:
    """Writes states (S,) of a robot as JointStates.

    A state is a position if it is an angle or a length, and its rate is unknown (NaN). Any other is
    a rate, and its integral is the position, which begins at zero.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self._names = [variable.name for variable in spec.state]
        units = [variable.unit for variable in spec.state]
        self._is_position = np.isin(units, messages.POSITION_UNITS)
        self._integral = np.zeros(len(units))
        self._last: tuple[int, Array] | None = None  # time [ns] and state

    def write(self, state: Array, time_ns: int) -> JointState:
        """Return a message with the state at a time [ns]."""
        if self._last is not None:
            last_ns, last = self._last
            elapsed_s = max(0, time_ns - last_ns) / NS_PER_S  # a clock may be set back
            self._integral += 0.5 * elapsed_s * (last + state)
        self._last = time_ns, state.copy()
        return JointState(
            header=header_to_ros(time_ns, ""),
            name=self._names,
            position=np.where(self._is_position, state, self._integral),
            velocity=np.where(self._is_position, np.nan, state),
        )


def find_message_type(kind: str) -> Any | None:
    """Return the class of a type like `nav_msgs/msg/Odometry`; None if it is not installed.

    The name may come from any program on the network, so only packages with messages are imported.
    """
    named = re.fullmatch(
        r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", kind, re.ASCII
    )
    if named is None:
        return None
    package, interface, name = named.groups()
    if package not in sys.modules:  # nothing is imported to find out what it has
        spec = find_spec(package)
        folders = (spec.submodule_search_locations if spec is not None else None) or ()
        files = (Path(folder, interface, "__init__.py") for folder in folders)
        if not any(map(Path.is_file, files)):
            return None
    try:
        return getattr(import_module(f"{package}.{interface}"), name, None)
    except ImportError:
        return None


def find_sensor_type(sensor: Sensor) -> Any:
    """Return the class of a further sensor's message. Raises ConfigError if it is missing."""
    kind = find_message_type(sensor.message)
    if kind is None:
        raise ConfigError(
            f"sensor {sensor.name!r}: the message {sensor.message} is not installed; install "
            "its package with your ROS 2 distribution."
        )
    return kind


def sensor_to_ros(
    sensor: Sensor, reading: NDArray[np.float32], time_ns: int, frame: str
) -> Any:
    """Return a reading (S,) of a further sensor as its message."""
    message = find_sensor_type(sensor)(header=header_to_ros(time_ns, frame))
    sensor.write(message, reading)
    return message


def sensor_from_ros(sensor: Sensor, content: bytes) -> NDArray[np.float32]:
    """Return the reading (S,) of a serialised message. Raises ValueError for another type."""
    kind = find_sensor_type(sensor)
    try:
        message = deserialize_message(content, kind)
    except Exception as error:  # noqa: BLE001  (rclpy raises no public class)
        raise ValueError(f"is not a {sensor.message} ({error})") from None
    return sensor.read(message)
