import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Quaternion
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message

from nics_drl_bridge.lidar.spec import LidarSpec, from_device, load_lidar
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.recording import messages
from nics_drl_bridge.robot.spec import load_robot

pytestmark = pytest.mark.ros

FORWARD = LidarSpec(
    beams=181, angle_min=-1.5, angle_max=1.5, range_min=0.1, range_max=8.0, rate=20.0
)
VARIANCE = (0.01, 0.02, 0.03, 0.04)


def over_the_wire(message):
    """Return the message as another process gets it."""
    return deserialize_message(serialize_message(message), type(message))


def yaw(q):
    return conversions.compute_heading(q.x, q.y, q.z, q.w)


@given(st.integers(0, 2**61))
def test_stamps_come_back_to_the_nanosecond(time_ns):
    stamp = conversions.stamp_to_ros(time_ns)
    assert 0 <= stamp.nanosec < 1_000_000_000
    assert conversions.stamp_from_ros(stamp) == time_ns


@given(st.floats(-math.pi, math.pi))
def test_headings_come_back(heading):
    turned = yaw(conversions.heading_to_ros(heading))
    assert abs(math.remainder(turned - heading, 2.0 * math.pi)) < 1e-12


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
    back = conversions.twist_from_ros(over_the_wire(message))
    assert back.tolist() == [0.5, -0.25, 1.5]


def test_odometry_comes_back_with_its_frames_and_covariance():
    motion = ([1.0, -2.0, 3.0], [0.1, 0.2, 0.3])
    frames = ("odom", "base_link")
    message = over_the_wire(
        conversions.odometry_to_ros(*motion, 5_000_000_007, frames, VARIANCE)
    )
    pose, twist = conversions.odometry_from_ros(message)
    assert pose == pytest.approx([1.0, -2.0, 3.0])
    assert twist.tolist() == [0.1, 0.2, 0.3]
    assert conversions.stamp_from_ros(message.header.stamp) == 5_000_000_007
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    # x, y, z, roll, pitch, yaw: what a planar robot does not measure is as good as unknown.
    unknown = [conversions.UNUSED_VARIANCE] * 3
    pose, twist = (
        np.diag(part.covariance.reshape(6, 6)).tolist()
        for part in (message.pose, message.twist)
    )
    assert pose == [0.01, 0.01, *unknown, 0.02]
    assert twist == [0.03, 0.03, *unknown, 0.04]
    assert np.count_nonzero(message.pose.covariance) == 6


@pytest.mark.parametrize("spec", [load_lidar("paper"), FORWARD])
def test_every_header_field_of_a_scan_follows_from_the_lidar(spec):
    ranges = np.full(spec.beams, 1.5, np.float32)
    message = over_the_wire(conversions.scan_to_ros(spec, ranges, 42, "laser"))
    assert conversions.stamp_from_ros(message.header.stamp) == 42
    assert message.header.frame_id == "laser"
    angles = message.angle_min, message.angle_max, message.angle_increment
    wanted = spec.angles[0], spec.angles[-1], spec.angle_increment
    assert angles == pytest.approx(wanted)
    # What RViz and every costmap compute.
    beams = (angles[1] - angles[0]) / angles[2] + 1
    assert beams == pytest.approx(len(message.ranges), abs=1e-3)
    assert message.time_increment == 0.0  # all beams are measured at once
    assert message.scan_time == pytest.approx(1.0 / spec.rate)
    limits = message.range_min, message.range_max
    assert limits == pytest.approx((spec.range_min, spec.range_max))


@pytest.mark.parametrize(
    ("no_return", "wire"),
    [("inf", math.inf), ("zero", 0.0), ("range_max", 8.0), ("nan", math.nan)],
)
def test_no_return_travels_in_the_words_of_the_device_and_comes_back_as_inf(
    no_return, wire
):
    spec = FORWARD.model_copy(update={"no_return": no_return})
    ranges = np.full(2 * spec.beams, np.inf, np.float32)[::2]  # a slice
    ranges[0], ranges[1] = 1.5, -np.inf
    message = over_the_wire(conversions.scan_to_ros(spec, ranges, 0, "laser"))
    assert list(message.ranges[:2]) == [1.5, -math.inf]
    assert message.ranges[2] == pytest.approx(wire, nan_ok=True)
    back = from_device(message.ranges, spec)
    assert back.tobytes() == ranges.tobytes()
    back[0] = 9.0  # a copy
    assert message.ranges[0] == 1.5


def test_a_device_that_turns_while_it_measures_says_so_in_the_header():
    spec = FORWARD.model_validate(
        FORWARD.model_dump() | {"faults": {"skew": "counter_clockwise"}}
    )
    message = conversions.scan_to_ros(spec, np.ones(spec.beams, np.float32), 0, "laser")
    # 3 rad of a turn that takes 50 ms, in 180 steps.
    assert message.time_increment == pytest.approx(0.05 * 3.0 / (2.0 * math.pi) / 180)


def test_a_state_is_told_by_joints_of_its_names():
    car = load_robot("ackermann")
    writer = conversions.JointWriter(car)
    writer.write(np.array([0.5, 0.0]), 4_000_000_007)
    message = over_the_wire(writer.write(np.array([0.7, -0.3]), 5_000_000_007))
    assert conversions.stamp_from_ros(message.header.stamp) == 5_000_000_007
    assert message.name == ["speed", "steering"]
    assert list(message.velocity) == pytest.approx([0.7, np.nan], nan_ok=True)
    assert list(message.position) == pytest.approx([0.6, -0.3])
    # A clock that is set back turns no joint.
    message = writer.write(np.array([0.7, -0.3]), 1_000_000_000)
    assert list(message.position) == pytest.approx([0.6, -0.3])


def test_a_planar_covariance_survives_the_way_through_a_message():
    planar = np.array(
        [[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]]
    )
    message = PoseWithCovarianceStamped()
    message.pose.covariance = conversions.covariance_to_ros(planar)
    message.pose.pose = conversions.pose_to_ros([1.5, -2.0, -3.0], 0, "map").pose
    arrived = over_the_wire(message)
    assert messages.read_whole_pose(arrived) == pytest.approx([1.5, -2.0, -3.0])
    assert messages.read_pose_covariance(arrived) == pytest.approx(planar)
    assert messages.read_pose_covariance(PoseStamped()) is None
    whole = np.reshape(message.pose.covariance, (6, 6))
    assert (np.linalg.eigvalsh(whole) > 0.0).all()
    assert whole[2, 2] == whole[3, 3] == whole[4, 4] == conversions.UNUSED_VARIANCE


def test_an_orientation_that_was_never_filled_in_is_no_heading():
    odometry, pose = Odometry(), PoseStamped()
    odometry.pose.pose.orientation.w = pose.pose.orientation.w = 0.0
    assert np.isnan(conversions.odometry_from_ros(odometry)[0]).all()
    assert np.isnan(messages.read_whole_pose(pose)).all()
