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
    drive,
    gyro=None,
    commands=1.0,
    variance=None,
    turn_variance=None,
    model=None,
    every=1,
):
    """Feeds a drive to a middleware; returns it, its poses, and the true ones at these times."""
    middleware = Middleware(model or builtin_model("differential"))
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
@pytest.mark.parametrize("variance", [None, 0.004**2, 1e-12, 1e6])
@pytest.mark.parametrize("commands", [1.0 / OVER_REPORTED, 1.0])
def test_after_two_minutes_the_belief_is_close_to_the_truth(
    slipping, commands, variance
):
    """Whether the model predicts the true turns or those of the wheels, whatever is claimed."""
    middleware, poses, truths = believed(slipping, commands=commands, variance=variance)
    far, turned = off(poses, truths)
    assert turned < 0.1
    assert far < 0.8
    gyro = middleware.estimator.belief.gyro
    assert gyro.bias == pytest.approx(0.02, abs=3e-3)
    assert gyro.slip == pytest.approx(1.0 - 1.0 / OVER_REPORTED, abs=0.05)
    assert middleware.health(0).rejected.get(("imu", "outlier"), 0) < 5


@pytest.mark.slow
def test_without_the_gyro_the_same_drive_ends_far_from_the_truth(slipping):
    _, poses, truths = believed(slipping, gyro=False, commands=1.0 / OVER_REPORTED)
    far, turned = off(poses, truths)
    assert turned > 0.4
    assert far > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("turn_variance", [None, 1e-9, 1e3, 0.05])
def test_the_covariance_of_odometry_is_not_believed_where_the_wheels_slip(
    slipping, turn_variance
):
    _, poses, truths = believed(slipping, turn_variance=turn_variance)
    far, turned = off(poses, truths)
    assert turned < 0.1
    assert far < 0.8


@pytest.mark.slow
@pytest.mark.parametrize("every", [2, 5, 10])
def test_a_slow_gyro_helps_as_well(slipping, every):
    _, poses, truths = believed(slipping, every=every)
    assert off(poses, truths)[1] < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_neither_an_exact_nor_a_noisy_gyro_makes_odometry_an_outlier(noise):
    drive = drive_skid_steer(np.random.default_rng(3), duration=60.0, noise=noise)
    middleware, poses, truths = believed(drive)
    assert off(poses, truths)[1] < 0.1
    assert middleware.health(0).rejected.get(("odom", "outlier"), 0) < 5


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


@pytest.mark.slow
def test_the_error_is_within_what_the_estimate_says_of_its_uncertainty(slipping):
    middleware, poses, truths = believed(slipping, commands=1.0 / OVER_REPORTED)
    error = np.append(
        (poses - truths)[-1, :2], geometry.wrap_angle(poses[-1, 2] - truths[-1, 2])
    )
    covariance = middleware.estimator.covariance[:3, :3]
    assert error @ np.linalg.solve(covariance, error) < 20.0


FAULTS = {
    "frozen": lambda drive: np.full_like(drive.gyro, 0.0),
    "in degrees": lambda drive: np.degrees(drive.gyro),
    "mirrored": lambda drive: -drive.gyro,
    "mad": lambda drive: np.where(np.arange(len(drive.gyro)) % 2, 9.0, -9.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_gyro_that_is_faulty_leaves_the_heading_to_the_wheels(fault):
    drive = drive_skid_steer(
        np.random.default_rng(4), duration=60.0, over_reported=1.0, bias=0.0
    )
    _, poses, truths = believed(drive, gyro=FAULTS[fault](drive))
    _, turned = off(poses, truths)
    assert turned < 0.25


def test_single_far_off_rates_are_refused():
    drive = drive_skid_steer(np.random.default_rng(4), duration=20.0)
    rates = drive.gyro.copy()
    rates[100::37] += 2.5
    middleware, poses, truths = believed(drive, gyro=rates)
    assert middleware.health(0).rejected[("imu", "outlier")] >= 40
    assert off(poses, truths)[1] < 0.1


def test_a_gyro_that_falls_silent_leaves_the_turns_to_the_wheels():
    drive = drive_skid_steer(np.random.default_rng(4), duration=30.0, over_reported=1.0)
    middleware, poses, truths = believed(drive, gyro=drive.gyro[:1500])
    assert off(poses, truths)[1] < 0.15
    assert middleware.estimator.belief.gyro.stamp_ns < 16 * NS


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


def test_the_order_of_arrival_does_not_matter():
    drive = drive_skid_steer(np.random.default_rng(8), duration=5.0, rest_s=1.0)
    events = [("imu", k) for k in range(1, 450)] + [
        ("odom", 5 * k) for k in range(2, 45)
    ]

    def run(order):
        middleware = Middleware(builtin_model("differential"))
        middleware.reset(0, np.zeros(3))
        for what, k in order:
            if what == "imu":
                middleware.imu(k * NS // 100, 0, float(drive.gyro[k]))
            else:
                middleware.odometry(k * NS // 50, 0, drive.odom[k], drive.odom_twist[k])
        return middleware.estimator.belief.mean

    def when(event):
        return event[1] / (100 if event[0] == "imu" else 50)

    rng = np.random.default_rng(1)
    in_order = run(sorted(events, key=when))
    late = run(sorted(events, key=lambda e: when(e) + 0.3 * rng.random()))
    assert late == pytest.approx(in_order, abs=1e-9)


def test_without_a_gyro_nothing_is_known_of_one():
    drive = drive_skid_steer(np.random.default_rng(8), duration=5.0)
    middleware, _, _ = believed(drive, gyro=False)
    assert middleware.estimator.belief.gyro is None
