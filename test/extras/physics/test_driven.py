from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model, lidar

from nics_drl_bridge.extras.physics.driven import DrivenSimulator
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

PARTS = 4
LATE = Randomisation(
    name="late",
    observation_latency=(0.0, 1.5),
    odometry={"odom_linear": (0.0, 0.1), "odom_angular": (0.0, 0.1)},
    lidar={"noise_std": (0.0, 0.05), "dropout": (0.0, 0.2)},
)


def end_of(fast: FastSimulator) -> tuple[np.ndarray, ...]:
    """What robots did that move as the fast simulator's, and whose wheels never slip."""
    data = fast.data
    row = fast.data.steps[0] % fast.data.past.shape[2]
    pose = data.pose[0].copy()
    twist = data.past[0, :, row, 3:6].copy()
    return pose, twist, data.state[0].copy(), pose, twist, data.collided[0] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "skew", "drawn"),
    [("crowd", "none", None), ("room", "counter_clockwise", LATE)],
)
def test_robots_moved_from_outside_sense_what_those_of_the_fast_simulator_do(
    name, skew, drawn
):
    sensor = lidar(noise_std=0.01, faults={"skew": skew})
    model = direct_model(odometry=(0.05, 0.03), sensor=sensor)
    world = load_world(name)
    rng = np.random.default_rng(1)
    fast = FastSimulator(model, world, robots=2, randomisation=drawn)
    driven = DrivenSimulator(model, world, robots=2, randomisation=drawn)
    for seed in (3, 4):
        fast.reset([seed])
        driven.reset([seed])
        for _ in range(20):
            commands = rng.uniform(-0.5, 0.5, (1, 2, 3))
            fast.step(commands)
            driven.begin_period(commands[0])
            for part in range(PARTS):
                driven.move_obstacles(model.control_period * (part + 1) / PARTS)
            driven.end_period(*end_of(fast))
            for known in ("ranges", "twist", "collided", "steps", "marks"):
                assert np.array_equal(
                    getattr(driven.data, known), getattr(fast.data, known)
                )
            for rounded in ("bodies", "odom"):
                ours, theirs = (getattr(s.data, rounded) for s in (driven, fast))
                assert np.abs(ours - theirs).max() < 1e-12


def test_commands_are_in_force_as_late_as_is_drawn_and_without_the_latency_of_the_model():
    model = direct_model(latency=0.07)
    world = load_world("empty")
    late = Randomisation(name="late", action_latency=(1.3, 1.3))
    driven = DrivenSimulator(model, world, randomisation=late)
    driven.reset([0])
    for k in (1.0, 2.0, 3.0):
        driven.begin_period(np.full((1, 3), k))
    assert [driven.in_force(time)[0, 0] for time in (0.0, 0.02, 0.03, 0.09)] == [
        1.0,
        1.0,
        2.0,
        2.0,
    ]
    driven.reset([1])
    assert not driven.in_force(0.0).any()
    prompt = DrivenSimulator(model, world)
    prompt.begin_period(np.ones((1, 3)))
    assert prompt.in_force(0.0)[0, 0] == 1.0


def test_odometry_is_what_the_wheels_count_and_the_scan_is_of_where_the_robot_is():
    driven = DrivenSimulator(direct_model(), load_world("empty"))
    start = np.array([[[0.5, 0.0, 0.0]]])
    driven.reset([0], starts=start)
    data = driven.data
    before = data.ranges.copy()
    turned = np.array([[1.0, 0.2, 0.1]])
    for touched in (True, False):
        driven.begin_period(np.zeros((1, 3)))
        stuck = start[0], np.zeros((1, 3)), np.zeros((1, 0))
        driven.end_period(*stuck, turned, turned, np.array([touched]))
    assert data.odom[0] == pytest.approx(turned)
    assert data.twist[0] == pytest.approx(turned)
    assert np.array_equal(data.pose, start)
    assert np.array_equal(data.ranges, before)
    assert data.collided[0, 0] == 1
