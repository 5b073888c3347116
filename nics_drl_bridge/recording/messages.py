"""Messages of a bag: their types, their rows of numbers, and the quality of service offered."""

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.robot.spec import RobotSpec

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos
    from rosbags.typesys.store import Typestore

Row = tuple[float, float, float]
# maximum difference of a quaternion's squared length from 1
LOOSE_QUATERNION_TOLERANCE = 0.1

ACKERMANN_DEFINITION = (
    "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
    "float32 acceleration\nfloat32 jerk\n"
)
ACKERMANN_STAMPED_DEFINITION = (
    "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
)
LIBRARIES = ("rosbags", "mcap")
POSITION_UNITS = ("rad", "m")  # units of states that a JointState reports as positions
HEADER = "std_msgs/msg/Header"
WHEELS = ("left_wheel", "right_wheel")


# x, y and heading in the 6 x 6 covariance of a message
PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


def check_libraries(path: Path, what: str, instead: str = "") -> None:
    """Raises RecordingError if a library for bags is missing; `what` is `reading` or `writing`."""
    for library in LIBRARIES:
        if find_spec(library) is None:
            raise RecordingError(
                f"{path}: {what} a bag needs the library {library}; install it with "
                f"pip install 'nics_drl_bridge[bags]'{instead}."
            )


def make_typestore() -> "Typestore":
    """Returns the message types of ROS 2, and of Ackermann drives."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(ACKERMANN_DEFINITION, topic_roles.ACKERMANN))
    store.register(
        get_types_from_msg(ACKERMANN_STAMPED_DEFINITION, topic_roles.ACKERMANN_STAMPED)
    )
    return store


def collect_types(
    connections: "Sequence[Connection]", header: bool = True
) -> "Typestore":
    """Returns the message types of `make_typestore`, replaced by those that a bag defines.

    With `header`, the bag's own type of headers is used, which decodes messages of ROS 1; without,
    the type of ROS 2, which converts them.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import (
        Stores,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    defined: dict[str, Any] = {}
    store = make_typestore()
    for connection in connections:
        form, text = connection.msgdef
        # A definition that can't be parsed leaves its type unknown.
        with suppress(Exception):
            if form == MessageDefinitionFormat.MSG:
                defined |= get_types_from_msg(text, connection.msgtype)
            elif form == MessageDefinitionFormat.IDL:
                for part in re.split(r"^=+\nIDL: .*\n", text, flags=re.MULTILINE):
                    if part.strip():
                        defined |= get_types_from_idl(part)
    if not header:
        defined.pop(HEADER, None)
    new = {
        name: fields
        for name, fields in defined.items()
        if store.fielddefs.get(name) != fields
    }
    # Known types may be those of another release, or of ROS 1.
    if new.keys() & store.fielddefs.keys():
        new = {**store.fielddefs, **new}
        store = get_typestore(Stores.EMPTY)
        for name in store.fielddefs:
            new.pop(name, None)
    store.register(new)
    return store


def get_frames(transform: Any) -> tuple[str, str]:
    """Returns parent and child of a transform, without the leading slash of old publishers."""
    return transform.header.frame_id.strip("/"), transform.child_frame_id.strip("/")


def get_stamp(message: Any) -> int:
    """Returns the stamp of a message's header [ns]."""
    time = message.header.stamp
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def read_command(message: Any) -> Row:
    """Returns linear.x, linear.y, angular.z; for an Ackermann drive speed, 0, steering angle."""
    drive = getattr(message, "drive", message)
    if hasattr(drive, "steering_angle"):
        return drive.speed, 0.0, drive.steering_angle
    twist = getattr(message, "twist", message)
    return twist.linear.x, twist.linear.y, twist.angular.z


def read_robot_command(message: Any, spec: RobotSpec) -> Array:
    """Returns the command (C,) of a message for a robot; see `read_command`."""
    row = np.array(read_command(message))
    if hasattr(getattr(message, "drive", message), "steering_angle"):
        return spec.from_fields(row)
    return spec.from_cmd_vel(row)


def _get_place(message: Any) -> tuple[Any, Any]:
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = getattr(message.pose, "pose", message.pose)
    return pose.position, pose.orientation


def read_quaternion(message: Any) -> tuple[float, float, float, float]:
    """Returns x, y, z, w of a message's orientation."""
    q = _get_place(message)[1]
    return q.x, q.y, q.z, q.w


def is_rotation(x: float, y: float, z: float, w: float) -> bool:
    """True if a quaternion has about unit length; a zero quaternion was never set."""
    return abs(w * w + x * x + y * y + z * z - 1.0) < LOOSE_QUATERNION_TOLERANCE


def read_whole_pose(message: Any) -> Row:
    """Returns the pose of a message; NaN if its orientation was never set."""
    return (
        read_pose(message)
        if is_rotation(*read_quaternion(message))
        else (math.nan,) * 3
    )


def read_pose(message: Any) -> Row:
    """Returns position x, y [m] and heading [rad]."""
    position, q = _get_place(message)
    heading = math.atan2(
        2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z)
    )
    return position.x, position.y, heading


def read_pose_covariance(message: Any) -> Array | None:
    """Returns the covariance (3, 3) of x, y, heading of a pose; None if its message has none."""
    covariance = getattr(message.pose, "covariance", None)
    return None if covariance is None else np.reshape(covariance, (6, 6))[PLANAR]


def read_twist(message: Any) -> Row:
    """Returns body velocity x, y [m/s] and yaw rate [rad/s] of an Odometry."""
    twist = message.twist.twist
    return twist.linear.x, twist.linear.y, twist.angular.z


def read_turn_variance(message: Any) -> float | None:
    """Returns the variance of an Odometry's yaw rate [rad^2/s^2]; None if it is not stated."""
    variance = float(message.twist.covariance[35])
    if not math.isfinite(variance) or variance <= 0.0:
        return None
    return variance


def read_imu(message: Any) -> Row:
    """Returns acceleration along x and y [m/s^2] and yaw rate [rad/s]."""
    acceleration = message.linear_acceleration
    return acceleration.x, acceleration.y, message.angular_velocity.z


@dataclass(frozen=True)
class Offer:
    """Quality of service that a publisher offers, as needed to match subscribers."""

    depth: int = 10  # depth of its history
    reliable: bool = True  # False for best effort
    # late subscribers get earlier messages; False for volatile
    transient_local: bool = False


def convert_offers(profiles: "Sequence[Qos]") -> tuple[Offer, ...]:
    """Converts rosbags profiles to offers."""
    from rosbags.interfaces import QosDurability, QosReliability

    return tuple(
        Offer(
            max(int(profile.depth), 1),
            profile.reliability is not QosReliability.BEST_EFFORT,
            profile.durability is QosDurability.TRANSIENT_LOCAL,
        )
        for profile in profiles
    )


def make_profile(offer: Offer) -> "Qos":
    """Converts an offer to a rosbags profile; the other policies keep their defaults."""
    from rosbags import interfaces as rosbags

    forever = rosbags.QosTime(9223372036, 854775807)
    reliability = rosbags.QosReliability
    durability = rosbags.QosDurability
    return rosbags.Qos(
        rosbags.QosHistory.KEEP_LAST,
        offer.depth,
        reliability.RELIABLE if offer.reliable else reliability.BEST_EFFORT,
        durability.TRANSIENT_LOCAL if offer.transient_local else durability.VOLATILE,
        forever,
        forever,
        rosbags.QosLiveliness.AUTOMATIC,
        forever,
        False,
    )
