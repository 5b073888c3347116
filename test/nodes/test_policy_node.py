import itertools
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
    """A policy whose commands move a simulator without a gate between, and what is said."""
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


def test_a_goal_in_the_robots_frame_lies_ahead_of_it_and_one_in_no_known_frame_is_refused(
    driving,
):
    peer, said, goals, policy = driving
    before = pose_of(said["ground_truth"][-1])
    ahead = PoseStamped()
    ahead.header.frame_id, ahead.pose.position.x = "car", 1.2
    goals.publish(ahead)
    peer.until(lambda: speed(said) > 0.1, "driving")
    ahead.header.frame_id = "kitchen"
    goals.publish(ahead)
    peer.until(lambda: "'kitchen' is refused" in policy.log.read_text(), "a refusal")
    assert "The previous goal stays" in policy.log.read_text()
    peer.until(lambda: speed(said) == 0.0, "a stop")
    truth = pose_of(said["ground_truth"][-1])
    wanted = before[:2] + 1.2 * np.array([math.cos(before[2]), math.sin(before[2])])
    assert math.dist(truth[:2], wanted) < 0.5


def test_with_a_pose_sensor_it_waits_until_it_knows_where_in_the_map_it_is(
    launch, meet, domain_id
):
    peer = meet(domain_id)
    start = {"episode_start": [-2.0, 0.0, 0.0]}
    simulator = launch("simulator_node", domain_id, world="empty", **start)
    policy = launch("policy_node", domain_id, pose_type="PoseStamped", goal=[0.0, 0.0])
    raw = peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    scans = peer.listen(LaserScan, "scan")
    poses = peer.speak(PoseStamped, "pose")
    peer.until(lambda: len(raw) >= 5 and scans, "commands and scans")
    assert all(each.twist == Twist() for each in raw)
    pose = PoseStamped(header=scans[-1].header)
    pose.pose.position.x, pose.pose.orientation.w = -3.0, 1.0

    def goes():
        pose.header = scans[-1].header
        poses.publish(pose)
        return raw[-1].twist.linear.x > 0.1

    peer.until(goes, "driving")
    simulator.check()
    policy.check()


def test_it_goes_on_after_a_simulation_has_set_the_clock_back(
    launch, meet, domain_id, model
):
    policy = launch("policy_node", domain_id, rate=0.0)
    peer = meet(domain_id)
    commands = peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    odom, scans = peer.speak(Odometry, "odom"), peer.speak(LaserScan, "scan")
    goals = peer.speak(PoseStamped, "goal_pose")
    goals.publish(conversions.pose_to_ros([3.0, 0.0, 0.0], 0, "map"))
    ranges = np.full(model.lidar.beams, np.inf, np.float32)
    tenths = itertools.count(1000)

    def drives():
        """A tenth of a second of a robot that stands; True once it is commanded to drive."""
        stamp = next(tenths) * NS_PER_S // 10
        odom.publish(odometry(stamp))
        scans.publish(conversions.scan_to_ros(model.lidar, ranges, stamp, "laser"))
        peer.within(0.05, lambda: False)
        return commands and commands[-1].twist.linear.x > 0.0

    peer.until(drives, "it drives")
    tenths = itertools.count(1)
    commands.clear()
    peer.until(
        lambda: drives() and stamp_ns(commands[-1]) < 100 * NS_PER_S, "it drives on"
    )
    policy.check()


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
