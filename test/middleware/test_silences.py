"""A clock that is set, and silences: how far the robot may have come is known."""

from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model

from middleware.rig import PERIOD, SECOND
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.belief import JITTER_S, find_max_speeds
from nics_drl_bridge.middleware.ekf import LONGEST_GAP_S
from nics_drl_bridge.middleware.middleware import Middleware


def driven(middleware, periods=20, shift_ns=0, begin=0):
    """Straight on at 1 m/s; the odometry of each period is true, but for its clock."""
    for k in range(begin + 1, begin + periods + 1):
        now = SECOND + k * PERIOD
        middleware.command(None, [1.0, 0.0, 0.0])
        middleware.odometry(now + shift_ns, now, [0.1 * k, 0.0, 0.0], [1.0, 0.0, 0.0])


def started():
    middleware = Middleware(direct_model())
    middleware.reset(SECOND, [1.0, 2.0, 0.5])
    return middleware


@pytest.mark.parametrize("jump_s", [-500.0, 30.0])
def test_after_a_jump_it_begins_at_the_last_pose_and_may_be_anywhere_in_reach(jump_s):
    middleware = started()
    driven(middleware)
    last = middleware.estimator.belief.mean[:2].copy()
    shift_ns = round(jump_s * SECOND)
    driven(middleware, 10, shift_ns, begin=20)
    assert middleware.health(0).noticed["clock: jump"] == 1
    belief = middleware.estimator.belief
    assert belief.time_ns == SECOND + 30 * PERIOD + shift_ns
    assert belief.mean[:2] == pytest.approx(last)
    far = find_max_speeds(direct_model())[0] * (1.0 + JITTER_S)
    assert np.sqrt(belief.covariance[0, 0]) == pytest.approx(far / np.sqrt(3), rel=0.02)
    truth = np.array([1.0, 2.0]) + 3.0 * np.array([np.cos(0.5), np.sin(0.5)])
    assert np.hypot(*(truth - last)) < 3.0 * np.sqrt(belief.covariance[0, 0])
    driven(middleware, 20, shift_ns, begin=30)
    moved = np.hypot(*(middleware.estimator.belief.mean[:2] - last))
    assert moved == pytest.approx(2.0, abs=0.05)
    view = middleware.view(middleware.estimator.time_ns)
    assert view.twist[0] == pytest.approx(1.0, abs=0.05)


def test_data_that_come_late_or_after_a_gap_or_in_a_burst_are_no_jump():
    middleware = started()
    rng = np.random.default_rng(0)
    for k in range(1, 200):
        if rng.random() < 0.2:
            continue  # lost
        stamp = SECOND + k * PERIOD
        held = 7 * PERIOD if 50 <= k < 56 or 120 <= k < 123 else 0
        late = int(rng.integers(0, 3)) * PERIOD
        middleware.odometry(
            stamp, stamp + max(late, held), [0.1 * k, 0.0, 0.0], [1.0, 0.0, 0.0]
        )
    assert "clock: jump" not in middleware.health(0).noticed


def silent(seconds, pose=None, twist=0.0, robot="differential"):
    middleware = Middleware(builtin_model(robot))
    middleware.reset(SECOND, np.zeros(3))
    middleware.odometry(SECOND, SECOND, np.zeros(3), np.zeros(3))
    for k in range(1, 6):
        middleware.odometry(
            SECOND + k * PERIOD, SECOND + k * PERIOD, np.zeros(3), np.zeros(3)
        )
    now = SECOND + round(seconds * SECOND)
    if pose is not None:
        assert middleware.odometry(now, now, pose, [twist, 0.0, 0.0])
    else:
        middleware.estimator.predict(now)
    return middleware


def test_in_a_long_silence_the_robot_may_have_driven_as_far_as_it_can():
    seconds = LONGEST_GAP_S + 5.0
    far = find_max_speeds(builtin_model("differential"))[0] * (seconds - 0.5 + JITTER_S)
    covariance = silent(seconds).estimator.covariance
    assert np.sqrt(covariance[:2, :2].diagonal()) == pytest.approx(
        far / np.sqrt(3), rel=0.02
    )
    assert covariance[2, 2] == pytest.approx(np.pi**2 / 3, rel=0.02)


def test_what_odometry_says_was_driven_in_a_long_silence_is_believed():
    middleware = silent(15.0, pose=[3.0, 1.0, 0.4], twist=0.5)
    belief = middleware.estimator.belief
    assert belief.mean[:3] == pytest.approx([3.0, 1.0, 0.4], abs=1e-6)
    assert 0.05 < np.sqrt(belief.covariance[0, 0]) < 1.0


@pytest.mark.parametrize("pose", [[400.0, 0.0, 0.0], [0.0, -99.0, 0.0]])
def test_what_no_robot_can_have_driven_in_a_silence_is_not(pose):
    belief = silent(15.0, pose=pose).estimator.belief
    assert np.abs(belief.mean[:3]).max() < 0.1
    assert np.sqrt(belief.covariance[0, 0]) > 3.0
