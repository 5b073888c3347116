import math

import numpy as np
import pytest

from nics_drl_bridge.interface import NS_PER_S

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import PoseStamped
from nodes.peer import odometry
from sensor_msgs.msg import Imu

from nics_drl_bridge.errors import BackendError, RecordingError
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.recording.drive_log import DriveLog
from nics_drl_bridge.recording.messages import get_stamp, read_imu, read_pose
from nics_drl_bridge.recording.recording import check
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.robot.spec import load_robot

pytestmark = pytest.mark.ros

CAR = load_robot("ackermann")
WHEELED = load_robot("differential")
START_NS = 1_795_000_000 * NS_PER_S
PERIOD_NS = NS_PER_S // 10


class Drive:
    """A log and the time on which it is written."""

    def __init__(self, spec=CAR):
        self.now_ns = START_NS
        self.spec, self.log = spec, DriveLog(spec, TopicRoles(), lambda: self.now_ns)

    def hears(self, k, stamp_ns=None, x=None, twist=(0.0, 0.0, 0.0)):
        """Odometry number k, on its way for 20 ms."""
        stamp = START_NS + k * PERIOD_NS if stamp_ns is None else stamp_ns
        pose = [0.1 * k if x is None else x, 0.0, 0.0]
        self.now_ns = START_NS + k * PERIOD_NS + PERIOD_NS // 5
        return self.log.take_odometry(odometry(stamp, pose, twist))

    def sends(self, k):
        """Command number k."""
        self.now_ns = START_NS + k * PERIOD_NS
        self.log.add("cmd_vel", 0, [0.01 * k, 0.0])

    def goes(self, first, last):
        for k in range(first, last):
            self.sends(k)
            self.hears(k)
        return self


def test_commands_are_on_the_clock_of_the_stamps_of_odometry():
    recording = check(Drive().goes(0, 30).log.make_recording(), CAR)
    assert recording.command.clock == recording.pose.clock
    # By stamp, not by receipt 20 ms later.
    assert recording.pose.t == pytest.approx(recording.command.t)
    assert recording.command.values[:, 0] == pytest.approx(0.01 * np.arange(30))
    assert recording.variables == CAR.variable_names
    assert recording.odometry is None  # which is the pose, and not compared with itself


def test_odometry_that_is_old_repeated_or_no_number_is_no_news():
    drive = Drive().goes(0, 10)
    assert drive.hears(10, stamp_ns=START_NS + 9 * PERIOD_NS) is None
    assert drive.hears(11, stamp_ns=START_NS + 5 * PERIOD_NS) is None
    assert drive.hears(12, x=math.nan) is None
    assert drive.hears(13)[0] == pytest.approx(1.3)
    assert len(drive.log.make_recording().pose.t) == 11


def test_without_stamps_the_time_of_receipt_counts():
    drive = Drive()
    for k in range(20):
        drive.sends(k)
        assert drive.hears(k, stamp_ns=0) is not None
    drive.log.check()
    recording = drive.log.make_recording()
    assert np.diff(recording.pose.t) == pytest.approx(np.full(19, 0.1))
    assert recording.pose.t[0] - recording.command.t[0] == pytest.approx(0.02)


def test_pose_of_motion_capture_imu_and_then_the_twist_of_the_odometry_are_taken():
    drive = Drive()
    for k in range(20):
        drive.sends(k)
        drive.hears(k, twist=(0.1 * k, 0.0, math.nan if k == 5 else -0.2))
        pose = PoseStamped()
        imu = Imu()
        for message in (pose, imu):
            message.header.stamp = conversions.stamp_to_ros(START_NS + k * PERIOD_NS)
        pose.pose.position.y = 0.2 * k
        pose.pose.orientation = conversions.heading_to_ros(0.5)
        imu.linear_acceleration.x, imu.angular_velocity.z = 0.3, -0.7
        drive.log.add("pose", get_stamp(pose), read_pose(pose))
        drive.log.add("imu", get_stamp(imu), read_imu(imu))
    recording = check(drive.log.make_recording(), CAR)
    assert recording.pose.values[-1] == pytest.approx([0.0, 3.8, 0.5])
    assert recording.imu.values[-1] == pytest.approx([0.3, 0.0, -0.7])
    assert recording.odometry.values[-1] == pytest.approx([1.9, 0.0, -0.2])
    assert len(recording.odometry.t) == 19
    assert recording.odometry.clock == recording.command.clock
    assert recording.measured_by == "tracker"


def test_measured_wheels_are_the_state():
    drive = Drive(WHEELED).goes(0, 5)
    joints = conversions.JointWriter(WHEELED)
    with pytest.raises(
        BackendError, match="'joint_states': nothing has arrived, but left_wheel"
    ):
        drive.log.check()
    for k in range(5, 30):
        drive.goes(k, k + 1)
        stamp = START_NS + k * PERIOD_NS
        drive.log.take_joints(joints.write(np.array([0.5 * k, -0.5 * k]), stamp))
    drive.log.check()
    assert drive.log.make_recording().state.values[-1] == pytest.approx([14.5, -14.5])


def test_stamps_at_another_pace_than_the_receipt_are_a_simulators():
    drive = Drive()
    for k in range(10):
        drive.hears(k, stamp_ns=START_NS + 5 * k * PERIOD_NS)
    with pytest.raises(
        BackendError, match=r"stamps advanced by 4.50 s within 0.90 s.*use_sim_time"
    ):
        drive.log.check()


def test_stamps_of_several_clocks_do_not_lose_a_drive_that_is_over():
    drive = Drive().goes(0, 20)
    for k in range(20, 40):
        drive.sends(k)
        drive.hears(k, stamp_ns=START_NS + (k + 600) * PERIOD_NS)
    assert len(drive.log.make_recording().pose.t) == 40


def test_nothing_received_is_no_recording():
    with pytest.raises(RecordingError, match="nothing was received"):
        Drive().log.make_recording()
