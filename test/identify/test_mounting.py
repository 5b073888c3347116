from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.drive import TwistIntervals
from nics_drl_bridge.identify.mounting import (
    estimate_mounting_by_instruments,
    estimate_mounting_by_twists,
    estimate_mounting_with_slip,
    estimate_mounting_without_lateral_motion,
)
from nics_drl_bridge.robot.spec import build_robot


def test_what_lasts_for_a_block_widens_the_uncertainty():
    rng = np.random.default_rng(0)
    n = np.arange(800.0)
    expected = rng.normal(size=(800, 3))
    noise = 0.1 * rng.normal(size=(800, 3))
    sigma = []
    for slip in (0.0, 0.3):
        lasting = slip * np.repeat(rng.normal(size=(8, 3)), 100, axis=0)
        lasting = lasting * expected.sum(axis=1, keepdims=True)
        turned = geometry.rotate(expected[:, :2], 0.4)
        twist = np.column_stack([turned, expected[:, 2]]) + lasting + noise
        found = estimate_mounting_by_twists(TwistIntervals(n, n + 1.0, twist), expected)
        sigma.append([found.rotation_sigma, *found.lever_sigma])
        assert abs(found.rotation - 0.4) < 3.0 * found.rotation_sigma
    assert (np.divide(*sigma[::-1]) > 3.0).all()


def test_a_robot_that_keeps_its_heading_and_goes_anywhere_tells_nothing_of_its_mounting():
    course = np.linspace(0.0, 6.0, 50)
    n = np.arange(50.0)
    twist = np.stack([np.cos(course), np.sin(course), 0.0 * course], axis=1)
    motion = TwistIntervals(n, n + 1.0, twist)
    assert estimate_mounting_without_lateral_motion(motion, np.ones(50)) is None


def seen_by(car, curvature, lever, seed=0, count=900):
    """States and noisy twists of a point on a car, which goes along curvatures (n,) [1/m]."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(0.3, 1.0, count // 10), 10)
    turn = speed * curvature
    twist = np.stack([speed - lever[1] * turn, lever[0] * turn, turn], axis=1)
    twist += rng.normal(size=twist.shape) * [0.02, 0.02, 0.05]
    n = np.arange(count)
    states = np.stack([speed, np.arctan(0.2 * curvature)], axis=1)
    return TwistIntervals(0.1 * n, 0.1 * n + 0.1, twist), states


def test_the_lever_of_a_car_that_turned_little_both_ways_is_found_with_its_error(car):
    off = []
    for seed in range(8):
        bends = np.random.default_rng(100 + seed).uniform(-0.4, 0.4, 90)
        motion, states = seen_by(car, np.repeat(bends, 10), (0.08, -0.03), seed)
        plain = estimate_mounting_without_lateral_motion(motion, states[:, 0])
        assert plain is not None
        assert np.isnan(
            plain.lever_sigma[0]
        )  # its noise is too large for the plain one
        found = estimate_mounting_by_instruments(motion, states, states[:, 0], car)
        assert found is not None
        assert (found.lever_sigma < 0.008).all()
        off.append(
            [
                *(found.lever - [0.08, -0.03]) / found.lever_sigma,
                found.rotation / found.rotation_sigma,
            ]
        )
    assert np.abs(off).max() < 3.5
    assert np.abs(off).mean() > 0.3  # the errors are not too wide either


@pytest.mark.parametrize("spread", [0.0, 0.005])
def test_a_path_of_one_curvature_tells_no_lever(car, spread):
    bends = 0.8 + spread * np.repeat(
        np.random.default_rng(0).uniform(-1.0, 1.0, 90), 10
    )
    motion, states = seen_by(car, bends, (0.08, 0.0))
    assert estimate_mounting_by_instruments(motion, states, states[:, 0], car) is None


def test_a_car_that_drives_backwards_first_faces_where_it_is_told_to(car):
    bends = np.repeat(np.random.default_rng(1).uniform(-2.0, 2.0, 90), 10)
    motion, states = seen_by(car, bends, (0.08, 0.0))
    found = estimate_mounting_by_instruments(motion, states, -states[:, 0], car)
    assert found is not None
    assert abs(found.rotation) == pytest.approx(np.pi, abs=0.01)
    assert found.lever[0] == pytest.approx(-0.08, abs=0.005)


@pytest.mark.parametrize(("bend", "ways"), [(0.0, 0), (0.5, 1), (-0.5, 1)])
def test_the_noise_of_a_heading_is_no_turning(bend, ways):
    rng = np.random.default_rng(0)
    n = np.arange(900)
    heading_noise = 0.005
    heading = heading_noise * rng.normal(size=901)
    twist = np.stack(
        [0.5 + 0.0 * n, 0.0 * n, 0.5 * bend + np.diff(heading) / 0.1], axis=1
    )
    motion = TwistIntervals(0.1 * n, 0.1 * n + 0.1, twist)
    found = estimate_mounting_without_lateral_motion(
        motion, np.ones(900), heading_noise
    )
    assert found is not None
    assert found.ways == ways
    assert np.isnan(found.lever_sigma[0])


def skidded(slip: float, slowest: float, seed: int = 0) -> TwistIntervals:
    """Noisy twists of a point 0.1 m before the middle of a robot that slips in proportion."""
    rng = np.random.default_rng(seed)
    n = np.arange(900)
    speed = np.repeat(rng.uniform(slowest, 1.0, 90), 10)
    turn = np.repeat(rng.uniform(-1.0, 1.0, 90), 10)
    twist = np.stack([speed, 0.1 * turn + slip * speed * turn, turn], axis=1)
    twist += rng.normal(size=twist.shape) * 0.02
    return TwistIntervals(0.1 * n, 0.1 * n + 0.1, twist)


@pytest.mark.parametrize("slip", [0.0, -0.12])
def test_a_lever_is_told_from_the_slip_of_a_robot_that_skids_both_ways(slip):
    spec = build_robot({"kind": "skid_steer", "footprint_radius": 0.4}, {})
    motion = skidded(slip, -0.6)
    plain = estimate_mounting_without_lateral_motion(motion, motion.twist[:, 0])
    found = estimate_mounting_with_slip(motion, plain, spec)
    assert found.lever[0] == pytest.approx(0.1, abs=0.005)
    assert found.lever_sigma[0] < 0.005


@pytest.mark.parametrize("slip", [0.0, -0.12])
def test_slip_of_a_robot_that_skids_forwards_only_is_no_lever(slip):
    spec = build_robot({"kind": "skid_steer", "footprint_radius": 0.4}, {})
    motion = skidded(slip, 0.2)
    plain = estimate_mounting_without_lateral_motion(motion, motion.twist[:, 0])
    assert plain.lever_sigma[0] < 0.005  # as if it were certain
    found = estimate_mounting_with_slip(motion, plain, spec)
    assert np.isnan(found.lever_sigma).all()
    assert not found.lever.any()
    assert found.slip
