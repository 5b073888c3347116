import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.sim.occupancy import occupancy, standing
from nics_drl_bridge.sim.scenes import SceneSampler
from nics_drl_bridge.sim.world_set import load_worlds
from nodes.peer import pose_of, stamp_ns

pytestmark = pytest.mark.ros
SEED = 5


def at(x, y, heading=0.0, frame="map"):
    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation = conversions.heading_to_ros(heading)
    return message


def stands_at(truths):
    return pose_of(truths[-1])


@pytest.fixture(scope="module")
def simulated(launch, meet, module_domain_id):
    """A simulator, and what it says of its world."""
    peer = meet(module_domain_id)
    simulator = launch(
        "simulator_node",
        module_domain_id,
        world="arena",
        episode_seed=SEED,
        odom_rate=10.0,
        map_resolution=0.02,
        map_frame="site",
    )
    truths = peer.listen(Odometry, "ground_truth")
    odoms = peer.listen(Odometry, "odom")
    poses = peer.speak(PoseWithCovarianceStamped, "initialpose")
    peer.until(lambda: truths and odoms, "the robot")
    yield peer, simulator, truths, odoms, poses
    simulator.check()


def begin_another_episode(simulated, seed):
    """What was heard last is of the new episode, as of a clock that begins to be heard in it."""
    peer, _, truths, odoms, _ = simulated
    assert peer.set_parameters("simulator_node", episode_seed=seed).successful
    assert peer.call(Trigger, "simulator_node/reset").success
    clocks = peer.listen(Clock, "/clock")
    peer.until(lambda: clocks, "the clock")
    now_ns = conversions.stamp_from_ros(clocks[0].clock)
    peer.until(
        lambda: min(stamp_ns(truths[-1]), stamp_ns(odoms[-1])) > now_ns, "the episode"
    )


def wanted(model, seed):
    world = load_worlds("arena")
    sampler = SceneSampler(world, model.robot.footprint_radius)
    return occupancy(world, standing(sampler, 0, sampler.draw([seed])[0].bodies), 0.02)


def test_the_map_of_the_episode_comes_to_whoever_joins_however_late(simulated, model):
    peer = simulated[0]
    grid = wanted(model, SEED)
    for _ in range(2):  # the second one joins when it has been published
        maps = peer.listen(OccupancyGrid, "map", qos.LATCHED)
        peer.until(lambda maps=maps: maps, "the map")
        found = conversions.map_from_ros(maps[-1])
        assert maps[-1].header.frame_id == "site"
        assert np.array_equal(found.cells, grid.cells)
        assert found.resolution == pytest.approx(0.02)
        assert found.origin == pytest.approx(grid.origin)


def test_the_map_of_the_next_episode_comes_by_itself_with_its_time(simulated, model):
    peer, _, truths, *_ = simulated
    maps = peer.listen(OccupancyGrid, "map", qos.LATCHED)
    peer.until(lambda: maps, "the map")
    begin_another_episode(simulated, SEED + 1)
    new = wanted(model, SEED + 1).cells.tobytes()
    peer.until(lambda: maps[-1].data.tobytes() == new, "the map of the next episode")
    period_ns = 100_000_000  # of the odometry, and so of a step
    assert (stamp_ns(maps[-1]) - stamp_ns(truths[0])) % period_ns == 0


def test_the_clock_ticks_at_50_hz_in_real_time_and_never_back(simulated):
    peer = simulated[0]
    clocks = peer.listen(Clock, "/clock")
    peer.until(lambda: len(clocks) > 200, "the clock")
    times_ns = np.array([conversions.stamp_from_ros(each.clock) for each in clocks])
    assert (np.diff(times_ns) > 0).all()
    assert (len(times_ns) - 1) / ((times_ns[-1] - times_ns[0]) * 1e-9) >= 50.0


def test_an_initial_pose_puts_the_robot_there_and_its_odometry_goes_on(simulated):
    peer, _, truths, odoms, poses = simulated
    before = pose_of(odoms[-1])
    poses.publish(at(0.4, -2.2, 1.0, "site"))
    peer.until(
        lambda: math.dist(stands_at(truths)[:2], (0.4, -2.2)) < 0.01, "the robot there"
    )
    assert stands_at(truths)[2] == pytest.approx(1.0, abs=0.01)
    peer.another(odoms, "odometry")
    assert pose_of(odoms[-1]) == pytest.approx(before, abs=0.05)


def test_an_initial_pose_that_can_not_be_used_is_refused_with_a_sentence(simulated):
    peer, simulator, truths, _, poses = simulated
    stood = stands_at(truths)
    for wrong, sentence in (
        (at(9.0, 0.0, frame="site"), "x 9.00 m, y 0.00 m is outside the world"),
        (at(0.0, 0.0, frame="kitchen"), "in the frame 'kitchen' is refused"),
        (at(math.nan, 0.0, frame="site"), "an invalid pose is refused"),
    ):
        poses.publish(wrong)
        peer.until(lambda text=sentence: text in simulator.log.read_text(), sentence)
    peer.another(truths, "truth")
    assert stands_at(truths) == pytest.approx(stood, abs=0.05)
