"""Odometry whose wheels slip turns by the gyro: its bias is learnt, faults are noticed."""

from __future__ import annotations

import numpy as np
import pytest
from skid_steer import OVER_REPORTED, drive_skid_steer

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.middleware import Middleware

NS = 1_000_000_000


def believed(
    drive, gyro=None, commands=1.0, variance=None, turn_variance=None, every=1
):
    """Feeds a drive to a middleware; returns it, its poses, and the true ones at these times."""
    middleware = Middleware(builtin_model("differential"))
    start = drive.odom_t[0]
    middleware.reset(round(start * NS), drive.odom[0])
    rates = drive.gyro if gyro is None else gyro
    events = [(t, 0, k) for k, t in enumerate(drive.t[::5])]
    events += [(t, 1, k) for k, t in enumerate(drive.odom_t[::5])]
    if rates is not False:
        events += [(t, 2, k) for k, t in enumerate(drive.t[: len(rates) : every])]
    poses = []
    truths = []
    for t, what, k in sorted(events):
        now = round(t * NS)
        if what == 0:
            speed, turn = drive.command[5 * k]
            middleware.command(now, [speed, turn * commands])
        elif what == 1:
            pose = drive.odom[5 * k].copy()
            pose[2] = geometry.wrap_angle(pose[2])
            middleware.odometry(now, now, pose, drive.odom_twist[5 * k], turn_variance)
            poses.append(middleware.view(now).pose)
            truths.append(drive.truth[round(t * 100)])
        else:
            middleware.imu(now, now, float(rates[every * k]), variance)
    return middleware, np.array(poses), np.array(truths)


def off(poses, truths):
    turn = np.abs(geometry.wrap_angle(poses[:, 2] - truths[:, 2]))
    return float(np.hypot(*(poses - truths)[:, :2].T).max()), float(turn.max())


@pytest.fixture(scope="module")
def slipping():
    return drive_skid_steer(np.random.default_rng(3), duration=120.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"commands": 1.0 / OVER_REPORTED, "variance": 0.004**2},
        {"variance": 1e-12, "turn_variance": 1e3},
        {"variance": 1e6, "turn_variance": 1e-9, "every": 10},
    ],
)
def test_after_two_minutes_the_belief_is_close_to_the_truth(slipping, changes):
    """Whether the model predicts the true turns or those of the wheels, whatever is claimed."""
    middleware, poses, truths = believed(slipping, **changes)
    far, turned = off(poses, truths)
    assert turned < 0.15
    assert far < 0.8
    error = poses[-1] - truths[-1]
    error[2] = geometry.wrap_angle(error[2])
    covariance = middleware.estimator.covariance[:3, :3]
    assert error @ np.linalg.solve(covariance, error) < 30.0
    gyro = middleware.estimator.belief.gyro
    assert gyro.bias == pytest.approx(0.02, abs=3e-3)
    assert gyro.slip == pytest.approx(1.0 - 1.0 / OVER_REPORTED, abs=0.05)
    assert middleware.health(0).rejected.get(("imu", "outlier"), 0) < 5


@pytest.mark.slow
def test_without_the_gyro_the_same_drive_ends_far_from_the_truth(slipping):
    middleware, poses, truths = believed(slipping, gyro=False)
    far, turned = off(poses, truths)
    assert turned > 0.4
    assert far > 0.5
    assert middleware.estimator.belief.gyro is None


def test_an_exact_gyro_that_turns_steadily_is_not_taken_for_stuck():
    middleware = Middleware(builtin_model("differential"))
    middleware.reset(0, np.zeros(3))
    heading = 0.0
    for k in range(1, 600):
        now = k * NS // 100
        rate = 0.0 if k < 100 else min(0.4, 0.01 * (k - 100))
        middleware.imu(now, now, rate)
        heading += 0.01 * 1.5 * rate
        if k % 10 == 0:
            middleware.odometry(now, now, [0.0, 0.0, heading], [0.0, 0.0, 1.5 * rate])
    assert middleware.view(6 * NS).pose[2] == pytest.approx(heading / 1.5, abs=0.08)


TRUE_WHEELS = {"over_reported": 1.0}
UNBIASED = {"over_reported": 1.0, "bias": 0.0}


def spoil(rates):
    """Every 37th rate is far off."""
    spoilt = rates.copy()
    spoilt[100::37] += 2.5
    return spoilt


@pytest.mark.parametrize(
    ("seconds", "changes", "gyro", "turned", "outliers"),
    [
        (30.0, {"noise": 0.0}, lambda rates: rates, 0.1, {"odom": (0, 5)}),
        (30.0, {"noise": 0.03}, lambda rates: rates, 0.1, {"odom": (0, 5)}),
        (20.0, {}, spoil, 0.1, {"imu": (40, 60)}),
        (30.0, TRUE_WHEELS, lambda rates: rates[:1500], 0.15, {}),
        (40.0, UNBIASED, np.zeros_like, 0.25, {}),
        (40.0, UNBIASED, np.degrees, 0.25, {}),
        (40.0, UNBIASED, np.negative, 0.25, {}),
        (40.0, UNBIASED, lambda rates: 9.0 * (-1.0) ** np.arange(len(rates)), 0.25, {}),
    ],
    ids=[
        *("exact", "noisy", "single rates far off", "falls silent"),
        *("frozen", "in degrees", "mirrored", "mad"),
    ],
)
def test_whatever_the_gyro_does_the_heading_is_true_and_odometry_no_outlier(
    seconds, changes, gyro, turned, outliers
):
    drive = drive_skid_steer(np.random.default_rng(4), duration=seconds, **changes)
    middleware, poses, truths = believed(drive, gyro=gyro(drive.gyro))
    assert off(poses, truths)[1] < turned
    rejected = middleware.health(0).rejected
    for topic, (least, most) in outliers.items():
        assert least <= rejected.get((topic, "outlier"), 0) < most


def test_wheels_that_stand_do_not_turn_the_robot_however_the_gyro_drifts():
    rng = np.random.default_rng(0)
    middleware = Middleware(builtin_model("differential"))
    middleware.reset(0, np.zeros(3))
    for k in range(1, 6000):
        now = k * NS // 100
        middleware.imu(now, now, 0.05 + rng.normal(0.0, 0.01))
        if k % 10 == 0:
            middleware.odometry(now, now, np.zeros(3), np.zeros(3))
    assert abs(middleware.view(60 * NS).pose[2]) < 1e-3
    gyro = middleware.estimator.belief.gyro
    assert gyro.bias == pytest.approx(0.05, abs=1e-3)
    assert gyro.bias_variance < 1e-3**2 * 4.0


def test_a_robot_that_is_turned_by_hand_turns_in_the_estimate_too():
    middleware = Middleware(builtin_model("differential"))
    middleware.reset(0, np.zeros(3))
    rng = np.random.default_rng(0)
    for k in range(1, 1000):
        now = k * NS // 100
        turning = 0.4 * np.sin(np.pi * (k - 500) / 300.0) if 500 <= k < 800 else 0.0
        middleware.imu(now, now, turning + rng.normal(0.0, 0.005))
        if k % 10 == 0:
            middleware.odometry(now, now, np.zeros(3), np.zeros(3))
    assert middleware.view(10 * NS).pose[2] == pytest.approx(2.4 / np.pi, abs=0.05)
