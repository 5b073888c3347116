"""A simulator behind its topics, which the test steps or lets run on a clock of its own."""

import math
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.extras.simulation_interfaces.roster import Entities
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, qos, simulator_node
from nics_drl_bridge.nodes.device_parameters import declare_device, get_timing
from nics_drl_bridge.nodes.link import EPISODE_NS
from nics_drl_bridge.robot.noise import Delay, Latency
from nics_drl_bridge.sim.occupancy import occupancy, standing
from nics_drl_bridge.sim.scenes import SceneSampler
from nics_drl_bridge.sim.simulator import EpisodeSampler
from nics_drl_bridge.sim.world import load_world
from nodes.peer import pose_of, stamp_ns

pytestmark = pytest.mark.ros

FRAMES = (
    "map_frame:=field",
    "odom_frame:=wheels",
    "base_frame:=car",
    "laser_frame:=eye",
)
TOPICS = ("scan", "odom", "ground_truth")
PERIOD_NS = 10**8
TICK_S = 0.005
CLOCK_TICKS = 3
HAS_TF, HAS_ACKERMANN = (
    find_spec(name) is not None for name in ("tf2_msgs", "ackermann_msgs")
)
STAMPED = (
    "enable_stamped_cmd_vel:=true",
    "odom_rate:=50.0",
    "scan_latency:=0.05",
    "frame_prefix:=car/",
    "world:=empty",
)


class Simulated:
    """A simulator that does not spin, and all that it publishes."""

    def __init__(self, direct, clock, *given):
        given = ("model:=ackermann", *given)
        if not any("stamped" in each for each in given):
            given += ("enable_stamped_cmd_vel:=false",)
        self.robot = direct(*given, kind=simulator_node.SimulatorNode)
        self.node = self.robot.node
        self.sent = self.robot.sent
        self._clock = clock

    def command(self, speed, turn=0.0, stamp=None):
        twist = [speed, 0.0, turn]
        message = conversions.twist_to_ros(twist)
        if stamp is not None:
            message = conversions.stamped_to_ros(twist, stamp, "")
        self.robot.give("cmd_vel", message)

    def run(self, seconds):
        """Let real time pass, with the calls of all timers."""
        for k in range(round(seconds / TICK_S)):
            self._clock.now_s += TICK_S
            self.node._on_time()
            if k % CLOCK_TICKS == 0:
                self.node._on_clock()
        return self.sent["odom"][-1].twist.twist.linear.x

    def clocks(self):
        return [conversions.stamp_from_ros(each.clock) for each in self.sent["/clock"]]

    def pose(self, topic="ground_truth"):
        return pose_of(self.sent[topic][-1])


@pytest.fixture
def simulate(direct, clock):
    return lambda *given: Simulated(direct, clock, *given)


@pytest.fixture
def lockstep(simulate):
    return simulate("mode:=lockstep", "renderer:=exact", *FRAMES)


def test_each_command_brings_exactly_one_message_of_each_topic_one_period_later(
    lockstep,
):
    began_ns = lockstep.node.now_ns
    for k in range(1, 11):
        lockstep.command(0.5, 0.1)
        for topic in TOPICS:
            stamps = [stamp_ns(message) for message in lockstep.sent[topic]]
            assert stamps[-2:] == [
                began_ns + (k - 1) * PERIOD_NS,
                began_ns + k * PERIOD_NS,
            ]
    scan, odom, truth = (lockstep.sent[topic][-1] for topic in TOPICS)
    assert scan.header.frame_id == "eye"
    assert (odom.header.frame_id, odom.child_frame_id) == ("wheels", "car")
    assert (truth.header.frame_id, truth.child_frame_id) == ("field", "car")
    known = len(lockstep.sent["scan"])
    assert lockstep.robot.call("~/repeat").success
    assert len(lockstep.sent["scan"]) == known + 1
    assert lockstep.robot.call("~/pause", data=True).message == "paused"
    lockstep.command(0.5)
    assert lockstep.node.now_ns == began_ns + 10 * PERIOD_NS
    assert lockstep.robot.call("~/pause", data=False).message == "running"
    lockstep.command(0.5)
    assert lockstep.node.now_ns == began_ns + 11 * PERIOD_NS


