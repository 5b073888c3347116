"""The gate between its topics; `test/gate` tests the rules, and processes are in other files."""

import math
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Bool

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import shield_kernels
from nics_drl_bridge.gate.black_box import replay
from nics_drl_bridge.gate.inputs import Press, Tick
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes import command_gate, conversions
from nics_drl_bridge.nodes.command_gate import declare_gate, find_black_box
from nics_drl_bridge.nodes.runner import declare_model
from nodes.peer import odometry

pytestmark = pytest.mark.ros


TICK_S = 0.005
TICKS = 4  # between two ticks of the gate
PLAIN = ("enable_stamped_cmd_vel:=false", "stop_when_held:=false")
WRITTEN_S = 20.0
AHEAD = [0.5, 0.0, 0.0]
FOREIGN = "foreign_commands:=Twist"
TOPICS = ("odom", "odometry/filtered", "scan", "e_stop", "cmd_vel_raw")


class Robot:
    """A robot and its policy around a gate that does not spin; topics have the model's rates."""

    def __init__(self, direct, clock, model, *given, words=()):
        kind = command_gate.CommandGate
        self.gate = direct(*given, kind=kind, words=words)
        self.is_foreign = FOREIGN in given
        self.sent = self.gate.sent["cmd_vel"]
        self.policies = [b"policy"]  # ids of the publishers of commands
        self._lidar = model.lidar
        scan_s = 1.0 / model.lidar.rate
        odom_s = model.control_period
        self._due_s = dict.fromkeys(TOPICS, 0.0)
        self._periods_s = dict.fromkeys(TOPICS, scan_s)
        self._periods_s |= {"odom": odom_s, "odometry/filtered": odom_s}
        self._clock = clock
        self._x = 0.0
        self._scan_stamp = 0

    def run(self, seconds, without=()):
        """Let time pass; some topics may be silent. Return the last command."""
        for k in range(round(seconds / TICK_S)):
            self._clock.now_s += TICK_S
            self._speed = self.sent[-1].linear.x if self.sent else 0.0
            self._x += self._speed * TICK_S
            for topic in TOPICS:
                if self._due_s[topic] <= self._clock.now_s + 1e-6:
                    self._due_s[topic] = self._clock.now_s + self._periods_s[topic]
                    if topic not in without:
                        self._send(topic)
            if k % TICKS == 0:
                self.gate.node._tick()
        return conversions.twist_from_ros(self.sent[-1]).tolist()

    def _send(self, topic):
        stamp = self._clock.monotonic_ns()
        if topic == "e_stop":
            self.gate.give(topic, Bool(data=False))
        elif topic == "scan":
            ranges = np.full(self._lidar.beams, 2.0 + 1e-12 * stamp % 0.1, np.float32)
            scan = conversions.scan_to_ros(self._lidar, ranges, stamp, "laser")
            self.gate.give(topic, scan)
            self._scan_stamp = stamp
        elif topic == "cmd_vel_raw":
            command = conversions.stamped_to_ros(AHEAD, self._scan_stamp, "")
            given = command.twist if self.is_foreign else command
            for policy in self.policies:
                self.gate.give(topic, given, publisher_gid={"data": policy})
        else:
            twist = [self._speed, 0.0, 0.0]
            self.gate.give(topic, odometry(stamp, [self._x, 0.0, 0.0], twist))

    def drive(self):
        """Arm the gate, and drive."""
        assert self.run(2.0) == [0.0, 0.0, 0.0]
        answer = self.gate.call("~/arm")
        assert answer.success, answer.message
        assert self.run(2.0) == AHEAD, self.gate.diagnose().message
        return self


@pytest.fixture
def open_gate(direct, clock, model, tmp_path):
    given = (f"black_box:={tmp_path}", "model:=ackermann", "limits:=ackermann", *PLAIN)
    return partial(Robot, direct, clock, model, *given)


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


