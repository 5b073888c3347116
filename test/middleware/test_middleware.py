"""What can't be true never enters the estimate, and is counted by its reason."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from robots import direct_model

from middleware.rig import PERIOD, RANGES, SECOND, STILL, assert_same, refused, state
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.middleware import Middleware, TopicCache, rehearse


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


def test_before_any_datum_the_view_says_that_nothing_is_known(middleware):
    view = middleware.view(SECOND)
    assert view.pose == pytest.approx([1.0, 2.0, 0.5])
    assert np.isnan(view.ranges).all()
    assert view.ranges.dtype == np.float32
    assert view.scan_age_s == view.odom_age_s == np.inf


def test_the_view_holds_the_newest_data_with_their_ages(middleware):
    assert middleware.scan(SECOND + PERIOD, 0, RANGES)
    assert middleware.odometry(SECOND + 2 * PERIOD, 0, *STILL)
    view = middleware.view(SECOND + 5 * PERIOD)
    assert np.array_equal(view.ranges, RANGES)
    assert view.stamp_s == pytest.approx(1.2)
    assert (view.scan_age_s, view.odom_age_s) == pytest.approx((0.4, 0.3))


@pytest.mark.parametrize(
    ("stamp", "reason"),
    [
        (SECOND - 1, "not after the reset"),
        (SECOND, "not after the reset"),
        (SECOND + PERIOD, "older than 1 s"),
        (3 * SECOND, "duplicate"),
    ],
)
def test_old_and_repeated_odometry_is_refused_counted_and_changes_nothing(
    middleware, stamp, reason
):
    middleware.odometry(3 * SECOND, 0, [0, 0, 0], [0.4, 0.0, 0.1])
    before = state(middleware)
    assert not middleware.odometry(stamp, 0, [9.0, 9.0, 9.0], [9.0, 9.0, 9.0])
    assert middleware.cache.rejected == {("odom", reason): 1}
    assert_same(before, state(middleware))


@pytest.mark.parametrize("stamp", [SECOND + PERIOD, SECOND + 2 * PERIOD])
def test_old_and_repeated_scans_are_refused_and_counted(middleware, stamp):
    middleware.scan(SECOND + 2 * PERIOD, 0, RANGES)
    assert not middleware.scan(stamp, 0, RANGES + 1)
    assert refused(middleware) == 1
    assert np.array_equal(middleware.view(2 * SECOND).ranges, RANGES)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(6))
def test_odometry_that_is_no_number_never_enters(middleware, value, place):
    numbers = np.zeros(6)
    numbers[place] = value
    before = state(middleware)
    assert not middleware.odometry(SECOND + PERIOD, 0, numbers[:3], numbers[3:])
    assert middleware.cache.rejected == {("odom", "NaN or inf"): 1}
    assert_same(before, state(middleware))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_commands_that_are_no_numbers_never_enter(middleware, value):
    before = state(middleware)
    middleware.command(SECOND, [value, 0.0, 0.0])
    assert middleware.cache.rejected == {("cmd_vel", "NaN or inf"): 1}
    assert_same(before, state(middleware))
    middleware.odometry(SECOND + PERIOD, 0, *STILL)
    assert np.isfinite(state(middleware)[0]).all()


def test_after_bad_data_good_ones_count_in_full(middleware):
    clean = Middleware(direct_model())
    clean.reset(SECOND, [1.0, 2.0, 0.5])
    rng = np.random.default_rng(0)
    for step in range(1, 60):
        twist = rng.normal(size=3)
        now = SECOND + step * PERIOD
        middleware.odometry(now, 0, np.zeros(3), np.full(3, np.nan))
        for one in (clean, middleware):
            one.command(now - PERIOD, twist)
            one.odometry(now, 0, np.zeros(3), twist)
        middleware.odometry(now - PERIOD, 0, np.zeros(3), np.full(3, 5.0))
    assert refused(middleware) == 2 * 59
    assert_same(state(clean), state(middleware))


@pytest.mark.parametrize("shape", [(71,), (0,), (1, 72)])
def test_a_scan_of_another_lidar_is_refused(middleware, shape):
    assert not middleware.scan(SECOND + PERIOD, 0, np.zeros(shape, np.float32))
    assert refused(middleware) == 1
    assert np.isnan(middleware.view(2 * SECOND).ranges).all()


def test_ranges_without_return_pass_as_they_are(middleware):
    ranges = np.full(72, np.inf, np.float32)
    ranges[:2] = -np.inf, np.nan
    assert middleware.scan(SECOND + PERIOD, 0, ranges)
    assert np.array_equal(middleware.view(2 * SECOND).ranges, ranges, equal_nan=True)


def test_a_reset_forgets_everything(middleware):
    middleware.scan(9 * SECOND, 0, RANGES)
    middleware.command(9 * SECOND, [1.0, 0.0, 0.0])
    middleware.odometry(9 * SECOND, 0, [0, 0, 0], [1.0, 0.0, 0.0])
    middleware.odometry(9 * SECOND, 0, [0, 0, 0], [1.0, 0.0, 0.0])
    middleware.reset(SECOND, [1.0, 2.0, 0.5])
    fresh = Middleware(direct_model())
    fresh.reset(SECOND, [1.0, 2.0, 0.5])
    assert_same(state(fresh), state(middleware))
    assert refused(middleware) == 0


def test_asking_for_a_view_changes_nothing(middleware):
    middleware.command(SECOND, [0.5, 0.1, 0.3])
    middleware.odometry(SECOND + PERIOD, 0, [0, 0, 0], [0.5, 0.1, 0.3])
    before = state(middleware, 2 * SECOND)
    for later in (3, 50, 2):
        middleware.view(later * SECOND)
    assert_same(before, state(middleware, 2 * SECOND))


def test_late_odometry_counts_but_the_newest_stays_the_newest(middleware):
    middleware.odometry(3 * SECOND, 7, [3.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert middleware.odometry(3 * SECOND - PERIOD, 9, [2.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    newest = middleware.cache.newest["odom"]
    assert (newest.stamp_ns, newest.arrival_ns, newest.value[0][0]) == (
        3 * SECOND,
        7,
        3.0,
    )
    assert middleware.health(9).topics["odom"].received == 2


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


def test_without_data_nothing_is_healthy_or_ill(middleware):
    health = middleware.health(SECOND)
    assert (health.topics, health.rejected, health.noticed, health.replayed) == (
        {},
        {},
        {},
        0,
    )


def test_a_rehearsal_ends_with_a_robot_that_stands_still_in_the_open():
    model = builtin_model("ackermann")
    view = rehearse(model)
    assert np.allclose(view.pose, 0.0, atol=1e-9)
    assert np.allclose(view.twist, 0.0, atol=1e-9)
    assert np.isposinf(view.ranges).all()
    assert view.scan_age_s == view.odom_age_s == 0.0


USED = """
import numpy as np
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.kernels import KERNELS
from nics_drl_bridge.middleware.middleware import Middleware, rehearse