def test_the_clock_and_all_stamps_only_ever_grow_also_across_resets(lockstep, clock):
    for _ in range(3):
        assert lockstep.robot.call("~/reset").success
        lockstep.command(0.5)
        lockstep.command(0.5)
    ticks = lockstep.clocks()
    for stamps in (ticks, *(map(stamp_ns, lockstep.sent[topic]) for topic in TOPICS)):
        assert (np.diff(list(stamps)) > 0).all()
    assert len(ticks) == 10
    assert abs(ticks[0] - clock.time_ns()) < NS_PER_S  # it began at the system's time


def test_a_reset_begins_where_the_parameters_say_and_a_self_test_shows_what_runs(
    lockstep, model
):
    start = [0.5, -0.25, 1.0]
    assert lockstep.robot.set_to(episode_seed=3, episode_start=start).successful
    assert lockstep.robot.call("~/reset").success
    (status,) = lockstep.robot.call("~/self_test").status
    facts = {pair.key: pair.value for pair in status.values}
    assert int(facts[EPISODE_NS]) == stamp_ns(lockstep.sent["scan"][-1])
    assert facts["model"] == model.fingerprint
    assert facts["world"] == load_world("arena").fingerprint
    for topic in ("odom", "ground_truth"):
        pose, twist = conversions.odometry_from_ros(lockstep.sent[topic][-1])
        assert pose == pytest.approx(start)
        assert twist.tolist() == [0.0, 0.0, 0.0]
    assert lockstep.robot.set_to(episode_start=[math.nan] * 3).successful
    lockstep.node.begin()
    (drawn,) = EpisodeSampler(model, load_world("arena")).draw([3])[0].starts[0]
    assert lockstep.pose() == pytest.approx(drawn)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"episode_seed": -1}, "episode_seed"),
        ({"world": "empty"}, "read-only"),
    ],
)
def test_a_parameter_it_cant_use_is_refused_with_the_reason(lockstep, values, reason):
    result = lockstep.robot.set_to(**values)
    assert not result.successful
    assert reason in result.reason


@pytest.mark.parametrize(
    "start", [[1.0, 2.0, math.inf], [1.0, 2.0, math.nan], 6 * [1.0]]
)
def test_no_episode_begins_at_a_start_that_it_cant_use(lockstep, start):
    began_ns = lockstep.node.now_ns
    assert lockstep.robot.set_to(episode_start=start).successful
    answer = lockstep.robot.call("~/reset")
    assert not answer.success
    assert "give x, y, heading of each robot: 3 finite numbers" in answer.message
    assert lockstep.node.now_ns == began_ns


def test_a_command_that_can_not_be_used_is_ignored_and_reported(lockstep, logged):
    began_ns = lockstep.node.now_ns
    lockstep.robot.give("cmd_vel", b"\0\7\0\0" + bytes(48))
    assert "can't be read" in logged[-1]
    for bad in (math.nan, math.inf, -math.inf):
        lockstep.command(bad)
        lockstep.command(0.0, bad)
    assert lockstep.node.now_ns == began_ns
    lockstep.command(0.5)
    assert lockstep.node.now_ns == began_ns + PERIOD_NS


def test_commands_are_as_old_as_before_when_time_is_put_back(simulate):
    node = simulate("world:=empty").node
    node.pause(True)
    for _ in range(100):
        node.step()
    command(node, 0, 0.5)
    node.step()
    assert node.device.commands[0, 0] == 0.5
    node.rewind()
    for _ in range(20):
        node.step()
    assert node.device.commands[0, 0] == 0.0


def test_a_start_that_it_is_started_with_holds_and_no_other_parameter_changes(simulate):
    simulated = simulate("world:=empty", "episode_start:=[1.0, -1.5, 0.5]")
    node = simulated.node

    def read_all():
        parameters = node.get_parameters_by_prefix("").items()
        return {(name, str(parameter.value)) for name, parameter in parameters}

    node.begin()
    assert simulated.pose() == pytest.approx([1.0, -1.5, 0.5])
    before = read_all()
    assert simulated.robot.set_to(episode_start=[0.5, 0.0, 1.0]).successful
    assert {name for name, _ in read_all() - before} == {"episode_start"}


