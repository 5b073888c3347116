"""Whatever the order of arrival, the estimate is that of the order of the stamps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from robots import direct_model

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.measurement import Kind, Measurement
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.middleware.timeline import (
    BEFORE_START,
    CLOCK_JUMP,
    DUPLICATE,
    HISTORY_NS,
    TOO_OLD,
    Stamps,
    Timeline,
)

SECOND = 1_000_000_000
MILLISECOND = 1_000_000


class Message(NamedTuple):
    """A message of a robot and how long it is under way."""

    topic: str
    stamp_ns: int
    value: np.ndarray
    underway_ns: int


START = [0.5, -0.3, 3.0]
TOPICS = ("cmd_vel", "odom", "imu", "pose")
PERIODS_MS = (50, 50, 20, 100)


def messages(model, rng, seconds=6.0, latest_ns=HISTORY_NS):
    """What is sent on a drive: noisy, one in nine far off, many with equal stamps."""
    stamps = {}
    for topic, period_ms in zip(TOPICS, PERIODS_MS, strict=True):
        ticks = np.arange(1, int(seconds * 1000 / period_ms)) * period_ms
        moved = ticks + rng.integers(0, period_ms, len(ticks)) * (
            rng.random(len(ticks)) < 0.3
        )
        stamps[topic] = [int(ms) * MILLISECOND for ms in moved]
    truth = Estimator(model)
    made = []
    truth.reset(0, START)
    for stamp in stamps["cmd_vel"]:
        command = rng.uniform(model.robot.command_low, model.robot.command_high)
        truth.add_command(stamp, command)
        made.append(Message("cmd_vel", stamp, command, 0))
    for topic in TOPICS[1:]:
        for k, stamp in enumerate(stamps[topic]):
            pose, twist = truth.look_ahead(stamp)
            value = {"odom": twist, "imu": twist[2:], "pose": pose}[topic]
            error = rng.normal(size=len(value)) * (3.0 if k % 9 == 4 else 0.01)
            made.append(Message(topic, stamp, value + error, 0))
    made = [m._replace(underway_ns=int(rng.integers(0, latest_ns))) for m in made]
    return sorted(made, key=lambda m: (m.stamp_ns, TOPICS.index(m.topic)))


def feed(middleware, message):
    """Hands a message to the middleware, all at one moment of the receiver's clock."""
    stamp = message.stamp_ns
    value = message.value
    if message.topic == "cmd_vel":
        return middleware.command(stamp, value, stamp)
    arrival = stamp + message.underway_ns
    if message.topic == "odom":
        return middleware.odometry(stamp, arrival, np.zeros(3), value)
    if message.topic == "imu":
        return middleware.imu(stamp, arrival, float(value[0]))
    return middleware.pose(stamp, arrival, value, np.eye(3) * 0.05**2)


def fed(model, drive):
    middleware = Middleware(model)
    middleware.reset(0, START)
    for message in drive:
        assert feed(middleware, message), message
    return middleware


