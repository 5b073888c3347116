"""What is taken for an outlier, for news and for a jump; and that the filter stays healthy."""

from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.measurement import Acceptance

SECOND = 1_000_000_000
PERIOD = SECOND // 10


def driven(robot="ackermann", seconds=2):
    """An estimator of a robot that drives as it should, at the end."""
    estimator = Estimator(builtin_model(robot))
    estimator.reset(0, np.zeros(3))
    command = estimator._log.arrays[1][0] * 0.0
    command[0] = 0.5
    estimator.command(0, command)
    for step in range(1, seconds * 10 + 1):
        estimator.predict(step * PERIOD)
        verdict = estimator.update_twist(estimator.at(step * PERIOD)[1])
        assert verdict.outcome is Acceptance.USED
    return estimator


def test_a_twist_that_the_robot_can_not_have_is_refused_and_changes_nothing():
    estimator = driven()
    before = estimator.belief
    verdict = estimator.update_twist([50.0, 0.0, 0.0])
    assert verdict.outcome is Acceptance.OUTLIER
    assert verdict.distance > 1000.0
    after = estimator.belief
    assert np.array_equal(before.mean, after.mean)
    assert np.array_equal(before.covariance, after.covariance)
    assert after.outliers == (1, 0, 0)


def test_a_twist_that_is_slower_than_expected_is_news_at_once():
    estimator = driven()
    assert estimator.update_twist([0.0, 0.0, 0.0]).outcome is Acceptance.NEWS
    assert estimator.belief.outliers == (0, 0, 0)
    assert abs(estimator.at(estimator.time_ns)[1][0]) < 0.01


def test_impossible_twists_are_believed_from_the_third_in_a_row_until_one_fits_again():
    estimator = driven()
    outcomes = [estimator.update_twist([0.5, 0.8, 0.0]).outcome for _ in range(5)]
    assert outcomes == [Acceptance.OUTLIER] * 2 + [Acceptance.JUMP] * 3
    assert estimator.update_twist([0.5, 0.0, 0.0]).outcome is not Acceptance.OUTLIER
    assert estimator.belief.outliers == (0, 0, 0)
    assert estimator.update_twist([0.5, 0.8, 0.0]).outcome is Acceptance.OUTLIER


def test_impossible_twists_do_not_move_the_pose():
    estimator = driven()
    before = estimator.at(estimator.time_ns)[0]
    for _ in range(10):
        estimator.update_twist([500.0, 300.0, -40.0])
    assert np.array_equal(estimator.at(estimator.time_ns)[0], before)


@pytest.mark.parametrize("value", [1e9, 1e200, 1e308])
def test_what_is_beyond_all_bounds_is_never_believed_however_often_it_comes(value):
    estimator = driven()
    before = estimator.belief
    for _ in range(20):
        assert estimator.update_twist([value, 0.0, 0.0]).outcome is Acceptance.OUTLIER
        assert estimator.update_pose([0.0, -value, 0.0]).outcome is Acceptance.OUTLIER
        assert estimator.update_yaw_rate(value).outcome is Acceptance.OUTLIER
    assert np.array_equal(estimator.belief.mean, before.mean)
    assert np.array_equal(estimator.belief.covariance, before.covariance)


@pytest.mark.parametrize("robot", ["ackermann", "differential", "mecanum"])
@pytest.mark.parametrize("value", [1e3, 1e100, 1e308, -1e308])
def test_absurd_commands_leave_the_filter_sound(robot, value):
    estimator = driven(robot)
    for k in range(1, 60):
        now = estimator.time_ns
        estimator.command(now, np.full(len(estimator._log.arrays[1][0]), value))
        estimator.predict(now + k * PERIOD)
        estimator.update_twist(np.zeros(3))
        assert np.isfinite(np.concatenate(estimator.at(now + 90 * SECOND))).all()
        assert np.isfinite(np.concatenate(estimator.at(now + 9 * SECOND))).all()
        np.linalg.cholesky(estimator.covariance)


