import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.interface import NS_PER_S

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav_msgs.msg import Odometry
from robots import open_field
from sensor_msgs.msg import Imu, LaserScan
from std_srvs.srv import Trigger

from nics_drl_bridge.middleware.measurement import Health, Rejection, TopicHealth
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.link import EPISODE_NS
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode, judge_topics
from nics_drl_bridge.nodes.runner import ERROR, OK, STALE
from nodes.peer import odometry, pose_of, stamp_ns

pytestmark = pytest.mark.ros


@pytest.fixture(scope="module")
def driven(launch, meet, module_domain_id, tmp_path_factory):
    """A middleware beside a simulator that the test drives, and all that is said."""
    world = open_field(tmp_path_factory.mktemp("world"))
    simulator = launch("simulator_node", module_domain_id, mode="lockstep", world=world)
    middleware = launch(
        "middleware_node", module_domain_id, map_frame="site", base_frame="car"
    )
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
            peer.until(
                lambda heard=heard: heard and stamp_ns(heard[-1]) > now,
                f"new {topic}",
                5.0,
            )
            after[topic] = heard[-1]
        return after["odometry/filtered"], after["ground_truth"]

    def newest_ns():
        return max(
            (stamp_ns(estimate) for estimate in said["odometry/filtered"]), default=-1
        )

    def begin():
        """Resets both, and steps until all have found each other."""
        for _ in range(10):
            assert peer.call(Trigger, "middleware_node/reset").success
            assert peer.call(Trigger, "simulator_node/reset").success
            stamp = int(peer.read_episode()[EPISODE_NS])
            try:
                peer.until(
                    lambda stamp=stamp: newest_ns() >= stamp, "the first estimate", 2.0
                )
                return
            except AssertionError:
                continue
        raise AssertionError("no estimate")

    begin()
    yield peer, said, step, begin, commands
    simulator.check()
    middleware.check()


def test_the_estimate_follows_the_robot_and_names_its_frames_and_its_doubt(driven):
    _, said, step, begin, _ = driven
    begin()
    errors = []
    for k in range(40):
        estimate, truth = step(0.6, 0.3 * math.sin(0.3 * k))
        assert stamp_ns(estimate) == stamp_ns(truth)
        believed, twist = conversions.odometry_from_ros(estimate)
        true = pose_of(truth)
        errors.append(math.dist(believed[:2], true[:2]))
    assert max(errors) < 0.15  # over a drive of 2.3 m
    assert twist[0] == pytest.approx(0.6, abs=0.1)
    assert (estimate.header.frame_id, estimate.child_frame_id) == ("site", "car")
    before = said["odometry/filtered"][-40]
    doubts = [np.reshape(m.pose.covariance, (6, 6)) for m in (before, estimate)]
    assert doubts[1][0, 0] > doubts[0][0, 0] > 0.0
    covariances = [m.twist.covariance for m in (estimate, said["odom"][-1])]
    twist, measured = (np.diag(np.reshape(c, (6, 6)))[[0, 5]] for c in covariances)
    assert (twist > 0.0).all()
    assert (twist <= measured + 1.1e-6).all()  # no twist is trusted to less than 1e-3


def test_a_command_of_nan_does_not_reach_the_estimate(driven):
    _, _, step, begin, commands = driven
    begin()
    step(0.5)
    commands.publish(conversions.twist_to_ros([math.nan, 0.0, 0.0]))
    for _ in range(3):
        estimate, _ = step(0.5)
    pose, twist = conversions.odometry_from_ros(estimate)
    assert np.isfinite([*pose, *twist]).all()


