from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, LaserScan

from nics_drl_bridge.lidar.spec import LidarSpec, from_device, load_lidar
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.recording.imu_axis import GyroReader
from nics_drl_bridge.robot.spec import load_robot

pytestmark = pytest.mark.ros

FORWARD = LidarSpec(
    beams=181, angle_min=-1.5, angle_max=1.5, range_min=0.1, range_max=8.0, rate=20.0
)
VARIANCE = (0.01, 0.02, 0.03, 0.04)


def over_the_wire(message):
    """The message as another process gets it."""
    return deserialize_message(serialize_message(message), type(message))


@pytest.mark.parametrize(
    "time_ns", [0, 1, 999_999_999, 1_000_000_000, 1_795_234_830_123_456_789]
)
def test_stamps_come_back_to_the_nanosecond(time_ns):
    stamp = conversions.stamp_to_ros(time_ns)
    assert 0 <= stamp.nanosec < 1_000_000_000
    assert conversions.stamp_from_ros(stamp) == time_ns


def yaw(q):
    return conversions.heading_of(q.x, q.y, q.z, q.w)


@pytest.mark.parametrize("heading", [-math.pi, -2.0, -0.0, 1e-9, 0.5, 3.1415])
def test_headings_come_back(heading):
    turned = yaw(conversions.heading_to_ros(heading))
    assert math.remainder(turned - heading, 2.0 * math.pi) == pytest.approx(
        0.0, abs=1e-12
    )


def test_a_heading_is_the_yaw_of_a_tilted_quaternion_too():
    # Yaw 0.7 after pitch 0.3, as an IMU on a slope would say.
    cy = math.cos(0.35)
    sy = math.sin(0.35)
    cp = math.cos(0.15)
    sp = math.sin(0.15)
    tilted = Quaternion(x=-sy * sp, y=cy * sp, z=sy * cp, w=cy * cp)
    assert yaw(tilted) == pytest.approx(0.7)


def test_twists_come_back_and_leave_the_other_fields_zero():
    message = conversions.twist_to_ros([0.5, -0.25, 1.5])
    assert (message.linear.z, message.angular.x, message.angular.y) == (0.0, 0.0, 0.0)
    assert conversions.twist_from_ros(over_the_wire(message)).tolist() == [
        0.5,
        -0.25,
        1.5,
    ]


def test_odometry_comes_back_with_its_frames_and_covariance():
    message = over_the_wire(
        conversions.odometry_to_ros(
            [1.0, -2.0, 3.0],
            [0.1, 0.2, 0.3],
            5_000_000_007,
            ("odom", "base_link"),
            VARIANCE,
        )
    )
    pose, twist = conversions.odometry_from_ros(message)
    assert pose == pytest.approx([1.0, -2.0, 3.0])
    assert twist.tolist() == [0.1, 0.2, 0.3]
    assert conversions.stamp_from_ros(message.header.stamp) == 5_000_000_007
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    # x, y, z, roll, pitch, yaw: what a planar robot does not measure is as good as unknown.
    unknown = [conversions.UNUSED_VARIANCE] * 3
    assert np.diag(message.pose.covariance.reshape(6, 6)).tolist() == [
        0.01,
        0.01,
        *unknown,
        0.02,
    ]
    assert np.diag(message.twist.covariance.reshape(6, 6)).tolist() == [
        0.03,
        0.03,
        *unknown,
        0.04,
    ]
    assert np.count_nonzero(message.pose.covariance) == 6


@pytest.mark.parametrize(
    "spec", [load_lidar("paper"), FORWARD], ids=["full circle", "forward"]
)
def test_every_header_field_of_a_scan_follows_from_the_lidar(spec):
    ranges = np.full(spec.beams, 1.5, np.float32)
    message = over_the_wire(conversions.scan_to_ros(spec, ranges, 42, "laser"))
    assert conversions.stamp_from_ros(message.header.stamp) == 42
    assert message.header.frame_id == "laser"
    assert message.angle_min == pytest.approx(spec.angles[0])
    assert message.angle_max == pytest.approx(spec.angles[-1])
    assert message.angle_increment == pytest.approx(spec.angle_increment)
    # What RViz and every costmap compute.
    beams = (message.angle_max - message.angle_min) / message.angle_increment + 1
    assert beams == pytest.approx(len(message.ranges), abs=1e-3)
    assert message.time_increment == 0.0  # all beams are measured at once
    assert message.scan_time == pytest.approx(1.0 / spec.rate)
    assert (message.range_min, message.range_max) == pytest.approx(
        (spec.range_min, spec.range_max)
    )


def test_ranges_keep_their_infinities_nan_and_bits():
    spec = LidarSpec(
        beams=6, angle_min=-1.0, angle_max=1.0, range_min=0.1, range_max=8.0, rate=10.0
    )
    ranges = np.array([np.inf, -np.inf, np.nan, 0.1, np.pi, 7.999999], np.float32)
    message = over_the_wire(conversions.scan_to_ros(spec, ranges, 0, "l"))
    back = from_device(message.ranges, spec)
    assert back.dtype == np.float32
    assert back.tobytes() == ranges.tobytes()


