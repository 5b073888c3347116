import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from robots import open_field

from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.identify.fit import measure_coverage
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.nodes import conversions, qos, record_node
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import check
from nics_drl_bridge.robot.spec import load_robot
from nodes.peer import DEADLINE_S, odometry, pose_of

pytestmark = pytest.mark.ros

CAR = load_robot("ackermann")
LONG_S = 180.0
FAST = ("--duration", 40, "--use-sim-time", "--namespace", "bot")
SHARE_OF_PATH = 0.1


class FakeRobot:
    """A robot that goes its own way: what it hears, and odometry of a pose that the test gives."""

    def __init__(self, peer, kind=Twist):
        self.peer = peer
        self.heard = peer.listen(kind, "cmd_vel", qos.COMMAND)
        self.odom = peer.node.create_publisher(Odometry, "odom", qos.SENSOR_RELIABLE)
        self.pose = [3.0, -2.0, 0.0]
        self.sent = 0.0

    def until(self, condition, what, deadline_s=DEADLINE_S):
        """Publishes its pose 50 times a second until something is the case."""

        def met():
            if time.monotonic() - self.sent > 0.02:
                self.sent = time.monotonic()
                stamp = self.peer.node.get_clock().now().nanoseconds
                self.odom.publish(odometry(stamp, self.pose))
            return condition()

        self.peer.until(met, what, deadline_s)

    @property
    def driven(self):
        """Whether it was told to drive."""
        return bool(self.heard) and self.heard[-1] != self.heard[-1].__class__()


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
    node = launch_process("record_node", domain_id, out=str(out))
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


def test_sigterm_and_stamped_commands_in_a_namespace(launch, meet, domain_id, tmp_path):
    robot = FakeRobot(meet(domain_id, "bot"), TwistStamped)
    out = tmp_path / "drive.npz"
    stamped = {"enable_stamped_cmd_vel": True}
    node = launch("record_node", domain_id, "bot", out=str(out), **stamped)
    robot.until(lambda: robot.heard and robot.heard[-1].twist != Twist(), "it drives")
    assert conversions.stamp_from_ros(robot.heard[-1].header.stamp) > 0
    node._process.send_signal(signal.SIGTERM)
    robot.until(lambda: code_of(node) is not None, "it ends")
    robot.peer.until(lambda: robot.heard[-1].twist == Twist(), "zero")
    assert seconds(out) > 0.5


def test_silence_of_odometry_stops_the_robot(launch, meet, domain_id, tmp_path):
    robot = FakeRobot(meet(domain_id))
    out = tmp_path / "drive.npz"
    node = launch("record_node", domain_id, out=str(out))
    robot.until(lambda: robot.driven, "it drives")
    robot.peer.until(lambda: code_of(node) is not None, "it ends without odometry")
    assert code_of(node) == 2
    robot.peer.until(lambda: robot.heard[-1] == Twist(), "zero")
    sentence = (
        f"topic '/odom' (namespace '/', ROS domain {domain_id}): nothing new for 0."
    )
    assert sentence in said(node)
    assert seconds(out) > 0.5


def test_leaving_the_bound_stops_the_robot(launch, meet, domain_id, tmp_path):
    robot = FakeRobot(meet(domain_id))
    out = tmp_path / "drive.npz"
    node = launch("record_node", domain_id, out=str(out), bound=1.5)
    robot.until(lambda: robot.driven, "it drives")
    robot.pose = [3.0, -2.0 + 1.2, 0.0]  # still inside with its radius of 0.26 m
    known = len(robot.heard)
    robot.until(lambda: len(robot.heard) > known + 10, "it goes on")
    assert code_of(node) is None
    robot.pose = [3.0, -2.0 + 1.26, 0.0]
    robot.until(lambda: code_of(node) is not None, "it ends")
    robot.peer.until(lambda: robot.heard[-1] == Twist(), "zero")
    assert code_of(node) == 2
    assert "left its circle of 1.5 m, at x 0.00, y 1.26 m from the start" in said(node)
    assert seconds(out) > 0.5


def test_without_odometry_or_a_listener_it_says_where_it_looked(
    launch, meet, domain_id, tmp_path, monkeypatch
):
    monkeypatch.setattr(record_node, "PATIENCE_S", 2.0)
    out = str(tmp_path / "drive.npz")
    silent = launch("record_node", domain_id, "bot", {"odom": "wheel_odom"}, out=out)
    peer = meet(domain_id)
    unheard = FakeRobot(peer)
    peer.node.destroy_subscription(next(iter(peer.node.subscriptions)))
    deaf = launch("record_node", domain_id, out=out)
    unheard.until(
        lambda: None not in (code_of(silent), code_of(deaf)), "both end", 90.0
    )
    assert (code_of(silent), code_of(deaf)) == (2, 2)
    where = f"(namespace '/bot', ROS domain {domain_id}): nothing arrived within 2 s"
    assert f"topic '/bot/wheel_odom' {where}" in said(silent)
    where = f"(namespace '/', ROS domain {domain_id}): nobody listened within 2 s"
    assert f"topic '/cmd_vel' {where}" in said(deaf)
    assert os.listdir(tmp_path) == []


