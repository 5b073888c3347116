"""policy_node with a policy file, without any library of training, and with other lidars."""

import array
import os

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra 'sb3'")

import torch
from extras.foreign_policies import nets
from geometry_msgs.msg import PoseStamped, TwistStamped
from policy.policy_rig import export_remembering, network
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.middleware import rehearse
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.policy.train.export import export_policy
from nodes.peer import PlayedRobot, odometry, stamp_ns

pytestmark = pytest.mark.ros
torch.set_num_threads(1)

GOAL = [1.5, 0.5]
START_NS = 10**9
PERIOD_NS = 10**8
STILL = TwistStamped().twist
NOTHING_OF_TRAINING = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "stable_baselines3", "mujoco", "tensorboard"):
            raise ImportError(name + " is not to be imported")
sys.meta_path.insert(0, Block())
"""


def read_ranges(angles):
    """Return ranges of smooth surroundings, in sight of every lidar."""
    return (1.6 + 0.7 * np.cos(angles) + 0.3 * np.sin(2.0 * angles)).astype(np.float32)


def scan_of(angles, phase=0.0):
    message = LaserScan(range_min=0.05, range_max=3.0)
    message.angle_min, message.angle_max = float(angles[0]), float(angles[-1])
    message.angle_increment = float((angles[-1] - angles[0]) / (len(angles) - 1))
    message.ranges = array.array("f", read_ranges(angles + phase).tobytes())
    return message


def around(beams):
    return -np.pi + 2.0 * np.pi / beams * np.arange(beams)


def answer(robot, scan, stamp):
    """Show a scan to a robot that stands at the origin; return the command after it."""
    robot.node._topics.now_ns = lambda: stamp
    scan.header.stamp = conversions.stamp_to_ros(stamp)
    robot.give("odom", odometry(stamp))
    robot.give("scan", scan)
    return conversions.twist_from_ros(robot.sent["cmd_vel_raw"][-1].twist)


def drive_in_process(file, model, views, goal=GOAL):
    """Return the commands of a policy in process, for one scan after the other."""
    policy, task = open_policy(str(file), model)
    commands = []
    for ranges in views:
        view = RobotView(np.zeros(3), np.zeros(3), ranges, 0.0, 0.0, 0.0)
        action = policy.act(task.observation(view, {"goal": np.array(goal)}))
        commands.append(task.robot.to_cmd_vel(task.command(action)))
    return np.array(commands)


@pytest.fixture(scope="module")
def file(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "car.onnx"
    task = make_task("navigation", model, {"scan": "around"})
    # so that the node finds it compiled
    task.judge(rehearse(model), {"goal": np.zeros(2)})
    export_policy(network(78, len(model.robot.command)), task, model, path)
    return path


@pytest.fixture
def open_robot(direct):
    """Makes a policy node, `open_robot(file, *parameters)`."""

    def open_(file, *given):
        given = (f"policy:={file}", f"goal:={GOAL}", "rate:=0.0", *given)
        return direct("model:=ackermann", *given, kind=PolicyNode)

    return open_


@pytest.mark.process
def test_without_libraries_of_training_it_commands_what_the_file_does(
    launch_process, meet, domain_id, file, model, tmp_path, monkeypatch
):
    (tmp_path / "sitecustomize.py").write_text(NOTHING_OF_TRAINING, encoding="utf-8")
    paths = [str(tmp_path), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    given = {"policy": str(file), "goal": GOAL, "deadline": 5.0}
    launch_process("policy_node", domain_id, **given)
    robot = PlayedRobot(meet(domain_id), model.lidar)
    raw = robot.peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    robot.peer.until(lambda: robot.send() and raw, "a command")
    seen = np.full(model.lidar.beams, 2.0, np.float32)
    (wanted,) = drive_in_process(file, model, [seen])
    assert np.abs(wanted).max() > 0.0
    command = conversions.twist_from_ros(raw[-1].twist)
    assert command == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize(
    ("angles", "tolerance"),
    [(around(720), 1e-4), (around(1440)[::-1], 0.02), (around(720) + np.pi, 0.02)],
    ids=["its own", "finer-clockwise", "from-zero"],
)
def test_scans_of_another_lidar_give_the_same_command(
    open_robot, file, model, angles, tolerance
):
    robot = open_robot(file, "deadline:=5.0")
    command = answer(robot, scan_of(angles), START_NS)
    (wanted,) = drive_in_process(file, model, [read_ranges(model.lidar.angles)])
    assert command == pytest.approx(wanted, abs=tolerance)


def test_a_foreign_policy_commands_what_it_does_in_process(open_robot, model, tmp_path):
    foreign = nets.write(tmp_path, "three", robot=None)
    robot = open_robot(foreign, "deadline:=5.0")
    command = answer(robot, scan_of(model.lidar.angles), START_NS)
    (wanted,) = drive_in_process(foreign, model, [read_ranges(model.lidar.angles)])
    assert np.abs(wanted[[0, 2]]).min() > 0.01
    assert command == pytest.approx(wanted, abs=1e-4)


def test_scans_that_can_not_fill_its_sectors_are_refused_in_one_sentence_once(
    open_robot, file, logged
):
    robot = open_robot(file, "deadline:=5.0")
    narrow = scan_of(np.linspace(-1.0, 1.0, 200))
    for k in range(3):
        narrow.header.stamp = conversions.stamp_to_ros(START_NS + k)
        robot.give("scan", narrow)
    answer(robot, scan_of(around(720)), START_NS + PERIOD_NS)  # it goes on
    (refusal,) = (line for line in logged if "not used" in line)
    assert "looks from -57.3 to 57.3 deg" in refusal
    assert len(robot.sent["cmd_vel_raw"]) == 1


def test_inferences_that_are_late_every_time_command_zero(open_robot, file):
    robot = open_robot(file, "deadline:=0.000000001", "late_limit:=3")
    for k in range(5):
        robot.give("odom", odometry(START_NS + k * PERIOD_NS))
        scan = scan_of(around(720))
        scan.header.stamp = conversions.stamp_to_ros(START_NS + k * PERIOD_NS)
        robot.give("scan", scan)
    sent = robot.sent["cmd_vel_raw"]
    assert [raw.twist for raw in sent] == [STILL] * 3
    assert "the robot is stopped" in robot.diagnose().message


def test_a_policy_that_fails_when_it_runs_is_one_sentence_and_leaves_a_zero(
    open_robot, file, monkeypatch
):
    onnxruntime = pytest.importorskip("onnxruntime")
    from onnxruntime.capi.onnxruntime_pybind11_state import Fail

    def fail(*_):
        raise Fail("a shape\ndoes not fit")

    robot = open_robot(file, "deadline:=5.0")
    assert np.abs(answer(robot, scan_of(around(720)), START_NS)).max() > 0.0
    monkeypatch.setattr(onnxruntime.InferenceSession, "run", fail)
    sentence = f"{file}: field 'graph': onnxruntime can't run it"
    with pytest.raises(BridgeError, match=sentence):
        answer(robot, scan_of(around(720)), START_NS + PERIOD_NS)
    robot.node.stop()
    assert robot.sent["cmd_vel_raw"][-1].twist == STILL


def test_a_policy_with_a_state_begins_anew_with_a_goal_an_activation_and_after_a_gap(
    open_robot, model, tmp_path, logged
):
    file = tmp_path / "car.onnx"
    export_remembering(file, model, scan="around")
    phases = np.linspace(0.0, 2.0, 6)  # of the surroundings, scan after scan
    views = [read_ranges(model.lidar.angles + phase) for phase in phases]
    wanted = drive_in_process(file, model, views)
    fresh = [drive_in_process(file, model, [view])[0] for view in views]
    assert np.abs(wanted[1:] - fresh[1:]).max() > 0.01  # its state matters
    robot = open_robot(file, "deadline:=5.0")

    def drive(tenths):
        """Show all scans from a time on."""
        commands = []
        for k, phase in enumerate(phases):
            stamp = START_NS + (tenths + k) * PERIOD_NS
            commands.append(answer(robot, scan_of(model.lidar.angles, phase), stamp))
        return commands

    def aim(x):
        goal = PoseStamped()
        goal.pose.position.x, goal.pose.position.y = x, GOAL[1]
        robot.give("goal_pose", goal)

    assert drive(0) == pytest.approx(wanted, abs=1e-4)
    aim(2.5)
    drive(6)
    aim(GOAL[0])
    assert drive(12) == pytest.approx(wanted, abs=1e-4)
    robot.node.trigger_deactivate()
    robot.node.trigger_activate()
    assert drive(18) == pytest.approx(wanted, abs=1e-4)
    logged.clear()
    assert drive(48) == pytest.approx(wanted, abs=1e-4)
    (reset,) = (line for line in logged if "was reset" in line)
    assert "no observation for 2.5 s, longer than the 0.5 s" in reset
    stamps = [stamp_ns(raw) for raw in robot.sent["cmd_vel_raw"]]
    assert len(stamps) == 31  # one for each scan, and a zero
