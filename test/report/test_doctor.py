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

SECONDS = 6.0
RELIABLE = Offer()
BEST_EFFORT = Offer(reliable=False)
LIDAR = load_lidar("paper")
EXPECTED = Expected(load_robot("ackermann"), LIDAR, 0.1)
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"


def scan(t, frame=LIDAR.frame, **changed):
    usual = np.where(np.arange(LIDAR.beams) % 3, 0.6 * LIDAR.range_max, np.inf)
    ranges = changed.pop("ranges", usual)
    return bags.scan_of(LIDAR, t, ranges, frame, **{"time_increment": 0.0} | changed)


def odometry(t, frames=("odom", "base_link"), pose=1.0, speed=1.0, turn=1.0, **other):
    x, y, heading = bags.place_at(0.0 if t is None else t)
    jump = other.get("jump", 0.0) if t is not None and t > 4.0 else 0.0
    velocity = 0.5 * speed, 0.0, 0.25 * turn
    covariance = other.get("covariance", 0.01)
    stamp = t if other.get("stamped", True) else None
    place = pose * x + jump, pose * y, heading
    return bags.moving_odometry(stamp, place, velocity, frames, covariance)


def every(step, message, **changed):
    """Rows (time, message) of a topic."""
    return [(t, message(t, **changed)) for t in bags.times(step, SECONDS)]


def scans(step=1.0 / LIDAR.rate, **changed):
    return every(step, scan, **changed)


def odometries(**changed):
    return every(0.02, odometry, **changed)


def commands(turn=0.2):
    return every(0.1, lambda t: bags.twist(0.5, 0.0, turn))


def gyro(rate, seconds=SECONDS):
    """Rows of a gyro that measures a rate."""
    noise = np.random.default_rng(0).normal(0.0, 0.003, 10_000)
    return [
        (t, bags.imu(t, 0.0, 0.0, rate + noise[k]))
        for k, t in enumerate(bags.times(0.01, seconds))
    ]


ROWS = {
    "scan": cache(scans),
    "odom": cache(odometries),
    "cmd_vel": cache(commands),
    "imu": gyro,
}


def heard(late=0.002, **rows):
    """Facts of a robot on a circle; rows of a role take the place of its own."""
    facts = Facts("a robot", True, names_in(""))
    for role in {"scan": 0, "odom": 0, "cmd_vel": 0, **rows}:
        of_role = rows[role] if role in rows else ROWS[role]()
        for t, message in of_role:
            facts.take(role, bags.ns(t + late), message)
        asks = (RELIABLE,) if role == "cmd_vel" else ()
        kind = of_role[0][1].__msgtype__
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


@pytest.mark.parametrize(
    ("ticks", "said"),
    [
        ([(t, t) for t in bags.times(0.01, 4.0)], "silent"),
        ([(t, 100.0) for t in bags.times(0.01, SECONDS)], "stands still"),
        ([(t, t % 5.0) for t in bags.times(0.01, SECONDS)], "backwards"),
    ],
)
def test_a_clock_that_does_not_go_on_is_named(ticks, said):
    clock = [(t, bags.new(CLOCK_TYPE, bags.header(now).stamp)) for t, now in ticks]
    findings = examine(heard(**{"/clock": clock}), EXPECTED)
    findings = [finding for finding in findings if finding.check == "clock"]
    assert len(findings) == 1
    assert said in findings[0].what