def numbers(middleware):
    belief = middleware.estimator.belief
    pose, twist = middleware.estimator.look_ahead(belief.time_ns + SECOND // 3)
    return belief.time_ns, np.concatenate(
        [belief.mean, belief.covariance.ravel(), pose, twist]
    )


@pytest.mark.slow
def test_data_that_arrive_out_of_order_give_the_estimate_of_the_right_order():
    model = builtin_model("mecanum")
    rng = np.random.default_rng(0)
    drive = messages(model, rng)
    late = sorted(drive, key=lambda m: m.stamp_ns + m.underway_ns)
    assert late != drive
    ordered = fed(model, drive)
    shuffled = fed(model, late)
    (expected_ns, expected), (found_ns, found) = numbers(ordered), numbers(shuffled)
    assert found_ns == expected_ns
    assert found == pytest.approx(expected, abs=1e-9)
    one = ordered.health(0)
    other = shuffled.health(0)
    assert (one.rejected, one.noticed) == (other.rejected, other.noticed)
    assert all(one.rejected[topic, "outlier"] >= 2 for topic in ("odom", "imu", "pose"))
    assert all(one.topics[topic].received > 50 for topic in ("odom", "imu", "pose"))
    assert sum(one.rejected.values()) < 120
    assert one.replayed == 0
    assert other.replayed > 100


@pytest.fixture
def timeline():
    estimator = Estimator(builtin_model("ackermann"))
    estimator.reset(SECOND, np.zeros(3))
    return Timeline(estimator)


def twist(speed=0.0):
    return Measurement(Kind.TWIST, np.array([speed, 0.0, 0.0]))


def test_a_late_command_after_a_silence_finds_the_commands_before_it():
    """What was in effect before the last second is needed where the data are sparse."""
    model = direct_model()
    middleware = Middleware(model)
    middleware.reset(0, np.zeros(3))
    middleware.odometry(SECOND, 0, np.zeros(3), np.zeros(3))
    for k in range(1, 400):
        middleware.command(
            SECOND + k * 5 * MILLISECOND, [0.5 if k < 200 else 0.0, 0.0, 0.0]
        )
    middleware.odometry(3 * SECOND, 2 * SECOND, np.zeros(3), np.zeros(3))
    expected = middleware.estimator.look_ahead(3 * SECOND)[0]
    assert expected[0] == pytest.approx(0.5 * 0.995, abs=1e-9)
    for k in range(1, 400):  # so many that old ones have to go
        middleware.command(3 * SECOND + k * MILLISECOND, [0.0, 0.0, 0.0])
    middleware.command(2 * SECOND + 500 * MILLISECOND + 1, [0.0, 0.0, 1.0])
    middleware.command(2 * SECOND + 505 * MILLISECOND - 1, [0.0, 0.0, 0.0])
    found = middleware.estimator.look_ahead(3 * SECOND)[0]
    assert found[:2] == pytest.approx(expected[:2], abs=1e-9)
    assert found[2] == pytest.approx(0.005, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "stamp", "reason"),
    [
        ("twist", 0, BEFORE_START),
        ("twist", SECOND, BEFORE_START),
        ("twist", 4 * SECOND - 1, TOO_OLD),
        ("twist", 4 * SECOND + 1, None),
        ("twist", 5 * SECOND, DUPLICATE),
        ("command", SECOND - 1, BEFORE_START),
        ("command", 2 * SECOND, TOO_OLD),
        ("command", 5 * SECOND, None),
        ("command", 9 * SECOND, None),
    ],
)
def test_what_is_too_late_is_refused_with_the_reason(timeline, kind, stamp, reason):
    for k in range(1, 9):
        assert timeline.measure(SECOND + k * SECOND // 2, twist()) is None
    assert timeline.newest_ns == 5 * SECOND
    if kind == "twist":
        assert timeline.measure(stamp, twist()) == reason
        return
    assert timeline.command(stamp, [0.5, 0.0]) == reason
    if not reason:
        assert timeline.command(stamp, [0.2, 0.0]) == DUPLICATE


@pytest.mark.parametrize("offset", [-(10**18), 10**18])
@pytest.mark.parametrize(
    ("period_s", "passed_s", "ahead_s"), [(0, 0, 1), (0, 60, 61), (3, 1, 7), (0, -7, 1)]
)
def test_a_stamp_may_be_ahead_of_what_is_due_by_a_second_or_two_periods(
    offset, period_s, passed_s, ahead_s
):
    """The first one shows how the clocks lie; one may be set back."""
    stamps = Stamps(period_ns=period_s * SECOND)
    first = 100 * SECOND + offset
    assert stamps.find_fault(first, 7 * SECOND) is None
    stamps.accept(first, 7 * SECOND)
    stamps.accept(first - 50 * SECOND, 9 * SECOND)  # an old one changes nothing
    now = (7 + passed_s) * SECOND
    assert stamps.find_fault(first + ahead_s * SECOND, now) is None
    fault = stamps.find_fault(first + ahead_s * SECOND + 1, now)
    assert fault.may_be_clock
    assert fault.reason == f"more than {max(1, 2 * period_s)} s in the future"


def test_a_row_of_refusals_means_that_the_clock_was_set():
    stamps = Stamps()
    row = [False] * (CLOCK_JUMP - 1)
    assert [stamps.refuse() for _ in row] == row
    stamps.accept(101 * SECOND, 8 * SECOND)  # ends the row
    assert [stamps.refuse() for _ in [*row, True]] == [*row, True]
