"""policy_node with a policy file, where nothing of training can be imported, and other lidars."""

import array
import os
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
pytest.importorskip("torch", reason="needs the extra 'train'")

from extras.foreign_policies import nets
from geometry_msgs.msg import PoseStamped, TwistStamped
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from policy.policy_rig import export_remembering, network
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.middleware import rehearse
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.policy.train.export import export_policy
from nodes.peer import odometry, stamp_ns

pytestmark = pytest.mark.ros

GOAL = [1.5, 0.5]
NOTHING_OF_TRAINING = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "stable_baselines3", "mujoco", "tensorboard"):
            raise ImportError(name + " is not to be imported")
sys.meta_path.insert(0, Block())
"""


def read_ranges(angles):
    """A smooth surrounding, in sight of every lidar."""
    return (1.6 + 0.7 * np.cos(angles) + 0.3 * np.sin(2.0 * angles)).astype(np.float32)


def scan_of(angles, backwards=False):
    message = LaserScan(range_min=0.05, range_max=3.0)
    message.header.frame_id = "laser"
    ordered = angles[::-1] if backwards else angles
    message.angle_min, message.angle_max = float(ordered[0]), float(ordered[-1])
    message.angle_increment = float((ordered[-1] - ordered[0]) / (len(ordered) - 1))
    message.ranges = array.array("f", read_ranges(ordered).tobytes())
    return message


def around(beams):
    return -np.pi + 2.0 * np.pi / beams * np.arange(beams)


class Robot:
    """A robot that stands at the origin of the map and looks around."""

    def __init__(self, peer):
        self.peer = peer
        self.raw = peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
        self.scans = peer.speak(LaserScan, "scan")
        self.odometry = peer.speak(Odometry, "odom")

    def says(self, scan, stamp=None):
        """Publishes a scan and an odometry of now or a stamp; returns it [ns]."""
        now = stamp or time.time_ns()
        scan.header.stamp = conversions.stamp_to_ros(now)
        self.odometry.publish(odometry(now))
        self.scans.publish(scan)
        return now

    def hears(self, scan, count=3):
        """The command for a scan, repeated until the node has answered some."""
        known, stamps = len(self.raw), set()

        def answered():
            stamps.add(self.says(scan))
            return (
                len([raw for raw in self.raw[known:] if stamp_ns(raw) in stamps])
                >= count
            )

        self.peer.until(answered, "commands")
        return conversions.twist_from_ros(self.raw[-1].twist)


@pytest.fixture(scope="module")
def file(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "car.onnx"
    task = make_task("navigation", model, {"scan": "around"})
    task.judge(
        rehearse(model), {"goal": np.zeros(2)}
    )  # so that the node finds it compiled
    export_policy(network(78, len(model.robot.command)), task, model, path)
    return path


@pytest.fixture(scope="module")
def driving(launch_process, meet, module_domain_id, file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("blocked")
    (folder / "sitecustomize.py").write_text(NOTHING_OF_TRAINING, encoding="utf-8")
    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
        given = {"policy": str(file), "goal": GOAL, "deadline": 5.0}
        node = launch_process("policy_node", module_domain_id, **given)
    robot = Robot(meet(module_domain_id))
    yield robot, node
    node.check()


def wanted(file, model):
    """What the policy commands in process, in the same place."""
    policy = load_policy(file)
    task = policy.make_task(model)
    view = RobotView(
        np.zeros(3), np.zeros(3), read_ranges(model.lidar.angles), 0.0, 0.0, 0.0
    )
    action = policy.act(task.observation(view, {"goal": np.array(GOAL)}))
    return task.robot.to_cmd_vel(task.command(action))


def test_it_commands_what_the_file_does_in_process(driving, file, model):
    robot, _ = driving
    command = robot.hears(scan_of(model.lidar.angles))
    assert np.abs(command).max() > 0.0
    assert command == pytest.approx(wanted(file, model), abs=1e-4)


@pytest.mark.parametrize(
    ("angles", "backwards"),
    [(around(1440), True), (around(720) + np.pi, False)],
    ids=["finer-clockwise", "from-zero"],
)
def test_scans_of_another_lidar_give_the_same_command(
    driving, file, model, angles, backwards
):
    robot, _ = driving
    command = robot.hears(scan_of(angles, backwards))
    assert command == pytest.approx(wanted(file, model), abs=0.02)


def test_a_foreign_policy_commands_what_it_does_in_process(
    launch, meet, domain_id, model, tmp_path
):
    foreign = nets.write(tmp_path, "three", robot=None)
    node = launch(
        "policy_node", domain_id, policy=str(foreign), goal=GOAL, deadline=5.0
    )
    command = Robot(meet(domain_id)).hears(scan_of(model.lidar.angles))
    (expected,) = driven_in_process(foreign, model, [0.0], GOAL[0])
    assert np.abs(expected[[0, 2]]).min() > 0.01
    assert command == pytest.approx(expected, abs=1e-4)
    node.check()


def test_scans_that_cannot_fill_its_sectors_are_refused_in_one_sentence_once(
    driving, model
):
    robot, node = driving
    narrow = scan_of(np.linspace(-1.0, 1.0, 200))

    def refused():
        robot.says(narrow)
        return "scan is not used" in node.log.read_text(encoding="utf-8")

    robot.peer.until(refused, "a refusal")
    known = len(robot.raw)
    for _ in range(5):
        robot.says(narrow)
    robot.hears(scan_of(model.lidar.angles))  # it goes on with one that can
    log = node.log.read_text(encoding="utf-8")
    assert log.count("scan is not used") == 1
    assert "looks from -57.3 to 57.3 deg" in log
    assert len(robot.raw) > known


def test_inferences_that_are_late_every_time_command_zero(
    launch, meet, domain_id, file, model
):
    launch(
        "policy_node",
        domain_id,
        policy=str(file),
        goal=GOAL,
        deadline=1e-9,
        late_limit=3,
    )
    robot = Robot(meet(domain_id))
    assert robot.hears(scan_of(model.lidar.angles)).tolist() == [0.0, 0.0, 0.0]
    assert all(
        conversions.twist_from_ros(raw.twist).tolist() == [0.0] * 3 for raw in robot.raw
    )


def test_a_policy_that_fails_when_it_runs_leaves_a_zero_and_ends_with_a_sentence(
    launch, meet, domain_id, file, monkeypatch
):
    onnxruntime = pytest.importorskip("onnxruntime")
    from onnxruntime.capi.onnxruntime_pybind11_state import Fail

    def fails(*_):
        raise Fail("a shape\ndoes not fit")

    node = launch("policy_node", domain_id, policy=str(file), goal=GOAL, deadline=5.0)
    robot = Robot(meet(domain_id))
    assert np.abs(robot.hears(scan_of(around(720)))).max() > 0.0
    monkeypatch.setattr(onnxruntime.InferenceSession, "run", fails)

    def ended():
        robot.says(scan_of(around(720)))
        return node._process.poll() is not None

    robot.peer.until(ended, "the end of policy_node")
    still = TwistStamped().twist
    robot.peer.until(lambda: robot.raw[-1].twist == still, "a zero command")
    sentence = node.log.read_text(encoding="utf-8").splitlines()[-1]
    assert sentence.startswith(f"{file}: field 'graph': onnxruntime can't run it (")
    assert "Traceback" not in node.log.read_text(encoding="utf-8")
    assert node.close() == 2


# A policy with a state: what it commands depends on what it saw before.

PHASES = np.linspace(0.0, 2.0, 6)  # of the surroundings that it sees, scan after scan


@pytest.fixture(scope="module")
def remembering(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("remembering") / "car.onnx"
    export_remembering(path, model, scan="around")
    return path


@pytest.fixture
def stateful(launch, meet, domain_id, remembering):
    given = {"policy": str(remembering), "goal": GOAL, "deadline": 5.0, "rate": 0.0}
    node = launch("policy_node", domain_id, **given)
    robot = Robot(meet(domain_id))
    robot.goals = robot.peer.speak(PoseStamped, "goal_pose")
    robot.peer.until(
        lambda: robot.raw or robot.says(scan_of(around(720))) is None, "a command"
    )
    yield robot, node
    node.check()


def scan_at(angles, phase):
    scan = scan_of(angles)
    scan.ranges = array.array("f", read_ranges(angles + phase).tobytes())
    return scan


def aims(robot, node, x):
    """Gives another goal, from which the policy starts over."""
    known = node.log.read_text(encoding="utf-8").count("new goal")
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.position.y = x, GOAL[1]

    def heard():
        robot.goals.publish(goal)
        return node.log.read_text(encoding="utf-8").count("new goal") > known

    robot.peer.until(heard, "a new goal")


def drives(robot, phases, angles, first_ns, period_s=0.1):
    """Shows scan after scan, each answered before the next; returns the commands."""
    commands = []
    for k, phase in enumerate(phases):
        stamp = first_ns + round(k * period_s * 1e9)
        scan, known = scan_at(angles, phase), len(robot.raw)

        def answered(scan=scan, stamp=stamp):
            robot.says(scan, stamp)
            return any(stamp_ns(raw) == stamp for raw in robot.raw[known:])  # noqa: B023

        robot.peer.until(answered, "an answer")
        found = [raw for raw in robot.raw[known:] if stamp_ns(raw) == stamp]
        assert len(found) == 1  # a scan that is heard twice is answered once
        commands.append(conversions.twist_from_ros(found[0].twist))
    return np.array(commands)


def driven_in_process(file, model, phases, x):
    policy, task = open_policy(str(file), model)
    commands = []
    for phase in phases:
        seen = read_ranges(model.lidar.angles + phase)
        view = RobotView(np.zeros(3), np.zeros(3), seen, 0.0, 0.0, 0.0)
        action = policy.act(task.observation(view, {"goal": np.array([x, GOAL[1]])}))
        commands.append(task.robot.to_cmd_vel(task.command(action)))
    return np.array(commands)


def test_a_policy_with_a_state_commands_over_dds_what_it_does_in_process(
    stateful, remembering, model
):
    robot, node = stateful
    wanted = driven_in_process(remembering, model, PHASES, 1.7)
    fresh = [driven_in_process(remembering, model, [phase], 1.7)[0] for phase in PHASES]
    assert np.abs(wanted[1:] - fresh[1:]).max() > 0.01  # its state matters
    begin = time.time_ns()
    for k, x in enumerate((1.7, 2.5, 1.7)):  # nothing is to be left of the goal before
        aims(robot, node, x)
        first = begin + round(k * 0.1e9 * len(PHASES))
        commands = drives(robot, PHASES, model.lidar.angles, first)
        if x == 1.7:
            assert commands == pytest.approx(wanted, abs=1e-4)


def test_a_policy_that_is_activated_again_begins_anew(stateful, remembering, model):
    robot, node = stateful
    aims(robot, node, 1.7)
    begin = time.time_ns()
    before = drives(robot, PHASES[:3], model.lidar.angles, begin)
    for transition in ("deactivate", "activate"):
        request = ChangeState.Request()
        request.transition.label = transition
        assert robot.peer.call(ChangeState, "policy_node/change_state", request).success
    after = drives(robot, PHASES[:3], model.lidar.angles, begin + 3 * 10**8)
    assert after == pytest.approx(before, abs=1e-4)


def test_after_a_gap_it_begins_anew_and_says_so_once(stateful, remembering, model):
    robot, node = stateful
    aims(robot, node, 1.7)
    begin = time.time_ns()
    wanted = driven_in_process(remembering, model, PHASES, 1.7)
    before = drives(robot, PHASES, model.lidar.angles, begin)
    after = drives(robot, PHASES, model.lidar.angles, begin + 3 * 10**9)
    assert before == pytest.approx(wanted, abs=1e-4)
    assert after == pytest.approx(wanted, abs=1e-4)
    log = node.log.read_text(encoding="utf-8")
    assert log.count("the state was reset") == 1
    assert "no observation for 2.5 s, longer than the 0.5 s" in log
