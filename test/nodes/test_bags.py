import json
import os
import resource
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags
import command_line
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.extras.bags.info import read_bag_info
from nics_drl_bridge.middleware.playback import estimate
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.recording.bag_file import open_bag
from nodes.peer import odometry, stamp_ns

pytestmark = [pytest.mark.ros, pytest.mark.process, pytest.mark.timeout(240)]

ENDS_S = 60.0
SMALL_FILE = 100_000  # bytes


def small_drive(path):
    """Write two seconds of odometry and commands, at different times."""
    topics = {
        "/odom": [
            (t + 0.01, bags.moving_odometry(t, bags.place_at(t), (0.5, 0.0, 0.25)))
            for t in bags.times(0.05, 2.0)
        ],
        "/cmd_vel": [
            (t + 0.013, bags.twist(0.5, 0.0, 0.1 * np.sin(t)))
            for t in bags.times(0.1, 2.0)
        ],
    }
    return bags.write(path, topics)


class Robot:
    """Publishes what is to be recorded."""

    def __init__(self, peer):
        self.peer = peer
        self.sent = 0
        self.odom = peer.node.create_publisher(Odometry, "odom", qos.SENSOR)
        self.command = peer.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)

    def until(self, condition, what):
        """Publish until a condition holds."""

        def met():
            stamp = self.peer.node.get_clock().now().nanoseconds
            self.odom.publish(odometry(stamp))
            self.command.publish(conversions.twist_to_ros([0.1, 0.0, 0.0]))
            self.sent += 1
            return condition()

        self.peer.until(met, what, ENDS_S)


def test_a_recorder_writes_a_whole_bag_at_ctrl_c(interrupt, meet, domain_id, tmp_path):
    robot = Robot(meet(domain_id))
    out = tmp_path / "drive"
    ends = (robot.odom, robot.command)

    def play():
        robot.until(
            lambda: all(end.get_subscription_count() > 0 for end in ends), "a recorder"
        )
        until = robot.sent + 40
        robot.until(lambda: robot.sent > until, "40 more messages")

    done = interrupt(play, "bag record", out, "--json")
    assert done.returncode == 0, done.stderr
    counts = {topic.topic: topic.count for topic in read_bag_info(out).topics}
    assert json.loads(done.stdout) == {"path": str(out), "messages": counts}
    assert min(counts["/odom"], counts["/cmd_vel"]) >= 30
    with open_bag(out) as bag:
        assert [offer.reliable for offer in bag.offers("/odom")] == [False]
        assert [offer.depth for offer in bag.offers("/cmd_vel")] == [1]
    assert {path.name for path in tmp_path.iterdir()} == {"drive"}


def count_on_disk(folder):
    """Count the messages of an unfinished bag that are on the disk."""
    unfinished = list(folder.glob(".drive.*/drive"))
    if not unfinished or not any(
        file.stat().st_size > 20_000 for file in unfinished[0].iterdir()
    ):
        return 0
    return bags.unfinished_messages(unfinished[0])


@pytest.mark.parametrize(
    "storage", ["mcap", pytest.param("sqlite3", marks=pytest.mark.campaign)]
)
def test_a_recorder_flushes_and_tells_where_the_bag_lies_once_the_storage_is_full(
    storage, meet, domain_id, tmp_path
):
    """What was flushed stays, whatever ends the recorder."""
    robot = Robot(meet(domain_id))
    place = tmp_path / "drive"
    cli = [sys.executable, "-m", "nics_drl_bridge.commands.cli"]
    recorder = subprocess.Popen(
        [*cli, "bag", "record", str(place), "--storage", storage],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain_id)},
        stderr=subprocess.PIPE,
        text=True,
    )
    robot.until(lambda: robot.odom.get_subscription_count() > 0, "a recorder of odom")
    robot.until(lambda: count_on_disk(tmp_path) > 10, "a flush")
    assert recorder.poll() is None
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (SMALL_FILE, SMALL_FILE))
    robot.until(lambda: recorder.poll() is not None, "its end")
    err = recorder.communicate(timeout=ENDS_S)[1]
    assert recorder.returncode == 2
    assert "Traceback" not in err
    (left,) = tmp_path.glob(".drive.*/drive")
    (told,) = (line for line in err.splitlines() if "drive" in line)
    assert told.startswith(f"nics: {place}: ")
    assert f"the data written so far are in {left}" in told
    assert bags.unfinished_messages(left) > 10


@pytest.fixture
def replay(domain_id, monkeypatch, tmp_path, restored_signals):
    """Replays a bag in this process, `replay(bag, *options)`; returns what is printed."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))

    def run(*words):
        done = command_line.nics("bag", "replay", *words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_a_bag_is_published_with_its_time_on_the_clock(
    replay, meet, domain_id, tmp_path
):
    bag = small_drive(tmp_path / "bag")
    peer = meet(domain_id)
    odom, clock = peer.listen(Odometry, "odom", 100), peer.listen(Clock, "/clock", 1000)
    assert json.loads(replay(bag, "--rate", "0.5", "--json")) == {"published": 60}
    peer.until(lambda: len(odom) >= 40, "the whole bag")
    wanted = [bags.ns(t) for t in bags.times(0.05, 2.0)]
    assert list(map(stamp_ns, odom)) == wanted
    ticks = [conversions.stamp_from_ros(message.clock) for message in clock]
    assert ticks == sorted(ticks)
    assert bags.ns(0.0) <= ticks[0]
    assert ticks[-1] <= bags.ns(2.0)


def test_a_replay_in_lock_step_gives_the_estimate_in_process_bit_for_bit(
    replay, launch, meet, domain_id, model, tmp_path
):
    bag = small_drive(tmp_path / "bag")
    peer = meet(domain_id)
    filtered = peer.listen(Odometry, "odometry/filtered", 100)
    launch("middleware_node", domain_id, use_sim_time=True)
    peer.be_known_to("middleware_node")
    printed = replay(bag, "--lockstep", "middleware_node")
    assert printed.splitlines() == ["60 messages were published"]
    peer.until(lambda: len(filtered) >= 40, "all estimates")
    made = estimate(bag, model, {})
    assert list(map(stamp_ns, filtered)) == list(made.stamp_ns)
    twists = [conversions.odometry_from_ros(message)[1] for message in filtered]
    assert np.array_equal(twists, made.twist)
    x = [message.pose.pose.position.x for message in filtered]
    assert np.array_equal(x, made.pose[:, 0])


def test_the_doctor_finds_a_second_driver_beside_the_simulator_and_nothing_else(
    launch, meet, domain_id, model_folder, tmp_path, monkeypatch
):
    launch("simulator_node", domain_id, world="empty")
    peer = meet(domain_id)
    scans = peer.listen(LaserScan, "scan")
    peer.until(lambda: scans, "a scan", ENDS_S)
    for _ in range(2):
        peer.speak(Twist, "cmd_vel")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
    options = ("--model", model_folder, "--duration", "2", "--json")
    done = command_line.nics("doctor", *options, cwd=tmp_path)
    (finding,) = json.loads(done.stdout)["findings"]
    assert done.returncode == 1, done.stderr
    assert (finding["check"], finding["where"]) == ("publishers", "/cmd_vel")
