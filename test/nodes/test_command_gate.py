import math
import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from nics_drl_bridge.interface import NS_PER_S

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.gate import shield_kernels
from nics_drl_bridge.gate.black_box import replay
from nics_drl_bridge.gate.inputs import Press, Tick
from nics_drl_bridge.nodes import command_gate, conversions, qos
from nics_drl_bridge.nodes.wire import read_stamped_twist
from nodes.peer import DEADLINE_S, odometry

pytestmark = pytest.mark.ros

LATE_S = 5.0
PERIOD_S = 0.1
START_NS = 10**18
MOST_S = 1.0
MOST_ARMINGS = 3
CORRIDOR_M = 1.5  # from the middle of it, on which the robot drives, to either wall
WRITTEN_S = 5.0
PATIENT = {
    "scan_age": 1.0,
    "odom_age": 0.6,
    "command_age": 1.0,
    "rate_tolerance": 0.6,
    "e_stop_silence": 1.0,
}
"""This machine may be busy with other tests. Odometry that is silent for 0.75 s is `no_motion`."""


class Robot:
    """A robot with its policy around a gate; it does what it is told."""

    kind = TwistStamped

    def __init__(self, peer, lidar):
        self.peer = peer
        self.lidar = lidar
        self.stamp_ns = START_NS
        self.x = 0.0
        self.silent = set()
        self.wish = (0.5, 0.0, 0.0)
        self.stamped = None
        # Along a corridor without an end nothing moves, however late a pose or a scan may be.
        bearings = lidar.angles + lidar.mount[2]
        self.walls = CORRIDOR_M / np.maximum(np.abs(np.sin(bearings)), 1e-9)
        self.distance = math.inf  # of an obstacle all around it
        self.passed = peer.listen(Twist, "cmd_vel", qos.COMMAND)
        self.topics = {
            "scan": peer.speak(LaserScan, "scan"),
            "odom": peer.speak(Odometry, "odom"),
            "filtered": peer.speak(Odometry, "odometry/filtered"),
            "cmd_vel_raw": peer.speak(self.kind, "cmd_vel_raw"),
            "e_stop": peer.speak(Bool, "e_stop", quality=qos.EVERY_COMMAND),
        }
        peer.node.create_timer(PERIOD_S, self.sends)

    def sends(self):
        """What arrives in a period."""
        speed = self.passed[-1].linear.x if self.passed else 0.0
        before = self.stamp_ns
        self.stamp_ns = START_NS + time.monotonic_ns()
        # A busy machine leaves out some periods; the robot drives on all the same.
        self.x += speed * min((self.stamp_ns - before) / NS_PER_S, MOST_S)
        moved = odometry(self.stamp_ns, [self.x, 0.0, 0.0], [speed, 0.0, 0.0])
        # No two scans are the same; this is less than what counts as a motion.
        noise = self.stamp_ns % 7_000_000_000 * 1e-12
        ranges = (np.minimum(self.walls, self.distance) + noise).astype(np.float32)
        said = {
            "odom": moved,
            "filtered": moved,
            "scan": conversions.scan_to_ros(self.lidar, ranges, self.stamp_ns, "laser"),
            "e_stop": Bool(data=False),
            "cmd_vel_raw": self.command(),
        }
        for topic in said.keys() - self.silent:
            self.topics[topic].publish(said[topic])

    def command(self):
        message = TwistStamped(twist=conversions.twist_to_ros(self.wish))
        stamp_ns = self.stamp_ns if self.stamped is None else self.stamped
        message.header.stamp = conversions.stamp_to_ros(stamp_ns)
        return message

    def call(self, service):
        return self.peer.call(Trigger, f"command_gate/{service}")

    def gets(self, *wanted):
        """Waits for a command to come out."""
        assert self.comes(wanted, DEADLINE_S), (
            f"{wanted} never came, but {self.passed[-1]}"
        )

    def comes(self, wanted, patience_s):
        """Whether a command comes out within a time."""
        wanted = conversions.twist_to_ros(wanted)
        deadline = time.monotonic() + patience_s
        self.passed.clear()
        while time.monotonic() < deadline:
            if self.peer.another(self.passed, "command") == wanted:
                return True
        return False

    def stops(self):
        self.gets(0.0, 0.0, 0.0)

    def drives(self, *wish):
        """Everything is well, the gate is armed, and the robot drives.

        A busy machine may let the gate stop in between, and stay so; once is enough.
        """
        self.silent = set()
        self.stamped = None
        wish = wish or (0.5, 0.0, 0.0)
        deadline = time.monotonic() + DEADLINE_S
        for _ in range(MOST_ARMINGS):
            self.is_armed(deadline)
            self.wish = wish
            if self.comes(wish, DEADLINE_S / MOST_ARMINGS):
                return
        raise AssertionError(f"{wish} never came, but {self.passed[-1]}")

    def is_armed(self, deadline):
        """Arms the gate unless it is."""
        while self.diagnosed()["armed"] != "True":
            self.wish = (0.0, 0.0, 0.0)
            self.call("reset")
            answer = self.call("arm")
            assert answer.success or time.monotonic() < deadline, answer.message

    def says(self, cause):
        """Waits until the gate names what stops it; a busy machine may stop it before."""
        self.peer.until(lambda: self.diagnosed()[""].startswith(cause), cause)

    def diagnosed(self):
        """What the gate says next about itself."""
        said = self.peer.listen(DiagnosticArray, "/diagnostics")
        status = self.peer.another(said, "diagnostics").status[0]
        return {value.key: value.value for value in status.values} | {
            "": status.message
        }


