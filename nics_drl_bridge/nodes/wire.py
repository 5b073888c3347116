"""Serialised scans, odometry and twists: "plain CDR" of OMG DDS-XTypes 7.4.3."""

import math
import struct
import sys

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike, NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.nodes.conversions import PLANAR, compute_heading

Bytes = bytes | bytearray
HEAD = 4  # bytes of the header, not counted for alignment; the second one gives the byte order
# offsets of stamp and frame of a message's header
STAMP = 4
FRAME = 12
# raised by all readers for bytes of another message type
UNREADABLE = (ValueError, struct.error)
PLAIN = (0, 1)  # big-endian and little-endian plain CDR
NATIVE = bytes((0, PLAIN[sys.byteorder == "little"], 0, 0))  # header of this machine
# Offsets among the numbers of an odometry, which are pose, covariance, twist, covariance.
POSE_COVARIANCE = 7
TWIST = 7 + 36
DOUBLES = 7 + 36 + 6 + 36
SCAN_FIELDS = 7  # floats of a scan between its header and its ranges


def _order(content: Bytes) -> str:
    if len(content) < HEAD or content[0] != 0 or content[1] not in PLAIN:
        raise ValueError(f"the header {bytes(content[:HEAD]).hex()} is not plain CDR")
    return "<" if content[1] else ">"


def _skip_text(content: Bytes, place: int, order: str) -> int:
    place = _align(place, 4)  # a text starts with its length, aligned
    (length,) = struct.unpack_from(f"{order}I", content, place)
    return place + 4 + int(length)


def _text(content: Bytes, place: int, order: str) -> str:
    begin = _align(place, 4) + 4
    end = _skip_text(content, place, order)
    if end > len(content):
        raise ValueError("a text in it is longer than the message")
    return bytes(content[begin:end]).rstrip(b"\0").decode("utf-8", "replace")


def _align(place: int, size: int) -> int:
    return place + (HEAD - place) % size


def _floats(content: Bytes, order: str) -> int:
    return _align(_skip_text(content, FRAME, order), 4)


def read_stamp(content: Bytes) -> int:
    """Return the stamp of a message that begins with a header [ns]."""
    seconds, nanoseconds = struct.unpack_from(f"{_order(content)}iI", content, STAMP)
    return int(seconds) * NS_PER_S + int(nanoseconds)


def numbers_of(content: Bytes) -> Array:
    """Return all numbers (85,) of a serialised Odometry, in order."""
    order = _order(content)
    names_end = _skip_text(content, _skip_text(content, FRAME, order), order)
    return np.frombuffer(content, f"{order}f8", DOUBLES, _align(names_end, 8))


def read_frames(content: Bytes) -> tuple[str, str]:
    """Return the frame of the header and the child frame of a serialised Odometry."""
    order = _order(content)
    return _text(content, FRAME, order), _text(
        content, _skip_text(content, FRAME, order), order
    )


def read_odometry(content: Bytes) -> tuple[Array, Array]:
    """Return pose (3,) and body twist (3,) of a serialised Odometry."""
    values = numbers_of(content)
    x, y, _, qx, qy, qz, qw = values[:7].tolist()
    vx = values[TWIST]
    vy = values[TWIST + 1]
    wz = values[TWIST + 5]
    return np.array([x, y, compute_heading(qx, qy, qz, qw)]), np.array([vx, vy, wz])


def read_ranges(content: Bytes) -> NDArray[np.float32]:
    """Return the device's ranges (B,) of a serialised LaserScan."""
    order = _order(content)
    place = _floats(content, order) + 4 * SCAN_FIELDS
    (beams,) = struct.unpack_from(f"{order}I", content, place)
    return np.frombuffer(content, f"{order}f4", beams, place + 4)


def read_angles(content: Bytes) -> tuple[float, float]:
    """Return angle_min, angle_increment [rad] of a serialised LaserScan."""
    order = _order(content)
    first, _, step = struct.unpack_from(f"{order}3f", content, _floats(content, order))
    return first, step


def read_twist(content: Bytes, place: int = HEAD) -> tuple[float, float, float]:
    """Return linear.x, linear.y, angular.z of a Twist serialised at an offset."""
    x, y, _, _, _, w = struct.unpack_from(f"{_order(content)}6d", content, place)
    return x, y, w


def read_stamped_twist(content: Bytes) -> tuple[float, float, float]:
    """Return linear.x, linear.y, angular.z of a serialised TwistStamped."""
    return read_twist(content, _align(_skip_text(content, FRAME, _order(content)), 8))


def read_bool(content: Bytes) -> bool:
    """Return the value of a serialised Bool."""
    _order(content)
    return bool(struct.unpack_from("B", content, HEAD)[0])


class OdometryWriter:
    """Serialises the odometry of one robot; all other fields are copied from a message."""

    def __init__(self, message: Odometry) -> None:
        self._content = bytearray(serialize_message(message))
        self._stamp = struct.Struct(f"{_order(self._content)}iI")
        # writable, because it is a view of a bytearray
        self._numbers = numbers_of(self._content)
        self._covariance = self._numbers[POSE_COVARIANCE:TWIST].reshape(6, 6)

    def write(
        self, stamp_ns: int, pose: Array, twist: Array, covariance: Array | None = None
    ) -> bytes:
        """Return a message with pose (3,), body twist (3,), and covariance (3, 3) of the pose."""
        numbers = self._numbers
        heading = float(pose[2])
        self._stamp.pack_into(self._content, STAMP, *divmod(stamp_ns, NS_PER_S))
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
        self._stamp = struct.Struct(f"{_order(self._content)}iI")
        # writable, because it is a view of a bytearray
        self._ranges = read_ranges(self._content)

    def write(self, stamp_ns: int, ranges: NDArray[np.float32]) -> bytes:
        """Return a message with ranges (B,), as the device reports them."""
        self._stamp.pack_into(self._content, STAMP, *divmod(stamp_ns, NS_PER_S))
        self._ranges[:] = ranges
        return bytes(self._content)


def write_stamped_twist(twist: ArrayLike, stamp_ns: int, frame: str) -> bytes:
    """Serialise linear.x, linear.y, angular.z (3,) as a TwistStamped in a robot's frame."""
    x, y, w = np.asarray(twist, np.float64).tolist()
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    text = frame.encode() + b"\0"
    header = NATIVE + struct.pack(
        f"=iII{len(text)}s", seconds, nanoseconds, len(text), text
    )
    padding = bytes(_align(len(header), 8) - len(header))
    return header + padding + struct.pack("=6d", x, y, 0.0, 0.0, 0.0, w)


def write_twist(twist: ArrayLike) -> bytes:
    """Serialise linear.x, linear.y, angular.z (3,) as a Twist."""
    x, y, w = np.asarray(twist, np.float64).tolist()
    return NATIVE + struct.pack("=6d", x, y, 0.0, 0.0, 0.0, w)
