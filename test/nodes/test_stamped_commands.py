"""`cmd_vel` is a TwistStamped by default since Kilted, and who speaks to a node follows it."""

from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry

from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.interface import Start
from nics_drl_bridge.nodes import qos, record_node
from nics_drl_bridge.nodes.backends import DdsBackend
from nics_drl_bridge.nodes.command_gate import CommandGate
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.parameters import is_stamped_default
from nics_drl_bridge.sim.world import load_world
from nodes.peer import stamp_ns

pytestmark = pytest.mark.ros

KINDS = {True: TwistStamped, False: Twist}


@pytest.mark.parametrize("named", ["", "base_footprint"])
def test_the_gate_sends_stamped_commands_in_the_frame_of_odometry_or_of_its_parameter(
    launch, meet, domain_id, named
):
    peer = meet(domain_id)
    heard = peer.listen(TwistStamped, "cmd_vel", qos.COMMAND)
    odom = peer.node.create_publisher(Odometry, "odom", qos.SENSOR_RELIABLE)
    peer.node.create_timer(
        0.05, lambda: odom.publish(Odometry(child_frame_id="car_1/base"))
    )
    gate = launch(
        "command_gate", domain_id, enable_stamped_cmd_vel=True, base_frame=named
    )
    frame = named or "car_1/base"
    peer.until(lambda: heard and heard[-1].header.frame_id == frame, frame)
    before = stamp_ns(heard[-1])
    assert before > 0
    assert stamp_ns(peer.another(heard, "zero")) > before
    heard.clear()
    assert gate.close() == 0
    peer.until(lambda: heard, "a zero command")
    assert heard[-1].twist == Twist()


def test_a_frame_that_is_none_is_refused_by_the_gate(make_node):
    with pytest.raises(ConfigError, match="parameter 'base_frame'"):
        make_node("base_frame:=/base", kind=CommandGate)


def test_an_env_follows_the_type_that_a_simulator_hears_and_its_frame(
    launch, meet, domain_id, model
):
    frames = {"base_frame": "base_footprint", "frame_prefix": "car_1/"}
    given = {"mode": "lockstep", "world": "empty", "enable_stamped_cmd_vel": True}
    simulator = launch("simulator_node", domain_id, **given, **frames)
    peer = meet(domain_id)
    peer.until(lambda: "running" in simulator.read_text(), "its start")
    heard = peer.listen(TwistStamped, "cmd_vel", qos.EVERY_COMMAND)
    with closing(
        DdsBackend(model, load_world("empty"), domain_id=domain_id)
    ) as backend:
        assert backend._link.stamped
        backend.reset(Start(seed=1, pose=np.zeros(3)))
        ahead = np.array([0.5, 0.0])
        peer.until(lambda: backend.step(ahead) and heard, "a command")
        assert heard[-1].header.frame_id == "car_1/base_footprint"


def test_without_anybody_who_listens_it_is_the_distributions_type(domain_id):
    link = Link(domain_id=domain_id)
    assert link.stamped is is_stamped_default()
    link.begin()
    link.close()


def test_an_estimator_names_who_publishes_commands_of_the_other_type(
    launch, meet, domain_id
):
    process = launch("middleware_node", domain_id, enable_stamped_cmd_vel=True)
    peer = meet(domain_id)
    peer.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
    peer.until(
        lambda: "set enable_stamped_cmd_vel:=false" in process.read_text(), "a warning"
    )


def test_a_drive_whose_chosen_type_nobody_hears_names_who_hears_the_other(
    launch, meet, domain_id, tmp_path, monkeypatch
):
    monkeypatch.setattr(record_node, "PATIENCE_S", 2.0)
    peer = meet(domain_id)
    other = not is_stamped_default()
    peer.listen(KINDS[other], "cmd_vel", qos.COMMAND)
    odom = peer.node.create_publisher(Odometry, "odom", qos.SENSOR_RELIABLE)
    peer.node.create_timer(0.02, lambda: odom.publish(Odometry()))
    out = str(tmp_path / "d.npz")
    chosen = {"enable_stamped_cmd_vel": not other}
    node = launch("record_node", domain_id, out=out, **chosen)
    fix = f"set enable_stamped_cmd_vel:={str(other).lower()}"
    peer.until(
        lambda: fix in node.read_text(),
        "the reason",
    )
    assert "expects geometry_msgs/msg/" in node.read_text()


def test_an_env_whose_chosen_type_nobody_hears_names_who_hears_the_other(
    meet, domain_id, model
):
    meet(domain_id).listen(Twist, "cmd_vel", qos.COMMAND)
    sentence = r"/cmd_vel: /peer_\d+ expects geometry_msgs/msg/Twist there.*set `stamped` to False"
    with pytest.raises(BackendError, match=sentence):
        DdsBackend(
            model, load_world("empty"), domain_id=domain_id, stamped=True, timeout_s=3.0
        )


def test_the_gate_names_who_publishes_raw_commands_of_the_other_type(
    launch, meet, domain_id
):
    peer = meet(domain_id)
    gate = launch("command_gate", domain_id)
    peer.node.create_publisher(Twist, "cmd_vel_raw", qos.COMMAND)
    peer.until(
        lambda: "set foreign_commands:=Twist" in gate.read_text(), "the warning", 20.0
    )
