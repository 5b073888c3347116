import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

from nics_drl_bridge import geometry
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.frames import (
    compute_odom_in_map,
    transform_from_ros,
    transform_to_ros,
)
from nodes.peer import odometry, pose_of, stamp_ns

pytestmark = pytest.mark.ros
TFS = conversions.find_message_type("tf2_msgs/msg/TFMessage")
needs_tf2_msgs = pytest.mark.skipif(TFS is None, reason="tf2_msgs is not installed")


def test_odom_lies_in_the_map_so_that_both_tell_of_the_same_robot():
    in_map = np.array([1.0, 2.0, 0.7])
    in_odom = np.array([-3.0, 0.5, -2.0])
    home = compute_odom_in_map(in_map, in_odom)
    assert geometry.compose(home, in_odom) == pytest.approx(in_map)


@pytest.fixture
def placed(launch, meet, domain_id):
    """A middleware, a robot that the test plays, and a place for it."""
    middleware = launch("middleware_node", domain_id)
    peer = meet(domain_id)
    filtered = peer.listen(Odometry, "odometry/filtered")
    odom = peer.speak(Odometry, "odom")
    poses = peer.speak(PoseWithCovarianceStamped, "initialpose")
    numbers = iter(range(1, 1000))

    def drive(x):
        """An odometry at x [m], every tenth of a second at 0.2 m/s, and the estimate after it."""
        stamp = next(numbers) * 100_000_000
        odom.publish(odometry(stamp, [x, 0.0, 0.0], [0.2, 0.0, 0.0]))
        if peer.within(5.0, lambda: filtered and stamp_ns(filtered[-1]) >= stamp):
            return pose_of(filtered[-1])
        return None

    peer.until(lambda: drive(0.0) is not None, "the first estimate")
    yield peer, middleware, poses, drive
    middleware.check()


def to(x, y, heading):
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation = conversions.heading_to_ros(heading)
    message.pose.covariance[0] = message.pose.covariance[7] = 0.25  # as RViz says
    message.pose.covariance[35] = 0.07
    return message


def test_an_initial_pose_puts_the_estimate_there_and_it_goes_on_from_there(placed):
    peer, middleware, poses, drive = placed
    for k in range(1, 5):
        drive(0.02 * k)
    poses.publish(to(5.0, -1.0, np.pi / 2))
    peer.until(
        lambda: "the robot is at (5.00, -1.00) m" in middleware.log.read_text(), "heard"
    )
    last = [drive(0.08 + 0.02 * k) for k in range(1, 11)][-1]
    assert last == pytest.approx([5.0, -0.8, np.pi / 2], abs=0.03)
    assert peer.call(Trigger, "middleware_node/reset").success
    assert drive(0.3) == pytest.approx([0.3, 0.0, 0.0], abs=0.03)  # forgotten, too


@needs_tf2_msgs
def test_map_to_odom_follows_from_the_estimate_until_another_node_publishes_it(placed):
    peer, middleware, poses, drive = placed
    transforms = peer.listen(TFS, "/tf", qos.TRANSFORMS)
    others = peer.speak(TFS, "/tf", quality=qos.TRANSFORMS)
    peer.be_known_to("middleware_node")
    poses.publish(to(5.0, -1.0, np.pi / 2))
    peer.until(lambda: "the robot is at" in middleware.log.read_text(), "heard")
    drive(0.0)
    peer.until(lambda: drive(0.0) is not None and transforms, "a transform")
    (one,) = transforms[-1].transforms
    parent, child, home = transform_from_ros(one)
    assert (parent, child) == ("map", "odom")
    assert home == pytest.approx([5.0, -1.0, np.pi / 2], abs=0.15)
    # as of a localiser that stamps as this one does
    now_ns = conversions.stamp_from_ros(one.header.stamp)
    others.publish(
        TFS(transforms=[transform_to_ros("map", "odom", [9.0, 0.0, 0.0], now_ns)])
    )
    told = "another node publishes map -> odom"
    peer.until(lambda: told in middleware.log.read_text(), "yielding")
    known = len(transforms)
    drive(0.0)
    drive(0.0)
    ours = [t for m in transforms[known:] for t in m.transforms]
    assert all(each.transform.translation.x == 9.0 for each in ours)
