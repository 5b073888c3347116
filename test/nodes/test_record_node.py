import os
import re
import signal
import time

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from robots import open_field

from nics_drl_bridge.identify.fit import measure_coverage
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.nodes import conversions, qos, record_node
from nics_drl_bridge.nodes.simulator_node import SimulatorNode
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import check
from nics_drl_bridge.robot.spec import load_robot
from nodes.peer import DEADLINE_S, odometry, pose_of

pytestmark = pytest.mark.ros

CAR = load_robot("ackermann")
SHARE_OF_PATH = 0.1


class FakeRobot:
    """A robot that stands whatever it is told."""

    def __init__(self, peer):
        self.peer = peer
        self.heard = peer.listen(Twist, "cmd_vel", qos.COMMAND)
        self.odom = peer.node.create_publisher(Odometry, "odom", qos.SENSOR_RELIABLE)
        self.sent = 0.0

    def until(self, condition, what, deadline_s=DEADLINE_S):
        """Publish its pose 50 times a second until a condition holds."""

        def met():
            if time.monotonic() - self.sent > 0.02:
                self.sent = time.monotonic()
                stamp = self.peer.node.get_clock().now().nanoseconds
                self.odom.publish(odometry(stamp, [3.0, -2.0, 0.0]))
            return condition()

        self.peer.until(met, what, deadline_s)

    @property
    def driven(self):
        """Return whether it was told to drive."""
        return bool(self.heard) and self.heard[-1] != Twist()


def said(node):
    return node.log.read_text(encoding="utf-8")


def code_of(node):
    return node._process.poll()


def recorded(path, spec=CAR):
    return check(read_recording(path, spec), spec)


def seconds(path):
    return float(np.ptp(recorded(path).command.t))


@pytest.mark.process
def test_ctrl_c_leaves_a_zero_command_and_a_whole_recording(
    launch_process, meet, domain_id, tmp_path
):
    robot = FakeRobot(meet(domain_id))
    out = tmp_path / "drive.npz"
    node = launch_process("record_node", domain_id, out=str(out), duration=20.0)
    robot.until(lambda: robot.driven, "it drives")
    node._process.send_signal(signal.SIGINT)
    robot.until(lambda: code_of(node) is not None, "it ends")
    assert code_of(node) == 0
    robot.peer.until(lambda: robot.heard[-1] == Twist(), "zero")
    assert robot.heard[-5:] == [Twist()] * 5
    assert seconds(out) > 0.5
    assert "interrupted: the robot was told to stop" in said(node)
    assert f"are recorded in {out}" in said(node)
    assert os.listdir(tmp_path) == ["drive.npz"]


class Drive:
    """A record node on a clock of the test, and the odometry of its robot."""

    def __init__(self, direct, clock, *given, words=()):
        self._clock = clock
        given = ("robot:=ackermann", "duration:=20.0", *given)
        self.robot = direct(*given, kind=record_node.RecordNode, words=words)
        self.node = self.robot.node
        self.sent = self.robot.sent["cmd_vel"]
        self.stamp_s = clock.now_s

    def run(self, seconds, y=-2.0, pace=1.0):
        """Publish the pose 50 times a second, stamped at a pace."""
        for _ in range(round(seconds * 50)):
            if self.node.outcome is not None:
                break
            self._clock.now_s += 0.02
            self.stamp_s += 0.02 * pace
            message = odometry(round(self.stamp_s * 1e9), [3.0, y, 0.0])
            self.robot.give("odom", message)
            self.node._on_time()
        return self

    def wait(self, seconds):
        self._clock.now_s += seconds
        self.node._on_time()


