import itertools
import math
import time
from types import SimpleNamespace

import numpy as np
import pytest

from nics_drl_bridge.interface import NS_PER_S

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from domains import claimed_domain
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import SetBool, Trigger

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.extras.simulation_interfaces.roster import Entities
from nics_drl_bridge.nodes import conversions, simulator_node
from nics_drl_bridge.nodes.link import EPISODE_NS
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.simulator import EpisodeSampler
from nics_drl_bridge.sim.world import load_world
from nodes.peer import pose_of, stamp_ns

pytestmark = pytest.mark.ros

FRAMES = {
    "map_frame": "field",
    "odom_frame": "wheels",
    "base_frame": "car",
    "laser_frame": "eye",
}
TOPICS = {"scan": LaserScan, "odom": Odometry, "ground_truth": Odometry}


class Watched:
    """A simulator node and all that it says."""

    def __init__(self, peer):
        self.peer = peer
        self.said = {topic: peer.listen(kind, topic) for topic, kind in TOPICS.items()}
        self.clock = peer.listen(Clock, "/clock")
        self.commands = peer.speak(Twist, "cmd_vel")

    def reset(self, **episode):
        """Resets until the data of it arrive: a first one may come before discovery is over."""
        if episode:
            assert self.peer.set_parameters("simulator_node", **episode).successful
        for _ in range(20):
            answer = self.peer.call(Trigger, "simulator_node/reset")
            assert answer.success, answer.message
            facts = self.peer.read_episode()
            if self.has(int(facts[EPISODE_NS]), patience_s=1.5):
                return facts
        raise AssertionError(f"no data after a reset: {facts}")

    def has(self, stamp, patience_s=30.0):
        """Whether all topics come to a stamp."""
        try:
            self.peer.until(
                lambda: min(self.newest()) >= stamp, f"data of {stamp}", patience_s
            )
        except AssertionError:
            return False
        return True

    def newest(self):
        yield from (stamp_ns(said[-1]) if said else -1 for said in self.said.values())
        yield conversions.stamp_from_ros(self.clock[-1].clock) if self.clock else -1

    def command(self, speed, steering=0.0):
        self.commands.publish(conversions.twist_to_ros([speed, 0.0, steering]))

    def step(self, speed, steering=0.0):
        """A command, and the stamps of all that came of it."""
        known = {topic: len(said) for topic, said in self.said.items()}
        now = stamp_ns(self.said["odom"][-1])
        self.command(speed, steering)
        assert self.has(now + 1), "nothing came of a command"
        return {
            topic: [stamp_ns(m) for m in self.said[topic][n:]]
            for topic, n in known.items()
        }


@pytest.fixture(scope="module")
def lockstep(launch, meet, module_domain_id):
    process = launch(
        "simulator_node", module_domain_id, mode="lockstep", renderer="exact", **FRAMES
    )
    watched = Watched(meet(module_domain_id))
    watched.log = process.log
    watched.reset()
    yield watched
    process.check()


@pytest.fixture(scope="module")
def realtime(launch, meet):
    with claimed_domain() as domain_id:
        process = launch(
            "simulator_node", domain_id, rate=2.0, world="empty", use_sim_time=True
        )
        watched = Watched(meet(domain_id))
        assert watched.has(0), "the simulator says nothing"
        yield watched
        process.check()


@pytest.fixture
def period_ns(model):
    return round(model.control_period * NS_PER_S)


def test_each_command_brings_exactly_one_scan_and_odometry_one_period_later(
    lockstep, period_ns
):
    now = int(lockstep.reset()[EPISODE_NS])
    for _ in range(
        3
    ):  # each call makes the node spin, and without a command time stands
        lockstep.peer.call(SetBool, "simulator_node/pause", SetBool.Request(data=False))
    assert set(lockstep.newest()) == {now}
    for k in range(1, 31):
        expected = [now + k * period_ns]
        assert lockstep.step(0.5, 0.1) == dict.fromkeys(TOPICS, expected)


def test_a_paused_simulator_ignores_commands_until_it_goes_on(lockstep, period_ns):
    now = int(lockstep.reset()[EPISODE_NS])
    lockstep.peer.call(SetBool, "simulator_node/pause", SetBool.Request(data=True))
    lockstep.command(0.5)
    lockstep.peer.call(SetBool, "simulator_node/pause", SetBool.Request(data=False))
    assert set(lockstep.newest()) == {now}
    assert lockstep.step(0.0) == {topic: [now + period_ns] for topic in TOPICS}


def test_the_clock_and_all_stamps_only_ever_grow_also_across_resets(lockstep):
    for _ in range(3):
        lockstep.reset()
        lockstep.step(0.5)
        lockstep.step(0.5)
    clock = [conversions.stamp_from_ros(message.clock) for message in lockstep.clock]
    assert len(clock) > 9
    assert all(a < b for a, b in itertools.pairwise(clock))
    for said in lockstep.said.values():
        assert all(stamp_ns(a) < stamp_ns(b) for a, b in itertools.pairwise(said))
    assert abs(clock[0] * 1e-9 - time.time()) < 600.0  # it began at the system's time


