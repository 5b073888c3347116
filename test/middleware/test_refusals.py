"""What can't be true never enters the estimate, and is counted by its reason."""

from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model

from middleware.rig import PERIOD, RANGES, SECOND, STILL, assert_same, refused, state
from nics_drl_bridge.middleware.middleware import Middleware

SENSORS = {
    "odom": lambda m, stamp, value: m.odometry(stamp, 0, np.zeros(3), np.full(3, value)),
    "pose": lambda m, stamp, value: m.pose(stamp, 0, np.full(3, value)),
    "imu": lambda m, stamp, value: m.imu(stamp, 0, value),
}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("topic", ["pose", "imu"])
def test_poses_and_yaw_rates_that_are_no_numbers_never_enter(middleware, topic, value):
    before = state(middleware)
    assert not SENSORS[topic](middleware, SECOND + PERIOD, value)
    assert middleware.cache.rejected == {f"{topic}: NaN or inf": 1}
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
    assert middleware.cache.rejected == {f"pose: covariance: {fault}": 1}
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
    assert middleware.cache.rejected == {f"{kind}: stamp is no number": 1}
    assert_same(before, state(middleware))


@pytest.mark.parametrize("kind", ["scan", *SENSORS])
def test_data_from_the_future_never_enter(middleware, kind):
    middleware.odometry(SECOND, 50 * SECOND, *STILL)
    before = state(middleware)
    late, due = 3 * SECOND + 1, 3 * SECOND
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
        assert middleware.cache.rejected == {f"{kind}: more than 1 s in the future": 1}
        if not used:
            assert_same(before, state(middleware))


def test_a_command_from_the_future_never_enters_but_ones_own_needs_no_check(middleware):
    middleware.odometry(SECOND, 50 * SECOND, *STILL)
    assert not middleware.command(9 * SECOND, [1.0, 0.0, 0.0], 50 * SECOND)
    assert middleware.cache.rejected == {"cmd_vel: more than 1 s in the future": 1}
    assert middleware.command(9 * SECOND, [1.0, 0.0, 0.0])


def test_a_command_of_another_robot_is_refused(middleware):
    assert not middleware.command(SECOND, [1.0, 0.0])
    assert middleware.cache.rejected == {"cmd_vel: shape (2,), not (3,)": 1}


@pytest.mark.parametrize("jump", [-500, 3600])
def test_a_clock_that_was_set_is_followed_and_the_robot_stays_where_it_was(middleware, jump):
    for k in range(1, 31):
        middleware.odometry(SECOND + k * PERIOD, k * PERIOD, *STILL)
    middleware.scan(4 * SECOND, 3 * SECOND, RANGES)
    for k in range(31, 41):
        assert not middleware.odometry((1 + jump) * SECOND + k * PERIOD, k * PERIOD, *STILL)
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
