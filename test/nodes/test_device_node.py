from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec

import numpy as np
import pytest

from nics_drl_bridge.interface import NS_PER_S

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.srv import SelfTest
from domains import claimed_domain
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.device_parameters import declare_device, get_timing
from nics_drl_bridge.nodes.link import EPISODE_NS
from nics_drl_bridge.robot.noise import Delay, Latency
from nodes.peer import pose_of, stamp_ns

pytestmark = pytest.mark.ros

NAMES = ("left", "right")


class Fleet:
    """Two robots in lock-step, and all that they say."""

    def __init__(self, peer):
        self.peer = peer
        self.scans = {name: peer.listen(LaserScan, f"{name}/scan") for name in NAMES}
        self.odoms = {name: peer.listen(Odometry, f"{name}/odom") for name in NAMES}
        self.commands = {name: peer.speak(Twist, f"{name}/cmd_vel") for name in NAMES}

    def reset(self, start):
        set_start = self.peer.set_parameters("simulator_node", episode_start=start)
        assert set_start.successful
        for _ in range(20):
            answer = self.peer.call(Trigger, "simulator_node/reset")
            if not answer.success:
                return answer
            stamp = int(self.peer.read_episode()[EPISODE_NS])
            try:
                self.peer.until(
                    lambda stamp=stamp: self.stamps() == {stamp}, "first data", 1.5
                )
            except AssertionError:
                continue
            return answer
        raise AssertionError("no data after a reset")

    def stamps(self):
        said = (*self.scans.values(), *self.odoms.values())
        return {stamp_ns(each[-1]) if each else -1 for each in said}

    def command(self, name, speed):
        self.commands[name].publish(conversions.twist_to_ros([speed, 0.0, 0.0]))

    def x(self, name):
        return pose_of(self.odoms[name][-1])[0]


FACING = [0.0, 0.0, 0.0, 1.0, 0.0, np.pi]


@pytest.fixture(scope="module")
def fleet(launch, meet, module_domain_id):
    peer = meet(module_domain_id)
    process = launch(
        "simulator_node",
        module_domain_id,
        mode="lockstep",
        world="empty",
        robots=list(NAMES),
    )
    robots = Fleet(peer)
    assert robots.reset(FACING).success
    yield robots
    process.check()