def test_scans_have_their_own_rate_and_latency_and_the_stamp_of_their_measurement(
    simulate,
):
    simulated = simulate(*STAMPED)
    late_s = []
    for _ in range(400):
        known = len(simulated.sent["scan"])
        simulated.run(TICK_S)
        for scan in simulated.sent["scan"][known:]:
            late_s.append((simulated.clocks()[-1] - stamp_ns(scan)) / NS_PER_S)
    assert 0.03 < np.median(late_s) < 0.08  # published every 5 ms, after 50 to 60 ms
    for topic, rate in (("scan", 10), ("odom", 50)):
        steps = np.diff([stamp_ns(message) for message in simulated.sent[topic]])
        assert set(steps[2:]) == {NS_PER_S // rate}
    assert simulated.sent["odom"][-1].header.frame_id == "car/odom"
    assert not simulated.robot.call("~/repeat").success
    ticks = simulated.clocks()
    assert (np.diff(ticks) > 0).all()
    assert len(ticks) > 50.0 * (ticks[-1] - ticks[0]) / NS_PER_S - 1


@pytest.mark.parametrize(
    ("given", "scan_ns", "odom_ns"),
    [
        ({}, (12_000_000, 10_000_000), (3_000_000, 0)),
        (
            {"scan_latency": 0.0, "odom_latency": 0.0, "latency_jitter": 0.0},
            (0, 0),
            (0, 0),
        ),
        ({"scan_latency": 0.05}, (50_000_000, 10_000_000), (3_000_000, 0)),
        ({"latency_jitter": 0.002}, (12_000_000, 2_000_000), (3_000_000, 2_000_000)),
        ({"mode": "lockstep"}, (0, 0), (0, 0)),
    ],
)
def test_a_device_is_as_late_as_was_measured_unless_a_parameter_says_otherwise(
    model, make_node, given, scan_ns, odom_ns
):
    latency = Latency(
        scan=Delay(least=0.012, jitter=0.01), odom=Delay(least=0.003, jitter=0.0)
    )
    node = make_node(*(f"{name}:={value}" for name, value in given.items()))
    declare_device(node, "laser")
    time = get_timing(node, replace(model, latency=latency))
    assert (time.scan_late_ns, time.odom_late_ns) == (scan_ns, odom_ns)


def test_a_stamped_command_drives_the_robot_unless_its_stamp_is_too_old(
    simulate, logged
):
    simulated = simulate(*STAMPED)

    def drive(age_ns):
        for _ in range(100):
            stamp = 0 if age_ns is None else simulated.node.now_ns - age_ns
            simulated.command(0.5, 0.2, stamp)
            speed = simulated.run(0.02)
        return speed

    assert drive(0) > 0.3
    joints = simulated.sent["joint_states"][-1]
    assert joints.name == ["speed", "steering"]
    assert joints.velocity[0] > 0.4
    assert joints.position[1] > 0.1
    assert stamp_ns(joints) == stamp_ns(simulated.sent["odom"][-1])
    logged.clear()
    assert abs(drive(2 * NS_PER_S)) < 0.05
    assert "older than command_timeout" in logged[0]
    assert drive(None) > 0.3  # without a stamp


def test_it_stops_the_robot_when_commands_end_though_nan_keeps_coming(simulate):
    simulated = simulate("world:=empty", "odom_latency:=0.0")
    for _ in range(20):
        simulated.command(0.5)
        speed = simulated.run(0.1)
    assert speed > 0.3
    speeds = []
    for _ in range(20):
        simulated.command(math.nan)
        speeds.append(simulated.run(0.1))
    assert min(speeds[:4]) > 0.3  # the limit is 0.5 s
    assert abs(speeds[-1]) < 0.05


@pytest.mark.skipif(not HAS_ACKERMANN, reason="needs ackermann_msgs: nox -s messages")
def test_a_car_is_driven_by_speed_and_steering_angle(simulate):
    simulated = simulate(*STAMPED)
    message = import_module("ackermann_msgs.msg").AckermannDriveStamped()
    message.drive.speed, message.drive.steering_angle = 0.5, 0.3
    for _ in range(20):
        simulated.robot.give("ackermann_cmd", message)
        speed = simulated.run(0.1)
    assert speed > 0.4
    assert simulated.sent["odom"][-1].twist.twist.angular.z > 0.1


def test_its_transforms_are_those_of_rep_105_or_one_line_says_what_is_missing(
    simulate, logged
):
    simulated = simulate(*STAMPED)
    simulated.run(0.1)
    if not HAS_TF:
        (line,) = (each for each in logged if "tf2_msgs" in each)
        assert "; install it by `nics install tf2_msgs`." in line
        return
    (odom,), (mount,) = (
        simulated.sent[t][-1].transforms for t in ("/tf", "/tf_static")
    )
    assert (odom.header.frame_id, odom.child_frame_id) == ("car/odom", "car/base_link")
    frames = mount.header.frame_id, mount.child_frame_id
    assert frames == ("car/base_link", "car/laser")


def test_the_map_is_that_of_the_episode_and_changes_with_it(simulate, model):
    given = ("episode_seed:=5", "map_resolution:=0.02", "map_frame:=site")
    simulated = simulate("mode:=lockstep", *given)
    world = load_world("arena")
    sampler = SceneSampler(world, model.robot.footprint_radius)
    maps = simulated.sent["map"]
    for seed in (5, 6):
        assert simulated.robot.set_to(episode_seed=seed).successful
        simulated.node.begin()
        for _ in range(2):  # only what is new is published
            simulated.node.map_topic.look()
        scene = standing(sampler, 0, sampler.draw([seed])[0].bodies)
        wanted = occupancy(world, scene, 0.02)
        found = conversions.map_from_ros(maps[-1])
        assert np.array_equal(found.cells, wanted.cells)
        assert found.origin == pytest.approx(wanted.origin)
        assert maps[-1].header.frame_id == "site"
        assert stamp_ns(maps[-1]) == simulated.node.now_ns
    assert len(maps) == 2


def put_at(x, y, heading, frame):
    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    message.pose.pose = conversions.pose_to_ros([x, y, heading], 0, "").pose
    return message


def test_an_initial_pose_puts_the_robot_there_unless_it_can_not_be_used(
    simulate, logged
):
    simulated = simulate("mode:=lockstep", "map_frame:=site")
    before = simulated.pose("odom")
    simulated.robot.give("initialpose", put_at(0.4, -2.2, 1.0, "site"))
    simulated.command(0.0)
    assert simulated.pose() == pytest.approx([0.4, -2.2, 1.0], abs=0.01)
    assert simulated.pose("odom") == pytest.approx(before, abs=0.05)  # it goes on
    for wrong, sentence in (
        (put_at(9.0, 0.0, 0.0, "site"), "(9, 0) m lies outside the world"),
        (put_at(0.0, 0.0, 0.0, "kitchen"), "in the frame 'kitchen' is refused"),
        (put_at(math.nan, 0.0, 0.0, "site"), "an invalid pose is refused"),
    ):
        simulated.robot.give("initialpose", wrong)
        assert sentence in logged[-1]
    simulated.command(0.0)
    assert simulated.pose() == pytest.approx([0.4, -2.2, 1.0], abs=0.01)


def test_in_real_time_it_publishes_at_about_the_rate_and_the_map_to_late_joiners(
    launch, meet, domain_id
):
    given = {"rate": 4.0, "world": "empty", "use_sim_time": True}
    process = launch("simulator_node", domain_id, **given)
    peer = meet(domain_id)
    scans = peer.listen(LaserScan, "scan")
    for _ in range(2):  # the second one joins when it has been published
        maps = peer.listen(OccupancyGrid, "map", qos.LATCHED)
        peer.until(lambda maps=maps: maps and scans, "the map")
    known = len(scans)
    span_s = peer.until(lambda: len(scans) >= known + 40, "40 scans")
    # half a second is made up for
    assert 40.0 * (span_s / 2.0) < 40 <= 40.0 * (span_s + 0.5) + 1
    assert set(np.diff([stamp_ns(scan) for scan in scans[known:]])) == {PERIOD_NS}
    process.check()


def test_as_fast_as_possible_it_steps_whenever_it_has_the_time(simulate):
    simulated = simulate("mode:=as_fast_as_possible", "world:=empty")
    for paused in (False, True):
        began_ns = simulated.node.now_ns
        simulated.node.pause(paused)
        for _ in range(10):
            simulated.robot.fire_timers()
        steps = (simulated.node.now_ns - began_ns) / simulated.node.timing.step_ns
        assert steps == (0 if paused else 10)


@pytest.mark.parametrize(
    ("parameter", "error", "reason"),
    [
        ("mode:=lockstp", BridgeError, "'mode'.*did you mean 'lockstep'"),
        ("model:=/no/such/folder", BridgeError, "no such folder"),
        ("world:=areena", BridgeError, "did you mean 'arena'"),
        ("rate:=fast", ParameterException, "rate"),
        ("rate:=-1.0", ParameterException, "rate"),
        ("episode_start:=[1.0, 2.0]", BridgeError, "3 finite numbers"),
        ("base_frame:=map", BridgeError, "must differ"),
    ],
)
def test_a_wrong_parameter_is_refused_at_the_start(make_node, parameter, error, reason):
    with pytest.raises(error, match=reason):
        make_node(parameter, kind=simulator_node.SimulatorNode)


@pytest.fixture
def fleet(make_node, model_folder):
    """A node with two robots in lock-step, and its entities as the services know them."""
    given = (f"model:={model_folder}", "world:=empty", "mode:=lockstep")
    node = make_node(*given, "robots:=[ant, bee]", kind=simulator_node.SimulatorNode)
    entities = Entities(node.device, node.world, node.robot_names, node.make_simulator)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)

    def settle():
        for _ in range(20):
            executor.spin_once(timeout_sec=0.0)

    yield SimpleNamespace(node=node, entities=entities, settle=settle)
    executor.shutdown(timeout_sec=1.0)