def test_a_motion_that_was_decided_on_before_a_freeze_is_never_published(
    open_gate, clock, monkeypatch
):
    robot = open_gate()
    decide = command_gate.decide
    began_s = clock.now_s

    def freeze(config, state, event, now):
        """Move the robot, and be frozen for half a second the first time."""
        state, decision = decide(config, state, event, now)
        if now > began_s:
            return state, decision
        clock.now_s += 0.5
        return state, replace(decision, publish=True, cause=None, twist=np.ones(3))

    monkeypatch.setattr(command_gate, "decide", freeze)
    robot.gate.node._decide(Tick())
    assert robot.sent == [Twist()]


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_decision_that_is_no_number_leaves_as_zero_and_latches(
    open_gate, monkeypatch, wrong
):
    """No rule decides on NaN; here they are made to."""
    robot = open_gate()
    decide = command_gate.decide

    def fail(config, state, event, now):
        state, decision = decide(config, state, event, now)
        if event == Press():
            return state, decision
        return state, replace(decision, twist=np.array([0.5, wrong, 0.1]), publish=True)

    monkeypatch.setattr(command_gate, "decide", fail)
    robot.gate.node._decide(Tick())
    assert robot.sent == [Twist()]
    found = robot.gate.diagnose()
    assert found.message.startswith("e_stop_pressed")
    assert found.facts["not finite, sent as zero"] == "1"


def test_bytes_that_are_no_message_are_refused_and_counted(open_gate):
    gate = open_gate().gate
    for topic in ("scan", "odom", "odometry/filtered", "cmd_vel_raw"):
        info = {"publisher_gid": None} if topic == "cmd_vel_raw" else {}
        gate.give(topic, b"\x00\x01\x00\x00\x01", **info)
        assert gate.diagnose().facts[f"refused, {topic}"] == "1"
    gate.give("e_stop", b"")
    assert gate.diagnose().message.startswith("e_stop_pressed")


def test_it_starts_disarmed_refuses_by_name_to_be_armed_and_then_lets_commands_pass(
    open_gate,
):
    robot = open_gate()
    assert robot.run(1.0, without=("scan", "odometry/filtered")) == [0.0, 0.0, 0.0]
    answer = robot.gate.call("~/arm")
    assert not answer.success
    for check in ("scan_fresh", "scan_rate", "estimator_converged"):
        assert f"{check}: " in answer.message
    assert robot.gate.diagnose().facts["armed"] == "False"
    robot.drive()
    assert robot.gate.diagnose().message == "commands pass"


def test_twists_of_another_controller_pass_until_scans_fall_silent(open_gate):
    robot = open_gate(FOREIGN).drive()
    assert robot.run(1.0, without=("scan",)) == [0.0, 0.0, 0.0]
    assert robot.gate.diagnose().message.startswith("scan")


def test_another_publisher_of_commands_is_reported_while_it_is_there(open_gate):
    gate = open_gate().gate
    node = Node("other", context=gate.node.context)
    other = node.create_publisher(Twist, "cmd_vel", 1)
    warning = "others publish on cmd_vel too (1) and bypass this gate"
    assert gate.diagnose().message.endswith(warning)
    node.destroy_publisher(other)
    assert warning not in gate.diagnose().message
    node.destroy_node()


def test_a_second_policy_that_joins_while_the_robot_drives_stops_it_and_is_named(
    open_gate,
):
    robot = open_gate()
    context = robot.gate.node.context
    nodes = [Node(name, context=context) for name in ("ant", "bee")]
    for node in nodes:
        node.create_publisher(TwistStamped, "cmd_vel_raw", 1)
    ends = robot.gate.node.get_publishers_info_by_topic("cmd_vel_raw")
    ids = {end.node_name: bytes(end.endpoint_gid) for end in ends}
    robot.policies = [ids["ant"]]
    robot.drive()
    robot.policies.append(ids["bee"])
    assert robot.run(0.5) == [0.0, 0.0, 0.0]
    message = robot.gate.diagnose().message
    assert message.startswith("two_policies: topic=cmd_vel_raw")
    assert "/ant (publisher " in message
    assert "/bee (publisher " in message
    assert robot.gate.call("~/reset").success
    assert "one_policy" in robot.gate.call("~/arm").message
    for node in nodes:
        node.destroy_node()


@pytest.mark.parametrize("by", ["topic", "service"])
def test_the_e_stop_stops_and_a_reset_alone_does_not_move(open_gate, by):
    robot = open_gate().drive()
    gate = robot.gate
    if by == "topic":
        gate.give("e_stop", Bool(data=True))
    else:
        assert gate.call("~/e_stop").success
    assert robot.sent[-1] == Twist()  # at once
    assert gate.diagnose().message.startswith("e_stop_pressed: topic=e_stop")
    assert not gate.call("~/arm").success
    robot.run(0.2)
    assert gate.call("~/reset").success
    known = len(robot.sent)
    robot.run(1.0)
    assert all(command == Twist() for command in robot.sent[known:])


