from contextlib import closing

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.listener import holds
from nics_drl_bridge.nodes.watching import RosSource
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.watch.server import Request

pytestmark = pytest.mark.ros

PATIENCE_S = 90.0


@pytest.fixture
def watched(launch, model, domain_id):
    """Topics of a simulator in real time, on the page's source."""
    launch("simulator_node", domain_id, world="arena", mode="realtime")
    with closing(RosSource(model, None, domain_id=domain_id)) as source:
        yield source, domain_id


def frame_where(source, fits):
    """The first frame that fits."""
    found = []

    def look():
        source.advance()
        found[:] = [source.frame()]
        return fits(found[0].worlds[0])

    assert holds(look, PATIENCE_S, 0.02), found[0]
    return found[0]


def test_live_topics_are_shown_and_a_goal_of_the_page_goes_out(watched, meet):
    source, domain_id = watched
    assert source.frame().worlds[0].state == "waiting for topics"
    seen = frame_where(source, lambda world: np.isfinite(world.shot.ranges).any())
    shot = seen.worlds[0].shot
    assert shot.ranges.shape == (1, 720)
    assert np.all(np.linalg.eigvalsh(shot.covariance[0]) > 0.0)
    assert "scan" in seen.note

    peer = meet(domain_id)
    goals = peer.listen(PoseStamped, "goal_pose", qos.COMMAND)
    peer.until(lambda: source._goals.get_subscription_count() >= 2, "a listener")
    assert not source.take(Request(kind="goal", x=1.5, y=-0.5))
    frame_where(source, lambda world: world.shot.goals.tolist() == [[1.5, -0.5]])
    peer.until(lambda: goals, "the goal")
    assert goals[0].header.frame_id == "map"


def test_a_goal_goes_out_in_the_frame_that_the_estimate_names(meet, model, domain_id):
    peer = meet(domain_id)
    goals = peer.listen(PoseStamped, "goal_pose", qos.COMMAND)
    estimates = peer.node.create_publisher(
        Odometry, "odometry/filtered", qos.SENSOR_RELIABLE
    )
    message = Odometry()
    message.header.frame_id = "hall"
    peer.node.create_timer(0.02, lambda: estimates.publish(message))
    with closing(RosSource(model, None, domain_id=domain_id)) as source:

        def answered():
            source.take(Request(kind="goal", x=1.0, y=1.0))
            return goals and goals[-1].header.frame_id == "hall"

        peer.until(answered, "a goal in the estimate's frame", 20.0)


def test_a_goal_off_the_given_world_is_refused_before_it_goes_out(model, domain_id):
    with closing(RosSource(model, load_world("arena"), domain_id=domain_id)) as source:
        for x, reason in ((1e7, "lies outside the world"), (3.0, "is in a wall")):
            with pytest.raises(ConfigError, match=rf"goal: .* {reason}; the field is"):
                source.take(Request(kind="goal", x=x))