@pytest.mark.parametrize(
    ("topic", "ends", "check", "said"),
    [
        ("/cmd_vel", {"offers": (RELIABLE, RELIABLE)}, "publishers", "2 publishers"),
        (
            "/cmd_vel",
            {"offers": (BEST_EFFORT,)},
            "quality of service",
            "requires reliable",
        ),
        ("/cmd_vel", {"asks": ()}, "missing topic", "has no subscriber"),
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


def test_a_table_is_no_damaged_bag(tmp_path):
    table = tmp_path / "drive.csv"
    table.write_text("t,x,y,yaw\n0,0,0,0\n")
    with pytest.raises(
        RecordingError, match=r"drive\.csv: is not a bag; .*`nics inspect"
    ):
        collect_facts_of_bag(table)


FREE = np.where(np.arange(LIDAR.beams) % 3, 0.6 * LIDAR.range_max, 0.0)
HALF = LIDAR.beams // 2
HEADER = LIDAR.header
SCANS = [
    ({"frame": "/laser"}, "frame", "/laser"),
    ({"frame": "camera"}, "frame", "frame: camera"),
    *(
        ({"ranges": np.where(FREE == 0.0, value, FREE)}, "range convention", said)
        for value, said in (
            (0.0, "no_return: zero"),
            (np.nan, "no_return: nan"),
            (LIDAR.range_max, "no_return: range_max"),
            (-1.0, "negative"),
            (2.0 * LIDAR.range_max, "exceed range_max"),
        )
    ),
    ({"ranges": 1000.0 * FREE}, "unit", "millimetres"),
    ({"range_max": 1000.0 * LIDAR.range_max}, "unit", "range_max"),
    ({"range_max": 2.0 * LIDAR.range_max}, "range limits", "range_max"),
    (
        {
            "ranges": np.full(HALF, np.inf),
            "angle_max": HEADER.angle_min + (HALF - 1) * HEADER.angle_increment,
        },
        "beam layout",
        f"{HALF} beams",
    ),
    (
        {
            "angle_min": HEADER.angle_max,
            "angle_max": HEADER.angle_min,
            "angle_increment": -HEADER.angle_increment,
        },
        "beam layout",
        "clockwise",
    ),
    (
        {"angle_min": HEADER.angle_min + 0.5, "angle_max": HEADER.angle_max + 0.5},
        "beam layout",
        "beams go from",
    ),
    (
        {"angle_min": -180.0, "angle_max": LIDAR.beams - 181.0, "angle_increment": 1.0},
        "unit",
        "degrees",
    ),
    ({"angle_max": HEADER.angle_max + 0.5}, "beam layout", "angle_max"),
]


@pytest.mark.parametrize(("changed", "check", "said"), SCANS)
def test_a_scan_that_does_not_fit_is_named(changed, check, said):
    findings = examine(heard(scan=scans(**changed)), EXPECTED)
    told = [f.what + f.fix for f in findings if f.check == check]
    assert any(said in text for text in told)
    assert {f.where for f in findings} == {"/scan"}


@pytest.mark.parametrize(
    ("role", "changed", "check", "said"),
    [
        ("odom", {"frames": ("map", "base_link")}, "frame", "'map'"),
        ("odom", {"frames": ("odom", "robot")}, "frame", "child_frame_id"),
        ("odom", {"frames": ("/odom", "base_link")}, "frame", "slash"),
        ("odom", {"speed": 1000.0}, "odometry", "mm/s"),
        ("odom", {"speed": -1.0}, "odometry", "linear.x has the opposite sign"),
        ("odom", {"turn": 180.0 / np.pi}, "odometry", "degrees per second"),
        ("odom", {"turn": -1.0}, "odometry", "angular.z has the opposite sign"),
        ("odom", {"pose": 1000.0}, "odometry", "millimetres"),
        ("odom", {"pose": 2.0}, "odometry", "times the rate of the pose"),
        ("odom", {"covariance": 0.0}, "odometry", "covariance of zeros"),
        ("odom", {"jump": 3.0}, "odometry", "jumps 1 times, by up to 3.0"),
        ("odom", {"stamped": False}, "stamp", "300 of 300 messages are not stamped"),
        ("cmd_vel", {"turn": -0.2}, "command", "turns opposite to its commands"),
        ("scan", {"step": 2.0 / LIDAR.rate}, "rate", f"expected {LIDAR.rate:.3g} Hz"),
        ("imu", {"rate": 0.25 / 1.6}, "gyro", "contradicts odometry by 0."),
        ("imu", {"rate": 0.25 / 1.6, "seconds": 5.0}, "gyro", "imu:=TOPIC"),
        ("imu", {"rate": -0.25}, "gyro", "opposite to odometry"),
        ("imu", {"rate": 45.0 / np.pi}, "gyro", "degrees per second"),
    ],
)
def test_what_does_not_fit_is_named_where_it_is(role, changed, check, said):
    finding = only(heard(**{role: ROWS[role](**changed)}))
    assert (finding.check, finding.where) == (check, f"/{role}")
    assert said in finding.what + finding.fix


def test_what_fits_has_no_findings():
    assert examine(heard(), EXPECTED) == []
    assert examine(heard(imu=gyro(0.25)), EXPECTED) == []
    known = replace(EXPECTED, gyro=True)  # made where odometry slips
    assert examine(heard(imu=gyro(0.25 / 1.6)), known) == []
    (missing,) = examine(heard(), known)
    assert "made with a gyro" in missing.what
    apart = 1000.0  # a simulation in its own time
    clock = every(0.02, lambda t: bags.new(CLOCK_TYPE, bags.header(t + apart).stamp))
    later = {
        "scan": every(1.0 / LIDAR.rate, lambda t: scan(t + apart)),
        "odom": every(0.02, lambda t: odometry(t + apart)),
    }
    assert examine(heard(**later, **{"/clock": clock}), EXPECTED) == []


def of_lidar(beams, begin, end, range_max):
    return scans(
        ranges=np.where(np.arange(beams) % 3, 1.5, np.inf),
        angle_min=begin,
        angle_max=end,
        angle_increment=(end - begin) / (beams - 1),
        range_max=range_max,
    )


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ((360, -3.13, 3.13, 8.0), None),
        ((360, 3.13, -3.13, 8.0), None),
        ((360, -1.5, 1.5, 8.0), "use a lidar that sees farther or wider"),
        ((360, -3.13, 3.13, 2.0), "needs 3 m"),
        ((20, -3.0, 3.0, 8.0), "deg apart"),
    ],
)
def test_a_lidar_fits_a_policy_if_it_fills_its_sectors(layout, said):
    facts = heard(scan=of_lidar(*layout))
    assert "beam layout" in {finding.check for finding in examine(facts, EXPECTED)}
    findings = examine(facts, SECTORED)
    if said is None:
        assert findings == []
    else:
        (finding,) = findings
        assert (finding.check, finding.where) == ("beam layout", "/scan")
        assert said in finding.what


