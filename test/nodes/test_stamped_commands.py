"""`cmd_vel` is a TwistStamped by default since Kilted, and who speaks to a node follows it."""

from contextlib import closing

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Start
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.backends import DdsBackend
from nics_drl_bridge.nodes.command_gate import CommandGate
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode
from nics_drl_bridge.nodes.parameters import is_stamped_default
from nics_drl_bridge.nodes.simulator_node import SimulatorNode
from nics_drl_bridge.sim.world import load_world
from nodes.peer import stamp_ns

pytestmark = pytest.mark.ros


@pytest.mark.parametrize("named", ["", "base_footprint"])
def test_the_gate_sends_stamped_commands_in_the_frame_of_odometry_or_of_its_parameter(
    direct, named
):
    gate = direct(
        f"base_frame:='{named}'", "enable_stamped_cmd_vel:=true", kind=CommandGate
    )
    gate.give("odom", Odometry(child_frame_id="car_1/base"))
    gate.node._tick()
    gate.node.stop()
    for command in gate.sent["cmd_vel"]:
        assert command.header.frame_id == (named or "car_1/base")
        assert stamp_ns(command) > 0
        assert command.twist == Twist()


@pytest.mark.parametrize(
    ("kind", "topic", "fix"),
    [
        (SimulatorNode, "cmd_vel", "set enable_stamped_cmd_vel:=false"),
        (MiddlewareNode, "cmd_vel", "set enable_stamped_cmd_vel:=false"),
        (CommandGate, "cmd_vel_raw", "set foreign_commands:=Twist"),
    ],
)
def test_who_publishes_commands_of_the_other_type_is_named(
    direct, meet, domain_id, logged, kind, topic, fix
):
    node = direct("enable_stamped_cmd_vel:=true", kind=kind)
    stranger = meet(domain_id)
    stranger.node.create_publisher(Twist, topic, 1)

    def list_warnings():
        node.fire_timers()
        return [each for each in logged if "publishes geom" in each]

    stranger.until(list_warnings, "a warning")
    (line,) = list_warnings()
    kinds = "publishes geometry_msgs/msg/Twist, but geometry_msgs/msg/TwistStamped"
    assert f"/{stranger.node.get_name()} {kinds}" in line
    assert fix in line


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
