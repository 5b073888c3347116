import itertools

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import PoseWithCovarianceStamped

from nics_drl_bridge import geometry
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.frames import (
    compute_odom_in_map,
    transform_from_ros,
    transform_to_ros,
)
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode
from nodes.peer import odometry, pose_of

pytestmark = pytest.mark.ros
TFS = conversions.find_message_type("tf2_msgs/msg/TFMessage")
needs_tf2_msgs = pytest.mark.skipif(TFS is None, reason="tf2_msgs is not installed")


def test_odom_lies_in_the_map_so_that_both_tell_of_the_same_robot():
    in_map = np.array([1.0, 2.0, 0.7])
    in_odom = np.array([-3.0, 0.5, -2.0])
    home = compute_odom_in_map(in_map, in_odom)
    assert geometry.compose(home, in_odom) == pytest.approx(in_map)


class Placed:
    """A middleware whose robot drives along x at 0.2 m/s."""

    def __init__(self, direct):
        self.robot = direct("model:=ackermann", kind=MiddlewareNode)
        self._stamps = itertools.count(10**8, 10**8)

    def drive(self, x):
        """Give an odometry; return the estimate after it."""
        moving = odometry(next(self._stamps), [x, 0.0, 0.0], [0.2, 0.0, 0.0])
        self.robot.give("odom", moving)
        return pose_of(self.robot.sent["odometry/filtered"][-1])

    def put(self, x, y, heading):
        message = PoseWithCovarianceStamped()
        message.header.frame_id = "map"
        message.pose.pose = conversions.pose_to_ros([x, y, heading], 0, "").pose
        message.pose.covariance[0] = message.pose.covariance[7] = 0.25  # as RViz says
        message.pose.covariance[35] = 0.07
        self.robot.give("initialpose", message)


def test_an_initial_pose_puts_the_estimate_there_and_it_goes_on_from_there(direct):
    placed = Placed(direct)
    for k in range(5):
        placed.drive(0.02 * k)
    placed.put(5.0, -1.0, np.pi / 2)
    last = [placed.drive(0.08 + 0.02 * k) for k in range(1, 11)][-1]
    assert last == pytest.approx([5.0, -0.8, np.pi / 2], abs=0.03)
    assert placed.robot.call("~/reset").success
    assert placed.drive(0.3) == pytest.approx([0.3, 0.0, 0.0], abs=0.03)  # forgotten


@needs_tf2_msgs
def test_map_to_odom_follows_from_the_estimate_until_another_node_publishes_it(direct):
    placed = Placed(direct)
    placed.drive(0.0)
    placed.put(5.0, -1.0, np.pi / 2)
    placed.drive(0.0)
    sent = placed.robot.sent["/tf"]
    (ours,) = sent[-1].transforms
    parent, child, home = transform_from_ros(ours)
    assert (parent, child) == ("map", "odom")
    assert home == pytest.approx([5.0, -1.0, np.pi / 2], abs=0.15)
    placed.robot.give("/tf", sent[-1])  # its own
    placed.drive(0.0)
    known = len(sent)
    # as of a localiser that stamps as this one does
    stamp = conversions.stamp_from_ros(ours.header.stamp)
    other = transform_to_ros("map", "odom", [9.0, 0.0, 0.0], stamp)
    placed.robot.give("/tf", TFS(transforms=[other]))
    placed.drive(0.0)
    assert len(sent) == known