def test_ranges_of_a_slice_are_those_of_the_slice():
    spec = LidarSpec(
        beams=3, angle_min=-1.0, angle_max=1.0, range_min=0.1, range_max=8.0, rate=10.0
    )
    ranges = np.arange(6, dtype=np.float32)[::2]
    message = conversions.scan_to_ros(spec, ranges, 0, "laser")
    assert list(message.ranges) == [0.0, 2.0, 4.0]


def test_ranges_taken_from_a_message_are_a_copy():
    message = LaserScan(ranges=[1.0, 2.0])
    ranges = from_device(message.ranges, FORWARD)
    ranges[0] = 9.0
    assert message.ranges[0] == 1.0


@pytest.mark.parametrize(
    ("no_return", "wire"),
    [("inf", math.inf), ("zero", 0.0), ("range_max", 8.0), ("nan", math.nan)],
)
def test_no_return_travels_in_the_words_of_the_device_and_comes_back_as_inf(
    no_return, wire
):
    spec = FORWARD.model_copy(update={"no_return": no_return})
    ranges = np.full(spec.beams, np.inf, np.float32)
    ranges[0], ranges[1] = 1.5, -np.inf
    message = over_the_wire(conversions.scan_to_ros(spec, ranges, 0, "laser"))
    assert list(message.ranges[:2]) == [1.5, -math.inf]
    assert message.ranges[2] == pytest.approx(wire, nan_ok=True)
    assert np.array_equal(from_device(message.ranges, spec), ranges)


def test_a_device_that_turns_while_it_measures_says_so_in_the_header():
    spec = FORWARD.model_validate(
        FORWARD.model_dump() | {"faults": {"skew": "counter_clockwise"}}
    )
    message = conversions.scan_to_ros(spec, np.ones(spec.beams, np.float32), 0, "laser")
    # 3 rad of a turn that takes 50 ms, in 180 steps.
    assert message.time_increment == pytest.approx(0.05 * 3.0 / (2.0 * math.pi) / 180)


def test_a_state_is_told_by_joints_of_its_names():
    car = load_robot("ackermann")
    message = over_the_wire(conversions.joints_to_ros(car, [0.7, -0.3], 5_000_000_007))
    assert conversions.stamp_from_ros(message.header.stamp) == 5_000_000_007
    assert message.name == ["speed", "steering"]
    assert list(message.velocity) == [0.7, 0.0]
    assert list(message.position) == [0.0, -0.3]


def test_a_measured_pose_comes_with_the_covariance_of_x_y_and_heading():
    message = PoseWithCovarianceStamped()
    message.pose.pose.position.x, message.pose.pose.position.y = 1.5, -2.0
    message.pose.pose.orientation = conversions.heading_to_ros(-3.0)
    message.pose.covariance = np.arange(36, dtype=np.float64)
    pose, covariance = conversions.pose_from_ros(over_the_wire(message))
    assert pose == pytest.approx([1.5, -2.0, -3.0])
    assert covariance.tolist() == [
        [0.0, 1.0, 5.0],
        [6.0, 7.0, 11.0],
        [30.0, 31.0, 35.0],
    ]


def test_a_pose_without_covariance_says_so():
    message = PoseStamped()
    message.pose.position.x, message.pose.position.y = 1.5, -2.0
    message.pose.orientation = conversions.heading_to_ros(0.5)
    pose, covariance = conversions.pose_from_ros(over_the_wire(message))
    assert pose == pytest.approx([1.5, -2.0, 0.5])
    assert covariance is None


def test_an_imu_gives_its_yaw_rate_and_variance_unless_it_has_none():
    message = Imu()
    message.angular_velocity.z = -0.75
    message.angular_velocity_covariance[8] = 0.25
    assert GyroReader().read(over_the_wire(message)) == (-0.75, 0.25)
    message.angular_velocity_covariance[0] = -1.0
    assert GyroReader().read(over_the_wire(message)) is None


def test_a_planar_covariance_survives_the_way_through_a_message():
    planar = np.array(
        [[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]]
    )
    message = PoseWithCovarianceStamped()
    message.pose.covariance = conversions.covariance_to_ros(planar)
    assert conversions.pose_from_ros(message)[1] == pytest.approx(planar)
    whole = np.reshape(message.pose.covariance, (6, 6))
    assert (np.linalg.eigvalsh(whole) > 0.0).all()
    assert whole[2, 2] == whole[3, 3] == whole[4, 4] == conversions.UNUSED_VARIANCE


@pytest.mark.parametrize("kind", [Odometry, PoseStamped])
def test_an_orientation_that_was_never_filled_in_is_no_heading(kind):
    message = kind()
    inner = message.pose if kind is PoseStamped else message.pose.pose
    inner.orientation.w = 0.0
    read = (
        conversions.pose_from_ros
        if kind is PoseStamped
        else conversions.odometry_from_ros
    )
    assert np.isnan(read(message)[0]).all()
