from __future__ import annotations

import math
import signal
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import Twist, TwistStamped
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.nodes import conversions, qos
from nodes.peer import DEADLINE_S

pytestmark = pytest.mark.ros

SOON_S = 0.5  # what the gate is made for, on a machine with time
LATE_S = 5.0


class Robot:
    """Scans and commands into a gate, and what comes out of it."""

    def __init__(self, peer, lidar):
        self.peer, self.lidar, self.stamp_ns = peer, lidar, 0
        self.passed = peer.listen(Twist, "cmd_vel", qos.COMMAND)
        self.scan = peer.speak(LaserScan, "scan")
        self.raw = peer.speak(TwistStamped, "cmd_vel_raw")

    def scans(self):
        """Publishes the next scan."""
        self.stamp_ns += 1
        ranges = np.ones(self.lidar.beams, np.float32)
        self.scan.publish(conversions.scan_to_ros(self.lidar, ranges, self.stamp_ns, "laser"))

    def asks(self, speed, steering=0.0, stamp_ns=None):
        """Publishes what a policy computed from the last scan, or from another."""
        message = TwistStamped(twist=conversions.twist_to_ros([speed, 0.0, steering]))
        stamp_ns = self.stamp_ns if stamp_ns is None else stamp_ns
        message.header.stamp = conversions.stamp_to_ros(stamp_ns)
        self.raw.publish(message)

    def gets(self, speed, steering=0.0, again=None):
        """Waits for a command, repeating an act as long as it does not come."""
        wanted = conversions.twist_to_ros([speed, 0.0, steering])
        self.passed.clear()
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            if again is not None:
                again()
            self.peer.another(self.passed, "command")
            if self.passed[-1] == wanted:
                return
        raise AssertionError(f"({speed}, {steering}) never came, but {self.passed[-1]}")

    def drives(self, speed=0.5, steering=0.0):
        self.gets(speed, steering, again=lambda: (self.scans(), self.asks(speed, steering)))


@pytest.fixture(scope="module")
def robot(launch, meet, module_domain_id, model):
    gate = launch("command_gate", module_domain_id)
    yield Robot(meet(module_domain_id), model.lidar)
    gate.check()


def test_a_command_with_a_fresh_scan_behind_it_passes(robot):
    robot.drives(0.5, -0.25)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_no_number_becomes_zero(robot, bad):
    robot.drives()
    robot.gets(0.0, again=lambda: (robot.scans(), robot.asks(0.5, bad)))


def test_a_command_is_limited_to_what_the_robot_may_do(robot):
    robot.gets(1.0, 0.5, again=lambda: (robot.scans(), robot.asks(99.0, 99.0)))
    robot.gets(0.0, -0.5, again=lambda: (robot.scans(), robot.asks(-99.0, -99.0)))


def test_a_component_that_the_robot_has_no_use_for_becomes_zero(robot):
    def sideways():
        robot.scans()
        message = TwistStamped(twist=conversions.twist_to_ros([0.5, 0.7, 0.1]))
        message.header.stamp = conversions.stamp_to_ros(robot.stamp_ns)
        robot.raw.publish(message)

    robot.gets(0.5, 0.1, again=sideways)


@pytest.mark.parametrize("off_ns", [1_000_000, 3600 * conversions.NANO])
def test_a_command_stamped_with_an_unknown_scan_becomes_zero(robot, off_ns):
    robot.drives()
    # In the future too: a stamp alone proves nothing.
    robot.gets(
        0.0, again=lambda: (robot.scans(), robot.asks(0.5, stamp_ns=robot.stamp_ns + off_ns))
    )


def test_a_command_repeated_without_new_scans_runs_out(robot):
    robot.drives()
    began = time.monotonic()
    robot.gets(0.0, again=lambda: robot.asks(0.5))
    assert 0.1 < time.monotonic() - began < LATE_S


def test_scans_alone_do_not_keep_a_command_alive(robot):
    robot.drives()
    robot.gets(0.0, again=robot.scans)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_policy_that_dies_or_hangs_stops_the_robot(launch, meet, domain_id, how):
    launch("simulator_node", domain_id, world="empty")
    launch("command_gate", domain_id)
    peer = meet(domain_id)
    passed = peer.listen(Twist, "cmd_vel", qos.COMMAND)
    # As far as the field goes, so that it does not arrive in between.
    policy = launch("policy_node", domain_id, goal=[100.0, 0.0])
    peer.until(lambda: passed and passed[-1].linear.x > 0.0, "the robot drives")
    policy._process.send_signal(how)
    began = time.monotonic()
    peer.until(lambda: passed[-1] == Twist(), "zero", LATE_S)
    print(f"zero {time.monotonic() - began:.2f} s after the {how.name}, wanted within {SOON_S} s")
    passed.clear()
    peer.until(lambda: len(passed) >= 5, "more commands")
    assert passed == [Twist()] * len(passed)
    if how == signal.SIGSTOP:
        policy._process.send_signal(signal.SIGCONT)
        peer.until(lambda: passed[-1].linear.x > 0.0, "the robot drives on once it wakes")


def test_it_leaves_a_zero_command_behind(launch, meet, domain_id, model):
    gate = launch("command_gate", domain_id)
    robot = Robot(meet(domain_id), model.lidar)
    robot.drives()
    assert gate.close() == 0
    robot.peer.until(lambda: robot.passed[-1] == Twist(), "zero")
