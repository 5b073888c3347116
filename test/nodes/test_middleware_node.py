import math
from dataclasses import replace

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import Imu

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode
from nics_drl_bridge.nodes.runner import OK, STALE
from nics_drl_bridge.robot.kinds import textbook
from nodes.peer import odometry, pose_of, scan, stamp_ns

pytestmark = pytest.mark.ros


def test_the_estimate_follows_the_robot_and_names_its_frames_and_its_doubt(
    direct, model
):
    given = ("map_frame:=site", "base_frame:=car", "model:=ackermann")
    robot = direct(*given, kind=MiddlewareNode)
    motion = textbook(model.robot)
    pose = np.zeros(3)
    state = np.zeros(2)
    for k in range(1, 31):
        twist = [0.6, 0.0, 0.3 * math.sin(0.3 * k)]
        robot.give("cmd_vel", conversions.twist_to_ros(twist))
        state = motion.target(model.robot.from_cmd_vel(twist))
        moving = motion.twist(state)
        pose = geometry.compose(pose, geometry.exp(0.1 * moving))
        robot.give("odom", odometry(k * 10**8, pose, moving))
    estimates = robot.sent["odometry/filtered"]
    estimate = estimates[-1]
    assert stamp_ns(estimate) == 3 * NS_PER_S
    believed, twist = conversions.odometry_from_ros(estimate)
    assert math.dist(believed[:2], pose[:2]) < 0.15  # over a drive of 1.7 m
    assert twist == pytest.approx(moving, abs=0.1)
    assert (estimate.header.frame_id, estimate.child_frame_id) == ("site", "car")
    doubts = [np.reshape(m.pose.covariance, (6, 6)) for m in (estimates[0], estimate)]
    assert doubts[1][0, 0] > doubts[0][0, 0] > 0.0
    twist = np.diag(np.reshape(estimate.twist.covariance, (6, 6)))[[0, 5]]
    assert (twist > 0.0).all()
    assert (twist <= 1e-4 + 1.1e-6).all()  # no twist is trusted to less than 1e-3


def at(tenths, message):
    """Stamp a message [0.1 s]."""
    message.header.stamp = conversions.stamp_to_ros(tenths * NS_PER_S // 10)
    return message


def stand(x, tenths):
    return odometry(tenths * NS_PER_S // 10, [x, 0.0, 0.0])


def test_what_it_can_not_use_is_counted_in_the_diagnostics(direct, model):
    robot = direct("model:=ackermann", kind=MiddlewareNode)
    estimates = robot.sent["odometry/filtered"]
    first = robot.diagnose()
    assert (first.level, first.message) == (STALE, "nothing usable on scan, odom")
    assert first.hardware == "ackermann"
    robot.give("odom", stand(math.nan, 10))  # must not become the origin of the map
    robot.give("odom", stand(1.0, 20))
    assert pose_of(estimates[-1]) == pytest.approx([1.0, 0.0, 0.0])
    for tenths, beams in ((30, 720), (30, 720), (40, 7)):
        robot.give("scan", at(tenths, scan(model.lidar, 0, beams=beams)))
    for x, tenths in (
        (math.nan, 30),
        (1.0, 28),
        (1.0, 28),
        (1.0, 25),
        (1.0, 36),
        (1.0, 23),
    ):
        robot.give("odom", stand(x, tenths))
    wanted = {
        "rejected, odom: NaN or inf": "1",
        "rejected, odom: duplicate": "1",
        "rejected, odom: older than 1 s": "1",
        "rejected, scan: duplicate": "1",
        "rejected, scan: shape (7,), not (720,)": "1",
        "late and put in place": "1",
        "scan received": "1",
        "odom received": "4",
    }
    found = robot.diagnose()
    assert wanted.items() <= found.facts.items()
    assert (found.level, found.message) == (OK, "receiving")
    # After a reset an older odometry counts, as after a restart of the robot.
    assert robot.call("~/reset").success
    robot.give("odom", stand(5.0, 10))
    assert stamp_ns(estimates[-1]) == NS_PER_S
    assert pose_of(estimates[-1]) == pytest.approx([5.0, 0.0, 0.0])


def test_pose_and_gyro_correct_the_estimate_and_are_in_the_diagnostics(direct):
    given = ("pose_type:=PoseWithCovarianceStamped", "imu:=imu", "model:=ackermann")
    robot = direct(*given, kind=MiddlewareNode)
    estimates = robot.sent["odometry/filtered"]
    robot.give("odom", stand(1.0, 10))
    assert robot.diagnose().message == "nothing usable on scan, pose, imu"
    assert estimates[-1].pose.covariance[0] == pytest.approx(1e4)  # anywhere in the map
    pose = PoseWithCovarianceStamped()
    pose.pose.pose = conversions.pose_to_ros([30.0, -20.0, 2.0], 0, "").pose
    pose.pose.covariance = conversions.covariance_to_ros(0.05**2 * np.eye(3))
    robot.give("pose", at(11, pose))
    gyro = Imu()
    gyro.angular_velocity_covariance[8] = 1e-4
    robot.give("imu", at(11, gyro))
    assert {"pose received", "imu received"} <= robot.diagnose().facts.keys()
    robot.give("odom", stand(1.0, 12))
    assert pose_of(estimates[-1]) == pytest.approx([30.0, -20.0, 2.0], abs=1e-3)
    assert 0.05**2 < estimates[-1].pose.covariance[0] < 0.06**2
    gyro.angular_velocity_covariance[0] = -1.0
    robot.give("imu", at(13, gyro))
    assert robot.diagnose().facts["rejected, imu: no angular velocity"] == "1"


@pytest.mark.parametrize("gyro", [True, False])
def test_the_usual_topics_of_a_gyro_are_heard_if_the_model_was_made_with_one(
    make_node, tmp_path, gyro
):
    save_model(replace(builtin_model("differential"), gyro=gyro), tmp_path / "model")
    node = make_node(f"model:={tmp_path / 'model'}", kind=MiddlewareNode)
    node.configure()
    heard = {subscription.topic_name for subscription in node.subscriptions}
    assert ({"/imu", "/imu/data"} <= heard) == gyro


def test_a_pose_type_that_does_not_exist_is_refused_with_the_nearest(make_node):
    node = make_node("pose_type:=PoseStampd", kind=MiddlewareNode)
    with pytest.raises(ConfigError, match="'PoseStampd'; did you mean 'PoseStamped'"):
        node.configure()
