import math
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import Twist

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nodes.peer import odometry, scan, stamp_ns

pytestmark = pytest.mark.ros


@pytest.fixture
def standing(direct):
    """Makes a policy node, and a function that shows it what a standing robot sees at a time."""

    def make(*given):
        robot = direct("rate:=0.0", "deadline:=5.0", *given, kind=PolicyNode)
        lidar = robot.node._model.lidar

        def look(tenths, pose=(0.0, 0.0, 0.0), twist=(0.0, 0.0, 0.0)):
            """Return the command after a scan at a time [0.1 s]."""
            stamp = tenths * NS_PER_S // 10
            robot.give("odom", odometry(stamp, pose, twist))
            robot.give("scan", scan(lidar, stamp, 3.0))
            return robot.sent["cmd_vel_raw"][-1]

        return robot, look

    return make


def test_a_goal_by_topic_is_driven_to_and_stopped_at_with_an_answer_to_each_scan(
    standing,
):
    robot, look = standing("base_frame:=car")
    assert look(10).twist == Twist()  # without a goal
    robot.give("goal_pose", conversions.pose_to_ros([2.0, 0.5, 0.0], 0, "map"))
    pose = np.zeros(3)
    twist = np.zeros(3)
    speeds = []
    for tenths in range(11, 90):
        command = look(tenths, pose, twist)
        assert stamp_ns(command) == tenths * NS_PER_S // 10
        twist = conversions.twist_from_ros(command.twist)
        pose = geometry.compose(pose, geometry.exp(0.1 * twist))
        speeds.append(twist[0])
    assert max(speeds) > 0.3
    assert speeds[-10:] == [0.0] * 10
    assert math.dist(pose[:2], (2.0, 0.5)) < 0.5
    assert command.header.frame_id == "car"
    assert len(robot.sent["cmd_vel_raw"]) == 80


def test_a_goal_in_the_robots_frame_lies_ahead_of_it_and_one_in_no_known_frame_is_refused(
    standing,
):
    robot, look = standing("base_frame:=car")
    look(10, (1.0, 2.0, math.pi / 2))
    robot.give("goal_pose", conversions.pose_to_ros([1.2, 0.0, 0.0], 7, "car"))
    assert robot.node._goal == pytest.approx([1.0, 3.2])
    assert robot.diagnose().facts["newest goal"] == "(1.00, 3.20) m in the map"
    robot.give("goal_pose", conversions.pose_to_ros([1.2, 0.0, 0.0], 8, "kitchen"))
    assert robot.node._goal == pytest.approx([1.0, 3.2])
    facts = robot.diagnose().facts
    assert facts["newest goal taken"] == "False"
    assert "'kitchen' is refused" in facts["newest goal"]
    assert look(11, (1.0, 2.0, math.pi / 2)).twist.linear.x > 0.0


def test_an_error_of_a_policy_is_told_with_its_place(standing, monkeypatch):
    robot, look = standing("goal:=[2.0, 0.0]")

    def fail(observation):
        raise ZeroDivisionError("no lidar today")

    monkeypatch.setattr(robot.node, "_policy", SimpleNamespace(act=fail))
    with pytest.raises(
        BridgeError,
        match=r"ZeroDivisionError: no lidar today \(.*test_policy_node.py, line \d+\)",
    ):
        look(10)


def test_with_a_pose_sensor_it_waits_until_it_knows_where_in_the_map_it_is(standing):
    robot, look = standing("pose_type:=PoseStamped", "goal:=[2.0, 0.0]")
    assert look(10).twist == look(11).twist == Twist()
    robot.give("pose", conversions.pose_to_ros([0.0, 0.0, 0.0], 11 * 10**8, "map"))
    assert look(12).twist.linear.x > 0.0


def test_it_goes_on_after_a_simulation_has_set_the_clock_back(standing):
    _, look = standing("goal:=[3.0, 0.0]")
    for k in range(30):
        assert look(1000 + k).twist.linear.x > 0.0
    commands = [look(1 + k) for k in range(30)]
    assert commands[-1].twist.linear.x > 0.0
    assert stamp_ns(commands[-1]) == 3 * NS_PER_S


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (["goal:=[.nan, 1.0]"], r"^parameter 'goal': must be \[x, y\] within 1e8 m"),
        (["goal:=[300000000.0, 0.0]"], "parameter 'goal'"),
        (["goal:=[1.0]"], "parameter 'goal'"),
        (["rate:=-1.0"], "rate -1.0"),
        (["deadline:=0.0"], "deadline 0.0"),
        (["policy:=none.onnx"], "none.onnx: field 'file'"),
    ],
)
def test_a_parameter_that_can_not_be_used_is_refused_when_it_is_configured(
    make_node, given, reason
):
    with pytest.raises(BridgeError, match=reason):
        make_node(*given, kind=PolicyNode).configure()