@pytest.mark.parametrize("live", [True, False])
def test_a_missing_topic_is_named_with_one_of_its_type(live):
    facts = replace(heard(), live=live, layouts=[], ranges=[])
    facts.topics["/front/scan"] = facts.topics.pop("/scan")
    del facts.heard["scan"]
    finding = only(facts)
    assert finding.what == "there is no such topic"
    assert "/front/scan is of its type: remap it" in finding.fix
    assert ("driver" in finding.fix) is live


def test_a_bag_is_judged_like_the_robot_and_its_gyro_is_found_by_type(tmp_path):
    rows = {
        "/scan": every(1.0 / LIDAR.rate, scan),
        "/odom": odometries(),
        "/cmd_vel": commands(),
        "/gyroscope": gyro(0.15),
    }
    for topic in ("/scan", "/odom"):
        rows[topic] = [(t + 0.002, message) for t, message in rows[topic]]
    bag = bags.write(tmp_path / "good", rows)
    assert only(collect_facts_of_bag(bag)).where == "/gyroscope"
    assert examine(collect_facts_of_bag(bag, imu="none"), EXPECTED) == []
    rows["/odom"] = [(t + 0.002, message) for t, message in odometries(turn=-1.0)]
    bad = bags.write(tmp_path / "bad", rows)
    assert "opposite sign" in only(collect_facts_of_bag(bad, imu="none")).what
