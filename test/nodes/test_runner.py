import itertools
import threading

import pytest
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Bool

from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.nodes import runner
from nics_drl_bridge.nodes.backends import DdsBackend
from nics_drl_bridge.nodes.listener import open_context, spin
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode
from nics_drl_bridge.nodes.parameters import Row
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.nodes.record_node import declare_drive
from nics_drl_bridge.nodes.runner import (
    FAILURE,
    SUCCESS,
    declare_model,
    declare_row,
    explain_ignored_values,
)
from nics_drl_bridge.sim.world import load_world
from nodes.peer import odometry, scan, stamp_ns

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(("domain", "variable"), [(240, "0"), (None, "999")])
def test_a_domain_without_ports_is_one_sentence(monkeypatch, domain, variable):
    monkeypatch.setenv("ROS_DOMAIN_ID", variable)
    with pytest.raises(BackendError, match=r"domain (240|999) is above 232"):
        open_context([], domain_id=domain)


def test_what_speaks_to_topics_refuses_a_robot_without_cmd_vel(
    make_node, tmp_path, monkeypatch
):
    file = tmp_path / "kart.yaml"
    file.write_text("kind: ackermann_throttle\nfootprint_radius: 0.2\n")
    kart = open_model(file)
    monkeypatch.setattr(runner, "open_model", lambda _: kart)
    for drive in (
        lambda: declare_model(make_node()),
        lambda: declare_drive(make_node(f"robot:={file}")),
        lambda: DdsBackend(kart, load_world("empty")),
        lambda: RealtimeBackend(kart, load_world("empty")),
    ):
        with pytest.raises(ConfigError, match="'throttle' names no field of cmd_vel"):
            drive()


def test_a_whole_number_is_taken_for_a_floating_point_parameter(make_node):
    node = make_node("rate:=2", "start:=[1, 2, 3]", "count:=3")
    assert declare_row(node, Row("rate", 1.0, "Of time.", span=(0.1, 10.0))) == 2.0
    assert isinstance(node.get_parameter("rate").value, float)
    assert list(declare_row(node, Row("start", [0.0, 0.0, 0.0], "Pose."))) == [
        1.0,
        2.0,
        3.0,
    ]
    assert declare_row(node, Row("count", 1, "Of robots.")) == 3


def test_an_argument_that_ros_does_not_know_is_one_sentence(domain_id):
    with pytest.raises(
        BackendError, match=r"ROS 2 knows no argument .*--wait.*; write them as in"
    ):
        open_context(["node", "--ros-args", "--wait"], domain_id)


@pytest.mark.parametrize("value", ["0.05", "11", ".nan", "fast", "[1.0]"])
def test_a_value_that_can_not_be_used_is_refused_with_the_parameters_name(
    make_node, value
):
    node = make_node(f"rate:={value}", "robots:=0")
    with pytest.raises(ParameterException, match="rate"):
        declare_row(node, Row("rate", 1.0, "Of time.", span=(0.1, 10.0)))
    with pytest.raises(ParameterException, match=r"robots.*1"):
        declare_row(node, Row("robots", 1, "How many.", span=(1, 100)))


def test_a_description_and_a_range_are_told_to_ros2_param_describe(make_node):
    node = make_node()
    declare_row(node, Row("rate", 1.0, "Of time.", span=(0.1, 10.0), fixed=True))
    told = node.describe_parameter("rate")
    assert (told.description, told.read_only) == ("Of time.", True)
    (span,) = told.floating_point_range
    assert (span.from_value, span.to_value) == (0.1, 10.0)


def test_a_value_that_nothing_reads_is_named_with_the_nearest_parameter(make_node):
    node = make_node("command_timout:=2.0", "qos_overrides./scam.publisher.depth:=3")
    declare_row(node, Row("command_timeout", 0.5, "Silence."))
    node.create_publisher(Bool, "/scan", 1)
    misspelt, quality = explain_ignored_values(node)
    assert "'command_timout'" in misspelt
    assert "did you mean 'command_timeout'?" in misspelt
    assert "'qos_overrides./scam.publisher.depth' is ignored" in quality


def test_a_node_whose_callback_raises_is_stopped_before_its_context_ends(domain_id):
    stopped = []

    class Failing(Node):
        def __init__(self, **options):
            super().__init__("failing", **options)
            runner.call_periodically(self, 0.01, self.fail)

        def fail(self):
            raise BackendError("of the policy")

        def stop(self):
            stopped.append(self.context.ok())

    context = open_context([], domain_id)
    with (
        pytest.raises(BackendError, match="of the policy"),
        runner.open_node(Failing, context) as node,
    ):
        spin(node, threading.Event())
    assert stopped == [True]
    assert not context.ok()


