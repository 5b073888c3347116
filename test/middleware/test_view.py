from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model

from middleware.rig import PERIOD, RANGES, SECOND, STILL, assert_same, refused, state
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.middleware import Middleware, rehearse


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
        (SECOND - 1, "odom: not after the reset"),
        (SECOND, "odom: not after the reset"),
        (SECOND + PERIOD, "odom: older than 1 s"),
        (3 * SECOND, "odom: duplicate"),
    ],
)
def test_old_and_repeated_odometry_is_refused_counted_and_changes_nothing(
    middleware, stamp, reason
):
    middleware.odometry(3 * SECOND, 0, [0, 0, 0], [0.4, 0.0, 0.1])
    before = state(middleware)
    assert not middleware.odometry(stamp, 0, [9.0, 9.0, 9.0], [9.0, 9.0, 9.0])
    assert middleware.cache.rejected == {reason: 1}
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
    assert middleware.cache.rejected == {"odom: NaN or inf": 1}
    assert_same(before, state(middleware))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_commands_that_are_no_numbers_never_enter(middleware, value):
    before = state(middleware)
    middleware.command(SECOND, [value, 0.0, 0.0])
    assert middleware.cache.rejected == {"cmd_vel: NaN or inf": 1}
    assert_same(before, state(middleware))
    middleware.odometry(SECOND + PERIOD, 0, *STILL)
    assert np.isfinite(state(middleware)[0]).all()


def test_after_bad_data_good_ones_count_in_full(middleware):
    clean = Middleware(direct_model())
    clean.reset(SECOND, [1.0, 2.0, 0.5])
    rng = np.random.default_rng(0)
    for step in range(1, 60):
        twist, now = rng.normal(size=3), SECOND + step * PERIOD
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
    assert (newest.stamp_ns, newest.arrival_ns, newest.value[0][0]) == (3 * SECOND, 7, 3.0)
    assert middleware.health(9).topics["odom"].received == 2


def test_health_tells_rates_ages_refusals_and_innovations(middleware):
    for k in range(1, 101):
        now = SECOND + k * PERIOD // 5
        middleware.imu(now, now + 7, 0.0)
        if k % 5 == 0:
            middleware.odometry(now, now + 7, *STILL)
            middleware.pose(now, now + 7, [1.0, 2.0, 0.5] if k < 100 else [8.0, 2.0, 0.5])
    middleware.scan(3 * SECOND, 3 * SECOND, RANGES)
    health = middleware.health(4 * SECOND + 7)
    rates = {topic: each.rate_hz for topic, each in health.topics.items()}
    # A second after the last: 32 arrivals of the gyro in 1.62 s, 20 of the others in 2.9 s.
    slow = {"imu": 32 / 1.62, "odom": 20 / 2.9, "pose": 20 / 2.9, "scan": 0.0}
    assert rates == pytest.approx(slow)
    assert middleware.health(3 * SECOND + 7).topics["imu"].rate_hz == pytest.approx(50.0)
    assert health.topics["odom"].age_s == pytest.approx(1.0)
    assert {t: each.received for t, each in health.topics.items()} == {
        "imu": 100, "odom": 20, "pose": 20, "scan": 1
    }  # fmt: skip
    assert health.topics["odom"].innovation == pytest.approx(0.0)
    assert health.topics["pose"].innovation > 1000.0
    assert np.isnan(health.topics["scan"].innovation)
    assert health.rejected == {"pose: outlier": 1}
    assert health.replayed == 20  # of equal stamps, the yaw rate counts after the twist


def test_without_data_nothing_is_healthy_or_ill(middleware):
    health = middleware.health(SECOND)
    assert (health.topics, health.rejected, health.noticed, health.replayed) == ({}, {}, {}, 0)


def test_a_rehearsal_ends_with_a_robot_that_stands_still_in_the_open():
    model = builtin_model("ackermann")
    view = rehearse(model)
    assert np.allclose(view.pose, 0.0, atol=1e-9)
    assert np.allclose(view.twist, 0.0, atol=1e-9)
    assert np.isposinf(view.ranges).all()
    assert view.scan_age_s == view.odom_age_s == 0.0


def test_after_a_change_of_lidar_only_scans_of_its_beams_are_taken(middleware):
    assert middleware.scan(SECOND, SECOND, RANGES)
    middleware.expect_beams(7)
    assert np.isnan(middleware.view(SECOND).ranges).tolist() == [True] * 7
    assert not middleware.scan(SECOND + PERIOD, SECOND + PERIOD, RANGES)
    assert middleware.scan(SECOND + PERIOD, SECOND + PERIOD, np.ones(7, np.float32))
    assert middleware.view(SECOND + PERIOD).ranges.tolist() == [1.0] * 7