def command(node, robot, speed):
    node.take_command(node._ports[robot], np.array([speed, 0.0]))


def test_a_fleet_in_lock_step_keeps_its_commands_where_a_robot_joins(fleet):
    node = fleet.node
    began_ns = node.now_ns
    command(node, 0, 0.25)
    fleet.entities.spawn_robot("cat", np.array([2.0, 2.0, 0.0]))
    node.add_robot("cat")
    command(node, 1, 0.5)
    assert node.now_ns == began_ns, "the new robot has no command yet"
    command(node, 2, 0.75)
    assert node.now_ns == began_ns + PERIOD_NS
    assert node.device.commands[:, 0].tolist() == [0.25, 0.5, 0.75]


def test_who_has_touched_something_is_shown_by_a_self_test_and_in_words(fleet):
    node = fleet.node
    node.set_parameters(
        [Parameter("episode_start", value=[0.0, 0.0, 0.0, 1.0, 0.0, 3.1])]
    )
    node.begin()
    assert node._test(None, SelfTest.Response()).passed == b"\1"
    assert node._list_touched() == (True, "touched something: nobody")
    for _ in range(20):
        for robot in range(2):
            command(node, robot, 0.5)
    tested = node._test(None, SelfTest.Response())
    assert tested.passed == b"\0"
    facts = {pair.key: pair.value for pair in tested.status[0].values}
    assert (facts["touched, ant"], facts["touched, bee"]) == ("True", "True")
    assert node._list_touched() == (True, "touched something: ant, bee")
    names = [(port.name, port.frames.base, port.frames.laser) for port in node._ports]
    assert names == [(n, f"{n}/base_link", f"{n}/laser") for n in ("ant", "bee")]


