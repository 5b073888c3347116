from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.lidar.sectors import ScanLayout
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.recording.messages import Offer
from nics_drl_bridge.report.doctor import examine
from nics_drl_bridge.report.doctor_facts import (
    Endpoints,
    Expected,
    Facts,
    collect_facts_of_bag,
    names_in,
)
from nics_drl_bridge.robot.spec import load_robot

SECONDS = 8.0
RELIABLE = Offer()
BEST_EFFORT = Offer(reliable=False)
LIDAR = load_lidar("paper")
EXPECTED = Expected(load_robot("ackermann"), LIDAR, 0.1)
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"


def scan(t, **changed):
    header = LIDAR.header._asdict() | {"time_increment": 0.0}
    ranges = np.where(np.arange(LIDAR.beams) % 3, 0.6 * LIDAR.range_max, np.inf)
    values = header | {"ranges": ranges, "frame": LIDAR.frame} | changed
    frame = values.pop("frame")
    ranges = np.asarray(values.pop("ranges"), np.float32)
    return bags.new(
        "sensor_msgs/msg/LaserScan",
        bags.header(t, frame),
        *values.values(),
        ranges,
        np.zeros(0, np.float32),
    )


def odometry(
    t,
    frames=("odom", "base_link"),
    pose=1.0,
    speed=1.0,
    turn=1.0,
    covariance=0.01,
    jump=0.0,
):
    x, y, heading = bags.place_at(0.0 if t is None else t)
    inner = bags.new(
        "geometry_msgs/PoseWithCovariance",
        bags.pose(pose * x + jump, pose * y, heading),
        np.full(36, covariance),
    )
    twist = bags.new(
        "geometry_msgs/TwistWithCovariance",
        bags.twist(0.5 * speed, 0.0, 0.25 * turn),
        np.full(36, covariance),
    )
    return bags.new(
        "nav_msgs/msg/Odometry", bags.header(t, frames[0]), frames[1], inner, twist
    )


def each_scan(**changed):
    return [(t, scan(t, **changed)) for t in bags.times(1.0 / LIDAR.rate, SECONDS)]


def each_odometry(**changed):
    return [(t, odometry(t, **changed)) for t in bags.times(0.02, SECONDS)]


own_odometry = cache(each_odometry)


def heard(scans=None, odometries=None, commands=None, late=0.002, ticks=None):
    """Facts of a robot on a circle; rows (time, message) take the place of its own."""
    facts = Facts("a robot", True, names_in(""))
    every = {
        "scan": scans or each_scan(),
        "odom": odometries or own_odometry(),
        "cmd_vel": commands
        or [(t, bags.twist(0.5, 0.0, 0.2)) for t in bags.times(0.1, SECONDS)],
    }
    if ticks is not None:
        every["/clock"] = [
            (t, bags.new(CLOCK_TYPE, bags.header(value).stamp)) for t, value in ticks
        ]
    for role, rows in every.items():
        for t, message in rows:
            facts.take(role, bags.ns(t + late), message)
        asks = (RELIABLE,) if role == "cmd_vel" else ()
        kind = rows[0][1].__msgtype__
        facts.topics[facts.names[role]] = Endpoints((kind,), (RELIABLE,), asks)
    facts.end_ns = bags.ns(SECONDS)
    return facts


SECTORED = Expected(
    EXPECTED.robot, LIDAR, EXPECTED.period_s, ScanLayout(sectors=36, range_max=3.0)
)
"""What a policy expects that sees sectors, all around."""


def only(facts):
    """The one thing that is found."""
    findings = examine(facts, EXPECTED)
    assert len(findings) == 1, findings
    return findings[0]


def test_a_robot_that_fits_has_no_findings():
    assert examine(heard(), EXPECTED) == []


FREE = np.where(np.arange(LIDAR.beams) % 3, 0.6 * LIDAR.range_max, 0.0)
HALF = LIDAR.beams // 2


