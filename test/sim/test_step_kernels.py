"""Each robot by its own parameters: kinematics, latencies, noise, skew; and moving obstacles."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest
from robots import FOOTPRINT, RADIUS, direct_model, field, lidar

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim import simulator as sizes
from nics_drl_bridge.sim.collision_kernels import body_cells
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

ORIGIN = np.zeros((1, 1, 3))
SUBSTEPS = 10
PERIOD = 0.1
OVERLAP = 1e-3  # a robot stops this near to what it touches [m]
"""So deep may a robot be in what it touches [m]."""


def random_commands(worlds, steps, robots=1, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, worlds, robots, 3))


def test_each_robot_drifts_by_its_own_noise():
    simulator = FastSimulator(direct_model(), field(40.0), 400)
    simulator.data.noise[:200, 0, 2:5] = 0.0, 0.05, 0.0
    simulator.data.noise[200:, 0, 0] = 0.2
    simulator.reset(range(400), starts=np.zeros((400, 1, 3)))
    for _ in range(10):
        simulator.step(np.zeros((400, 1, 3)))
    data = simulator.data
    assert data.pose[:200, 0, 1].std() == pytest.approx(0.05, rel=0.2)
    assert not data.pose[200:].any()
    assert data.twist[200:, 0, :2].std() == pytest.approx(0.2, rel=0.15)
    assert not data.twist[:200].any()


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


def still(simulator, steps):
    for _ in range(steps):
        simulator.step(np.zeros_like(simulator.data.pose))


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
    assert simulator.data.bodies[0, 0, 1] == pytest.approx(stopped, abs=OVERLAP)
    assert simulator.data.velocity[0, 0, 1] == pytest.approx(
        (stopped - 1.0) / PERIOD, abs=1e-4
    )


def test_a_late_scan_shows_a_moving_obstacle_where_it_was():
    simulator = one_obstacle(longest_age=20)
    simulator.data.velocity[0, 0, 0] = 0.4
    simulator.data.age[:] = 15
    still(simulator, 4)
    ahead = simulator.data.ranges[0, 0, 36]
    assert ahead == pytest.approx(1.0 + 0.4 * (0.4 - 0.15) - RADIUS, abs=2e-3)


def test_a_late_scan_moves_an_obstacle_back_for_a_second_at_most():
    simulator = one_obstacle(longest_age=200)
    simulator.data.age[:] = 200
    still(simulator, 25)
    simulator.data.velocity[0, 0, 0] = -0.4
    still(simulator, 1)
    ahead = simulator.data.ranges[0, 0, 36]
    assert ahead == pytest.approx(1.0 - 0.04 + 0.4 - RADIUS, abs=2e-3)


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
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.7, abs=OVERLAP)
    assert simulator.data.collided[0, 0] == 1
    for _ in range(5):
        simulator.step([[[-1.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0, 0] < 0.32


STEPS = 60


def model():
    return direct_model(
        latency=0.03, odometry=(0.05, 0.03), sensor=lidar(noise_std=0.01)
    )


def vary(simulator, seed=0):
    """Gives each world parameters of its own; world i the same in a batch of any size."""
    data = simulator.data
    for n in range(len(data.steps)):
        rng = np.random.default_rng([seed, n])
        data.coefficient[n] *= rng.uniform(0.8, 1.2, data.coefficient[n].shape)
        data.delay[n] = rng.integers(0, 25, data.delay[n].shape)
        data.age[n] = rng.integers(0, 25, data.age[n].shape)
        data.noise[n, :, 2:] = 0.02
        data.velocity[n] = rng.uniform(-0.3, 0.3, data.velocity[n].shape)
        data.faults[n, :, -1] = rng.integers(-1, 2)


def digests(worlds, threads=1, robots=2, steps=STEPS, parts=False):
    """SHA-256 of all that each world came to in a drive."""
    simulator = FastSimulator(
        model(),
        field(4.0, count=3),
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
    for _ in range(steps):
        command = np.array([rng.uniform(-1.0, 1.0, (robots, 3)) for rng in generators])
        if parts:
            for part in reversed(simulator.parts):
                simulator.step_part(part, command[part])
        else:
            simulator.step(command)
        for n in range(worlds):
            for array in simulator.data:
                found[n].update(array[n].tobytes())
    assert simulator.data.collided.sum() > 0
    return [digest.hexdigest() for digest in found]


@pytest.fixture(scope="module")
def expected():
    return digests(16)


def test_two_threads_come_to_the_bits_of_one(expected):
    assert digests(16, threads=2) == expected


def test_a_world_comes_to_the_same_bits_in_a_batch_of_any_size(expected):
    assert digests(5) == expected[:5]
    assert digests(1) == expected[:1]


def test_parts_stepped_by_themselves_come_to_the_same_bits(expected):
    assert digests(16, threads=3, parts=True) == expected


def test_a_crowd_in_cells_comes_to_the_bits_of_looking_at_all_bodies(monkeypatch):
    plain = digests(2, robots=12, steps=60)
    monkeypatch.setattr(sizes, "CROWD", 0)
    assert sizes.Sizes(1, 12, 3, 0, 0).crowded
    assert digests(2, robots=12, steps=60) == plain


def drive_among(world, worlds=3, threads=1, steps=100):
    """All that each world comes to among many obstacles that stand, reset in between."""
    longest = {"longest_delay": 25, "longest_age": 25}
    simulator = FastSimulator(model(), world, worlds, 2, threads=threads, **longest)
    rng = np.random.default_rng(3)
    found = []
    touched = 0
    simulator.data.age[:1] = 7  # a scan of where the robot was
    for t in range(steps):
        if t % 50 == 0:
            scenes = simulator.reset(np.arange(worlds) + t)
            assert np.array_equal(scenes.bodies, simulator.obstacles)
            drawn = simulator.scenes(np.arange(worlds) + t).bodies
            assert np.array_equal(
                np.sort(scenes.bodies, axis=1), np.sort(drawn, axis=1)
            )
            command = rng.uniform(-1.0, 1.0, (worlds, 2, 3))
        simulator.step(command)
        touched += int(simulator.data.collided.sum())
        in_order = np.sort(
            simulator.data.bodies, axis=1
        )  # the order is the simulator's own
        found += [array.copy() for array in simulator.data._replace(bodies=in_order)]
    assert touched > 0
    return found


def test_obstacles_in_cells_are_seen_and_touched_like_those_that_are_all_looked_at(
    monkeypatch,
):
    world = field(12.0, count=40)
    made = []
    monkeypatch.setattr(
        sizes, "body_cells", lambda n, *rest: made.append(n) or body_cells(n, *rest)
    )
    in_cells = [drive_among(world, threads=threads) for threads in (1, 2)]
    assert 3 in made
    made.clear()
    monkeypatch.setattr(sizes, "STANDING", 41)
    plain = drive_among(world)
    assert 3 not in made
    for found in in_cells:
        for one, other in zip(plain, found, strict=True):
            assert one.tobytes() == other.tobytes()
