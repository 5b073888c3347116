from __future__ import annotations

import numpy as np
import pytest
from lidar_scenes import slice_poses
from robots import direct_model, field, lidar

from nics_drl_bridge import geometry
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.faults import LidarFaults
from nics_drl_bridge.sim.simulator import FastSimulator

BEAMS = 40_000
LIMITS = (0.05, 3.0)
POSE = np.array([1.0, -2.0, 3.0])
TWIST = np.array([0.8, -0.3, 1.2])


def scan_at(distance, beams=BEAMS):
    return np.full(beams, distance, np.float32)


def reported(ranges, noise_std=0.0, seed=1, counter=0, **faults):
    out = ranges.copy()
    row = LidarFaults(**faults).parameters(noise_std)
    fault_kernels.distort(out, np.array(LIMITS), row, seed, counter)
    return out


def mixed_scan():
    rng = np.random.default_rng(3)
    ranges = rng.uniform(*LIMITS, BEAMS).astype(np.float32)
    ranges[::5], ranges[1::7], ranges[2::11] = np.inf, -np.inf, np.nan
    return ranges


def test_without_faults_a_scan_keeps_its_bits():
    ranges = mixed_scan()
    assert reported(ranges).tobytes() == ranges.tobytes()


@pytest.mark.parametrize(
    "faults",
    [
        {"noise_std": 0.02},
        {"dropout_far": 0.1},
        {"too_close": "ghost"},
    ],
    ids=lambda faults: next(iter(faults)),
)
def test_a_draw_depends_on_seed_and_counter_alone(faults):
    ranges = mixed_scan()
    one = reported(ranges, seed=5, counter=9, **faults)
    assert reported(ranges, seed=5, counter=9, **faults).tobytes() == one.tobytes()
    for seed, counter in ((6, 9), (5, 10)):
        assert (
            reported(ranges, seed=seed, counter=counter, **faults).tobytes()
            != one.tobytes()
        )


@pytest.mark.parametrize("distance", [0.5, 2.0])
def test_noise_has_its_mean_and_deviation_at_each_range(distance):
    error = (
        reported(scan_at(distance), noise_std=0.01, noise_proportional=0.02) - distance
    )
    std = 0.01 + 0.02 * distance
    assert abs(error.mean()) < 4.0 * std / np.sqrt(BEAMS)
    assert error.std() == pytest.approx(std, rel=4.0 / np.sqrt(2 * BEAMS))
    ahead = np.corrcoef(error[1:], error[:-1])[0, 1]
    assert abs(ahead) < 4.0 / np.sqrt(BEAMS)


def test_noise_stays_within_the_limits_and_off_what_is_no_return():
    ranges = mixed_scan()
    noisy = reported(ranges, noise_std=0.5)
    returns = np.isfinite(ranges)
    assert np.array_equal(noisy[~returns], ranges[~returns], equal_nan=True)
    assert np.float32(LIMITS[0]) == noisy[returns].min()
    assert np.float32(LIMITS[1]) == noisy[returns].max()


@pytest.mark.parametrize("distance", [0.3, 3.0])
def test_dropouts_have_their_share_which_grows_with_the_square_of_the_range(distance):
    lost = np.isposinf(
        reported(scan_at(distance), dropout=0.05, dropout_far=0.2)
    ).mean()
    share = 0.05 + 0.2 * (distance / 3.0) ** 2
    assert lost == pytest.approx(share, abs=4.0 * np.sqrt(share / BEAMS))


def test_dropouts_take_what_is_too_close_too_and_leave_the_others_alone():
    ranges = mixed_scan()
    kept = reported(ranges, dropout=0.25)
    unchanged = (kept == ranges) | np.isnan(ranges)
    assert np.isposinf(kept[~unchanged]).all()
    close = np.isneginf(ranges)
    assert (~unchanged[close]).mean() == pytest.approx(0.25, abs=0.03)
    assert np.array_equal(np.isnan(kept), np.isnan(ranges))
    assert np.isposinf(reported(scan_at(1.0), dropout=1.0)).all()