@pytest.mark.parametrize(
    ("changed", "check", "said"),
    [
        ({"frame": "/laser"}, "frame", "/laser"),
        ({"frame": "camera"}, "frame", "frame: camera"),
        ({"ranges": FREE}, "range convention", "no_return: zero"),
        (
            {"ranges": np.where(FREE == 0.0, np.nan, FREE)},
            "range convention",
            "no_return: nan",
        ),
        (
            {"ranges": np.where(FREE == 0.0, LIDAR.range_max, FREE)},
            "range convention",
            "no_return: range_max",
        ),
        ({"ranges": np.where(FREE == 0.0, -1.0, FREE)}, "range convention", "negative"),
        (
            {"ranges": np.where(FREE == 0.0, 2.0 * LIDAR.range_max, FREE)},
            "range convention",
            "exceed range_max",
        ),
        ({"ranges": 1000.0 * FREE}, "unit", "millimetres"),
        ({"range_max": 1000.0 * LIDAR.range_max}, "unit", "range_max"),
        ({"range_max": 2.0 * LIDAR.range_max}, "range limits", "range_max"),
        (
            {
                "ranges": np.full(HALF, np.inf),
                "angle_max": LIDAR.header.angle_min
                + (HALF - 1) * LIDAR.header.angle_increment,
            },
            "beam layout",
            f"{HALF} beams",
        ),
        (
            {
                "angle_min": LIDAR.header.angle_max,
                "angle_max": LIDAR.header.angle_min,
                "angle_increment": -LIDAR.header.angle_increment,
            },
            "beam layout",
            "clockwise",
        ),
        (
            {
                "angle_min": LIDAR.header.angle_min + 0.5,
                "angle_max": LIDAR.header.angle_max + 0.5,
            },
            "beam layout",
            "beams go from",
        ),
        (
            {
                "angle_min": -180.0,
                "angle_max": -180.0 + 1.0 * (LIDAR.beams - 1),
                "angle_increment": 1.0,
            },
            "unit",
            "degrees",
        ),
        ({"angle_max": LIDAR.header.angle_max + 0.5}, "beam layout", "angle_max"),
    ],
)
def test_a_scan_that_does_not_fit_is_named(changed, check, said):
    findings = examine(heard(scans=each_scan(**changed)), EXPECTED)
    assert any(
        f.check == check and f.where == "/scan" and said in f.what + f.fix
        for f in findings
    )
    assert {f.where for f in findings} == {"/scan"}


@pytest.mark.parametrize(
    ("changed", "check", "said"),
    [
        ({"frames": ("map", "base_link")}, "frame", "'map'"),
        ({"frames": ("odom", "robot")}, "frame", "child_frame_id"),
        ({"frames": ("/odom", "base_link")}, "frame", "slash"),
        ({"speed": 1000.0}, "odometry", "mm/s"),
        ({"speed": -1.0}, "odometry", "twist.linear.x has the sign opposite"),
        ({"turn": 180.0 / np.pi}, "odometry", "degrees per second"),
        ({"turn": -1.0}, "odometry", "twist.angular.z has the sign opposite"),
        ({"pose": 1000.0}, "odometry", "millimetres"),
        ({"pose": 2.0}, "odometry", "times what the pose does"),
        ({"covariance": 0.0}, "odometry", "covariance of zeros"),
    ],
)
def test_an_odometry_that_does_not_fit_is_named(changed, check, said):
    finding = only(heard(odometries=each_odometry(**changed)))
    assert (finding.check, finding.where) == (check, "/odom")
    assert said in finding.what + finding.fix


def other_lidar(beams, begin, end, range_max):
    step = (end - begin) / (beams - 1)
    ranges = np.where(np.arange(beams) % 3, 1.5, np.inf)
    return each_scan(
        ranges=ranges,
        angle_min=begin,
        angle_max=end,
        angle_increment=step,
        range_max=range_max,
    )


def test_any_lidar_fits_a_policy_whose_sectors_it_fills():
    assert examine(heard(), SECTORED) == []
    for begin, end in ((-3.13, 3.13), (3.13, -3.13)):
        facts = heard(scans=other_lidar(360, begin, end, 8.0))
        assert examine(facts, SECTORED) == []
        assert {finding.check for finding in examine(facts, EXPECTED)} >= {
            "beam layout"
        }


@pytest.mark.parametrize(
    ("scans", "said"),
    [
        (other_lidar(360, -1.5, 1.5, 8.0), "use a lidar that sees farther or wider"),
        (other_lidar(360, -3.13, 3.13, 2.0), "needs 3 m"),
        (other_lidar(20, -3.0, 3.0, 8.0), "deg apart"),
    ],
)
def test_a_lidar_that_does_not_fill_the_sectors_of_a_policy_is_named_once(scans, said):
    (finding,) = examine(heard(scans=scans), SECTORED)
    assert (finding.check, finding.where) == ("beam layout", "/scan")
    assert said in finding.what


