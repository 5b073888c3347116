"""What can't be true never enters the estimate, and is counted by its reason."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from robots import direct_model

from middleware.rig import PERIOD, RANGES, SECOND, STILL, assert_same, state
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.middleware.middleware import Middleware


def test_a_pose_that_is_set_stays_when_the_next_odometry_comes():
    middleware = Middleware(builtin_model("differential"))
    middleware.reset(0, np.zeros(3), 0.3)
    for step in range(2):
        middleware.odometry(step * PERIOD, 0, np.zeros(3), np.zeros(3))
    there = np.array([2.0, 1.0, 0.5])
    middleware.place(there, 1e-6 * np.eye(3))
    middleware.odometry(2 * PERIOD, 0, [0.0, 0.0, 0.02], np.zeros(3))
    assert middleware.view(2 * PERIOD).pose == pytest.approx(there, abs=5e-3)
    assert np.diag(middleware.estimator.covariance)[:3].max() < 1e-3


def test_the_view_holds_the_newest_data_with_their_ages(middleware):
    ranges = RANGES.copy()
    ranges[:3] = np.inf, -np.inf, np.nan
    assert middleware.scan(SECOND + PERIOD, 0, ranges)
    assert middleware.odometry(SECOND + 2 * PERIOD, 0, *STILL)
    view = middleware.view(SECOND + 5 * PERIOD)
    assert np.array_equal(view.ranges, ranges, equal_nan=True)
    assert view.stamp_s == pytest.approx(1.2)
    assert (view.scan_age_s, view.odom_age_s) == pytest.approx((0.4, 0.3))


def give(middleware, topic, stamp=SECOND + PERIOD, value=0.0, arrival=None):
    """Hands over a datum, whose numbers are all the same."""
    arrival = SECOND if arrival is None else arrival
    if topic == "scan":
        return middleware.scan(stamp, arrival, RANGES)
    if topic == "odom":
        return middleware.odometry(stamp, arrival, np.zeros(3), np.full(3, value))
    if topic == "pose":
        return middleware.pose(stamp, arrival, np.full(3, value))
    if topic == "imu":
        return middleware.imu(stamp, arrival, value)
    return middleware.command(stamp, np.full(3, value), arrival)


ZEROS = np.zeros(3)
LOPSIDED = [[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
EARLY = SECOND + PERIOD
REFUSED = [
    ("odom", "NaN or inf", lambda m: m.odometry(EARLY, 0, [0, 0, np.nan], ZEROS)),
    ("odom", "NaN or inf", lambda m: m.odometry(EARLY, 0, ZEROS, [np.inf, 0, 0])),
    ("cmd_vel", "NaN or inf", lambda m: give(m, "cmd_vel", value=np.nan)),
    ("pose", "NaN or inf", lambda m: give(m, "pose", value=-np.inf)),
    ("imu", "NaN or inf", lambda m: give(m, "imu", value=np.nan)),
    ("scan", "shape (71,), not (72,)", lambda m: m.scan(EARLY, 0, RANGES[1:])),
    ("scan", "shape (1, 72), not (72,)", lambda m: m.scan(EARLY, 0, RANGES[None])),
    ("cmd_vel", "shape (2,), not (3,)", lambda m: m.command(EARLY, [1.0, 0.0])),
    (
        "pose",
        "covariance: NaN or inf",
        lambda m: m.pose(EARLY, 0, ZEROS, np.diag([1.0, np.nan, 1.0])),
    ),
    (
        "pose",
        "covariance: not symmetric",
        lambda m: m.pose(EARLY, 0, ZEROS, LOPSIDED),
    ),
    (
        "pose",
        "covariance: not positive definite",
        lambda m: m.pose(EARLY, 0, ZEROS, np.diag([1.0, -1e-3, 1.0])),
    ),
    (
        "imu",
        "covariance: not positive definite",
        lambda m: m.imu(EARLY, 0, 0.0, -1.0),
    ),
    *(
        (topic, "stamp is not an integer", partial(give, topic=topic, stamp=1.5))
        for topic in ("scan", "odom", "pose", "imu")
    ),
]


@pytest.mark.parametrize(("topic", "reason", "hand_over"), REFUSED)
def test_what_can_not_be_true_is_refused_counted_and_changes_nothing(
    middleware, topic, reason, hand_over
):
    before = state(middleware)
    assert not hand_over(middleware)
    assert middleware.cache.rejected == {(topic, reason): 1}
    assert_same(before, state(middleware))


OLD = "not after the reset"


@pytest.mark.parametrize(
    ("topic", "stamp", "reason"),
    [
        ("odom", SECOND - 1, OLD),
        ("odom", SECOND, OLD),
        ("odom", SECOND + PERIOD, "older than 1 s"),
        ("odom", 3 * SECOND, "duplicate"),
        ("scan", 3 * SECOND - 1, "out of order"),
        ("scan", 3 * SECOND, "duplicate"),
    ],
)
def test_old_and_repeated_data_are_refused(middleware, topic, stamp, reason):
    assert give(middleware, topic, 3 * SECOND, 0.4)
    before = state(middleware)
    assert not give(middleware, topic, stamp, 9.0)
    assert middleware.cache.rejected == {(topic, reason): 1}
    assert_same(before, state(middleware))


@pytest.mark.parametrize("topic", ["scan", "odom", "pose", "imu", "cmd_vel"])
def test_data_from_the_future_are_refused_but_not_the_robots_own_commands(
    middleware, topic
):
    give(middleware, "odom", SECOND, arrival=50 * SECOND)
    before = state(middleware)
    assert not give(middleware, topic, 3 * SECOND + 1, arrival=51 * SECOND)
    assert middleware.cache.rejected == {(topic, "more than 1 s in the future"): 1}
    assert_same(before, state(middleware))
    assert give(middleware, topic, 3 * SECOND, arrival=51 * SECOND)
    assert middleware.command(9 * SECOND, [1.0, 0.0, 0.0])


def test_health_tells_rates_ages_refusals_and_innovations(middleware):
    for k in range(1, 101):
        now = SECOND + k * PERIOD // 5
        middleware.imu(now, now + 7, 0.0)
        if k % 5 == 0:
            middleware.odometry(now, now + 7, *STILL)
            middleware.pose(
                now, now + 7, [1.0, 2.0, 0.5] if k < 100 else [8.0, 2.0, 0.5]
            )
    middleware.scan(3 * SECOND, 3 * SECOND, RANGES)
    health = middleware.health(4 * SECOND + 7)
    rates = {topic: each.rate_hz for topic, each in health.topics.items()}
    # A second after the last: 32 arrivals of the gyro in 1.62 s, 20 of the others in 2.9 s.
    slow = {"imu": 32 / 1.62, "odom": 20 / 2.9, "pose": 20 / 2.9, "scan": 0.0}
    assert rates == pytest.approx(slow)
    assert middleware.health(3 * SECOND + 7).topics["imu"].rate_hz == pytest.approx(
        50.0
    )
    assert health.topics["odom"].age_s == pytest.approx(1.0)
    assert {t: each.received for t, each in health.topics.items()} == {
        "imu": 100,
        "odom": 20,
        "pose": 20,
        "scan": 1,
    }
    assert health.topics["odom"].innovation == pytest.approx(0.0)
    assert health.topics["pose"].innovation > 1000.0
    assert np.isnan(health.topics["scan"].innovation)
    assert health.rejected == {("pose", "outlier"): 1}
    assert health.replayed == 20  # of equal stamps, the yaw rate counts after the twist


USED = """
import sys
import numpy as np
from nics_drl_bridge.generator import load_model
from nics_drl_bridge.kernels import KERNELS
from nics_drl_bridge.middleware.middleware import Middleware, rehearse

