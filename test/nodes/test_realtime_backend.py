import itertools
import threading
import time
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import Imu
from std_srvs.srv import SetBool

from nics_drl_bridge.env.registry import NAVIGATION
from nics_drl_bridge.errors import BackendError, ConfigError, StaleDataError
from nics_drl_bridge.interface import Start
from nics_drl_bridge.middleware.middleware import Datum, TopicCache
from nics_drl_bridge.nodes import qos, realtime_backend
from nics_drl_bridge.nodes.link import EpisodeServices
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.sim.world import load_world
from nodes.peer import PlayedRobot, stamp_ns

pytestmark = pytest.mark.ros

PATIENCE_S = 60.0
START = Start(seed=3, pose=np.array([0.5, -0.5, 1.0]))
FORWARD = np.array([0.5, 0.0])


@pytest.fixture(scope="module")
def simulator(launch, module_domain_id):
    """Return the domain of a simulator in real time."""
    process = launch("simulator_node", module_domain_id, mode="realtime")
    yield module_domain_id
    process.check()


@pytest.fixture
def connect(simulator, model):
    """Make backends on that simulator, or in a given domain."""
    made = []

    def make(**options):
        options = {"domain_id": simulator, "timeout_s": PATIENCE_S} | options
        made.append(RealtimeBackend(model, load_world("arena"), **options))
        return made[-1]

    yield make
    for backend in made:
        backend.close()


@pytest.fixture
def vehicle(meet, domain_id, model):
    """A robot without services; `send(pose, twist)` publishes its data."""
    robot = PlayedRobot(meet(domain_id), model.lidar)
    robot.domain_id = domain_id
    return robot


def drive_on(backend):
    for _ in range(1000):
        backend.step(FORWARD)


def test_gymnasium_make_drives_a_simulator_in_real_time(simulator):
    options = {
        "domain_id": simulator,
        "mode": "realtime",
        "stale_after_s": PATIENCE_S,
    }
    env = gymnasium.make(
        NAVIGATION, backend="dds", model="ackermann", backend_options=options
    )
    try:
        _, info = env.reset(seed=3)
        before = info["pose"]
        told = [env.step(np.array([1.0, 0.0], np.float32))[4] for _ in range(5)]
    finally:
        env.close()
    sequences = [info["odom_sequence"] for info in told]
    assert sequences == sorted(sequences)
    assert sequences[-1] > sequences[0]
    assert np.hypot(*(told[-1]["pose"] - before)[:2]) > 0.01
    for info in told:
        assert info["stamp_ns"] == max(info["scan_stamp_ns"], info["odom_stamp_ns"])
        assert 0.0 <= info["scan_silence_s"] <= PATIENCE_S


def test_silence_of_a_topic_is_named_with_its_age_and_a_reset_goes_on(
    connect, simulator, meet
):
    backend = connect(stale_after_s=2.0)
    backend.reset(START)
    backend.step(FORWARD)
    peer = meet(simulator)
    peer.call(SetBool, "simulator_node/pause", SetBool.Request(data=True))
    with pytest.raises(StaleDataError, match=r"no fresh data within 2.000 s") as caught:
        drive_on(backend)
    peer.call(SetBool, "simulator_node/pause", SetBool.Request(data=False))
    assert caught.value.topic in ("scan", "odom")
    assert caught.value.age_s > 2.0
    assert backend.reset(START).pose == pytest.approx(START.pose, abs=0.2)
    backend.step(FORWARD)


def test_a_simulator_whose_services_are_found_late_is_no_vehicle(connect, monkeypatch):
    monkeypatch.setattr(realtime_backend, "SERVICES_S", 0.0)
    unseen = iter([False] * 20)
    seen = EpisodeServices.there.fget
    monkeypatch.setattr(
        EpisodeServices,
        "there",
        property(lambda self: next(unseen, True) and seen(self)),
    )
    elsewhere = Start(seed=4, pose=np.array([-0.5, 0.5, 0.0]))
    backend = connect(stale_after_s=PATIENCE_S)
    assert backend.reset(elsewhere).pose == pytest.approx(elsewhere.pose, abs=0.2)


def test_missed_deadlines_are_counted_and_not_made_up_for(connect, monkeypatch):
    backend = connect(stale_after_s=1e6)
    backend.reset(START)
    period, clock = backend._period_ns, SimpleNamespace(now=time.monotonic_ns())
    clock.monotonic_ns = lambda: clock.now
    clock.sleep = lambda seconds: setattr(
        clock, "now", clock.now + round(seconds * 1e9)
    )
    monkeypatch.setattr(realtime_backend, "time", clock)
    backend._deadline_ns = (began := clock.now) + period

    def step(thinking=0.0):
        clock.now += round(thinking * period)
        misses = backend.step(FORWARD)[1]["deadline_misses"]
        return round((clock.now - began) / period, 3), misses

    assert step() == (1.0, 0)
    assert step(thinking=0.9) == (2.0, 0)
    assert step(thinking=2.5) == (5.0, 2)  # due at 3; it comes at 4.5
    assert step() == (6.0, 2)