class Foreign(Robot):
    """The same with a controller that knows nothing of scans' stamps, as Nav2's."""

    kind = Twist

    def command(self):
        return conversions.twist_to_ros(self.wish)


@pytest.fixture(scope="module")
def black_box(tmp_path_factory):
    return tmp_path_factory.mktemp("black_box")


@pytest.fixture(scope="module")
def robot(launch, meet, module_domain_id, model, black_box):
    gate = launch(
        "command_gate",
        module_domain_id,
        limits="ackermann",
        black_box=str(black_box),
        **PATIENT,
    )
    yield Robot(meet(module_domain_id), model.lidar)
    gate.check()


def test_it_does_not_listen_before_its_shield_is_compiled(make_node, monkeypatch):
    """The first call of a kernel compiles it."""
    is_free = shield_kernels.is_free
    steps = []

    def compile_kernel(*values):
        steps.append("compiled")
        return is_free(*values)

    monkeypatch.setattr(shield_kernels, "is_free", compile_kernel)
    monkeypatch.setattr(
        command_gate.CommandGate, "_listen", lambda _: steps.append("listens")
    )
    make_node(kind=command_gate.CommandGate)
    assert steps == ["compiled", "listens"]


@pytest.fixture
def decided(make_node, tmp_path, monkeypatch):
    """A gate that does not spin: it, what it sends, and a function that replaces `decide`."""
    given = (f"black_box:={tmp_path}", "model:=ackermann", "limits:=ackermann")
    node = make_node(*given, kind=command_gate.CommandGate)
    sent = []
    out = SimpleNamespace(publish=sent.append, topic_name="/cmd_vel")
    monkeypatch.setattr(node, "_out", out)
    yield node, sent, partial(monkeypatch.setattr, command_gate, "decide")
    monkeypatch.undo()
    node.stop()


def test_a_motion_that_was_decided_on_before_a_freeze_is_never_published(
    decided, monkeypatch
):
    node, sent, use = decided
    clock = [100.0]
    decide = command_gate.decide

    def freeze(config, state, event, now):
        """Moves the robot, and is frozen for half a second the first time."""
        state, decision = decide(config, state, event, now)
        if now > 100.0:
            return state, decision
        clock[0] += 0.5
        return state, replace(decision, publish=True, cause=None, twist=np.ones(3))

    use(freeze)
    monkeypatch.setattr(command_gate.time, "monotonic", lambda: clock[0])
    node._decide(Tick())
    assert list(map(read_stamped_twist, sent)) == [(0.0, 0.0, 0.0)]


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_decision_that_is_no_number_leaves_as_zero_and_latches(decided, wrong):
    """Whatever the rules decide: here they are made to decide on NaN."""
    node, sent, use = decided
    decide = command_gate.decide

    def fail(config, state, event, now):
        state, decision = decide(config, state, event, now)
        if event == Press():
            return state, decision
        return state, replace(decision, twist=np.array([0.5, wrong, 0.1]), publish=True)

    use(fail)
    node._decide(Tick())
    assert list(map(read_stamped_twist, sent)) == [(0.0, 0.0, 0.0)]
    found = node._look()
    assert found.message.startswith("e_stop_pressed")
    assert found.facts["not finite, sent as zero"] == 1


def test_bytes_that_are_no_message_are_refused_and_counted(decided):
    node, *_ = decided
    for subscription in node.subscriptions:
        if subscription.raw:
            info = [{}] if subscription.topic_name == "/cmd_vel_raw" else []
            subscription.callback(b"\x00\x01\x00\x00\x01", *info)
    facts = node._look().facts
    for topic in ("scan", "odom", "odometry/filtered", "cmd_vel_raw"):
        assert facts[f"refused, {topic}"] == 1