def known():
    return {(kernel.__name__, types) for kernel in KERNELS for types in kernel.overloads}

model = builtin_model("ackermann")
rehearse(model)
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
def test_what_is_rehearsed_is_all_that_a_moving_robot_calls():
    done = subprocess.run(
        [sys.executable, "-c", USED], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


def test_after_a_change_of_lidar_only_scans_of_its_beams_are_taken(middleware):
    assert middleware.scan(SECOND, SECOND, RANGES)
    middleware.expect_beams(7)
    assert np.isnan(middleware.view(SECOND).ranges).tolist() == [True] * 7
    assert not middleware.scan(SECOND + PERIOD, SECOND + PERIOD, RANGES)
    assert middleware.scan(SECOND + PERIOD, SECOND + PERIOD, np.ones(7, np.float32))
    assert middleware.view(SECOND + PERIOD).ranges.tolist() == [1.0] * 7


SENSORS = {
    "odom": lambda m, stamp, value: m.odometry(
        stamp, 0, np.zeros(3), np.full(3, value)
    ),
    "pose": lambda m, stamp, value: m.pose(stamp, 0, np.full(3, value)),
    "imu": lambda m, stamp, value: m.imu(stamp, 0, value),
}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("topic", ["pose", "imu"])
def test_poses_and_yaw_rates_that_are_no_numbers_never_enter(middleware, topic, value):
    before = state(middleware)
    assert not SENSORS[topic](middleware, SECOND + PERIOD, value)
    assert middleware.cache.rejected == {(topic, "NaN or inf"): 1}
    assert_same(before, state(middleware))


NO_COVARIANCES = {
    "NaN or inf": np.diag([1.0, np.nan, 1.0]),
    "not symmetric": [[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "not positive definite": np.diag([1.0, -1e-3, 1.0]),
}


@pytest.mark.parametrize("fault", NO_COVARIANCES)
def test_a_pose_whose_covariance_is_none_never_enters(middleware, fault):
    before = state(middleware)
    assert not middleware.pose(SECOND + PERIOD, 0, np.zeros(3), NO_COVARIANCES[fault])
    assert middleware.cache.rejected == {("pose", f"covariance: {fault}"): 1}
    assert_same(before, state(middleware))


@pytest.mark.parametrize("variance", [np.nan, -1.0])
def test_a_yaw_rate_whose_variance_is_none_never_enters(middleware, variance):
    assert not middleware.imu(SECOND + PERIOD, 0, 0.0, variance)
    assert refused(middleware) == 1


def test_a_covariance_of_zeros_means_that_of_the_model(middleware):
    other = Middleware(direct_model())
    other.reset(SECOND, [1.0, 2.0, 0.5])
    middleware.pose(2 * SECOND, 0, [1.01, 2.0, 0.5], np.zeros((3, 3)))
    other.pose(2 * SECOND, 0, [1.01, 2.0, 0.5])
    assert_same(state(middleware), state(other))


@pytest.mark.parametrize("kind", ["scan", *SENSORS])
@pytest.mark.parametrize("stamp", [float("nan"), float("inf"), None, "1"])
def test_a_stamp_that_is_no_whole_number_is_refused(middleware, kind, stamp):
    before = state(middleware)
    if kind == "scan":
        assert not middleware.scan(stamp, 0, RANGES)
    else:
        assert not SENSORS[kind](middleware, stamp, 0.0)
    assert middleware.cache.rejected == {(kind, "stamp is not an integer"): 1}
    assert_same(before, state(middleware))


@pytest.mark.parametrize("kind", ["scan", *SENSORS])
def test_data_from_the_future_never_enter(middleware, kind):
    middleware.odometry(SECOND, 50 * SECOND, *STILL)
    before = state(middleware)
    late = 3 * SECOND + 1
    due = 3 * SECOND
    for stamp, used in ((late, False), (due, True)):
        if kind == "scan":
            given = middleware.scan(stamp, 51 * SECOND, RANGES)
        elif kind == "odom":
            given = middleware.odometry(stamp, 51 * SECOND, *STILL)
        elif kind == "pose":
            given = middleware.pose(stamp, 51 * SECOND, [1.0, 2.0, 0.5])
        else:
            given = middleware.imu(stamp, 51 * SECOND, 0.0)
        assert given == used
        assert middleware.cache.rejected == {(kind, "more than 1 s in the future"): 1}
        if not used:
            assert_same(before, state(middleware))


def test_a_command_from_the_future_never_enters_but_ones_own_needs_no_check(middleware):
    middleware.odometry(SECOND, 50 * SECOND, *STILL)
    assert not middleware.command(9 * SECOND, [1.0, 0.0, 0.0], 50 * SECOND)
    assert middleware.cache.rejected == {("cmd_vel", "more than 1 s in the future"): 1}
    assert middleware.command(9 * SECOND, [1.0, 0.0, 0.0])


def test_a_command_of_another_robot_is_refused(middleware):
    assert not middleware.command(SECOND, [1.0, 0.0])
    assert middleware.cache.rejected == {("cmd_vel", "shape (2,), not (3,)"): 1}


@pytest.mark.parametrize("jump", [-500, 3600])
def test_a_clock_that_was_set_is_followed_and_the_robot_stays_where_it_was(
    middleware, jump
):
    for k in range(1, 31):
        middleware.odometry(SECOND + k * PERIOD, k * PERIOD, *STILL)
    middleware.scan(4 * SECOND, 3 * SECOND, RANGES)
    for k in range(31, 41):
        assert not middleware.odometry(
            (1 + jump) * SECOND + k * PERIOD, k * PERIOD, *STILL
        )
    for k in range(41, 51):
        assert middleware.odometry((1 + jump) * SECOND + k * PERIOD, k * PERIOD, *STILL)
    assert middleware.scan((1 + jump) * SECOND + 50 * PERIOD, 50 * PERIOD, RANGES)
    assert middleware.newest_ns == (1 + jump) * SECOND + 50 * PERIOD
    health = middleware.health(50 * PERIOD)
    assert health.noticed == {"clock: jump": 1}
    assert sum(health.rejected.values()) == 10
    view = middleware.view(middleware.newest_ns)
    assert view.pose == pytest.approx([1.0, 2.0, 0.5])


def test_data_of_a_sensor_whose_clock_is_off_do_not_move_that_of_the_robot(middleware):
    for k in range(1, 101):
        assert middleware.odometry(SECOND + k * PERIOD, k * PERIOD, *STILL)
        assert not middleware.pose(k * PERIOD - 3 * SECOND, k * PERIOD, [9.0, 9.0, 0.0])
        assert not middleware.imu(SECOND * 1000, k * PERIOD, 0.0)
    assert "clock: jump" not in middleware.health(0).noticed


def test_only_newer_data_replace_the_newest():
    cache = TopicCache()
    assert cache.put("scan", 100, 101, "a")
    assert cache.put("scan", 200, 201, "b")
    assert not cache.put("scan", 150, 202, "late")
    assert not cache.put("scan", 200, 203, "copy")
    held = cache.newest["scan"]
    assert (held.value, held.stamp_ns, held.arrival_ns, held.sequence) == (
        "b",
        200,
        201,
        1,
    )


def test_refusals_are_counted_by_topic_and_reason():
    cache = TopicCache()
    for stamp in (5, 5, 5, 3, 9):
        cache.put("scan", stamp, 0, None)
    cache.put("odom", 4, 0, None)
    cache.put("odom", 1, 0, None)
    assert cache.rejected == {
        ("scan", "duplicate"): 2,
        ("scan", "out of order"): 1,
        ("odom", "out of order"): 1,
    }


def test_topics_do_not_disturb_each_other():
    cache = TopicCache()
    cache.put("scan", 1000, 0, "s")
    assert cache.put("odom", 10, 0, "o")
    assert cache.newest["odom"].sequence == 0


def test_age_counts_from_the_stamp_and_is_infinite_without_data():
    cache = TopicCache()
    assert cache.age_s("scan", 5) == float("inf")
    cache.put("scan", 1_000_000_000, 1_900_000_000, None)
    assert cache.age_s("scan", 2_500_000_000) == pytest.approx(1.5)


def test_two_caches_share_nothing():
    one = TopicCache()
    other = TopicCache()
    one.put("scan", 1, 1, None)
    one.reject("scan", "reason")
    assert not other.newest
    assert not other.rejected