def test_a_jump_of_odometry_is_named():
    rows = [(t, odometry(t, jump=3.0 * (t > 4.0))) for t in bags.times(0.02, SECONDS)]
    assert "jumps 1 times, by up to 3.0" in only(heard(odometries=rows)).what


def test_a_robot_that_turns_against_its_commands_is_named():
    rows = [(t, bags.twist(0.5, 0.0, -0.2)) for t in bags.times(0.1, SECONDS)]
    finding = only(heard(commands=rows))
    assert (finding.check, finding.what) == (
        "command",
        "the robot turns against its commands",
    )


def test_a_lidar_at_another_rate_is_named():
    rows = [(t, scan(t)) for t in bags.times(2.0 / LIDAR.rate, SECONDS)]
    finding = only(heard(scans=rows))
    assert finding.check == "rate"
    assert f"{LIDAR.rate / 2:.3g} Hz, expected {LIDAR.rate:.3g} Hz" in finding.what


@pytest.mark.parametrize(
    ("late", "side"),
    [(-3.0, "after their arrival"), (1.0, "before"), (3600.0, "before")],
)
def test_stamps_that_are_not_of_the_time_of_arrival_are_named(late, side):
    findings = examine(heard(late=late), EXPECTED)
    assert {(f.check, f.where) for f in findings} == {
        ("stamp", "/scan"),
        ("stamp", "/odom"),
    }
    assert all(side in f.what for f in findings)
    assert all(("NTP" in f.fix) == (late != 1.0) for f in findings)


def test_messages_without_stamps_are_named():
    rows = [(t, odometry(None)) for t in bags.times(0.02, SECONDS)]
    assert "400 of 400 messages are not stamped" in only(heard(odometries=rows)).what


@pytest.mark.parametrize(
    ("ticks", "said"),
    [
        ([(t, t) for t in bags.times(0.01, 4.0)], "silent"),
        ([(t, 100.0) for t in bags.times(0.01, SECONDS)], "stands still"),
        ([(t, t % 5.0) for t in bags.times(0.01, SECONDS)], "backwards"),
    ],
)
def test_a_clock_that_does_not_go_on_is_named(ticks, said):
    findings = [f for f in examine(heard(ticks=ticks), EXPECTED) if f.check == "clock"]
    assert len(findings) == 1
    assert said in findings[0].what


def test_a_simulation_in_its_own_time_fits():
    apart = 1000.0
    facts = heard(
        scans=[(t, scan(t + apart)) for t in bags.times(1.0 / LIDAR.rate, SECONDS)],
        odometries=[(t, odometry(t + apart)) for t in bags.times(0.02, SECONDS)],
        ticks=[(t, t + apart) for t in bags.times(0.02, SECONDS)],
    )
    assert examine(facts, EXPECTED) == []


