"""The gate reads from bytes what rclpy's messages hold, bit for bit."""

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool

from nics_drl_bridge.gate import inputs
from nics_drl_bridge.gate.intake import estimate_malformed
from nics_drl_bridge.lidar.spec import from_device, load_lidar
from nics_drl_bridge.nodes import conversions, gate_inputs, wire

pytestmark = pytest.mark.ros

STAMP_NS = 1_763_000_000_123_456_789
LIDAR = load_lidar("paper")


def odometry():
    message = conversions.odometry_to_ros(
        [0.1, -2.5, 0.7],
        [0.3, -0.1, 0.2],
        STAMP_NS,
        ("odom", "car/base_link"),
        (0.1,) * 4,
    )
    message.pose.covariance = np.arange(36.0)
    return message


def test_a_scan_has_the_ranges_of_the_device_in_the_words_of_the_package():
    ranges = np.linspace(0.0, 4.0, LIDAR.beams, dtype=np.float32)
    ranges[:3] = np.nan, np.inf, -np.inf
    message = conversions.scan_to_ros(LIDAR, ranges, STAMP_NS, "laser")
    read = gate_inputs.read_scan(LIDAR, serialize_message(message))
    assert read.stamp_ns == STAMP_NS
    assert read.angles == pytest.approx((message.angle_min, message.angle_increment))
    assert read.ranges.tobytes() == from_device(message.ranges, LIDAR).tobytes()
    read.ranges[0] = 1.0  # writable: nobody else's bytes


@pytest.mark.parametrize(
    "quaternion", [(0.0,) * 4, (0.0, 0.0, 0.0, 2.0), (np.nan, 0.0, 0.0, 1.0)]
)
def test_an_odometry_without_a_rotation_has_no_pose(quaternion):
    message = odometry()
    message.pose.pose.orientation = Quaternion(
        **dict(zip("xyzw", quaternion, strict=True))
    )
    assert np.isnan(gate_inputs.read_odometry(serialize_message(message)).pose).all()


def test_an_odometry_and_an_estimate_have_pose_and_twist_and_the_estimate_its_doubt():
    content = serialize_message(odometry())
    pose, twist = conversions.odometry_from_ros(odometry())
    read = gate_inputs.read_odometry(content)
    estimate = gate_inputs.read_estimate(content)
    assert read.stamp_ns == STAMP_NS
    for each in (read, estimate):
        assert each.pose.tolist() == pose.tolist()
        assert each.twist.tolist() == twist.tolist()
    assert np.diag(estimate.covariance).tolist() == [0.0, 7.0, 35.0]


def test_a_command_has_the_stamp_of_its_scan_and_a_press_is_read():
    message = conversions.stamped_to_ros([0.5, 0.0, np.nan], STAMP_NS, "")
    read = gate_inputs.read_command(serialize_message(message))
    assert read.stamp_ns == STAMP_NS
    assert np.array_equal(read.twist, [0.5, 0.0, np.nan], equal_nan=True)
    assert gate_inputs.read_e_stop(serialize_message(Bool(data=True))).pressed
    with pytest.raises(wire.UNREADABLE):
        gate_inputs.read_e_stop(b"\x00\x01\x00\x00")


@pytest.mark.parametrize(
    ("place", "variance"), [(0, np.nan), (7, np.nan), (35, np.nan), (35, -1)]
)
def test_an_estimate_one_of_whose_variances_is_no_number_is_refused(place, variance):
    message = odometry()
    message.pose.covariance[place] = variance
    read = gate_inputs.read_estimate(serialize_message(message))
    assert estimate_malformed(None, read)


def test_a_foreign_command_gets_the_stamp_of_the_newest_scan_unless_its_own_is_too_old():
    twist = [0.5, 0.0, 0.2]
    scan = inputs.Scan(STAMP_NS + 7, np.ones(LIDAR.beams, np.float32), (0.0, 0.1))
    stamped, unstamped = (
        serialize_message(conversions.stamped_to_ros(twist, stamp_ns, ""))
        for stamp_ns in (STAMP_NS, 0)
    )
    plain = serialize_message(conversions.twist_to_ros(twist))
    read = gate_inputs.read_foreign_command
    for kind, oldest_ns, content in (
        ("Twist", STAMP_NS, plain),
        ("TwistStamped", STAMP_NS, stamped),
        ("TwistStamped", STAMP_NS, unstamped),
    ):
        command = read(kind, oldest_ns, scan, content)
        assert (command.stamp_ns, command.twist.tolist()) == (STAMP_NS + 7, twist)
    with pytest.raises(ValueError, match="its stamp is older than command_age"):
        read("TwistStamped", STAMP_NS + 1, scan, stamped)
    with pytest.raises(ValueError, match="no scan has arrived yet"):
        read("TwistStamped", 0, None, stamped)