def test_a_vehicle_is_awaited_at_its_start_and_what_is_missing_is_said(
    connect, vehicle, monkeypatch
):
    monkeypatch.setattr(realtime_backend, "SAY_EVERY_S", 0.05)
    said = []
    robot = vehicle.peer.listen(TwistStamped, "cmd_vel")
    gyro = vehicle.peer.node.create_publisher(Imu, "gyro", qos.SENSOR_RELIABLE)

    def say(sentence):
        said.append(sentence.removeprefix("waiting for the robot: "))
        if said[-1].startswith("no "):
            vehicle.send(START.pose + np.array([1.0, 0.0, 0.5]))
        elif "off its start" in said[-1]:
            vehicle.send(START.pose, (0.3, 0.0, 0.0))
        else:
            vehicle.send(START.pose)

    backend = connect(
        domain_id=vehicle.domain_id,
        say=say,
        stale_after_s=PATIENCE_S,
        stamped=True,
        tolerance=(0.2, 0.2),
        pose_type="PoseStamped",
        imu="gyro",
    )
    assert gyro.get_subscription_count() == 1
    monkeypatch.setattr(backend._topics, "expected", ("scan", "odom", "pose"))
    view = backend.reset(START)
    assert np.hypot(*(view.pose - START.pose)[:2]) < 0.2
    assert said[0].startswith("no ")
    assert "it is 1.00 m and 29 deg off its start (0.50 m, -0.50 m, 57 deg)" in said, (
        said
    )
    assert "it is still moving" in said
    backend.step(FORWARD)
    heard = "a command stamped with its scan"
    vehicle.peer.until(lambda: robot and robot[-1].twist.linear.x == 0.5, heard)
    newest_ns = backend._topics.middleware.cache.newest["scan"].stamp_ns
    assert stamp_ns(robot[-1]) == newest_ns
    assert robot[-1].header.frame_id == "base_link"


@pytest.fixture
def standing(vehicle):
    """The vehicle, which sends all the time; its clock is `offset_ns` ahead of the steady one."""
    vehicle.offset_ns, over = 100 * 10**9, threading.Event()

    def send():
        for tick in itertools.count():
            if over.wait(0.02):
                return
            stamp = time.monotonic_ns() + vehicle.offset_ns
            vehicle.send(stamp=stamp, scans=tick % 5 == 0)

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    yield vehicle
    over.set()
    thread.join()


def test_a_drive_goes_on_after_the_clock_of_the_stamps_was_set_back(connect, standing):
    heard = standing.peer.listen(TwistStamped, "cmd_vel_raw")
    standing.peer.listen(TwistStamped, "cmd_vel")
    backend = connect(
        domain_id=standing.domain_id,
        command_topic="cmd_vel_raw",
        start="present",
        stale_after_s=PATIENCE_S,
    )
    view = backend.reset(START)
    standing.offset_ns -= 50 * 10**9
    deadline = time.monotonic() + PATIENCE_S
    while view.stamp_s > (time.monotonic_ns() + standing.offset_ns) / 1e9 + 1.0:
        assert time.monotonic() < deadline, "the jump was not followed"
        view = backend.step(FORWARD)[0]
    assert not np.isnan(view.ranges).any()
    backend.step(FORWARD)
    standing.peer.until(
        lambda: any(0 < stamp_ns(one) <= view.stamp_s * 1e9 for one in heard),
        "a command with the stamp of a scan after the jump",
    )


def test_a_vehicle_that_does_not_come_is_awaited_until_time_is_up_or_the_backend_closed(
    connect, vehicle, monkeypatch
):
    monkeypatch.setattr(realtime_backend, "SAY_EVERY_S", 0.05)
    for topic in ("cmd_vel_raw", "cmd_vel"):  # of a gate, and of the robot behind it
        vehicle.peer.listen(TwistStamped, topic)
    options = {
        "domain_id": vehicle.domain_id,
        "command_topic": "cmd_vel_raw",
        "stale_after_s": PATIENCE_S,
        "say": lambda _: vehicle.send(np.zeros(3)),
    }
    waiting = connect(**options, start_timeout_s=0.5)
    with pytest.raises(
        BackendError, match=r"not ready: it is 0.71 m and 57 deg off.*'present'"
    ):
        waiting.reset(START)
    waiting.close()
    present = connect(**options, start="present")
    for pose in (present.reset(START).pose, present.present_pose()):
        assert pose == pytest.approx(np.zeros(3), abs=0.05)
    present.close()
    closed = connect(**options | {"say": lambda _: closed.close()})
    with pytest.raises(BackendError, match="this backend is closed"):
        closed.reset(START)


def test_the_topic_that_is_missing_is_named_not_one_that_is_silent_longer():
    now_ns = time.monotonic_ns()
    odom = Datum(stamp_ns=10**9, arrival_ns=now_ns - 10**9, sequence=0, value=None)
    arrivals = {"odom": [odom.arrival_ns], "scan": [now_ns]}
    cache = TopicCache(newest={"odom": odom}, arrivals=arrivals)
    backend = RealtimeBackend.__new__(RealtimeBackend)
    backend._options = SimpleNamespace(stale_after_s=0.05)
    backend._topics = SimpleNamespace(
        lock=threading.RLock(),
        expected=("odom", "scan"),
        newest_ns=odom.stamp_ns,
        middleware=SimpleNamespace(cache=cache),
    )
    with pytest.raises(StaleDataError, match="the last is") as caught:
        backend._take_view()
    assert caught.value.topic == "scan"


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"lays_map": True}, "lays_map needs start='present'"),
        (
            {"lays_map": True, "start": "present", "pose_type": "PoseStamped"},
            "lays_map is for a robot without a pose",
        ),
        ({"stale_after": 1.0}, r"backend_options.*stale_after_s"),
        ({"pose_type": "Pose", "timeout_s": 0.1}, "pose_type"),
    ],
)
def test_a_wrong_option_is_one_sentence(connect, options, reason):
    with pytest.raises(ConfigError, match=reason):
        connect(**options)


def test_without_a_robot_the_missing_topic_is_named(connect, domain_id):
    with pytest.raises(BackendError, match=r"no publisher of /odom.*mode:=realtime"):
        connect(domain_id=domain_id, timeout_s=0.3)
