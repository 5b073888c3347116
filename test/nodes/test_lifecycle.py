import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry

from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nodes.peer import stamp_ns

pytestmark = pytest.mark.ros


@pytest.fixture(scope="module")
def managed(launch, meet, module_domain_id):
    """A driving simulator, and a policy and a middleware that wait to be led."""
    peer = meet(module_domain_id)
    start = {"episode_start": [-2.0, 0.0, 0.0]}
    simulator = launch("simulator_node", module_domain_id, world="empty", **start)
    nodes = [
        launch("policy_node", module_domain_id, autostart=False, goal=[2.0, 0.0]),
        launch("middleware_node", module_domain_id, autostart=False),
    ]
    yield peer
    for node in (simulator, *nodes):
        node.check()


def lead(peer, node, transition):
    request = ChangeState.Request()
    request.transition.label = transition
    # To configure may mean to compile.
    return peer.call(
        ChangeState, f"{node}/change_state", request, times=1, each_s=200.0
    ).success


def state(peer, node):
    return peer.call(GetState, f"{node}/get_state").current_state.label


def test_a_policy_is_silent_until_it_is_active(managed):
    raw = managed.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    odom = managed.listen(Odometry, "odom")
    assert state(managed, "policy_node") == "unconfigured"
    assert not lead(
        managed, "policy_node", "activate"
    )  # there is no such transition yet
    assert lead(managed, "policy_node", "configure")
    assert state(managed, "policy_node") == "inactive"
    known = len(odom)
    managed.until(lambda: len(odom) >= known + 5, "5 periods")
    assert not raw
    assert lead(managed, "policy_node", "activate")
    assert state(managed, "policy_node") == "active"
    managed.until(lambda: raw and raw[-1].twist.linear.x > 0.1, "driving")


def test_a_deactivated_policy_says_zero_once_and_nothing_after(managed):
    raw = managed.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    odom = managed.listen(Odometry, "odom")
    managed.until(lambda: raw and raw[-1].twist.linear.x > 0.1, "driving")
    assert lead(managed, "policy_node", "deactivate")
    managed.until(lambda: raw[-1].twist.linear.x == 0.0, "a zero command")
    known = len(raw)
    heard = len(odom)
    managed.until(lambda: len(odom) >= heard + 10, "10 periods")
    assert len(raw) == known
    assert [message.twist.linear.x == 0.0 for message in raw[-2:]] == [False, True]


def test_what_a_node_reads_when_it_is_configured_can_be_changed_before_only(managed):
    assert state(managed, "policy_node") == "inactive"
    late = managed.set_parameters("policy_node", goal=[0.0, 0.0])
    assert not late.successful
    assert "'goal'" in late.reason
    assert "cleanup" in late.reason
    assert lead(managed, "policy_node", "cleanup")
    assert managed.set_parameters("policy_node", policy="dynamic_windowl").successful
    assert not lead(managed, "policy_node", "configure")
    assert state(managed, "policy_node") == "unconfigured"
    assert managed.set_parameters("policy_node", policy="dynamic_window").successful
    assert lead(managed, "policy_node", "configure")
    assert lead(managed, "policy_node", "activate")


def test_a_policy_that_is_shut_down_while_it_drives_stops_its_robot(managed):
    raw = managed.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    managed.until(lambda: raw and raw[-1].twist.linear.x > 0.1, "driving")
    assert lead(managed, "policy_node", "shutdown")
    assert state(managed, "policy_node") == "finalized"
    managed.until(lambda: raw[-1].twist.linear.x == 0.0, "a zero command")


def test_a_middleware_publishes_its_estimate_only_while_active_and_its_health_always(
    managed,
):
    filtered = managed.listen(Odometry, "odometry/filtered")
    diagnostics = managed.listen(DiagnosticArray, "/diagnostics")

    def message():
        return diagnostics[-1].status[0].message if diagnostics else ""

    managed.until(lambda: message() == "unconfigured", "a diagnosis")
    assert lead(managed, "middleware_node", "configure")
    managed.until(lambda: message() == "inactive", "a diagnosis")
    assert not filtered
    assert lead(managed, "middleware_node", "activate")
    managed.until(lambda: message() == "receiving" and filtered, "an estimate")
    assert lead(managed, "middleware_node", "deactivate")
    known, last = len(diagnostics), stamp_ns(filtered[-1])
    managed.until(lambda: len(diagnostics) >= known + 2, "2 more diagnoses")
    assert stamp_ns(filtered[-1]) == last
    assert lead(managed, "middleware_node", "cleanup")
    managed.until(lambda: message() == "unconfigured", "a diagnosis")


@pytest.fixture
def mistaken(monkeypatch):
    def configure(_):
        raise TypeError("a mistake of ours")

    monkeypatch.setattr(PolicyNode, "configure", configure)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_mistake_in_configure_ends_a_node_that_leads_itself(
    launch, domain_id, mistaken
):
    node = launch("policy_node", domain_id)
    assert node.wait() == 1
    assert "TypeError: a mistake of ours" in node.read_text()


def test_a_mistake_in_configure_leaves_a_node_that_is_led_unconfigured(
    launch, meet, domain_id, mistaken
):
    peer = meet(domain_id)
    node = launch("policy_node", domain_id, autostart=False)
    assert not lead(peer, "policy_node", "configure")
    assert state(peer, "policy_node") == "unconfigured"
    assert "TypeError: a mistake of ours" in node.read_text()
    assert node.close() == 0
