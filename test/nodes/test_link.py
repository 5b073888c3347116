"""A link leaves nothing open, wherever the constructor of its backend fails."""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes import backends, link
from nics_drl_bridge.nodes.backends import DdsBackend, FleetBackend
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.sim.world import load_world

pytestmark = pytest.mark.ros


@pytest.fixture
def opened(monkeypatch):
    """The contexts and nodes that links have opened."""
    contexts = []
    nodes = []

    def open_context(**options):
        contexts.append(OPEN(**options))
        return contexts[-1]

    class Node(link.qos.QosWatch):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            nodes.append(self)

    monkeypatch.setattr(link, "open_context", open_context)
    monkeypatch.setattr(link.qos, "QosWatch", Node)
    return contexts, nodes


OPEN = link.open_context


def nothing_is_open(opened):
    contexts, nodes = opened
    assert contexts, "nothing was opened"
    assert not any(context.ok() for context in contexts)
    for node in nodes:
        with pytest.raises(Exception, match="destruction was requested"), node.handle:
            pass
    return True


def fail(*_, **__):
    raise KeyboardInterrupt


def test_a_link_whose_publisher_can_not_be_made_leaves_nothing_open(
    opened, monkeypatch, domain_id
):
    monkeypatch.setattr(link, "CommandTimeout", fail)
    with pytest.raises(KeyboardInterrupt):
        Link(domain_id=domain_id)
    assert nothing_is_open(opened)


def test_a_link_that_is_interrupted_while_it_looks_for_listeners_leaves_nothing_open(
    opened, monkeypatch, domain_id
):
    monkeypatch.setattr(Link, "hears_stamped", fail)
    with pytest.raises(KeyboardInterrupt):
        Link(domain_id=domain_id)
    assert nothing_is_open(opened)


@pytest.mark.parametrize(
    "make", [DdsBackend, lambda *a, **o: FleetBackend(*a, ["a", "b"], **o)]
)
def test_a_backend_whose_services_can_not_be_made_leaves_nothing_open(
    opened, monkeypatch, domain_id, model, make
):
    monkeypatch.setattr(backends, "EpisodeServices", fail)
    with pytest.raises(KeyboardInterrupt):
        make(model, load_world("empty"), domain_id=domain_id, timeout_s=0.2)
    assert nothing_is_open(opened)


def test_a_backend_that_finds_no_simulator_leaves_nothing_open(
    opened, domain_id, model
):
    with pytest.raises(BackendError, match="there is still no"):
        DdsBackend(model, load_world("empty"), domain_id=domain_id, timeout_s=0.2)
    assert nothing_is_open(opened)


def test_a_backend_with_a_wrong_option_leaves_nothing_open(opened, domain_id, model):
    options = {"domain_id": domain_id, "pose_type": "Pose", "timeout_s": 0.2}
    with pytest.raises(ConfigError, match="pose_type"):
        RealtimeBackend(model, load_world("empty"), **options)
    assert nothing_is_open(opened)


def test_a_link_that_was_never_begun_is_closed_twice(opened, domain_id):
    made = Link(domain_id=domain_id)
    made.close()
    made.close()
    assert nothing_is_open(opened)
