"""Managed nodes in each state, and what their transitions do."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nics_drl_bridge.nodes.runner import FAILURE, SUCCESS
from nodes.in_process import LINES
from nodes.peer import odometry, stamp_ns

pytestmark = pytest.mark.ros


def test_a_policy_is_silent_unless_active_and_leaves_one_zero(launch, meet, domain_id):
    peer = meet(domain_id)
    start = {"episode_start": [-2.0, 0.0, 0.0]}
    launch("simulator_node", domain_id, world="empty", **start)
    policy = launch("policy_node", domain_id, autostart=False, goal=[2.0, 0.0])
    raw = peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    odom = peer.listen(Odometry, "odom")

    def lead(transition):
        request = ChangeState.Request()
        request.transition.label = transition
        # To configure may mean to compile.
        node = "policy_node/change_state"
        return peer.call(ChangeState, node, request, times=1, each_s=200.0).success

    def state():
        return peer.call(GetState, "policy_node/get_state").current_state.label

    def wait_for(count):
        until = len(odom) + count
        peer.until(lambda: len(odom) >= until, f"{count} periods")

    assert state() == "unconfigured"
    assert not lead("activate")  # there is no such transition yet
    assert lead("configure")
    assert state() == "inactive"
    wait_for(5)
    assert not raw
    assert lead("activate")
    assert state() == "active"
    peer.until(lambda: raw and raw[-1].twist.linear.x > 0.1, "driving")
    assert lead("deactivate")
    peer.until(lambda: raw[-1].twist.linear.x == 0.0, "a zero command")
    known = len(raw)
    wait_for(10)
    assert len(raw) == known
    assert [message.twist.linear.x == 0.0 for message in raw[-2:]] == [False, True]
    policy.check()


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


def test_a_policy_that_is_shut_down_while_it_drives_stops_its_robot(direct):
    robot = direct("goal:=[2.0, 0.0]", "rate:=0.0", "deadline:=5.0", kind=PolicyNode)
    lidar = robot.node._model.lidar
    ranges = np.full(lidar.beams, 3.0, np.float32)
    scan = conversions.scan_to_ros(lidar, ranges, 10**9, "laser")
    robot.give("odom", odometry(10**9))
    robot.give("scan", scan)
    raw = robot.sent["cmd_vel_raw"]
    assert raw[-1].twist.linear.x > 0.0
    assert robot.node.trigger_shutdown() == SUCCESS
    assert raw[-1].twist == TwistStamped().twist


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
    assert robot.diagnose().message == "nothing on scan, odom yet"
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
    make_node, monkeypatch, autostart
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
    assert "TypeError: a mistake of ours" in LINES["MainThread"]
