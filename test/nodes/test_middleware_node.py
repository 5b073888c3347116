from __future__ import annotations

import json
import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import conversions
from nodes.peer import stamp_ns

pytestmark = pytest.mark.ros

VARIANCE = (1e-4,) * 4


@pytest.fixture(scope="module")
def driven(launch, meet, module_domain_id):
    """A middleware beside a simulator that the test drives, and all that is said."""
    simulator = launch("simulator_node", module_domain_id, mode="lockstep", world="empty")
    middleware = launch("middleware_node", module_domain_id, map_frame="site", base_frame="car")
    peer = meet(module_domain_id)
    said = {
        topic: peer.listen(kind, topic)
        for topic, kind in {
            "odom": Odometry,
            "ground_truth": Odometry,
            "odometry/filtered": Odometry,
            "/diagnostics": DiagnosticArray,
        }.items()
    }
    commands = peer.speak(Twist, "cmd_vel", subscribers=2)

    def step(speed, steering=0.0):
        """A command, and the estimate and the truth after it."""
        now = stamp_ns(said["odom"][-1]) if said["odom"] else 0
        commands.publish(conversions.twist_to_ros([speed, 0.0, steering]))
        after = {}
        for topic in ("odom", "ground_truth", "odometry/filtered"):
            heard = said[topic]
            peer.until(lambda heard=heard: heard and stamp_ns(heard[-1]) > now, f"new {topic}", 5.0)
            after[topic] = heard[-1]
        return after["odometry/filtered"], after["ground_truth"]

    def newest_ns():
        return max((stamp_ns(estimate) for estimate in said["odometry/filtered"]), default=-1)

    def begin():
        """Resets both, and steps until all have found each other."""
        for _ in range(10):
            assert peer.call(Trigger, "middleware_node/reset").success
            stamp = json.loads(peer.call(Trigger, "simulator_node/reset").message)["stamp_ns"]
            try:
                peer.until(lambda stamp=stamp: newest_ns() >= stamp, "the first estimate", 2.0)
                return
            except AssertionError:
                continue
        raise AssertionError("no estimate")

    begin()
    yield peer, said, step, begin, commands
    simulator.check()
    middleware.check()


def test_the_estimate_follows_the_robot(driven):
    _, _, step, begin, _ = driven
    begin()
    errors = []
    for k in range(40):
        estimate, truth = step(0.6, 0.3 * math.sin(0.3 * k))
        assert stamp_ns(estimate) == stamp_ns(truth)
        believed, twist = conversions.odometry_from_ros(estimate)
        true = conversions.odometry_from_ros(truth)[0]
        errors.append(math.dist(believed[:2], true[:2]))
    assert max(errors) < 0.15  # over a drive of 2.3 m
    assert twist[0] == pytest.approx(0.6, abs=0.1)


def test_the_estimate_names_its_frames_and_its_doubt(driven):
    _, _, step, begin, _ = driven
    begin()
    first, _ = step(0.5)
    for _ in range(10):
        last, _ = step(0.5)
    assert (last.header.frame_id, last.child_frame_id) == ("site", "car")
    doubts = [np.diag(np.reshape(m.pose.covariance, (6, 6))) for m in (first, last)]
    assert (doubts[0] > 0.0).all()
    assert doubts[1][0] > doubts[0][0]


def test_a_command_of_nan_does_not_reach_the_estimate(driven):
    _, _, step, begin, commands = driven
    begin()
    step(0.5)
    commands.publish(conversions.twist_to_ros([math.nan, 0.0, 0.0]))
    for _ in range(3):
        estimate, _ = step(0.5)
    pose, twist = conversions.odometry_from_ros(estimate)
    assert np.isfinite([*pose, *twist]).all()


def test_diagnostics_come_once_a_second(driven):
    peer, said, _, _, _ = driven
    heard = said["/diagnostics"]
    peer.another(heard, "diagnosis")
    stamps = [conversions.stamp_from_ros(peer.another(heard, "diagnosis").header.stamp)
              for _ in range(3)]  # fmt: skip
    assert np.diff(stamps) * 1e-9 == pytest.approx(1.0, abs=0.5)


def test_what_it_can_not_use_is_counted_in_the_diagnostics(launch, meet, domain_id, model):
    launch("middleware_node", domain_id, namespace="car")
    peer = meet(domain_id, "car")
    diagnostics = peer.listen(DiagnosticArray, "/diagnostics")
    filtered = peer.listen(Odometry, "odometry/filtered")
    odom, scan = peer.speak(Odometry, "odom"), peer.speak(LaserScan, "scan")

    def status():
        return diagnostics[-1].status[0]

    peer.until(lambda: diagnostics, "diagnostics")
    assert status().level == DiagnosticStatus.WARN
    assert status().message == "nothing on scan, odom yet"
    assert status().name == "/car/middleware_node: topics"

    def drive(x, second):
        odom.publish(conversions.odometry_to_ros(
            [x, 0.0, 0.0], [0.0, 0.0, 0.0], second * conversions.NANO, ("odom", "car"), VARIANCE
        ))  # fmt: skip

    def counts():
        return {pair.key: pair.value for pair in status().values}

    drive(math.nan, 1)  # must not become where the map is
    drive(1.0, 2)
    peer.until(lambda: filtered, "an estimate")
    assert conversions.odometry_from_ros(filtered[-1])[0] == pytest.approx([1.0, 0.0, 0.0])
    ranges = np.ones(model.lidar.beams, np.float32)
    for stamp, beams in ((3, model.lidar.beams), (3, model.lidar.beams), (4, 7)):
        message = conversions.scan_to_ros(
            model.lidar, ranges[:beams], stamp * conversions.NANO, "laser"
        )
        scan.publish(message)
    for x, second in ((math.nan, 3), (1.0, 4), (1.0, 4), (1.0, 3)):
        drive(x, second)
    wanted = {
        "rejected, odom: NaN or inf": "1",
        "rejected, odom: duplicate": "1",
        "rejected, odom: out of order": "1",
        "rejected, scan: duplicate": "1",
        "rejected, scan: shape (7,), not (720,)": "1",
        "scan received": "1",
        "odom received": "2",
    }
    peer.until(lambda: counts() == wanted, f"the counts {wanted}")
    assert status().level == DiagnosticStatus.OK
    assert status().message == "receiving"

    # After a reset an odometry from before counts, as after a restart of the robot.
    assert peer.call(Trigger, "middleware_node/reset").success
    drive(5.0, 1)
    peer.until(lambda: stamp_ns(filtered[-1]) == conversions.NANO, "an estimate after the reset")
    assert conversions.odometry_from_ros(filtered[-1])[0] == pytest.approx([5.0, 0.0, 0.0])
