import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.frames import (
    GoalFrames,
    compute_odom_in_map,
    transform_from_ros,
    transform_to_ros,
)
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode
from nics_drl_bridge.nodes.runner import declare_rows
from nodes.peer import odometry, pose_of

pytestmark = pytest.mark.ros


ESTIMATE = np.array([3.0, 1.0, math.pi / 2])  # in map
REPORTED = np.array([2.0, 0.0, 0.0])  # in odom, a tenth of a second before
TWIST = np.array([1.0, 0.0, 0.0])


class Topics:
    """Topics of a robot at 1 m/s, whose odometry has another origin than the map."""

    def __init__(self):
        self.frames = ("bot/odom", "bot/base")
        self.located = True
        self.newest_ns = 200_000_000
        self.reported = geometry.compose(REPORTED, [0.1, 0.0, 0.0])

    def locate_in_odom(self):
        return self.reported

    def view(self):
        return SimpleNamespace(pose=ESTIMATE)


@pytest.fixture
def frames(make_node):
    node = make_node()
    declare_rows(node, "frames", "policy")
    return GoalFrames(node, Topics())


def goal(frame, x, y):
    made = PoseStamped()
    made.header.frame_id = frame
    made.pose.position.x, made.pose.position.y = x, y
    return made


def mount(frames, parent, child, *pose):
    """Mount a frame as a message on `/tf_static` does, whose package may be missing."""
    each = TransformStamped(child_frame_id=child)
    each.header.frame_id = parent
    each.transform.translation.x, each.transform.translation.y = pose[:2]
    each.transform.rotation = conversions.heading_to_ros(pose[2])
    frames._take(SimpleNamespace(transforms=[each]))


@pytest.mark.parametrize("frame", ["", "map", "/map"])
def test_a_goal_of_the_map_or_of_no_frame_is_taken_as_it_is(frames, frame):
    assert frames.in_map(goal(frame, 1.0, -2.0)) == pytest.approx([1.0, -2.0])


@pytest.mark.parametrize("x", [float("nan"), float("inf")])
def test_a_goal_that_is_no_place_is_refused(frames, x):
    with pytest.raises(ConfigError, match="must be finite numbers"):
        frames.in_map(goal("map", x, 0.0))


@pytest.mark.parametrize("frame", ["base_link", "bot/base"])
def test_a_goal_ahead_of_the_robot_lies_where_it_looks(frames, frame):
    assert frames.in_map(goal(frame, 2.0, 0.5)) == pytest.approx([2.5, 3.0])


def test_a_goal_of_the_odometry_lies_as_far_from_the_robot_as_there(frames):
    now = geometry.compose(REPORTED, [0.1, 0.0, 0.0])
    wanted = geometry.compose(ESTIMATE, geometry.between(now, [4.0, 1.0, 0.0]))[:2]
    assert frames.in_map(goal("bot/odom", 4.0, 1.0)) == pytest.approx(wanted)
    assert wanted == pytest.approx([2.0, 2.9])


def test_with_a_localiser_a_goal_of_the_map_lies_as_far_from_the_robot_as_in_its_map(
    frames,
):
    other = TransformStamped(child_frame_id="bot/odom")
    other.header.frame_id, other.transform.translation.x = "map", -5.0
    other.transform.rotation.w = 1.0
    frames._follow(SimpleNamespace(transforms=[other]))
    now = geometry.compose([-5.0, 0.0, 0.0], frames._topics.reported)
    assert frames.locate_robot("map") == pytest.approx(now)
    wanted = geometry.compose(ESTIMATE, geometry.between(now, [1.0, -2.0, 0.0]))[:2]
    assert frames.in_map(goal("map", 1.0, -2.0)) == pytest.approx(wanted)


def test_a_goal_of_a_mounted_frame_follows_its_transforms(frames):
    mount(frames, "base_link", "mast", 0.2, 0.0, 0.0)
    mount(frames, "mast", "camera", 0.0, 0.1, math.pi)
    assert frames.in_map(goal("camera", 1.0, 0.0)) == pytest.approx([2.9, 0.2])


def test_an_unknown_frame_is_refused_with_the_known_ones(frames):
    with pytest.raises(
        ConfigError, match=r"'kitchen'.*'base_link', 'bot/base', 'bot/odom', 'map'"
    ):
        frames.in_map(goal("kitchen", 1.0, 0.0))


def test_frames_that_are_mounted_on_each_other_end_in_a_refusal(frames):
    mount(frames, "b", "a", 0.0, 0.0, 0.0)
    mount(frames, "a", "b", 0.0, 0.0, 0.0)
    with pytest.raises(ConfigError, match="'a' is refused"):
        frames.in_map(goal("a", 1.0, 0.0))


def test_before_the_robots_place_is_known_only_goals_of_the_map_are_taken(frames):
    frames._topics.reported = None
    assert frames.in_map(goal("map", 1.0, 0.0)) == pytest.approx([1.0, 0.0])
    with pytest.raises(ConfigError, match="pose is not known yet"):
        frames.in_map(goal("base_link", 1.0, 0.0))


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
