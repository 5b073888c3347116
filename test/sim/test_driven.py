from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import direct_model, lidar

from nics_drl_bridge.sim.simulator import Driven, DrivenSimulator, FastSimulator
from nics_drl_bridge.sim.world import load_world

PARTS = 4


def end_of(fast: FastSimulator) -> Driven:
    """What robots did that move as the fast simulator's, and whose wheels never slip."""
    data, row = fast.data, fast.data.steps[0] % fast.data.past.shape[2]
    pose, twist = data.pose[0].copy(), data.past[0, :, row, 3:6].copy()
    return Driven(pose, twist, data.state[0].copy(), pose, twist, data.collided[0] == 1)


@pytest.mark.parametrize("name", ["crowd", "room"])
@pytest.mark.parametrize("skew", ["none", "counter_clockwise"])
def test_robots_moved_from_outside_sense_what_those_of_the_fast_simulator_do(name, skew):
    sensor = lidar(noise_std=0.01, faults={"skew": skew})
    model = direct_model(odometry=(0.05, 0.03), sensor=sensor)
    world, rng = load_world(name), np.random.default_rng(1)
    fast = FastSimulator(model, world, robots=2)
    driven = DrivenSimulator(model, world, robots=2)
    for seed in (3, 4):
        fast.reset([seed])
        driven.reset([seed])
        for _ in range(20):
            fast.step(rng.uniform(-0.5, 0.5, (1, 2, 3)))
            driven.begin_period()
            for part in range(PARTS):
                driven.move_obstacles(model.control_period * (part + 1) / PARTS)
            driven.end_period(end_of(fast))
            for known in ("ranges", "twist", "collided", "steps", "marks"):
                assert np.array_equal(getattr(driven.fast.data, known), getattr(fast.data, known))
            for rounded in ("bodies", "odom"):
                ours, theirs = (getattr(s.data, rounded) for s in (driven.fast, fast))
                assert np.abs(ours - theirs).max() < 1e-12


def test_odometry_is_what_the_wheels_count_and_the_scan_is_of_where_the_robot_is():
    model = direct_model(odometry=(0.0, 0.0))
    world, start = load_world("empty"), np.array([[[0.5, 0.0, 0.0]]])
    driven = DrivenSimulator(model, world)
    driven.reset([0], start)
    before = driven.fast.data.ranges.copy()
    turned = np.array([[1.0, 0.2, 0.1]])
    stuck = Driven(start[0], np.zeros((1, 3)), np.zeros((1, 0)), turned, turned, np.array([True]))
    driven.begin_period()
    driven.end_period(stuck)
    driven.begin_period()
    driven.end_period(replace(stuck, touched=np.array([False])))
    data = driven.fast.data
    assert data.odom[0] == pytest.approx(turned)
    assert data.twist[0] == pytest.approx(turned)
    assert np.array_equal(data.pose, start)
    assert np.array_equal(data.ranges, before)
    assert data.collided[0, 0] == 1
