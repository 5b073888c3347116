"""A clock that is set while the robot drives, and silences: what may have been missed is known.

The drives are those of `jumping`: by odometry alone, at full speed, turning.
"""

from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model, field

from middleware.jumping import Setting, campaign, errors_after, noisy_model
from middleware.rig import PERIOD, RANGES, SECOND, assert_same, state
from nics_drl_bridge import geometry
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.belief import JITTER_S, greatest_twist
from nics_drl_bridge.middleware.ekf import LONGEST_GAP_S
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.sim.simulator import FastSimulator

CHI2_999 = 16.27
"""99.9 % of chi-squared with three degrees of freedom lie below."""
FAR = (-3600.0, -30.0, 2.0, 3600.0)
SMALL = (-2.0, -1.5, -0.5, -0.3, 0.3, 0.5, 0.9)
ROBOTS = ("ackermann", "differential", "mecanum")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "jumps"),
    [
        pytest.param("differential", FAR, id="far"),
        pytest.param("mecanum", SMALL, id="small"),
        *(
            pytest.param(robot, jumps, marks=pytest.mark.campaign)
            for robot in ROBOTS
            for jumps in (FAR, SMALL)
        ),
    ],
)
def test_after_a_jump_the_estimate_is_off_by_no_more_than_it_claims(robot, jumps):
    late = (Setting(jump, latency=1, lost=0.05) for jump in jumps)
    settings = [*(Setting(jump) for jump in jumps), *late]
    first, nees, last, nees_at_end = campaign(robot, 2 * len(settings), settings)
    assert (
        np.hypot(*first[:, :2].T).max() < 0.6
    )  # the drift of some seconds, and no way on top
    assert np.median(np.hypot(*first[:, :2].T)) < 0.2
    assert np.mean(nees) < 5.0  # chi-squared of some fifteen drives
    assert max(nees) < CHI2_999
    assert np.mean(nees_at_end) < 5.0
    assert np.hypot(*last[:, :2].T).max() < 2.5


BROKEN = {
    "begun anew at zero": lambda k, odom: (
        odom if k < 0 else geometry.between([30.0, -20.0, 1.0], odom)
    ),
    "never told": lambda k, odom: np.zeros(3),
    "teleporting": lambda k, odom: np.add(odom, [0.0, 7.0 * (k % 2), 0.0]),
}


@pytest.mark.slow
@pytest.mark.parametrize("pose", BROKEN)
def test_where_odometry_does_not_tell_the_way_the_robot_may_be_anywhere_in_reach(pose):
    settings = [Setting(jump, pose=BROKEN[pose]) for jump in FAR]
    first, nees, *_ = campaign("differential", 16, settings)
    assert np.hypot(*first[:, :2].T).max() > 0.3  # the way that nobody told of
    assert max(nees) < CHI2_999


@pytest.mark.slow
@pytest.mark.parametrize("jump_s", [*FAR, *SMALL])
def test_the_same_drive_gives_the_same_bits(jump_s):
    model = noisy_model("ackermann")
    simulator = FastSimulator(model, field(200.0))
    setting = Setting(jump_s, latency=1, lost=0.05)
    one, other = (errors_after(model, simulator, 3, setting, 6.0) for _ in range(2))
    assert np.array_equal(one[0], other[0])
    assert np.array_equal(one[1], other[1])
    assert one[2].health(0).noticed["clock: jump"] == 1


def driven(
    middleware, periods=20, speed=1.0, shift_ns=0, begin=0, pose=lambda x: [x, 0.0, 0.0]
):
    """Straight on; the odometry of each period is true, but for its clock."""
    for k in range(begin + 1, begin + periods + 1):
        now = SECOND + k * PERIOD
        middleware.command(None, [speed, 0.0, 0.0])
        middleware.odometry(
            now + shift_ns, now, pose(speed * k * 0.1), [speed, 0.0, 0.0]
        )


def started():
    middleware = Middleware(direct_model())
    middleware.reset(SECOND, [1.0, 2.0, 0.5])
    return middleware


def way(middleware):
    return float(np.hypot(*(middleware.estimator.belief.mean[:2] - [1.0, 2.0])))


