"""Bytes are written and read exactly as rclpy does it."""

import struct

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.nodes import conversions, wire
from nics_drl_bridge.recording import messages

pytestmark = pytest.mark.ros

STAMP_NS = 1_763_000_000_123_456_789
POSE = np.array([1.25, -3.5, 2.0])
TWIST = np.array([0.5, -0.25, 0.125])
COVARIANCE = np.array([[4.0, 0.5, 0.25], [0.5, 3.0, 0.125], [0.25, 0.125, 2.0]])
TEXTS = ["", "a", "map", "odom", "car_1/odom", "a frame with a long name"]
"""Their lengths leave the numbers behind them at every possible offset."""


def odometry(frame, child):
    message = conversions.odometry_to_ros(
        [7.0, 8.0, 9.0], [1.0, 2.0, 3.0], 5, (frame, child), (0.1, 0.2, 0.3, 0.4)
    )
    message.pose.pose.position.z, message.twist.twist.angular.x = 0.75, -0.75
    return message


@pytest.mark.parametrize("child", TEXTS)
@pytest.mark.parametrize("frame", TEXTS)
def test_an_odometry_is_read_as_rclpy_reads_it(frame, child):
    message = odometry(frame, child)
    content = serialize_message(message)
    assert wire.read_stamp(content) == 5
    assert wire.read_frames(content) == (frame, child)
    for mine, theirs in zip(
        wire.read_odometry(content), conversions.odometry_from_ros(message), strict=True
    ):
        assert np.array_equal(mine, theirs)


@pytest.mark.parametrize("child", TEXTS)
@pytest.mark.parametrize("frame", TEXTS)
def test_an_odometry_is_written_so_that_rclpy_reads_it_and_nothing_else_has_changed(
    frame, child
):
    message = odometry(frame, child)
    writer = wire.OdometryWriter(message)
    kept = deserialize_message(writer.write(5, POSE, TWIST), Odometry)
    assert np.array_equal(kept.pose.covariance, message.pose.covariance)
    content = writer.write(STAMP_NS, POSE, TWIST, COVARIANCE)
    writer.write(STAMP_NS + 1, 2.0 * POSE, 2.0 * TWIST)  # changes nothing before it

    message.header.stamp = conversions.stamp_to_ros(STAMP_NS)
    message.pose.pose.position.x, message.pose.pose.position.y = POSE[:2].tolist()
    message.pose.pose.orientation = conversions.heading_to_ros(float(POSE[2]))
    message.pose.covariance.reshape(6, 6)[messages.PLANAR] = COVARIANCE
    velocity = message.twist.twist
    velocity.linear.x, velocity.linear.y, velocity.angular.z = TWIST.tolist()
    assert deserialize_message(content, Odometry) == message


def scan(frame, beams):
    message = LaserScan(angle_min=-1.5, angle_max=1.5, angle_increment=0.25)
    message.header.frame_id, message.scan_time = frame, 0.125
    message.ranges = [1.0] * beams
    message.intensities = [0.5] * 3
    return message


@pytest.mark.parametrize("frame", TEXTS)
@pytest.mark.parametrize("beams", [0, 1, 720])
def test_a_scan_is_written_and_read_as_by_rclpy(frame, beams):
    message = scan(frame, beams)
    ranges = np.linspace(-1.0, 6.0, beams, dtype=np.float32)
    ranges[:3] = np.array([np.inf, -np.inf, np.nan])[:beams]
    content = wire.ScanWriter(message).write(STAMP_NS, ranges)

    read = deserialize_message(content, LaserScan)
    assert (
        conversions.stamp_from_ros(read.header.stamp)
        == wire.read_stamp(content)
        == STAMP_NS
    )
    assert np.array_equal(np.array(read.ranges, np.float32), ranges, equal_nan=True)
    assert np.array_equal(wire.read_ranges(content), ranges, equal_nan=True)
    angles = (read.angle_min, read.angle_increment)
    assert wire.read_angles(content) == angles
    message.header.stamp, message.ranges = read.header.stamp, read.ranges
    assert repr(read) == repr(message)  # NaN is not equal to itself


def test_a_twist_is_written_so_that_rclpy_reads_it_and_read_as_rclpy_writes_it():
    content = wire.write_twist(TWIST)
    message = conversions.twist_to_ros(TWIST)
    assert deserialize_message(content, Twist) == message

    message.linear.z, message.angular.x, message.angular.y = 7.0, 8.0, 9.0
    assert wire.read_twist(serialize_message(message)) == tuple(TWIST)


@pytest.mark.parametrize("frame", TEXTS)
def test_a_stamped_twist_is_written_and_read_in_its_frame_as_by_rclpy(frame):
    content = wire.write_stamped_twist(TWIST, STAMP_NS, frame)
    message = conversions.stamped_to_ros(TWIST, STAMP_NS, frame)
    assert deserialize_message(content, TwistStamped) == message
    message.twist.angular.x, message.twist.linear.z = 8.0, 9.0
    for each in (content, serialize_message(message)):
        assert wire.read_stamped_twist(each) == tuple(TWIST)


def test_bytes_in_the_other_order_which_no_platform_of_ros_has_are_refused():
    with pytest.raises(ValueError, match="is not plain CDR in little-endian order"):
        wire.read_twist(bytes(4) + struct.pack(">6d", *range(6)))


MESSAGES = {
    wire.read_stamp: odometry("odom", "base_link"),
    wire.read_odometry: odometry("odom", "base_link"),
    wire.read_frames: odometry("odom", "base_link"),
    wire.read_twist: Twist(),
    wire.read_ranges: scan("laser", 8),
}


@pytest.mark.parametrize("read", MESSAGES)
def test_bytes_that_are_no_plain_message_are_refused_and_not_read_beyond(read):
    content = serialize_message(MESSAGES[read])
    read(content)
    with pytest.raises(ValueError, match="is not plain CDR"):
        read(b"\0\7" + content[2:])
    for length in (0, 3, 4, 9, 15, 17):
        if read is wire.read_stamp and length > 11:
            continue
        with pytest.raises((ValueError, struct.error)):
            read(content[:length])
    longer = bytearray(content)
    longer[12:16] = struct.pack("<I", 2**31)
    if read not in (wire.read_stamp, wire.read_twist):  # which hold no text
        with pytest.raises((ValueError, struct.error)):
            read(bytes(longer))
