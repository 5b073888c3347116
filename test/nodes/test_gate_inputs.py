"""The gate reads from bytes what it would make of rclpy's messages, to the same bits."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import Quaternion, TwistStamped
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool

from nics_drl_bridge.gate import inputs
from nics_drl_bridge.gate.intake import estimate_malformed
from nics_drl_bridge.lidar.spec import from_device, load_lidar
from nics_drl_bridge.nodes import conversions, gate_inputs, wire

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


def test_a_scan_is_what_the_device_says_in_the_words_of_the_package():
    ranges = np.linspace(0.0, 4.0, LIDAR.beams, dtype=np.float32)
    ranges[:3] = np.nan, np.inf, -np.inf
    message = conversions.scan_to_ros(LIDAR, ranges, STAMP_NS, "laser")
    read = gate_inputs.read_scan(LIDAR, serialize_message(message))
    assert read.stamp_ns == STAMP_NS
    assert read.angles == pytest.approx(
        (message.angle_min, message.angle_increment), rel=1e-6
    )
    assert read.ranges.tobytes() == from_device(message.ranges, LIDAR).tobytes()
    read.ranges[0] = 1.0  # nobody else's bytes


def test_an_odometry_is_pose_and_twist():
    message = odometry()
    read = gate_inputs.read_odometry(serialize_message(message))
    pose, twist = conversions.odometry_from_ros(message)
    assert (read.stamp_ns, read.pose.tobytes(), read.twist.tobytes()) == (
        STAMP_NS,
        pose.tobytes(),
        twist.tobytes(),
    )


@pytest.mark.parametrize(
    "quaternion", [(0.0,) * 4, (0.0, 0.0, 0.0, 2.0), (np.nan, 0.0, 0.0, 1.0)]
)
def test_an_odometry_without_a_rotation_has_no_pose(quaternion):
    message = odometry()
    message.pose.pose.orientation = Quaternion(
        **dict(zip("xyzw", quaternion, strict=True))
    )
    assert np.isnan(gate_inputs.read_odometry(serialize_message(message)).pose).all()


def test_an_estimate_is_a_twist_and_how_uncertain_its_pose_is():
    message = odometry()
    read = gate_inputs.read_estimate(serialize_message(message))
    assert (
        read.pose.tolist()
        == gate_inputs.read_odometry(serialize_message(message)).pose.tolist()
    )
    assert np.diag(read.covariance).tolist() == [0.0, 7.0, 35.0]
    assert read.twist.tolist() == [0.3, -0.1, 0.2]


def test_a_command_and_a_word_of_the_e_stop():
    message = TwistStamped(twist=conversions.twist_to_ros([0.5, 0.0, np.nan]))
    message.header.stamp = conversions.stamp_to_ros(STAMP_NS)
    read = gate_inputs.read_command(serialize_message(message))
    assert read.stamp_ns == STAMP_NS
    assert np.array_equal(read.twist, [0.5, 0.0, np.nan], equal_nan=True)
    assert gate_inputs.read_e_stop(serialize_message(Bool(data=True))).pressed


@pytest.mark.parametrize(
    "read",
    [
        lambda content: gate_inputs.read_scan(LIDAR, content),
        gate_inputs.read_odometry,
        gate_inputs.read_estimate,
        gate_inputs.read_command,
        gate_inputs.read_e_stop,
    ],
)
def test_bytes_that_end_too_early_are_unreadable(read):
    for content in (
        b"",
        b"\x00\x01",
        b"\x00\x01\x00\x00",
        b"\x00\x07\x00\x00" + bytes(800),
    ):
        with pytest.raises(wire.UNREADABLE):
            read(content)


@pytest.mark.parametrize(
    ("place", "variance"), [(0, np.nan), (7, np.nan), (35, np.nan), (35, -1)]
)
def test_an_estimate_one_of_whose_variances_is_no_number_is_refused(place, variance):
    message = odometry()
    message.pose.covariance[place] = variance
    read = gate_inputs.read_estimate(serialize_message(message))
    assert estimate_malformed(None, read)


def scanned(stamp_ns):
    return inputs.Scan(stamp_ns, np.ones(LIDAR.beams, np.float32), (0.0, 0.1))


def test_another_controllers_command_counts_as_of_the_newest_scan():
    twist = conversions.twist_to_ros([0.5, 0.0, 0.2])
    stamped = TwistStamped(twist=twist)
    stamped.header.stamp = conversions.stamp_to_ros(STAMP_NS)
    for kind, message in (("Twist", twist), ("TwistStamped", stamped)):
        content = serialize_message(message)
        read = gate_inputs.read_foreign_command(
            kind, STAMP_NS - 1, scanned(STAMP_NS + 7), content
        )
        assert (read.stamp_ns, read.twist.tolist()) == (STAMP_NS + 7, [0.5, 0.0, 0.2])


def test_another_controllers_command_is_refused_if_it_is_old_or_before_any_scan():
    stamped = TwistStamped()
    stamped.header.stamp = conversions.stamp_to_ros(STAMP_NS)
    content = serialize_message(stamped)
    with pytest.raises(ValueError, match="its stamp is older than command_age"):
        gate_inputs.read_foreign_command(
            "TwistStamped", STAMP_NS + 1, scanned(STAMP_NS), content
        )
    with pytest.raises(ValueError, match="no scan has arrived yet"):
        gate_inputs.read_foreign_command("TwistStamped", 0, None, content)
    unstamped = serialize_message(TwistStamped())
    kept = gate_inputs.read_foreign_command(
        "TwistStamped", 1, scanned(STAMP_NS), unstamped
    )
    assert kept.stamp_ns == STAMP_NS