def test_every_stop_is_in_the_black_box_and_replays(open_gate, tmp_path):
    robot = open_gate().drive()
    robot.run(1.0, without=("scan",))
    deadline = time.monotonic() + WRITTEN_S
    while not (files := list(tmp_path.glob("*scan_silent.jsonl"))):
        assert time.monotonic() < deadline, "no file"
        time.sleep(0.01)
    again = replay(files[0])
    assert again.differing == ()
    assert again.entries[-1].decision.cause.rule == "scan_silent"
    robot.gate.node.stop()
    assert robot.sent[-1] == Twist()


@pytest.fixture
def declared(make_node):
    """Declares the gate's parameters as given, `declared({"scan_age": 0.5})`."""

    def declare(given=(), model=None):
        node = make_node(*(f"{name}:={value}" for name, value in dict(given).items()))
        return declare_gate(node, model or declare_model(node))

    return declare


def test_a_gate_that_is_told_nothing_requires_an_emergency_stop(declared):
    config = declared()
    assert config.e_stop_required
    assert not config.simulated


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"scan_age": 0.05}, "parameter 'scan_age': 0.05 s: scan comes every 0.1 s"),
        ({"odom_age": 0.02}, "parameter 'odom_age'"),
        ({"odom_rate": 50.0, "odom_age": 0.01}, "give more than 0.02"),
        ({"odom_rate": 0.5, "odom_age": 5.0}, "too rarely"),
        ({"estimate_std": 0.5}, "'estimate_position' .* and 'estimate_heading'"),
        ({"model": "ackermann", "limits": "mecanum"}, "limits are for 'mecanum', not"),
    ],
)
def test_a_parameter_that_can_not_be_used_is_one_sentence(declared, given, sentence):
    with pytest.raises(ConfigError, match=sentence):
        declared(given)


@pytest.mark.parametrize(
    ("rate", "age"), [(10.0, 0.3), (5.0, 0.35), (4.0, 0.4375), (40.0, 0.3)]
)
def test_scans_of_a_slow_lidar_may_get_older(declared, rate, age):
    model = builtin_model("ackermann")
    slow = replace(model, lidar=model.lidar.model_copy(update={"rate": rate}))
    assert declared({"odom_rate": 10.0}, model=slow).scan_age_s == pytest.approx(age)


def test_metres_and_radians_of_the_estimate_have_parameters_of_their_own(declared):
    config = declared(
        {"estimate_position": 0.7, "estimate_heading": 0.2, "stop_when_held": False}
    )
    assert (config.estimate_position, config.estimate_heading) == (0.7, 0.2)
    assert not config.stop_when_held
    assert declared().stop_when_held


def test_the_shield_needs_the_wheelbase_of_a_car_and_can_be_turned_off(declared):
    model = builtin_model("ackermann")
    robot = model.robot.model_copy(update={"parameters": {}})
    with pytest.raises(ConfigError, match="needs the parameter 'wheelbase' of a car"):
        declared(model=replace(model, robot=robot))
    assert declared(model=model).shield is not None
    assert declared({"shield": False}, model).shield is None


def test_each_namespace_has_a_black_box_of_its_own(make_node, tmp_path):
    def folder(*words):
        node = make_node(f"black_box:={tmp_path}", words=words)
        declare_gate(node, declare_model(node))
        return find_black_box(node)

    assert folder() == tmp_path
    assert folder("-r", "__ns:=/hall/robot_1") == tmp_path / "hall" / "robot_1"


@pytest.mark.parametrize("simulated", [False, True])
def test_the_clock_of_a_gate_that_runs_can_not_be_changed(make_node, simulated):
    node = make_node(f"use_sim_time:={simulated}")
    declare_gate(node, declare_model(node))
    (same,) = node.set_parameters([Parameter("use_sim_time", value=simulated)])
    (other,) = node.set_parameters([Parameter("use_sim_time", value=not simulated)])
    assert same.successful
    assert not other.successful
    assert "'use_sim_time' can't be changed" in other.reason
    assert node.get_clock().ros_time_is_active is simulated