def test_a_pose_far_off_is_refused_and_the_fifth_in_a_row_is_taken_as_a_jump():
    estimator = driven()
    before, far = estimator.belief, [30.0, 2.0, -3.0]
    for _ in range(4):
        assert estimator.update_pose(far, [0.02] * 3).outcome is Acceptance.OUTLIER
        assert np.array_equal(estimator.belief.mean, before.mean)
        assert np.array_equal(estimator.belief.covariance, before.covariance)
    assert estimator.update_pose(far, [0.02] * 3).outcome is Acceptance.JUMP
    pose, twist = estimator.at(estimator.time_ns)
    assert pose == pytest.approx(far)
    assert twist[0] == pytest.approx(0.5, abs=0.1)  # it still drives
    assert np.sqrt(np.diag(estimator.covariance)[:3]) == pytest.approx(0.02)
    assert (estimator.covariance[:3, 3:] == 0.0).all()  # it says nothing of the state
    assert np.linalg.eigvalsh(estimator.covariance).min() > 0.0
    assert estimator.update_pose(far, [0.02] * 3).outcome is Acceptance.USED


@pytest.mark.parametrize(("believed", "measured"), [(3.13, -3.14), (-3.13, 3.14)])
def test_a_heading_beyond_the_seam_is_near_and_no_outlier(believed, measured):
    estimator = Estimator(builtin_model("differential"))
    estimator.reset(0, [0.0, 0.0, believed], 0.02)
    verdict = estimator.update_pose([0.0, 0.0, measured], [0.02] * 3)
    assert verdict.outcome is Acceptance.USED
    assert verdict.distance == pytest.approx((2.0 * np.pi - 6.27) ** 2 / (2 * 0.02**2))
    assert abs(estimator.at(0)[0][2]) > 3.13


def test_outliers_are_counted_in_a_row_only():
    estimator = driven()
    good, far = estimator.at(estimator.time_ns)[0], [30.0, 2.0, 1.0]
    for _ in range(5):
        for _ in range(4):
            assert estimator.update_pose(far, [0.02] * 3).outcome is Acceptance.OUTLIER
        assert estimator.update_pose(good, [0.02] * 3).outcome is Acceptance.USED


@pytest.mark.parametrize("robot", ["ackermann", "differential"])
def test_a_gyro_corrects_the_yaw_rate_but_never_against_its_gate(robot):
    estimator = driven(robot)
    before = estimator.at(estimator.time_ns)[1][2]
    spread = estimator.covariance
    assert estimator.update_yaw_rate(before + 0.03, 0.01).outcome is Acceptance.USED
    after = estimator.at(estimator.time_ns)[1][2]
    assert before + 1e-3 < after < before + 0.03
    assert np.trace(estimator.covariance) < np.trace(spread)
    for _ in range(50):
        assert estimator.update_yaw_rate(9.0).outcome is Acceptance.OUTLIER
    assert estimator.at(estimator.time_ns)[1][2] == after


def test_a_gate_refuses_one_good_measurement_in_a_thousand():
    estimator, rng, refused = driven(), np.random.default_rng(0), 0
    belief = estimator.belief
    spread = np.linalg.cholesky(belief.covariance[:3, :3] + np.eye(3) * 0.05**2)
    for _ in range(20_000):
        estimator.belief = belief
        measured = belief.mean[:3] + spread @ rng.normal(size=3)
        refused += estimator.update_pose(measured, [0.05] * 3).outcome is Acceptance.OUTLIER
    assert 8 <= refused <= 36  # 20 are expected; 99.9 % of such counts


def test_an_unknown_start_is_mended_by_the_first_pose():
    estimator = Estimator(builtin_model("differential"))
    estimator.reset(0, np.zeros(3), [100.0, 100.0, np.pi])
    estimator.predict(SECOND)
    assert estimator.update_pose([40.0, -70.0, 2.0], [0.01] * 3).outcome is Acceptance.USED
    assert estimator.at(SECOND)[0] == pytest.approx([40.0, -70.0, 2.0], abs=1e-3)


def test_a_covariance_that_rounding_made_indefinite_is_mended():
    low, high = np.full(2, -1.0), np.full(2, 1.0)
    mean = np.array([0.0, 0.0, 4.0, 5.0, -0.5])
    covariance = np.ones((5, 5)) - 1e-13 * np.eye(5)
    covariance[0, 4] += 1e-12
    kernels.settle(mean, covariance, low, high)
    assert mean == pytest.approx([0.0, 0.0, 4.0 - 2.0 * np.pi, 1.0, -0.5])
    assert np.array_equal(covariance, covariance.T)
    np.linalg.cholesky(covariance)
    assert covariance == pytest.approx(np.ones((5, 5)), abs=1e-8)