@pytest.fixture
def open_drive(direct, clock, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return lambda *given, **options: Drive(direct, clock, *given, **options)


def leave(drive):
    drive.run(1.0, -2.0 + 1.2)  # still inside with its radius of 0.26 m
    assert drive.node.outcome is None
    drive.run(0.1, -2.0 + 1.26)


PLAIN = "enable_stamped_cmd_vel:=false"
ENDS = {
    "odometry falls silent": (
        lambda drive: drive.wait(0.6),
        "topic '/odom' .namespace '/', ROS domain .*: nothing new for 0.60 s .* 0.5 s",
    ),
    "the robot leaves": (
        leave,
        "left its circle of 1.5 m, at x 0.00, y 1.26 m from the start",
    ),
}


@pytest.mark.parametrize("end", ENDS)
def test_a_fault_stops_the_robot_and_the_drive_is_saved(open_drive, end):
    drive = open_drive(PLAIN, "bound:=1.5").run(3.0)
    assert drive.sent[-1] != Twist()
    act, sentence = ENDS[end]
    act(drive)
    outcome = drive.node.outcome
    assert re.search(sentence, str(outcome.failure))
    assert "the robot was told to stop" in outcome.line
    assert drive.sent[-5:] == [Twist()] * 5
    assert seconds("drive.npz") > 0.5


def test_a_drive_sends_stamped_commands_in_the_frame_of_odometry_and_can_be_stopped(
    open_drive,
):
    drive = open_drive("enable_stamped_cmd_vel:=true").run(3.0)
    assert drive.sent[-1].twist != Twist()
    assert conversions.stamp_from_ros(drive.sent[-1].header.stamp) > 0
    assert drive.sent[-1].header.frame_id == "base_link"
    drive.node.stop()
    assert drive.sent[-1].twist == Twist()
    assert drive.node.outcome.line.startswith("interrupted: the robot was told to stop")
    assert seconds("drive.npz") > 0.5


def test_a_simulator_that_is_faster_than_the_clock_is_noticed(open_drive):
    drive = open_drive(PLAIN).run(1.5, pace=4.0)
    sentence = r"stamps advanced by .* s within .*use_sim_time"
    assert re.search(sentence, str(drive.node.outcome.failure))


@pytest.mark.parametrize(
    ("missing", "sentence"),
    [
        ("odometry", "topic '/bot/wheel_odom' (namespace '/bot', ROS domain "),
        ("a listener", "topic '/bot/cmd_vel' (namespace '/bot', ROS domain "),
        ("the only driver", "topic '/bot/cmd_vel': 1 other publisher(s)"),
    ],
)
def test_a_robot_that_can_not_be_driven_is_not_moved(
    open_drive, meet, domain_id, monkeypatch, missing, sentence
):
    words = ("-r", "__ns:=/bot", "-r", "odom:=wheel_odom")
    drive = open_drive(PLAIN, words=words)
    if "listener" in missing:
        monkeypatch.setattr(drive.node._topic, "get_subscription_count", lambda: 0)
    other = meet(domain_id)
    if missing == "the only driver":
        other.node.create_publisher(Twist, "/bot/cmd_vel", 1)
        other.until(lambda: drive.node.count_publishers("/bot/cmd_vel") > 1, "it")
    if missing != "odometry":
        drive.run(0.1)
    if missing != "the only driver":
        assert drive.node.outcome is None
        drive.wait(11.0)
    outcome = drive.node.outcome
    assert sentence in str(outcome.failure)
    assert "the robot was not moved; nothing is recorded" in outcome.line
    assert drive.sent == []
    assert os.listdir() == []


def test_ctrl_c_on_the_command_line_saves_a_bag_and_tells_what_it_holds(
    interrupt, meet, domain_id, tmp_path
):
    pytest.importorskip("rosbags")
    robot = FakeRobot(meet(domain_id))

    def play():
        robot.until(lambda: robot.driven, "it drives")
        begin = time.monotonic()
        robot.until(lambda: time.monotonic() - begin > 2.0, "it drives on")

    words = "record --yes --robot ackermann --out drive --duration 20"
    done = interrupt(play, words)
    told = done.stdout + done.stderr
    assert done.returncode == 130, told
    robot.peer.until(lambda: robot.heard[-1] == Twist(), "zero")
    assert "interrupted: the robot was told to stop; " in told
    assert "s are recorded in drive\n" in told
    assert "steering_command: " in told
    assert set(os.listdir(tmp_path)) == {"drive", "drive_preview.png"}
    assert seconds(tmp_path / "drive") > 0.5


def test_a_recorded_drive_of_a_simulator_generates_it_again(
    direct, clock, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    spec = load_robot("differential")
    given = (PLAIN, "model:=differential", f"world:={open_field(tmp_path)}")
    simulated = direct(*given, kind=SimulatorNode)
    drive = Drive(direct, clock, PLAIN, "robot:=differential")
    poses = []
    relayed = 0
    while drive.node.outcome is None:
        clock.now_s += 0.005
        simulated.node._on_time()
        poses += map(pose_of, simulated.sent["odom"])
        for topic in ("joint_states", "odom"):
            for message in simulated.sent[topic]:
                drive.robot.give(topic, message)
            simulated.sent[topic].clear()
        drive.node._on_time()
        for command in drive.sent[relayed:]:
            simulated.give("cmd_vel", command)
        relayed = len(drive.sent)
    assert drive.node.outcome.complete, drive.node.outcome.line
    assert drive.sent[-1] == Twist()
    recording = recorded("drive.npz", spec)
    held_out = identify(recording, spec).held_out
    assert held_out.mean_position_error_m < SHARE_OF_PATH * held_out.mean_path_m
    away = np.hypot(*(np.array(poses) - poses[0])[:, :2].T) + spec.footprint_radius
    assert 0.5 < away.max() < 2.0
    for each in measure_coverage(recording, spec):
        assert each.share > 0.6
        assert not each.fault