@pytest.mark.parametrize("gone", [0, 1])
def test_a_fleet_in_lock_step_goes_on_where_the_robot_that_it_waited_for_leaves(
    fleet, gone
):
    node = fleet.node
    began_ns = node.now_ns
    command(node, 1 - gone, 0.25)
    left = node._ports[gone]
    fleet.entities.delete(fleet.entities.find(("ant", "bee")[gone]))
    node.remove_robots([gone])
    fleet.settle()
    assert node.now_ns == began_ns + PERIOD_NS
    assert node.device.commands[:, 0].tolist() == [0.25]
    node.take_command(left, np.array([0.5, 0.0]))  # which had arrived before it left
    fleet.settle()
    assert node.now_ns == began_ns + PERIOD_NS


class Sender:
    """A publisher that keeps what it sent."""

    def __init__(self):
        self.sent = []

    def publish(self, message):
        self.sent.append(message)


def test_what_waits_for_the_robots_that_stay_is_published_where_another_leaves():
    stays = Sender()
    leaves = Sender()
    outbox = simulator_node.Outbox()
    for publisher in (leaves, stays):
        outbox.send(publisher, b"data", 0, (10, 0))
    outbox.drop([leaves])
    outbox.flush(10)
    assert stays.sent == [b"data"]
    assert leaves.sent == []