@pytest.mark.parametrize("jump_s", [-500.0, -1.3, -0.3, 0.3, 0.8, 3600.0])
def test_what_was_driven_while_the_clock_was_set_is_not_lost(jump_s):
    middleware = started()
    driven(middleware)
    driven(middleware, 20, shift_ns=round(jump_s * SECOND), begin=20)
    assert way(middleware) == pytest.approx(4.0, abs=0.02)
    assert middleware.view(middleware.estimator.time_ns).twist[0] == pytest.approx(
        1.0, abs=0.01
    )
    assert middleware.health(0).noticed["clock: jump"] == 1


def test_the_first_command_after_a_jump_need_not_be_waited_for():
    middleware = started()
    driven(middleware)
    driven(middleware, 10, shift_ns=3600 * SECOND, begin=20)
    assert middleware.view(middleware.estimator.time_ns).twist[0] == pytest.approx(
        1.0, abs=0.01
    )


@pytest.mark.parametrize("jump_s", [-500.0, -0.3, 0.3, 3600.0])
def test_the_robot_follows_the_command_that_came_last_whatever_its_stamp(jump_s):
    middleware = started()
    shift = round(jump_s * SECOND)
    x = 0.0
    for k in range(1, 42):
        now = SECOND + k * PERIOD
        speed = 1.0 if k <= 24 else 0.5
        moved = shift if k > 20 else 0
        middleware.command(now - PERIOD + moved, [speed, 0.0, 0.0])
        x += speed * 0.1
        middleware.odometry(now + moved, now, [x, 0.0, 0.0], [speed, 0.0, 0.0])
        if middleware.health(0).noticed.get("clock: jump") and k > 24:
            break
    ahead = middleware.estimator.time_ns + 5 * PERIOD
    assert middleware.view(ahead).twist[0] == pytest.approx(0.5, abs=0.05)


def test_scans_of_the_new_clock_are_taken_and_those_of_the_old_one_forgotten():
    middleware = started()
    driven(middleware)
    middleware.scan(3 * SECOND, 3 * SECOND, RANGES)
    driven(middleware, 1, shift_ns=-SECOND // 2, begin=20)
    assert np.isnan(middleware.view(3 * SECOND).ranges).all()
    assert middleware.scan(
        SECOND + 21 * PERIOD - SECOND // 2, SECOND + 21 * PERIOD, RANGES
    )


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


def test_a_robot_whose_wheels_spin_while_it_stands_sets_no_clock():
    middleware = started()
    driven(middleware)
    for k in range(21, 60):
        stamp = SECOND + k * PERIOD + (3 * PERIOD if k >= 40 else 0)
        middleware.odometry(stamp, stamp, [2.0, 0.0, 0.0], [1.0, 0.0, 0.0])
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
    far = greatest_twist(builtin_model("differential"))[0] * (seconds - 0.5 + JITTER_S)
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


def test_the_end_of_a_silence_may_come_in_any_order():
    end = 16 * SECOND
    data = [
        lambda m: m.odometry(end, end, [3.0, 1.0, 0.4], [0.5, 0.0, 0.0]),
        lambda m: m.imu(end - PERIOD, end, 0.0),
        lambda m: m.odometry(end + PERIOD, end, [3.05, 1.0, 0.4], [0.5, 0.0, 0.0]),
        lambda m: m.imu(end - 2 * PERIOD, end, 0.0),
    ]
    found = []
    for order in ([3, 1, 0, 2], [0, 1, 2, 3], [2, 0, 3, 1], [2, 3, 1, 0]):
        middleware = Middleware(builtin_model("differential"))
        middleware.reset(SECOND, np.zeros(3))
        middleware.odometry(2 * SECOND, 2 * SECOND, np.zeros(3), np.zeros(3))
        assert all(data[k](middleware) for k in order)
        found.append(state(middleware))
    for other in found[1:]:
        assert_same(found[0], other)


def test_the_greatest_twist_is_that_of_the_fastest_command():
    assert greatest_twist(direct_model()) == pytest.approx((np.hypot(2.0, 2.0), 2.0))