def test_what_it_can_not_use_is_counted_in_the_diagnostics(
    launch, meet, domain_id, model
):
    middleware = launch("middleware_node", domain_id, namespace="car")
    peer = meet(domain_id, "car")
    diagnostics = peer.listen(DiagnosticArray, "/diagnostics")
    filtered = peer.listen(Odometry, "odometry/filtered")
    odom, scan = peer.speak(Odometry, "odom"), peer.speak(LaserScan, "scan")

    def status():
        return diagnostics[-1].status[0]

    peer.until(lambda: diagnostics, "diagnostics")
    assert status().level == DiagnosticStatus.STALE
    assert status().message == "nothing on scan, odom yet"
    assert status().name == "/car/middleware_node: topics"
    assert status().hardware_id == "ackermann"

    def drive(x, second):
        stamp = int(second * NS_PER_S)
        odom.publish(odometry(stamp, [x, 0.0, 0.0]))

    def counts():
        return {pair.key: pair.value for pair in status().values}

    drive(math.nan, 1)  # must not become where the map is
    drive(1.0, 2)
    peer.until(lambda: filtered, "an estimate")
    assert pose_of(filtered[-1]) == pytest.approx([1.0, 0.0, 0.0])
    ranges = np.ones(model.lidar.beams, np.float32)
    for stamp, beams in ((3, model.lidar.beams), (3, model.lidar.beams), (4, 7)):
        message = conversions.scan_to_ros(
            model.lidar, ranges[:beams], stamp * NS_PER_S, "laser"
        )
        scan.publish(message)
    for x, second in ((math.nan, 3), (1.0, 2.75), (1.0, 2.75)):
        drive(x, second)
    peer.until(
        lambda: stamp_ns(filtered[-1]) == 2.75 * NS_PER_S, "the estimate at 2.75 s"
    )
    for second in (2.5, 3.5, 2.25):
        drive(1.0, second)
    wanted = {
        "rejected, odom: NaN or inf": "1",
        "rejected, odom: duplicate": "1",
        "rejected, odom: older than 1 s": "1",
        "rejected, scan: duplicate": "1",
        "rejected, scan: shape (7,), not (720,)": "1",
        "late and put in place": "1",
        "scan received": "1",
        "odom received": "4",
    }
    peer.until(lambda: wanted.items() <= counts().items(), f"the counts {wanted}")
    told = {
        "scan rate [Hz]",
        "scan age [s]",
        "odom rate [Hz]",
        "odom age [s]",
        "odom innovation",
    }
    assert counts().keys() == wanted.keys() | told
    assert status().level == DiagnosticStatus.OK
    assert status().message == "receiving"
    log = middleware.read_text()
    assert log.count("rejected data, counted in /diagnostics: ") >= 1
    assert log.count("scan: shape (7,), not (720,)") == 1
    # After a reset an odometry from before counts, as after a restart of the robot.
    assert peer.call(Trigger, "middleware_node/reset").success
    drive(5.0, 1)
    peer.until(
        lambda: stamp_ns(filtered[-1]) == NS_PER_S, "an estimate after the reset"
    )
    assert pose_of(filtered[-1]) == pytest.approx([5.0, 0.0, 0.0])


@pytest.fixture
def sensed(launch, meet, domain_id):
    """A middleware that hears a pose sensor and a gyro, and a robot that the test plays."""
    middleware = launch(
        "middleware_node", domain_id, pose_type="PoseWithCovarianceStamped", imu="imu"
    )
    peer = meet(domain_id)
    said = {
        "filtered": peer.listen(Odometry, "odometry/filtered"),
        "diagnostics": peer.listen(DiagnosticArray, "/diagnostics"),
    }
    speakers = {
        "odom": peer.speak(Odometry, "odom"),
        "pose": peer.speak(PoseWithCovarianceStamped, "pose"),
        "imu": peer.speak(Imu, "imu"),
    }

    def stand(tenths, deadline_s=30.0):
        """An odometry of a robot that stands; returns the estimate after it."""
        stamp = tenths * NS_PER_S // 10
        speakers["odom"].publish(odometry(stamp, [1.0, 0.0, 0.0]))
        heard = said["filtered"]
        peer.until(
            lambda: heard and stamp_ns(heard[-1]) == stamp,
            f"estimate at {tenths} / 10 s",
            deadline_s,
        )
        return heard[-1]

    def meet_it():
        """Says where the robot stands until it is heard: what is said before is lost."""
        for tenths in range(1, 10):
            with contextlib.suppress(AssertionError):
                stand(tenths, 2.0)
                return
        raise AssertionError("no estimate")

    def facts():
        return {
            pair.key: pair.value for pair in said["diagnostics"][-1].status[0].values
        }

    peer.until(lambda: said["diagnostics"], "diagnostics")
    meet_it()
    yield peer, said, speakers, stand, facts
    middleware.check()