def test_it_starts_disarmed_refuses_by_name_to_be_armed_and_then_lets_commands_pass(
    robot,
):
    robot.silent = {"scan", "filtered"}
    robot.stops()
    answer = robot.call("arm")
    assert not answer.success
    for check in ("scan_fresh", "scan_rate", "estimator_converged"):
        assert f"{check}: " in answer.message
    robot.silent = set()
    robot.stops()
    assert robot.diagnosed()["armed"] == "False"
    robot.drives(0.5, 0.0, -0.25)


def test_another_controllers_twists_pass_until_scans_fall_silent(
    launch, meet, domain_id, model, tmp_path
):
    given = {"limits": "ackermann", "black_box": str(tmp_path), **PATIENT}
    gate = launch("command_gate", domain_id, foreign_commands="Twist", **given)
    robot = Foreign(meet(domain_id), model.lidar)
    robot.drives()
    robot.silent = {"scan"}
    robot.stops()
    robot.says("scan")
    gate.check()


def test_another_publisher_of_commands_is_told_of_as_long_as_it_is_there(robot):
    robot.drives()
    other = robot.peer.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
    robot.peer.until(
        lambda: "others publish on cmd_vel too (1)" in robot.diagnosed()[""],
        "the warning",
    )
    robot.peer.node.destroy_publisher(other)
    robot.peer.until(lambda: "others publish" not in robot.diagnosed()[""], "its end")


def test_a_second_policy_that_joins_while_the_robot_drives_stops_it_and_is_named(robot):
    robot.drives()
    node = robot.peer.node
    commands = node.create_publisher(TwistStamped, "cmd_vel_raw", qos.COMMAND)
    others = node.create_timer(PERIOD_S, lambda: commands.publish(robot.command()))
    try:
        robot.says("two_policies: topic=cmd_vel_raw")
        said = robot.diagnosed()[""]
        assert said.count(f"/{node.get_name()} (publisher ") == 2
        assert "both publish on cmd_vel_raw" in said
        robot.stops()
        assert robot.call("reset").success
        assert "one_policy" in robot.call("arm").message
    finally:
        node.destroy_timer(others)
        node.destroy_publisher(commands)
    robot.drives()


@pytest.mark.parametrize("by", ["topic", "service"])
def test_the_e_stop_stops_and_a_reset_alone_does_not_move(robot, by):
    robot.drives()
    if by == "topic":
        robot.topics["e_stop"].publish(Bool(data=True))
    else:
        assert robot.call("e_stop").success
    robot.stops()
    facts = robot.diagnosed()
    assert facts[""].startswith("e_stop_pressed: topic=e_stop")
    assert facts["armed"] == "False"
    assert not robot.call("arm").success
    robot.peer.until(
        lambda: robot.call("reset").success, "the e-stop is heard to be released"
    )
    known = len(robot.passed)
    robot.peer.until(lambda: len(robot.passed) > known + 20, "20 more commands")
    assert set(map(str, robot.passed[known:])) == {str(Twist())}


def test_every_stop_is_in_the_black_box_and_replays(robot, black_box):
    deadline = time.monotonic() + DEADLINE_S
    while not (files := sorted(black_box.glob("*scan_silent.jsonl"))):
        # A busy machine may freeze the gate; then that is the stop which is written.
        assert time.monotonic() < deadline, "no file"
        robot.drives()
        robot.silent = {"scan"}
        robot.stamped = robot.stamp_ns
        robot.stops()
        robot.peer.within(WRITTEN_S, lambda: list(black_box.glob("*scan_silent.jsonl")))
    again = replay(files[-1])
    assert again.differing == ()
    assert again.entries[-1].decision.cause.rule == "scan_silent"


def test_as_shipped_it_stops_before_an_obstacle_and_counts_it(
    launch, meet, domain_id, model, tmp_path
):
    given = {"limits": "ackermann", "black_box": str(tmp_path), **PATIENT}
    gate = launch("command_gate", domain_id, **given)
    robot = Robot(meet(domain_id), model.lidar)
    robot.drives(0.2, 0.0, 0.0)
    cut = int(robot.diagnosed().get("cut by the shield", 0))
    robot.distance = 0.19
    robot.peer.until(
        lambda: int(robot.diagnosed().get("cut by the shield", 0)) > cut,
        "the shield cuts",
    )
    robot.says("commands pass")
    robot.stops()
    said = gate.log.read_text(encoding="utf-8")
    assert "the shield is on: latency 0.2, deceleration 2, margin 0.05" in said
