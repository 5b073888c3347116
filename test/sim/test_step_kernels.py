"""Each robot by its own parameters: kinematics, latencies, noise, skew; and moving obstacles."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest
from robots import FOOTPRINT, RADIUS, direct_model, field, noisy_model

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim import simulator as sizes
from nics_drl_bridge.sim.simulator import STANDING, FastSimulator
from nics_drl_bridge.sim.world import World

ORIGIN = np.zeros((1, 1, 3))
SUBSTEPS = 10
PERIOD = 0.1
SKIN = 1e-3  # a robot stops this near to what it touches [m]


def still(simulator, steps):
    for _ in range(steps):
        simulator.step(np.zeros_like(simulator.data.pose))


def random_commands(worlds, steps, robots=1, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, worlds, robots, 3))


def test_each_robot_drifts_by_its_own_noise():
    drifting, noisy = slice(0, 200), slice(200, 1000)
    simulator = FastSimulator(direct_model(), field(40.0), 1000)
    data = simulator.data
    data.noise[drifting, 0, 2:5] = 0.0, 0.05, 0.0
    data.noise[noisy, 0, :2] = 0.2, 0.03
    simulator.reset(range(1000), starts=np.zeros((1000, 1, 3)))
    twists = []
    for _ in range(10):
        still(simulator, 1)
        twists.append(data.twist[noisy, 0].copy())
    assert data.pose[drifting, 0, 1].std() == pytest.approx(0.05, rel=0.2)
    assert not data.twist[drifting].any()
    assert not data.pose[noisy].any()
    std = np.array([0.2, 0.2, 0.03])
    assert np.std(twists, axis=(0, 1)) == pytest.approx(std, rel=0.05)
    # Each period draws again, independent of the one before.
    final = data.odom[noisy, 0].std(axis=0)
    assert final == pytest.approx(std * PERIOD * np.sqrt(10), rel=0.1)


def test_a_robot_near_a_wall_keeps_its_latency_as_one_in_the_open():
    near, far = (
        FastSimulator(direct_model(), field(size), 3, longest_delay=15)
        for size in (2, 9)
    )
    for simulator in (near, far):
        simulator.data.delay[:, 0] = [0, 4, 13]
        simulator.reset(range(3), starts=np.zeros((3, 1, 3)))
    # Slow enough never to touch, near enough to look after each substep.
    for command in random_commands(3, 12) * [0.3, 0.3, 2.0]:
        near.step(command)
        far.step(command)
        assert np.array_equal(near.data.pose, far.data.pose)


def test_a_coefficient_of_its_own_changes_how_a_robot_moves():
    simulator = FastSimulator(direct_model(), field(20.0), 3)
    simulator.data.coefficient[1] *= 1.5
    starts = np.zeros((3, 1, 3))
    for _ in range(2):  # a reset keeps it
        simulator.reset(range(3), starts=starts)
        for _ in range(5):
            simulator.step(np.tile([1.0, 0.0, 0.0], (3, 1, 1)))
        assert simulator.data.pose[:, 0, 0] == pytest.approx([0.5, 0.75, 0.5])


@pytest.mark.parametrize("age", [5, 17])
def test_odometry_is_of_its_age(age):
    simulator = FastSimulator(direct_model(), field(9.0), longest_age=30)
    simulator.data.age[:] = age
    simulator.reset([0], starts=ORIGIN)
    for step in range(1, 8):
        simulator.step([[[0.5, 0.0, 0.4]]])
        when = max(step - age / SUBSTEPS, 0.0)
        told = simulator.data.odom[0, 0]
        assert told[2] == pytest.approx(0.4 * PERIOD * when)
        assert np.hypot(*told[:2]) == pytest.approx(0.5 * PERIOD * when, rel=0.01)
        twist = np.array([0.5, 0.0, 0.4]) * min(when, 1.0)
        assert simulator.data.twist[0, 0] == pytest.approx(twist)


def test_what_is_older_than_the_episode_is_of_its_beginning():
    simulator = FastSimulator(direct_model(), field(4.0), longest_age=30)
    simulator.data.age[:] = 30
    for _ in range(2):
        simulator.reset([0], starts=ORIGIN)
        first = simulator.data.ranges.copy()
        for _ in range(3):
            simulator.step([[[0.5, 0.0, 0.0]]])
            assert not simulator.data.odom.any()
            assert np.array_equal(simulator.data.ranges, first)
        simulator.step([[[0.5, 0.0, 0.0]]])
        assert simulator.data.odom[0, 0, 0] == pytest.approx(0.05)


def one_obstacle(worlds=1, **changes):
    """Worlds with an obstacle 1 m in front of a robot at the origin."""
    simulator = FastSimulator(direct_model(), field(9.0, 1), worlds, **changes)
    simulator.reset(range(worlds), starts=np.zeros((worlds, 1, 3)))
    simulator.data.bodies[:, 0, :2] = 1.0, 0.0
    return simulator


def test_a_moving_obstacle_is_where_its_velocity_takes_it_near_and_far_from_a_robot():
    simulator = one_obstacle(3)
    simulator.data.bodies[1:, 0, :2] = [[3.0, 3.0], [-0.6, 0.0]]
    before = simulator.data.bodies[:, 0, :3].copy()
    simulator.data.velocity[:, 0] = [
        [0.1, -0.2, 0.5],
        [0.3, 0.3, -1.0],
        [-0.01, 0.5, 2.0],
    ]
    still(simulator, 7)
    after = simulator.data.bodies[:, 0]
    expected = before + 7 * PERIOD * simulator.data.velocity[:, 0]
    assert after[:, :3] == pytest.approx(expected)
    assert after[:, 3] == pytest.approx(np.cos(after[:, 2]))


def test_an_obstacle_that_would_pass_within_a_period_stops_at_the_robot():
    simulator = one_obstacle()
    simulator.data.bodies[0, 0, :2] = 0.0, 1.0
    simulator.data.velocity[0, 0, 1] = -20.0
    still(simulator, 1)
    assert simulator.data.collided[0, 0] == 1
    stopped = FOOTPRINT + RADIUS
    assert simulator.data.bodies[0, 0, 1] == pytest.approx(stopped, abs=SKIN)
    assert simulator.data.velocity[0, 0, 1] == pytest.approx(
        (stopped - 1.0) / PERIOD, abs=1e-4
    )


@pytest.mark.parametrize(
    ("age", "steps_at_rest", "steps", "distance"),
    [
        (15, 0, 4, 1.0 + 0.4 * (0.4 - 0.15)),
        (200, 25, 1, 1.0 + 0.04 - 0.4),  # it is moved back for a second at most
    ],
)
def test_a_late_scan_shows_a_moving_obstacle_where_it_was(
    age, steps_at_rest, steps, distance
):
    simulator = one_obstacle(longest_age=age)
    simulator.data.age[:] = age
    still(simulator, steps_at_rest)
    simulator.data.velocity[0, 0, 0] = 0.4
    still(simulator, steps)
    ahead = simulator.data.ranges[0, 0, 36]
    assert ahead == pytest.approx(distance - RADIUS, abs=2e-3)


def test_a_robot_that_was_put_elsewhere_is_seen_and_sees_from_there_at_once():
    simulator = FastSimulator(direct_model(), field(4.0), 1, 2, longest_age=30)
    simulator.data.age[:] = 25
    simulator.reset([0], starts=np.array([[[-1.0, 0.0, 0.0], [-1.0, 1.5, 0.0]]]))
    for _ in range(6):
        simulator.step(np.tile([0.1, 0.0, 0.0], (1, 2, 1)))
    simulator.put_robot(0, np.array([1.0, 0.0, 0.0]), np.zeros(0))
    still(simulator, 1)
    assert simulator.data.ranges[0, 0, 36] == pytest.approx(1.0, abs=1e-3)


def test_the_state_drifts_within_the_bounds_of_the_model():
    model = builtin_model("ackermann")
    bounded = dataclasses.replace(model.kinematics, bounded=True)
    model = dataclasses.replace(model, kinematics=bounded)
    low, high = bounded.state_box
    simulator = FastSimulator(model, field(60.0), 20)
    simulator.data.noise[..., 5:] = 0.5
    simulator.reset(range(20))
    for _ in range(40):
        simulator.step(np.tile(model.robot.command_high, (20, 1, 1)))
        state = simulator.data.state
        assert (state >= low).all()
        assert (state <= high).all()


def box_model(corners):
    """The direct robot with an outline."""
    model = direct_model()
    data = model.robot.model_dump(exclude={"footprint_radius"}) | {"footprint": corners}
    return dataclasses.replace(model, robot=RobotSpec.model_validate(data))


BOX = ((0.3, 0.1), (-0.3, 0.1), (-0.3, -0.1), (0.3, -0.1))


class MappedWorld(World):
    """A field with one solid square of 1 m, from (1, -0.5) on."""

    @property
    def grid(self) -> GridMap:
        cells = np.zeros((10, 10), np.int8)
        cells[3:5, 4:6] = 100
        return GridMap(cells, 0.5, (-1.0, -2.0, 0.0))


def test_a_robot_sees_and_touches_the_static_map():
    world = MappedWorld.model_validate(field(8.0).model_dump())
    simulator = FastSimulator(box_model(BOX), world)
    simulator.reset([0], starts=ORIGIN)
    assert simulator.data.ranges[0, 0, 36] == pytest.approx(1.0, abs=1e-4)
    for _ in range(15):
        simulator.step([[[1.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.7, abs=SKIN)
    assert simulator.data.collided[0, 0] == 1
    for _ in range(5):
        simulator.step([[[-1.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0, 0] < 0.32


def vary(simulator):
    """Gives each world parameters of its own; world i the same in a batch of any size."""
    data = simulator.data
    for n in range(len(data.steps)):
        rng = np.random.default_rng(n)
        data.coefficient[n] *= rng.uniform(0.8, 1.2, data.coefficient[n].shape)
        data.delay[n] = rng.integers(0, 25, data.delay[n].shape)
        data.age[n] = rng.integers(0, 25, data.age[n].shape)
        data.noise[n, :, 2:] = 0.02
        data.faults[n, :, -1] = rng.integers(-1, 2)
        if data.velocity.shape[1] < STANDING:
            data.velocity[n] = rng.uniform(-0.3, 0.3, data.velocity[n].shape)


def digests(worlds, robots=2, threads=1, world=None, parts=False):
    """SHA-256 of all that each world comes to in a drive."""
    simulator = FastSimulator(
        noisy_model(),
        world or field(4.0, count=3),
        worlds,
        robots,
        threads=threads,
        longest_delay=25,
        longest_age=25,
    )
    vary(simulator)
    simulator.reset(range(worlds))
    found = [hashlib.sha256() for _ in range(worlds)]
    generators = [np.random.default_rng(n) for n in range(worlds)]
    for _ in range(60):
        command = np.array([rng.uniform(-1.0, 1.0, (robots, 3)) for rng in generators])
        if parts:
            for part in reversed(simulator.parts):
                simulator.step_part(part, command[part])
        else:
            simulator.step(command)
        # The order of the bodies is the simulator's own.
        in_order = np.sort(simulator.data.bodies, axis=1)
        for n, digest in enumerate(found):
            for array in simulator.data._replace(bodies=in_order):
                digest.update(array[n].tobytes())
    assert simulator.data.collided.sum() > 0
    return [digest.hexdigest() for digest in found]


def test_a_world_comes_to_the_same_bits_in_any_batch_with_any_threads_and_parts():
    expected = digests(16)
    assert digests(16, threads=2) == expected
    assert digests(16, threads=3, parts=True) == expected
    for worlds in (1, 5):
        assert digests(worlds) == expected[:worlds]


def test_a_crowd_in_cells_comes_to_the_bits_of_looking_at_all_bodies(monkeypatch):
    plain = digests(2, robots=12)
    monkeypatch.setattr(sizes, "CROWD", 0)
    assert sizes.Sizes(1, 12, 3, 0, 0).crowded
    assert digests(2, robots=12) == plain