def test_a_node_is_the_only_one_of_its_name_in_its_namespace_until_it_ends(domain_id):
    def open_in(space):
        words = ["node", "--ros-args", "-r", f"__ns:=/{space}"]
        return open_context(words, domain_id)

    told = f"a node '/one/gate' already runs in ROS domain {domain_id}; end it"
    with runner.claim_name(open_in("one"), "gate"):
        with (
            pytest.raises(BackendError, match=told),
            runner.open_node(None, open_in("one"), "gate"),
        ):
            pass
        with runner.claim_name(open_in("two"), "gate"):
            pass
    with runner.claim_name(open_in("one"), "gate"):
        pass


def test_a_policy_is_silent_unless_active_and_leaves_a_zero_when_it_ceases(direct):
    robot = direct(
        "autostart:=false",
        "goal:=[2.0, 0.0]",
        "rate:=0.0",
        "deadline:=5.0",
        kind=PolicyNode,
    )
    node = robot.node
    sent = robot.sent["cmd_vel_raw"]
    tenths = itertools.count(10)

    def look():
        """Show a scan; return the speeds that were commanded so far."""
        stamp = next(tenths) * 10**8
        robot.give("odom", odometry(stamp))
        robot.give("scan", scan(node._model.lidar, stamp, 3.0))
        return [command.twist.linear.x for command in sent]

    assert node.state == "unconfigured"
    assert node.trigger_configure() == SUCCESS
    assert look() == []
    assert node.trigger_activate() == SUCCESS
    speeds = look()
    assert min(speeds) > 0.0
    assert node.trigger_deactivate() == SUCCESS
    assert look() == [*speeds, 0.0]
    assert node.trigger_activate() == SUCCESS
    speeds = look()
    assert speeds[-1] > 0.0
    assert node.trigger_shutdown() == SUCCESS
    assert [command.twist.linear.x for command in sent] == [*speeds, 0.0]


def test_what_a_node_reads_when_it_is_configured_can_be_changed_before_only(make_node):
    node = make_node("autostart:=false", kind=PolicyNode)

    def set_to(name, value):
        return node.set_parameters([Parameter(name, value=value)])[0]

    assert node.trigger_configure() == SUCCESS
    late = set_to("goal", [0.0, 0.0])
    assert not late.successful
    assert "'goal'" in late.reason
    assert "cleanup" in late.reason
    assert node.trigger_cleanup() == SUCCESS
    assert set_to("policy", "dynamic_windowl").successful
    assert node.trigger_configure() == FAILURE
    assert node.state == "unconfigured"
    assert set_to("policy", "dynamic_window").successful
    assert node.trigger_configure() == SUCCESS


def test_a_middleware_publishes_its_estimate_only_while_active_and_its_state_always(
    direct,
):
    robot = direct("autostart:=false", kind=MiddlewareNode)
    node = robot.node
    estimates = robot.sent["odometry/filtered"]
    stamps = iter(range(10**9, 10**10, 10**8))

    def hear():
        robot.give("odom", odometry(next(stamps)))
        return robot.diagnose().message, len(estimates)

    assert robot.diagnose().message == "unconfigured"
    assert not robot.call("~/reset").success
    assert node.trigger_configure() == SUCCESS
    assert robot.diagnose().message == "nothing usable on scan, odom"
    hear()
    assert estimates == []
    assert node.trigger_activate() == SUCCESS
    hear()
    assert [stamp_ns(estimate) for estimate in estimates] == [11 * 10**8]
    assert node.trigger_deactivate() == SUCCESS
    assert hear()[1] == 1
    assert node.trigger_cleanup() == SUCCESS
    assert robot.diagnose().message == "unconfigured"


@pytest.mark.parametrize("autostart", [True, False])
def test_a_mistake_in_configure_ends_a_node_that_leads_itself_and_no_other(
    make_node, monkeypatch, logged, autostart
):
    def fail(_):
        raise TypeError("a mistake of ours")

    monkeypatch.setattr(PolicyNode, "configure", fail)
    node = make_node(f"autostart:={autostart}", kind=PolicyNode)
    if autostart:
        with pytest.raises(TypeError, match="a mistake of ours"):
            node.start()
        return
    node.start()
    node.trigger_configure()
    assert node.state == "unconfigured"
    assert "TypeError: a mistake of ours" in logged