def known():
    return {(kernel.__name__, types) for kernel in KERNELS for types in kernel.overloads}

model = load_model(sys.argv[1])
view = rehearse(model)
assert np.allclose(view.pose, 0.0) and np.allclose(view.twist, 0.0)
assert np.isposinf(view.ranges).all() and view.scan_age_s == view.odom_age_s == 0.0
rehearsed, middleware, period = known(), Middleware(model), round(model.control_period * 1e9)
middleware.reset(period, np.zeros(3))
for k in range(2, 30):
    now, far = k * period, 3.0 if k % 9 == 0 else 0.0
    pose, twist = np.array([0.05 * k, 0.01, 0.02]), np.array([0.5 + far, 0.0, 0.1])
    middleware.command(now - 3 * period * (k % 7 == 0), np.full(len(model.robot.command), 0.1))
    middleware.odometry(now, now, pose, twist)
    middleware.scan(now, now, np.full(model.lidar.beams, 3.0, np.float32))
    middleware.pose(now - period // 3, now, pose + far)
    middleware.imu(now - period // 2, now, 0.1 + far)
    middleware.view(now + period // 2), middleware.estimator.twist_covariance
print(sorted(name for name, _ in known() - rehearsed))
"""


@pytest.mark.process
def test_what_is_rehearsed_is_all_that_a_moving_robot_calls(tmp_path):
    save_model(builtin_model("ackermann"), tmp_path / "model")
    command = [sys.executable, "-c", USED, tmp_path / "model"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_after_a_change_of_lidar_only_scans_of_its_beams_are_taken(middleware):
    assert middleware.scan(SECOND, SECOND, RANGES)
    middleware.expect_beams(7)
    assert np.isnan(middleware.view(SECOND).ranges).tolist() == [True] * 7
    assert not middleware.scan(SECOND + PERIOD, SECOND + PERIOD, RANGES)
    assert middleware.scan(SECOND + PERIOD, SECOND + PERIOD, np.ones(7, np.float32))
    assert middleware.view(SECOND + PERIOD).ranges.tolist() == [1.0] * 7


def test_a_covariance_of_zeros_means_that_of_the_model(middleware):
    other = Middleware(direct_model())
    other.reset(SECOND, [1.0, 2.0, 0.5])
    middleware.pose(2 * SECOND, 0, [1.01, 2.0, 0.5], np.zeros((3, 3)))
    other.pose(2 * SECOND, 0, [1.01, 2.0, 0.5])
    assert_same(state(middleware), state(other))


def test_data_of_a_sensor_whose_clock_is_off_do_not_move_that_of_the_robot(middleware):
    for k in range(1, 101):
        assert middleware.odometry(SECOND + k * PERIOD, k * PERIOD, *STILL)
        assert not middleware.pose(k * PERIOD - 3 * SECOND, k * PERIOD, [9.0, 9.0, 0.0])
        assert not middleware.imu(SECOND * 1000, k * PERIOD, 0.0)
    assert "clock: jump" not in middleware.health(0).noticed