def test_it_does_not_drive_a_robot_that_somebody_else_drives(
    launch, meet, domain_id, tmp_path
):
    robot = FakeRobot(meet(domain_id))
    robot.peer.speak(Twist, "cmd_vel", 1)
    node = launch("record_node", domain_id, out=str(tmp_path / "drive.npz"))
    robot.until(lambda: code_of(node) is not None, "it ends")
    assert "topic '/cmd_vel': 1 other publisher(s)" in said(node)
    assert robot.heard == []


def test_a_simulator_that_is_faster_than_the_clock_is_noticed(
    launch, meet, domain_id, tmp_path
):
    launch("simulator_node", domain_id, world="empty", rate=4.0)
    peer = meet(domain_id)
    odom = peer.listen(Odometry, "odom")
    peer.until(lambda: odom, "the simulator runs")
    node = launch("record_node", domain_id, out=str(tmp_path / "drive.npz"))
    peer.until(lambda: code_of(node) is not None, "it ends")
    assert re.search(r"stamps advanced by .* s within .*use_sim_time", said(node))


class Nics:
    """`nics record` in a process of its own, in a folder."""

    def __init__(self, folder, domain_id, *options, errors=subprocess.STDOUT):
        self._said = folder / "said"
        environment = {
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        cli = [sys.executable, "-m", "nics_drl_bridge.commands.cli"]
        with self._said.open("wb") as log:
            self.process = subprocess.Popen(
                [*cli, "record", "--yes", *map(str, options)],
                cwd=folder,
                env=os.environ | environment,
                stdout=log,
                stderr=errors,
            )

    @property
    def ended(self):
        return self.process.poll() is not None

    @property
    def said(self):
        return self._said.read_text(encoding="utf-8")


@pytest.fixture
def nics(tmp_path, domain_id):
    """Starts `nics record`; it has ended after the test."""
    started = []

    def start(*options, **errors):
        started.append(Nics(tmp_path, domain_id, *options, **errors))
        return started[-1]

    yield start
    for each in started:
        each.process.kill()
        each.process.wait()


@pytest.mark.process
def test_ctrl_c_on_the_command_line_saves_a_bag_and_tells_what_it_holds(
    nics, meet, domain_id, tmp_path
):
    pytest.importorskip("rosbags")
    robot = FakeRobot(meet(domain_id))
    command = nics("--robot", "ackermann", "--out", "drive")
    robot.until(lambda: robot.driven, "it drives")
    command.process.send_signal(signal.SIGINT)
    robot.until(lambda: command.ended, "it ends")
    assert command.process.returncode == 130, command.said
    robot.peer.until(lambda: robot.heard[-1] == Twist(), "zero")
    assert "interrupted: the robot was told to stop; " in command.said
    assert "s are recorded in drive\n" in command.said
    assert "steering_command: " in command.said
    assert set(os.listdir(tmp_path)) == {"said", "drive", "drive_preview.png"}
    assert seconds(tmp_path / "drive") > 0.5


@pytest.mark.process
@pytest.mark.timeout(480)
@pytest.mark.parametrize("rate", [3.0, pytest.param(1.0, marks=pytest.mark.campaign)])
def test_a_recorded_drive_of_a_simulator_generates_it_again(
    nics, launch, meet, domain_id, tmp_path, rate
):
    save_model(builtin_model("differential"), tmp_path / "model")
    parameters = {"model": str(tmp_path / "model"), "world": open_field(tmp_path)}
    launch("simulator_node", domain_id, "bot", rate=rate, **parameters)
    peer = meet(domain_id, "bot")
    odom = peer.listen(Odometry, "odom")
    heard = peer.listen(Twist, "cmd_vel", qos.COMMAND)
    peer.until(lambda: odom, "the simulator runs")
    spec = load_robot("differential")
    for out in ("drive", "again", "third"):  # a busy machine may hold up odometry
        odom.clear()
        command = nics("--robot", spec.name, "--out", f"{out}.npz", *FAST)
        peer.until(lambda: command.ended, "the drive ends", LONG_S)  # noqa: B023
        if "find out why odometry stopped" in command.said:
            continue
        assert command.process.returncode == 0, command.said
        drive = recorded(tmp_path / f"{out}.npz", spec)
        held_out = identify(drive, spec).held_out
        if held_out.mean_position_error_m < SHARE_OF_PATH * held_out.mean_path_m:
            break
    else:
        pytest.fail(f"no drive generates the robot again: {command.said}")
    after = f"next: nics generate {out}.npz --robot {spec.name} --out {out}_model\n"
    assert command.said.endswith(after)
    assert heard[-1] == Twist()
    poses = np.array([pose_of(message) for message in odom])
    away = np.hypot(*(poses - poses[0])[:, :2].T) + spec.footprint_radius
    assert 0.5 < away.max() < 2.0
    assert all(
        each.share > 0.6 and not each.fault for each in measure_coverage(drive, spec)
    )