def measured_pose(x, y, heading, tenths, std):
    message = PoseWithCovarianceStamped()
    message.header.stamp = conversions.stamp_to_ros(tenths * NS_PER_S // 10)
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation = conversions.heading_to_ros(heading)
    covariance = np.zeros((6, 6))
    covariance[[0, 1, 5], [0, 1, 5]] = std**2
    message.pose.covariance = covariance.ravel()
    return message


def measured_rate(rate, tenths, missing=False):
    message = Imu()
    message.header.stamp = conversions.stamp_to_ros(tenths * NS_PER_S // 10)
    message.angular_velocity.z = rate
    message.angular_velocity_covariance[0] = -1.0 if missing else 0.0
    message.angular_velocity_covariance[8] = 1e-4
    return message


def test_pose_and_gyro_correct_the_estimate_and_are_told_of_in_the_diagnostics(sensed):
    peer, said, speakers, stand, facts = sensed
    first = stand(10)
    peer.until(
        lambda: (
            said["diagnostics"][-1].status[0].message
            == "nothing on scan, pose, imu yet"
        ),
        "the missing topics",
    )
    assert first.pose.covariance[0] == pytest.approx(1e4)  # anywhere in the map
    speakers["pose"].publish(measured_pose(30.0, -20.0, 2.0, 11, 0.05))
    speakers["imu"].publish(measured_rate(0.0, 11))
    peer.until(lambda: {"pose received", "imu received"} <= facts().keys(), "both")
    told = stand(12)
    pose = pose_of(told)
    assert pose == pytest.approx([30.0, -20.0, 2.0], abs=1e-3)
    assert 0.05**2 < told.pose.covariance[0] < 0.06**2
    speakers["imu"].publish(measured_rate(0.0, 13, missing=True))
    wanted = {"rejected, imu: no angular velocity": "1"}
    peer.until(lambda: wanted.items() <= facts().items(), f"the counts {wanted}")


@pytest.mark.parametrize("gyro", [True, False])
def test_the_usual_topics_of_a_gyro_are_heard_if_the_model_was_made_with_one(
    make_node, tmp_path, gyro
):
    save_model(replace(builtin_model("differential"), gyro=gyro), tmp_path / "model")
    node = make_node(f"model:={tmp_path / 'model'}", kind=MiddlewareNode)
    node.configure()
    heard = {subscription.topic_name for subscription in node.subscriptions}
    assert ({"/imu", "/imu/data"} <= heard) == gyro


def test_topics_whose_data_are_refused_are_told_apart_from_silent_ones():
    counts = {
        Rejection("scan", "duplicate"): 1,
        Rejection("scan", "shape (7,), not (720,)"): 40,
        Rejection("scans", "other"): 9,
    }
    expected = ("scan", "odom")
    heard = TopicHealth(1, 10.0, 0.1)
    told = "scan: 41 refused, the last: shape (7,), not (720,)"
    first = Health({}, counts)
    assert judge_topics(first, expected, {}) == (ERROR, f"nothing on odom yet; {told}")
    assert judge_topics(first, expected, counts) == (STALE, "nothing on scan, odom yet")
    before = counts | {Rejection("scan", "shape (7,), not (720,)"): 30}
    assert judge_topics(Health({"odom": heard}, counts), expected, before) == (
        ERROR,
        told,
    )
    stale = {"scan": replace(heard, age_s=6.0), "odom": heard}
    assert judge_topics(Health(stale, counts), expected, before) == (ERROR, told)
    assert judge_topics(Health(stale, counts), expected, counts) == (
        STALE,
        "nothing on scan for 5 s",
    )
    well = Health(dict.fromkeys(expected, heard), counts)
    assert judge_topics(well, expected, before) == (OK, "")


def test_a_pose_type_that_does_not_exist_is_refused_with_the_nearest(make_node):
    node = make_node("pose_type:=PoseStampd", kind=MiddlewareNode)
    with pytest.raises(ConfigError, match="'PoseStampd'; did you mean 'PoseStamped'"):
        node.configure()
