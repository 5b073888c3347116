"""Serialised scans, odometry and twists: "plain CDR" of OMG DDS-XTypes 7.4.3."""

import math
import struct

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike, NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.nodes.conversions import compute_heading
from nics_drl_bridge.recording.messages import PLANAR

Bytes = bytes | bytearray
# The header of plain CDR in little-endian order, that of all platforms of ROS 2; its last two bytes
# are options. It is not counted for alignment.
HEADER = b"\x00\x01\x00\x00"
HEAD = len(HEADER)
# offsets of stamp and frame of a message's header
STAMP = 4
FRAME = 12
# raised by all readers for bytes of another message type
UNREADABLE = (ValueError, struct.error)
# Offsets among the numbers of an odometry, which are pose, covariance, twist, covariance.
POSE_COVARIANCE = 7
TWIST = 7 + 36
DOUBLES = 7 + 36 + 6 + 36
SCAN_FIELDS = 7  # floats of a scan between its header and its ranges
TIME = struct.Struct("<iI")
LENGTH = struct.Struct("<I")  # of a text or a sequence, before its content


def _check(content: Bytes) -> None:
    if content[:2] != HEADER[:2]:
        header = bytes(content[:HEAD]).hex()
        raise ValueError(f"the header {header} is not plain CDR in little-endian order")


def _skip_text(content: Bytes, place: int) -> int:
    place = _align(place, 4)
    (length,) = LENGTH.unpack_from(content, place)
    return place + LENGTH.size + int(length)


def _read_text(content: Bytes, place: int) -> str:
    begin = _align(place, 4) + LENGTH.size
    end = _skip_text(content, place)
    if end > len(content):
        raise ValueError("a text in it is longer than the message")
    return bytes(content[begin:end]).rstrip(b"\0").decode("utf-8", "replace")


def _align(place: int, size: int) -> int:
    return place + (HEAD - place) % size


def _find_floats(content: Bytes) -> int:
    _check(content)
    return _align(_skip_text(content, FRAME), 4)


def read_stamp(content: Bytes) -> int:
    """Return the stamp of a message that begins with a header [ns]."""
    _check(content)
    seconds, nanoseconds = TIME.unpack_from(content, STAMP)
    return int(seconds) * NS_PER_S + int(nanoseconds)


def read_numbers(content: Bytes) -> Array:
    """Return all numbers (85,) of a serialised Odometry, in order."""
    _check(content)
    names_end = _skip_text(content, _skip_text(content, FRAME))
    return np.frombuffer(content, "<f8", DOUBLES, _align(names_end, 8))


def read_frames(content: Bytes) -> tuple[str, str]:
    """Return the frame of the header and the child frame of a serialised Odometry."""
    _check(content)
    child = _read_text(content, _skip_text(content, FRAME))
    return _read_text(content, FRAME), child


def read_odometry(content: Bytes) -> tuple[Array, Array]:
    """Return pose (3,) and body twist (3,) of a serialised Odometry."""
    values = read_numbers(content)
    x, y, _, qx, qy, qz, qw = values[:7].tolist()
    vx = values[TWIST]
    vy = values[TWIST + 1]
    wz = values[TWIST + 5]
    return np.array([x, y, compute_heading(qx, qy, qz, qw)]), np.array([vx, vy, wz])


def read_ranges(content: Bytes) -> NDArray[np.float32]:
    """Return the device's ranges (B,) of a serialised LaserScan."""
    place = _find_floats(content) + 4 * SCAN_FIELDS
    (beams,) = LENGTH.unpack_from(content, place)
    return np.frombuffer(content, "<f4", beams, place + LENGTH.size)


def read_angles(content: Bytes) -> tuple[float, float]:
    """Return angle_min, angle_increment [rad] of a serialised LaserScan."""
    first, _, step = struct.unpack_from("<3f", content, _find_floats(content))
    return first, step


def read_twist(content: Bytes, place: int = HEAD) -> tuple[float, float, float]:
    """Return linear.x, linear.y, angular.z of a Twist serialised at an offset."""
    _check(content)
    x, y, _, _, _, w = struct.unpack_from("<6d", content, place)
    return x, y, w


def read_stamped_twist(content: Bytes) -> tuple[float, float, float]:
    """Return linear.x, linear.y, angular.z of a serialised TwistStamped."""
    return read_twist(content, _align(_skip_text(content, FRAME), 8))


def read_bool(content: Bytes) -> bool:
    """Return the value of a serialised Bool."""
    _check(content)
    return bool(struct.unpack_from("B", content, HEAD)[0])


class OdometryWriter:
    """Serialises the odometry of one robot; all other fields are copied from a message."""

    def __init__(self, message: Odometry) -> None:
        self._content = bytearray(serialize_message(message))
        # writable, because it is a view of a bytearray
        self._numbers = read_numbers(self._content)
        self._covariance = self._numbers[POSE_COVARIANCE:TWIST].reshape(6, 6)

    def write(
        self, stamp_ns: int, pose: Array, twist: Array, covariance: Array | None = None
    ) -> bytes:
        """Return a message with pose (3,), body twist (3,), and covariance (3, 3) of the pose."""
        numbers = self._numbers
        heading = float(pose[2])
        TIME.pack_into(self._content, STAMP, *divmod(stamp_ns, NS_PER_S))
        numbers[0], numbers[1] = pose[0], pose[1]
        numbers[5], numbers[6] = math.sin(heading / 2.0), math.cos(heading / 2.0)
        numbers[TWIST], numbers[TWIST + 1], numbers[TWIST + 5] = twist
        if covariance is not None:
            self._covariance[PLANAR] = covariance
        return bytes(self._content)


class ScanWriter:
    """Serialises the scans (B,) of one lidar; all other fields are copied from a message."""

    def __init__(self, message: LaserScan) -> None:
        self._content = bytearray(serialize_message(message))
        # writable, because it is a view of a bytearray
        self._ranges = read_ranges(self._content)

    def write(self, stamp_ns: int, ranges: NDArray[np.float32]) -> bytes:
        """Return a message with ranges (B,), as the device reports them."""
        TIME.pack_into(self._content, STAMP, *divmod(stamp_ns, NS_PER_S))
        self._ranges[:] = ranges
        return bytes(self._content)


def write_stamped_twist(twist: ArrayLike, stamp_ns: int, frame: str) -> bytes:
    """Serialise linear.x, linear.y, angular.z (3,) as a TwistStamped in a robot's frame."""
    text = frame.encode() + b"\0"
    stamp = TIME.pack(*divmod(stamp_ns, NS_PER_S))
    head = HEADER + stamp + LENGTH.pack(len(text)) + text
    padding = bytes(_align(len(head), 8) - len(head))
    return head + padding + _pack_twist(twist)


def write_twist(twist: ArrayLike) -> bytes:
    """Serialise linear.x, linear.y, angular.z (3,) as a Twist."""
    return HEADER + _pack_twist(twist)


def _pack_twist(twist: ArrayLike) -> bytes:
    x, y, w = np.asarray(twist, np.float64).tolist()
    return struct.pack("<6d", x, y, 0.0, 0.0, 0.0, w)