def test_a_reset_begins_where_the_parameters_say_and_tells_what_it_runs(
    lockstep, model
):
    facts = lockstep.reset(episode_seed=3, episode_start=[0.5, -0.25, 1.0])
    assert set(lockstep.newest()) == {int(facts[EPISODE_NS])}
    assert facts["model"] == model.fingerprint
    assert facts["world"] == load_world("arena").fingerprint
    for topic in ("odom", "ground_truth"):
        pose, twist = conversions.odometry_from_ros(lockstep.said[topic][-1])
        assert pose == pytest.approx([0.5, -0.25, 1.0])
        assert twist.tolist() == [0.0, 0.0, 0.0]
    lockstep.reset(episode_start=[math.nan] * 3)
    (drawn,) = EpisodeSampler(model, load_world("arena")).draw([3])[0].starts[0]
    assert pose_of(lockstep.said["ground_truth"][-1]) == pytest.approx(drawn)


def test_setting_a_start_changes_no_other_parameter(make_node):
    node = make_node("world:=empty", kind=simulator_node.SimulatorNode)

    def values():
        parameters = node.get_parameters_by_prefix("").items()
        return {(name, str(parameter.value)) for name, parameter in parameters}

    before = values()
    start = Parameter("episode_start", value=[0.5, 0.0, 1.0])
    assert node.set_parameters([start])[0].successful
    assert {name for name, _ in values() - before} == {"episode_start"}


def test_commands_are_as_old_as_before_when_time_is_put_back(make_node, model_folder):
    given = (f"model:={model_folder}", "world:=empty", "command_timeout:=0.5")
    node = make_node(*given, kind=simulator_node.SimulatorNode)
    node.pause(True)
    for _ in range(100):
        node.step()
    node._on_command(node._ports[0], np.array([0.5, 0.0]))
    node.step()
    assert node.device.commands[0, 0] == 0.5
    node.rewind()
    for _ in range(20):
        node.step()
    assert node.device.commands[0, 0] == 0.0


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"episode_seed": -1}, "episode_seed"),
        ({"episode_start": [1.0, 2.0, math.inf]}, "three finite numbers"),
        ({"episode_start": [1.0, 2.0, math.nan]}, "three finite numbers"),
        ({"episode_start": 6 * [1.0]}, "episode_start has 6 numbers; give 3"),
        ({"episode_seed": 1.5}, "type"),
        ({"world": "empty"}, "read-only"),
    ],
)
def test_a_parameter_it_cant_use_is_refused_with_the_reason(lockstep, values, reason):
    result = lockstep.peer.set_parameters("simulator_node", **values)
    assert not result.successful
    assert reason in result.reason


def test_a_command_that_can_not_be_used_is_ignored_and_told(lockstep, period_ns):
    def said():  # at most every few seconds, whatever there is to complain of
        lockstep.commands.publish(b"\0\7\0\0" + bytes(48))
        return "can't be read" in lockstep.log.read_text()

    now = int(lockstep.reset()[EPISODE_NS])
    lockstep.peer.until(said, "a warning")
    for bad in (math.nan, math.inf, -math.inf):
        lockstep.command(bad)
        lockstep.command(0.0, bad)
    assert lockstep.step(0.5) == {topic: [now + period_ns] for topic in TOPICS}


def test_a_start_that_it_is_started_with_alone_holds(make_node):
    given = ("world:=empty", "episode_start:=[1.0, -1.5, 0.5]")
    node = make_node(*given, kind=simulator_node.SimulatorNode)
    node.begin()
    assert node.device.sensed(0).pose == pytest.approx([1.0, -1.5, 0.5])


def test_all_frames_are_those_of_the_parameters(lockstep):
    scan, odom, truth = (lockstep.said[topic][-1] for topic in TOPICS)
    assert scan.header.frame_id == "eye"
    assert (odom.header.frame_id, odom.child_frame_id) == ("wheels", "car")
    assert (truth.header.frame_id, truth.child_frame_id) == ("field", "car")


def test_in_real_time_it_publishes_at_about_the_rate(realtime, period_ns):
    scans = realtime.said["scan"]
    known, began = len(scans), time.monotonic()
    realtime.peer.until(lambda: len(scans) >= known + 40, "40 scans")
    span_s = time.monotonic() - began
    assert (
        20.0 * (span_s / 2.0) < 40 <= 20.0 * (span_s + 0.5) + 1
    )  # half a second is made up for
    stamps = [stamp_ns(scan) for scan in scans[known:]]
    assert set(np.diff(stamps)) == {period_ns}
    assert not realtime.peer.call(Trigger, "simulator_node/repeat").success


