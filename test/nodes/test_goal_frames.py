import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import PoseStamped, TransformStamped

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.frames import GoalFrames
from nics_drl_bridge.nodes.parameters import list_policy_rows
from nics_drl_bridge.nodes.runner import declare_row

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
    for row in list_policy_rows():
        declare_row(node, row)
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