@pytest.mark.parametrize(
    ("topic", "ends", "check", "said"),
    [
        ("/cmd_vel", {"offers": (RELIABLE, RELIABLE)}, "publishers", "2 publishers"),
        (
            "/cmd_vel",
            {"offers": (BEST_EFFORT,)},
            "quality of service",
            "asks for reliable",
        ),
        ("/cmd_vel", {"asks": ()}, "missing topic", "nobody listens"),
        (
            "/odom",
            {"asks": (Offer(transient_local=True),)},
            "quality of service",
            "transient",
        ),
        ("/scan", {"types": ("sensor_msgs/msg/PointCloud2",)}, "type", "PointCloud2"),
        (
            "/cmd_vel",
            {"types": ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")},
            "type",
            "Twist and geometry_msgs/msg/TwistStamped",
        ),
    ],
)
def test_ends_of_a_topic_that_do_not_fit_are_named(topic, ends, check, said):
    facts = heard()
    facts.topics[topic] = replace(facts.topics[topic], **ends)
    finding = only(facts)
    assert (finding.check, finding.where) == (check, topic)
    assert said in finding.what


def test_a_missing_topic_is_named_with_one_of_its_type():
    facts = heard()
    facts.topics["/front/scan"] = facts.topics.pop("/scan")
    del facts.heard["scan"]
    facts.layouts = []
    facts.ranges = []
    finding = only(facts)
    assert finding.what == "there is no such topic"
    assert "/front/scan is of its type: remap it" in finding.fix


def test_a_topic_that_a_bag_lacks_is_to_be_recorded():
    facts = replace(heard(), live=False)
    del facts.topics["/scan"], facts.heard["scan"]
    facts.layouts = []
    facts.ranges = []
    fix = only(facts).fix
    assert fix.startswith("record it with the others")
    assert "driver" not in fix


def test_a_table_is_no_damaged_bag(tmp_path):
    table = tmp_path / "drive.csv"
    table.write_text("t,x,y,yaw\n0,0,0,0\n")
    with pytest.raises(RecordingError, match=r"drive\.csv: is no bag; .*`nics inspect"):
        collect_facts_of_bag(table)


def with_gyro(rate, noise=0.003, seconds=SECONDS):
    """Facts of a robot on a circle, beside a gyro that measures a rate."""
    facts = heard()
    rng = np.random.default_rng(0)
    for t in bags.times(0.01, seconds):
        message = bags.imu(t, 0.0, 0.0, rate + rng.normal(0.0, noise))
        facts.take("imu", bags.ns(t + 0.002), message)
    facts.topics["/imu"] = Endpoints(("sensor_msgs/msg/Imu",), (RELIABLE,))
    return facts


def test_a_gyro_that_turns_as_odometry_does_is_no_finding():
    assert examine(with_gyro(0.25), EXPECTED) == []


@pytest.mark.parametrize("seconds", [SECONDS, 5.0])
def test_odometry_that_turns_further_than_the_gyro_is_named_with_the_cure(seconds):
    finding = only(with_gyro(0.25 / 1.6, seconds=seconds))
    assert finding.check == "gyro"
    assert finding.where == "/imu"
    assert "contradicts odometry by 0." in finding.what
    assert "imu:=TOPIC" in finding.fix


def test_a_model_that_was_made_with_the_gyro_knows_that_odometry_slips():
    assert examine(with_gyro(0.25 / 1.6), replace(EXPECTED, gyro=True)) == []
    [missing] = examine(heard(), replace(EXPECTED, gyro=True))
    assert "made with a gyro" in missing.what


@pytest.mark.parametrize(
    ("rate", "said"),
    [(-0.25, "against odometry"), (0.25 * 180.0 / np.pi, "degrees per second")],
)
def test_a_gyro_of_another_sign_or_unit_is_an_error(rate, said):
    finding = only(with_gyro(rate))
    assert finding.severity == "error"
    assert said in finding.what


def test_the_gyro_of_a_bag_is_found_by_its_type(tmp_path):
    rows = {
        "/scan": [(t + 0.002, scan(t)) for t in bags.times(1.0 / LIDAR.rate, SECONDS)],
        "/odom": [(t + 0.002, odometry(t)) for t in bags.times(0.02, SECONDS)],
        "/cmd_vel": [(t, bags.twist(0.5, 0.0, 0.2)) for t in bags.times(0.1, SECONDS)],
        "/gyroscope": [
            (t, bags.imu(t, 0.0, 0.0, 0.15)) for t in bags.times(0.01, SECONDS)
        ],
    }
    bag = bags.write(tmp_path / "bag", rows)
    assert only(collect_facts_of_bag(bag)).where == "/gyroscope"
    assert examine(collect_facts_of_bag(bag, imu="none"), EXPECTED) == []


def test_a_bag_is_judged_like_the_robot(tmp_path):
    rows = {
        "/scan": [(t + 0.002, scan(t)) for t in bags.times(1.0 / LIDAR.rate, SECONDS)],
        "/odom": [(t + 0.002, odometry(t)) for t in bags.times(0.02, SECONDS)],
        "/cmd_vel": [(t, bags.twist(0.5, 0.0, 0.2)) for t in bags.times(0.1, SECONDS)],
    }
    good = bags.write(tmp_path / "good", rows)
    assert examine(collect_facts_of_bag(good), EXPECTED) == []
    rows["/odom"] = [
        (t + 0.002, odometry(t, turn=-1.0)) for t in bags.times(0.02, SECONDS)
    ]
    bad = bags.write(tmp_path / "bad", rows)
    assert "sign opposite" in only(collect_facts_of_bag(bad)).what