def test_in_real_time_it_stops_the_robot_when_commands_end_though_nan_keeps_coming(
    realtime,
):
    odom = realtime.said["odom"]
    speed = 0.0
    while speed < 0.3:
        realtime.command(0.5)
        speed = realtime.peer.another(odom, "odometry").twist.twist.linear.x
    ended = stamp_ns(odom[-1])
    while abs(speed) > 0.05:
        realtime.command(math.nan)
        speed = realtime.peer.another(odom, "odometry").twist.twist.linear.x
        assert stamp_ns(odom[-1]) - ended < 10 * NS_PER_S
    assert (
        0.4 < (stamp_ns(odom[-1]) - ended) * 1e-9 < 2.0
    )  # simulated; the limit is 0.5 s


def test_as_fast_as_possible_it_outruns_the_clock(launch, meet, domain_id):
    process = launch("simulator_node", domain_id, mode="as_fast_as_possible")
    peer = meet(domain_id)
    scans = peer.listen(LaserScan, "scan")
    peer.until(lambda: scans, "a scan")
    began = time.monotonic()
    first = stamp_ns(scans[-1])
    peer.until(lambda: stamp_ns(scans[-1]) - first > 20 * NS_PER_S, "20 simulated s")
    factor = 20.0 / (time.monotonic() - began)
    assert factor > 2.0
    process.close()


def test_its_joints_tell_the_state_at_the_stamps_of_its_odometry(
    launch, meet, domain_id
):
    launch("simulator_node", domain_id)
    peer = meet(domain_id)
    joints, odom = (
        peer.listen(JointState, "joint_states"),
        peer.listen(Odometry, "odom"),
    )
    command = peer.speak(Twist, "cmd_vel")
    ahead = conversions.twist_to_ros([0.5, 0.0, 0.2])
    peer.until(
        lambda: command.publish(ahead) or (joints and joints[-1].velocity[0] > 0.4),
        "driving",
    )
    assert joints[-1].name == ["speed", "steering"]
    assert joints[-1].position[1] > 0.1
    peer.until(
        lambda: stamp_ns(joints[-1]) in {stamp_ns(each) for each in odom},
        "its odometry",
    )


def test_wheels_turn_as_far_as_the_robot_drives(launch, meet, domain_id):
    launch("simulator_node", domain_id, model="differential", world="empty")
    peer = meet(domain_id)
    joints = peer.listen(JointState, "joint_states")
    truth = peer.listen(Odometry, "ground_truth")
    command = peer.speak(Twist, "cmd_vel")
    ahead = conversions.twist_to_ros([0.5, 0.0, 0.0])
    peer.until(
        lambda: command.publish(ahead) or (joints and joints[-1].position[0] > 10.0),
        "turning wheels",
    )
    poses = {stamp_ns(message): pose_of(message) for message in truth}
    both = [message for message in joints if stamp_ns(message) in poses]
    first, last = both[0], both[-1]
    radius = load_robot("differential").parameters["wheel_radius"]
    way = poses[stamp_ns(last)] - poses[stamp_ns(first)]
    turned = np.subtract(last.position, first.position)
    assert last.name == ["left_wheel", "right_wheel"]
    assert radius * turned == pytest.approx([np.hypot(*way[:2])] * 2, rel=0.02)


@pytest.mark.parametrize(
    ("parameter", "error", "reason"),
    [
        ("mode:=lockstp", BridgeError, "'mode'.*did you mean 'lockstep'"),
        ("model:=/no/such/folder", BridgeError, "no such folder"),
        ("world:=areena", BridgeError, "did you mean 'arena'"),
        ("rate:=fast", ParameterException, "rate"),
        ("rate:=-1.0", ParameterException, "rate"),
        ("episode_start:=[1.0, 2.0]", ParameterException, "has 2 numbers; give 3"),
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
    node._on_command(node._ports[robot], np.array([speed, 0.0]))


def test_a_fleet_in_lock_step_keeps_its_commands_where_a_robot_joins(fleet, period_ns):
    node = fleet.node
    began_ns = node.now_ns
    command(node, 0, 0.25)
    fleet.entities.spawn_robot("cat", np.array([2.0, 2.0, 0.0]))
    node.add_robot("cat")
    command(node, 1, 0.5)
    assert node.now_ns == began_ns, "the new robot has no command yet"
    command(node, 2, 0.75)
    assert node.now_ns == began_ns + period_ns
    assert node.device.commands[:, 0].tolist() == [0.25, 0.5, 0.75]


@pytest.mark.parametrize("gone", [0, 1])
def test_a_fleet_in_lock_step_goes_on_where_the_robot_that_it_waited_for_leaves(
    fleet, period_ns, gone
):
    node = fleet.node
    began_ns = node.now_ns
    command(node, 1 - gone, 0.25)
    left = node._ports[gone]
    fleet.entities.delete(fleet.entities.find(("ant", "bee")[gone]))
    node.remove_robots([gone])
    fleet.settle()
    assert node.now_ns == began_ns + period_ns
    assert node.device.commands[:, 0].tolist() == [0.25]
    node._on_command(left, np.array([0.5, 0.0]))  # which had arrived before it left
    fleet.settle()
    assert node.now_ns == began_ns + period_ns


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