def test_a_fleet_moves_when_each_of_its_robots_has_a_command(fleet):
    fleet.reset(FACING)
    (now,) = fleet.stamps()
    fleet.command("left", 0.5)
    for _ in range(3):  # each call makes the node spin
        assert fleet.peer.set_parameters("simulator_node", episode_seed=0).successful
    assert fleet.stamps() == {now}
    fleet.command("right", 0.0)
    fleet.peer.until(
        lambda: fleet.stamps() == {now + NS_PER_S // 10}, "a step of the fleet"
    )
    assert fleet.x("left") > 0.0


def test_who_has_touched_something_is_told_by_a_self_test_and_in_words(fleet):
    def has_passed():
        return any(fleet.peer.call(SelfTest, "simulator_node/self_test").passed)

    def read_words():
        return fleet.peer.call(Trigger, "simulator_node/touched").message

    fleet.reset(FACING)
    assert has_passed()
    assert read_words() == "touched something: nobody"
    for _ in range(20):
        (now,) = fleet.stamps()
        for name in NAMES:
            fleet.command(name, 0.5)
        after = {now + NS_PER_S // 10}
        fleet.peer.until(lambda after=after: fleet.stamps() == after, "a step")
    assert not has_passed()
    facts = fleet.peer.read_episode()
    assert [facts[f"touched, {name}"] for name in NAMES] == ["True", "True"]
    assert read_words() == "touched something: left, right"


def test_the_frames_of_a_fleet_begin_with_the_namespace_of_each_robot(fleet):
    for name in NAMES:
        scan = fleet.scans[name][-1]
        odom = fleet.odoms[name][-1]
        assert scan.header.frame_id == f"{name}/laser"
        assert (odom.header.frame_id, odom.child_frame_id) == (
            f"{name}/odom",
            f"{name}/base_link",
        )


class Stamped:
    """A robot of stamped commands, whose scan is told 50 ms after it was measured."""

    def __init__(self, peer):
        self.peer = peer
        self.order = []
        for kind, topic in ((LaserScan, "scan"), (Odometry, "odom")):
            peer.node.create_subscription(
                kind,
                topic,
                lambda m, topic=topic: self.order.append((topic, stamp_ns(m))),
                10,
            )
        peer.node.create_subscription(
            Clock,
            "/clock",
            lambda m: self.order.append(("clock", conversions.stamp_from_ros(m.clock))),
            50,
        )
        self.odom = peer.listen(Odometry, "odom")
        self.commands = peer.speak(TwistStamped, "cmd_vel")

    def stamps(self, topic):
        return [stamp for name, stamp in list(self.order) if name == topic]

    def drive(self, age_ns):
        message = TwistStamped(twist=conversions.twist_to_ros([0.5, 0.0, 0.0]))
        if age_ns is not None:
            message.header.stamp = conversions.stamp_to_ros(
                stamp_ns(self.odom[-1]) - age_ns
            )
        self.commands.publish(message)
        return self.peer.another(self.odom, "odometry").twist.twist.linear.x


@pytest.fixture(scope="module")
def stamped(launch, meet, domains):
    domain_id = domains.enter_context(claimed_domain())
    process = launch(
        "simulator_node",
        domain_id,
        world="empty",
        enable_stamped_cmd_vel=True,
        odom_rate=50.0,
        scan_latency=0.05,
        frame_prefix="car/",
    )
    robot = Stamped(meet(domain_id))
    robot.process, robot.stranger = process, meet(domain_id)
    robot.peer.until(lambda: len(robot.stamps("scan")) > 2, "scans")
    yield robot
    process.check()


def test_scan_and_odometry_have_rates_of_their_own(stamped):
    known = len(stamped.stamps("scan"))
    stamped.peer.until(lambda: len(stamped.stamps("scan")) > known + 5, "scans")
    for topic, rate in (("scan", 10), ("odom", 50)):
        steps = np.diff(stamped.stamps(topic)) / (NS_PER_S // rate)
        # A listener on a busy machine may miss one.
        assert np.array_equal(steps, steps.round())
        assert np.median(steps) == steps.min() == 1.0


def test_a_scan_is_told_as_late_as_the_latency_says_but_stamped_when_it_was_measured(
    stamped,
):
    known = len(stamped.stamps("scan"))
    stamped.peer.until(lambda: len(stamped.stamps("scan")) > known + 5, "scans")
    clock = 0
    late = []
    for topic, stamp in list(stamped.order):
        if topic == "clock":
            clock = stamp
        elif topic == "scan" and clock:
            late.append((clock - stamp) / NS_PER_S)
    assert np.median(late) >= 0.02  # the clock ticks every 20 ms
    assert stamped.odom[-1].header.frame_id == "car/odom"


@pytest.mark.parametrize(
    ("given", "scan_ns", "odom_ns"),
    [
        ({}, (12_000_000, 10_000_000), (3_000_000, 0)),
        (
            {"scan_latency": 0.0, "odom_latency": 0.0, "latency_jitter": 0.0},
            (0, 0),
            (0, 0),
        ),
        ({"scan_latency": 0.05}, (50_000_000, 10_000_000), (3_000_000, 0)),
        ({"latency_jitter": 0.002}, (12_000_000, 2_000_000), (3_000_000, 2_000_000)),
        ({"mode": "lockstep"}, (0, 0), (0, 0)),
    ],
)
def test_a_device_is_as_late_as_was_measured_unless_told_otherwise_and_never_in_lockstep(
    model, make_node, given, scan_ns, odom_ns
):
    latency = Latency(
        scan=Delay(least=0.012, jitter=0.01), odom=Delay(least=0.003, jitter=0.0)
    )
    node = make_node(*(f"{name}:={value}" for name, value in given.items()))
    declare_device(node, "laser")
    time = get_timing(node, replace(model, latency=latency))
    assert (time.scan_late_ns, time.odom_late_ns) == (scan_ns, odom_ns)


@pytest.mark.parametrize("age_ns", [0, None], ids=["fresh", "without a stamp"])
def test_a_stamped_command_drives_the_robot(stamped, age_ns):
    speed = 0.0
    for _ in range(200):
        speed = stamped.drive(age_ns)
        if speed > 0.3:
            return
    raise AssertionError(f"it goes at {speed} m/s")


def test_a_command_whose_stamp_is_older_than_the_timeout_is_ignored_and_said_to_be(
    stamped,
):
    for _ in range(300):
        if abs(stamped.drive(2 * NS_PER_S)) < 0.05:
            break
    assert max(abs(stamped.drive(2 * NS_PER_S)) for _ in range(20)) < 0.1
    assert "older than command_timeout" in stamped.process.log.read_text()


def test_a_publisher_of_the_other_type_is_named_with_both_types(stamped):
    stamped.stranger.node.create_publisher(Twist, "cmd_vel", 1)

    def said():
        text = stamped.process.log.read_text()
        return (
            "publishes geometry_msgs/msg/Twist, but geometry_msgs/msg/TwistStamped"
            in text
        )

    stamped.peer.until(said, "a warning")


HAS_TF, HAS_ACKERMANN = (
    find_spec(name) is not None for name in ("tf2_msgs", "ackermann_msgs")
)


@pytest.mark.skipif(not HAS_ACKERMANN, reason="needs ackermann_msgs: nox -s messages")
def test_a_car_is_driven_by_speed_and_steering_angle(stamped):
    kind = import_module("ackermann_msgs.msg").AckermannDriveStamped
    topic = stamped.stranger.speak(kind, "ackermann_cmd")
    message = kind()
    message.drive.speed, message.drive.steering_angle = 0.5, 0.3

    def turns():
        topic.publish(message)
        twist = stamped.odom[-1].twist.twist if stamped.odom else None
        return twist is not None and twist.linear.x > 0.4 and twist.angular.z > 0.1

    stamped.peer.until(turns, "a turn to the left")


@pytest.mark.skipif(not HAS_TF, reason="needs tf2_msgs: nox -s messages")
def test_its_transforms_are_those_of_rep_105_and_the_mount_is_told_to_late_comers(
    stamped,
):
    kind = import_module("tf2_msgs.msg").TFMessage
    moving = stamped.peer.listen(kind, "/tf", qos.TRANSFORMS)
    fixed = stamped.peer.listen(kind, "/tf_static", qos.LATCHED)
    stamped.peer.until(lambda: moving and fixed, "transforms")
    (odom,), (mount,) = moving[-1].transforms, fixed[-1].transforms
    assert (odom.header.frame_id, odom.child_frame_id) == ("car/odom", "car/base_link")
    assert (mount.header.frame_id, mount.child_frame_id) == (
        "car/base_link",
        "car/laser",
    )


@pytest.mark.skipif(HAS_TF, reason="tf2_msgs is installed")
def test_one_line_says_that_tf2_msgs_is_missing(stamped):
    log = stamped.process.log.read_text()
    assert log.count("tf2_msgs is not installed") == 1
    assert "; install it by `nics install tf2_msgs`." in log
