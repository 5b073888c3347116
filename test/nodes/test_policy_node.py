import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nodes.peer import odometry, pose_of, stamp_ns

pytestmark = pytest.mark.ros

RATE = 4.0


@pytest.fixture(scope="module")
def driving(launch, meet, module_domain_id):
    """A policy whose commands move a simulator without a gate, and what is published."""
    peer = meet(module_domain_id)
    said = {
        "scan": peer.listen(LaserScan, "scan"),
        "ground_truth": peer.listen(Odometry, "ground_truth"),
        "cmd_vel_raw": peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND),
    }
    commands = peer.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
    peer.node.create_subscription(
        TwistStamped,
        "cmd_vel_raw",
        lambda raw: commands.publish(raw.twist),
        qos.COMMAND,
    )
    start = {"episode_start": [-2.0, 0.0, 0.0]}
    simulator = launch(
        "simulator_node", module_domain_id, world="empty", rate=RATE, **start
    )
    policy = launch("policy_node", module_domain_id, base_frame="car", rate=0.0)
    goals = peer.speak(PoseStamped, "goal_pose")
    peer.until(lambda: all(said.values()), "all topics")
    yield peer, said, goals, policy
    simulator.check()


def speed(said):
    return said["cmd_vel_raw"][-1].twist.linear.x


def test_each_command_is_stamped_with_the_scan_it_was_computed_from(driving):
    peer, said, _, _ = driving
    known = len(said["cmd_vel_raw"])
    peer.until(lambda: len(said["cmd_vel_raw"]) >= known + 10, "10 commands")
    commands = [stamp_ns(raw) for raw in said["cmd_vel_raw"]]
    scans = {stamp_ns(scan) for scan in said["scan"]}
    answers = {
        stamp for stamp in commands if stamp >= min(scans)
    }  # this node may hear late
    assert len(answers) >= 5
    assert len(answers - scans) <= 1  # best effort
    assert (np.diff(commands) > 0).all()  # one for each scan at most
    assert all(raw.twist == Twist() for raw in said["cmd_vel_raw"])  # without a goal
    assert said["cmd_vel_raw"][-1].header.frame_id == "car"


def test_a_goal_by_topic_is_driven_to_and_stopped_at(driving):
    peer, said, goals, _ = driving
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.position.y = 0.0, 0.5
    goals.publish(goal)
    peer.until(lambda: speed(said) > 0.1, "driving")
    peer.until(lambda: speed(said) == 0.0, "a stop")
    truth = pose_of(said["ground_truth"][-1])
    assert math.dist(truth[:2], (0.0, 0.5)) < 0.5
    known = len(said["cmd_vel_raw"])
    peer.until(lambda: len(said["cmd_vel_raw"]) >= known + 10, "10 more commands")
    assert [raw.twist for raw in said["cmd_vel_raw"][known:]] == [Twist()] * 10


@pytest.fixture
def standing(direct):
    """A policy node, and a function that publishes what a standing robot sees at a time."""

    def make(*given):
        robot = direct("rate:=0.0", "deadline:=5.0", *given, kind=PolicyNode)
        lidar = robot.node._model.lidar
        ranges = np.full(lidar.beams, 3.0, np.float32)

        def look(tenths, pose=(0.0, 0.0, 0.0)):
            """Return the command after a scan at a time [0.1 s]."""
            stamp = tenths * NS_PER_S // 10
            robot.give("odom", odometry(stamp, pose))
            robot.give("scan", conversions.scan_to_ros(lidar, ranges, stamp, "laser"))
            return robot.sent["cmd_vel_raw"][-1]

        return robot, look

    return make


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