@pytest.mark.parametrize("step", [0.001, 0.07, 0.3])
def test_quantised_ranges_are_the_nearest_multiples_within_the_limits(step):
    ranges = mixed_scan()
    coarse = reported(ranges, quantisation=step)
    returns = np.isfinite(ranges)
    multiples = coarse[returns].astype(np.float64) / step
    assert multiples == pytest.approx(np.round(multiples), abs=1e-3)
    assert coarse[returns].min() >= np.float32(LIMITS[0])
    assert coarse[returns].max() <= np.float32(LIMITS[1])
    away = np.abs(coarse[returns] - ranges[returns])
    inside = (ranges[returns] > LIMITS[0] + step) & (ranges[returns] < LIMITS[1] - step)
    assert away[inside].max() <= step / 2.0 + 1e-6
    assert np.array_equal(coarse[~returns], ranges[~returns], equal_nan=True)


@pytest.mark.parametrize(
    ("too_close", "value"),
    [("minus_inf", -np.inf), ("range_min", np.float32(0.05)), ("no_return", np.inf)],
)
def test_what_is_too_close_becomes_what_the_device_makes_of_it(too_close, value):
    ranges = mixed_scan()
    seen = reported(ranges, too_close=too_close)
    close = np.isneginf(ranges)
    assert (seen[close] == value).all()
    assert np.array_equal(seen[~close], ranges[~close], equal_nan=True)


def test_a_ghost_may_be_anywhere_within_the_limits():
    seen = reported(scan_at(-np.inf), too_close="ghost")
    assert (seen.min(), seen.max()) == pytest.approx(LIMITS, abs=0.01)
    assert seen.mean() == pytest.approx(
        np.mean(LIMITS), abs=4.0 * 2.95 / np.sqrt(12 * BEAMS)
    )


def test_faults_act_in_the_order_of_the_device():
    close = reported(
        scan_at(-np.inf),
        too_close="range_min",
        noise_std=0.05,
        quantisation=0.02,
        dropout=0.5,
    )
    assert np.isposinf(close).mean() == pytest.approx(
        0.5, abs=0.02
    )  # dropout after too_close
    values = np.unique(close[np.isfinite(close)]) / 0.02
    assert len(values) > 3  # noise after too_close
    assert values == pytest.approx(
        np.round(values), abs=1e-4
    )  # quantisation after noise


# In the simulator.


def scans(model, rows=None, worlds=4, first_seed=0, periods=3):
    """Ranges (T, N, M, B) of two robots that stand still."""
    simulator = FastSimulator(model, field(4.0, count=2), worlds, 2)
    if rows is not None:
        simulator.data.faults[:] = rows
    simulator.reset(range(first_seed, first_seed + worlds))
    out = []
    for _ in range(periods):
        simulator.step(np.zeros((worlds, 2, 3)))
        out.append(simulator.data.ranges.copy())
    return np.array(out)


def test_each_robot_may_have_faults_of_its_own():
    model = direct_model(sensor=lidar())
    clean = scans(model)
    rows = np.tile(model.lidar.fault_parameters, (4, 2, 1))
    rows[1, 0, fault_kernels.DROPOUT] = 1.0
    rows[2, 1, fault_kernels.NOISE_STD] = 0.05
    mixed = scans(model, rows)
    changed = [
        (n, m)
        for n in range(4)
        for m in range(2)
        if mixed[:, n, m].tobytes() != clean[:, n, m].tobytes()
    ]
    assert changed == [(1, 0), (2, 1)]
    assert np.isposinf(mixed[:, 1, 0]).all()


# Skew.


@pytest.mark.parametrize("skew", ["counter_clockwise", "clockwise"])
@pytest.mark.parametrize("moving", [np.inf, 0.04])
@pytest.mark.parametrize(
    "twist", [TWIST, TWIST * [1, 1, 0], TWIST * [1, 1, 1e-6], np.zeros(3)]
)
def test_slices_lie_on_the_exact_arc_that_ends_at_the_pose(twist, moving, skew):
    poses = slice_poses(POSE, twist, 0.1, 5, skew, moving)
    if skew == "clockwise":  # its newest beam is the first
        poses = poses[::-1]
    for pose, ago in zip(poses, [0.09, 0.07, 0.05, 0.03, 0.01], strict=True):
        expected = geometry.compose(POSE, geometry.exp(-twist * min(ago, moving)))
        off = geometry.between(expected, pose)
        assert off == pytest.approx(np.zeros(3), abs=1e-9)
