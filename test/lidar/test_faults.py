from __future__ import annotations

import numpy as np
import pytest
from lidar_scenes import scan_skewed, slice_poses
from robots import direct_model, field, lidar

from nics_drl_bridge import geometry
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.faults import LidarFaults
from nics_drl_bridge.lidar.scanner import make_scanner
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
        {"noise_proportional": 0.02},
        {"dropout": 0.1},
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


@pytest.mark.parametrize("noise_std", [0.0, 0.1])
def test_a_step_without_a_multiple_within_the_limits_coarsens_nothing(noise_std):
    faults = LidarFaults().parameters(noise_std)
    faults[fault_kernels.QUANTISATION] = 5.0
    out = np.full(100, 0.4, np.float32)
    fault_kernels.distort(out, (0.1, 3.0), faults, 1, 1)
    assert out.min() >= np.float32(0.1)
    assert out.mean() == pytest.approx(0.4, abs=0.1)


@pytest.mark.parametrize("beams", [1, 2, 7, 1081])
def test_a_scan_of_any_length_has_the_noise_of_each_of_its_beams(beams):
    ranges = scan_at(1.0, beams)
    errors = np.array(
        [reported(ranges, noise_std=0.1, counter=k) - 1.0 for k in range(200)]
    )
    assert errors.std(axis=0) == pytest.approx(np.full(beams, 0.1), rel=0.3)
    assert abs(np.mean(errors)) < 0.4 / np.sqrt(errors.size)


def test_a_quantised_range_is_the_single_number_nearest_to_its_multiple():
    ranges = np.linspace(0.06, 2.99, BEAMS).astype(np.float32)
    coarse = reported(ranges, quantisation=0.00025)
    exact = (np.round(ranges.astype(np.float64) / 0.00025) * 0.00025).astype(np.float32)
    assert (coarse == exact).mean() > 0.99  # but for what lies between two multiples


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


FAULTY = {
    "too_close": "ghost",
    "noise_proportional": 0.02,
    "quantisation": 0.01,
    "dropout": 0.1,
    "dropout_far": 0.1,
}


def test_the_simulator_has_the_faults_of_its_lidar():
    clean = scans(direct_model(sensor=lidar()))
    faulty = scans(direct_model(sensor=lidar(faults=FAULTY, noise_std=0.01)))
    lost = np.isinf(faulty) & np.isfinite(clean)
    assert 0.08 < lost.sum() / np.isfinite(clean).sum() < 0.25
    both = np.isfinite(faulty) & np.isfinite(clean)
    assert 0.01 < (faulty[both] - clean[both]).std() < 0.1
    grid = faulty[np.isfinite(faulty)].astype(np.float64) / 0.01
    assert grid == pytest.approx(np.round(grid), abs=1e-3)


def test_faulty_scans_are_the_same_bits_in_a_batch_of_any_size():
    model = direct_model(sensor=lidar(faults=FAULTY, noise_std=0.01))
    together = scans(model, worlds=4)
    for n in range(4):
        assert (
            scans(model, worlds=1, first_seed=n)[:, 0].tobytes()
            == together[:, n].tobytes()
        )


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


def test_the_noise_of_a_range_is_the_same_bits_however_the_other_faults_are():
    model = direct_model(sensor=lidar(noise_std=0.03))
    plain = scans(model)
    dropping = scans(
        direct_model(sensor=lidar(noise_std=0.03, faults={"dropout": 0.3}))
    )
    kept = np.isfinite(dropping)
    assert 0 < kept.sum() < np.isfinite(plain).sum()
    assert np.array_equal(dropping[kept], plain[kept])


# Skew.


@pytest.mark.parametrize(
    "twist", [TWIST, TWIST * [1, 1, 0], TWIST * [1, 1, 1e-6], np.zeros(3)]
)
def test_slices_lie_on_the_exact_arc_that_ends_at_the_pose(twist):
    poses = slice_poses(POSE, twist, 0.1, 5, "counter_clockwise")
    for g, ago in enumerate([0.09, 0.07, 0.05, 0.03, 0.01]):
        expected = geometry.compose(POSE, geometry.exp(-twist * ago))
        assert geometry.between(expected, poses[g]) == pytest.approx(
            np.zeros(3), abs=1e-9
        )
    assert (np.abs(poses[:, 2]) <= np.pi).all()


def test_a_device_that_turns_clockwise_has_its_newest_beam_first():
    forward = slice_poses(POSE, TWIST, 0.1, 5, "counter_clockwise")
    assert np.array_equal(slice_poses(POSE, TWIST, 0.1, 5, "clockwise"), forward[::-1])


def test_without_skew_all_slices_are_at_the_pose():
    assert slice_poses(POSE, TWIST, 0.1, 3, "none") == pytest.approx(
        np.tile(POSE, (3, 1))
    )


@pytest.mark.parametrize("skew", ["counter_clockwise", "clockwise"])
def test_a_skewed_scan_sees_a_wall_from_where_each_beam_was_measured(skew):
    spec = lidar(beams=180, angle_min=-1.0, angle_max=1.0, range_max=9.0, rate=5.0)
    scanner = make_scanner(spec, ())
    wall = [[4.0, -50.0, 4.0, 50.0]]

    def render(pose):
        return scanner.scan(pose, np.zeros((1, 0, 3)), wall)[0]

    pose, twist = np.array([0.5, 0.2, 0.1]), np.array([2.0, 0.0, 1.5])
    skewed = scan_skewed(render, slice_poses(pose, twist, spec.sweep_time, 180, skew))
    order = np.arange(180) if skew == "counter_clockwise" else np.arange(180)[::-1]
    ago = spec.beam_time * (179.5 - order)
    then = geometry.compose(pose, geometry.exp(-twist * ago[:, None]))
    expected = (4.0 - then[:, 0]) / np.cos(then[:, 2] + spec.angles)
    assert skewed == pytest.approx(expected, abs=1e-4)
    assert np.abs(skewed - render(pose)).max() > 0.1
    for slices in (12, 36):  # what is left is the motion within half a slice
        coarse = scan_skewed(
            render, slice_poses(pose, twist, spec.sweep_time, slices, skew)
        )
        assert np.abs(coarse - skewed).max() < 0.8 / slices
