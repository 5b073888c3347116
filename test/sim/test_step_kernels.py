"""Each robot by its own parameters: kinematics, latencies, noise, skew; and moving obstacles."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest
from lidar_scenes import scan_skewed, slice_poses
from robots import FOOTPRINT, RADIUS, direct_model, field, lidar

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.cell_kernels import body_cells
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim import allocation as sizes
from nics_drl_bridge.sim.allocation import SLICES
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

ORIGIN = np.zeros((1, 1, 3))
SUBSTEPS = 10
PERIOD = 0.1
OVERLAP = 1e-6
"""So deep may a robot be in what it touches [m]."""


def random_commands(worlds, steps, robots=1, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, worlds, robots, 3))


def test_robots_side_by_side_keep_latencies_of_their_own():
    latencies = [0, 1, 3, 9, 10, 11, 25, 40]
    mixed = FastSimulator(direct_model(), field(), len(latencies), longest_delay=40)
    mixed.data.delay[:, 0] = latencies
    commands = random_commands(len(latencies), 12)
    mixed.reset(range(len(latencies)))
    alone = [
        FastSimulator(direct_model(0.01 * latency), field()) for latency in latencies
    ]
    for n, simulator in enumerate(alone):
        simulator.reset([n])
    for command in commands:
        mixed.step(command)
        for n, simulator in enumerate(alone):
            simulator.step(command[n : n + 1])
            for name in ("pose", "state", "twist", "ranges", "collided"):
                assert np.array_equal(
                    getattr(mixed.data, name)[n], getattr(simulator.data, name)[0]
                ), (n, name)


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


@pytest.mark.parametrize("age", [1, 5, 10, 17, 30])
def test_what_a_robot_is_told_is_of_its_age(age):
    model = direct_model(sensor=lidar(noise_std=0.0))
    late = FastSimulator(model, field(4.0, 4), 1, 2, longest_age=30)
    now = FastSimulator(model, field(4.0, 4), 1, 2)
    late.data.age[:] = age
    for simulator in (late, now):
        simulator.reset([3])
    poses = [now.data.pose[0].copy()]
    twists = [np.zeros((2, 3))]
    command = np.array([[[0.5, 0.1, 0.4], [0.2, -0.3, -0.7]]])
    for step in range(1, 8):
        late.step(command)
        now.step(command)
        poses.append(now.data.pose[0].copy())
        twists.append(now.data.twist[0].copy())
        told = max(step - age / SUBSTEPS, 0.0)
        low = int(told)
        high = min(low + 1, step)
        for m in range(2):
            a = poses[low][m]
            b = poses[high][m]
            expected = a + (told - low) * np.array(
                [*(b - a)[:2], geometry.wrap_angle(b[2] - a[2])]
            )
            off = late.data.odom[0, m] - expected
            assert np.abs([*off[:2], geometry.wrap_angle(off[2])]).max() < 1e-9
            speed = twists[low][m] + (told - low) * (twists[high][m] - twists[low][m])
            assert late.data.twist[0, m] == pytest.approx(speed)
        bodies = now.data.bodies.copy()
        for m in range(2):
            a = poses[low][m]
            b = poses[high][m]
            turn = geometry.wrap_angle(b[2] - a[2])
            bodies[0, 4 + m, :3] = a + (told - low) * np.array([*(b - a)[:2], turn])
        for m in range(2):
            others = bodies.copy()
            others[0, 4 + m, 5] = 0.0
            seen = now._scanner.scan(
                bodies[0, 4 + m, :3], others, now.world.all_walls()
            )[0]
            both = np.isfinite(seen) & np.isfinite(late.data.ranges[0, m])
            assert both.sum() > 20
            off = np.abs(late.data.ranges[0, m][both] - seen[both])
            assert np.quantile(off, 0.9) < 1e-4
    assert np.array_equal(late.data.pose, now.data.pose)


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


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_scan_of_a_single_robot_may_be_skewed(direction):
    skew = "counter_clockwise" if direction > 0.0 else "clockwise"
    plain = FastSimulator(direct_model(sensor=lidar(beams=180)), field(4.0, 3), 2)
    whole = FastSimulator(
        direct_model(sensor=lidar(beams=180, faults={"skew": skew})), field(4.0, 3), 2
    )
    plain.data.faults[1, 0, -1] = direction
    for simulator in (plain, whole):
        simulator.reset([1, 1])
        for _ in range(3):
            simulator.step(np.tile([0.4, 0.0, 1.5], (2, 1, 1)))
    assert np.array_equal(plain.data.ranges[1], whole.data.ranges[1])
    assert not np.array_equal(plain.data.ranges[0], plain.data.ranges[1])


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


def test_an_obstacle_that_meets_a_robot_marks_it():
    simulator = one_obstacle()
    simulator.data.velocity[0, 0, 0] = -1.0
    free = 1.0 - FOOTPRINT - RADIUS
    for step in range(1, 10):
        still(simulator, 1)
        if abs(step * PERIOD - free) > 0.02:
            assert simulator.data.collided[0, 0] == (step * PERIOD > free)
    assert not simulator.data.pose.any()


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


@pytest.mark.parametrize("age", [0, 5])
def test_a_skewed_sweep_does_not_begin_before_the_episode(age):
    spec = lidar(beams=180, rate=2.0, faults={"skew": "counter_clockwise"})
    world = field(2.0)
    simulator = FastSimulator(direct_model(sensor=spec), world, longest_age=5)
    simulator.data.age[:] = age

    def scan_from(pose):
        return simulator._scanner.scan(pose, np.zeros((0, 7)), world.all_walls())[0]

    simulator.reset([0], starts=np.array([[[-0.75, 0.0, 0.0]]]))
    for steps in (1, 2):
        simulator.step([[[1.0, 0.0, 0.0]]])
        driven = steps * PERIOD - age / 100
        pose = [-0.75 + driven, 0.0, 0.0]
        speed = driven / PERIOD if steps == 1 else 1.0
        poses = slice_poses(
            pose,
            [speed, 0.0, 0.0],
            spec.sweep_time,
            SLICES,
            "counter_clockwise",
            driven,
        )
        assert (poses[:, 0] >= -0.75 - 1e-9).all()
        expected = scan_skewed(scan_from, poses)
        assert simulator.data.ranges[0, 0] == pytest.approx(expected, abs=2e-3)


def test_a_robot_that_was_put_elsewhere_is_seen_and_sees_from_there_at_once():
    simulator = FastSimulator(direct_model(), field(4.0), 1, 2, longest_age=30)
    simulator.data.age[:] = 25
    simulator.reset([0], starts=np.array([[[-1.0, 0.0, 0.0], [-1.0, 1.5, 0.0]]]))
    for _ in range(6):
        simulator.step(np.tile([0.1, 0.0, 0.0], (1, 2, 1)))
    simulator.put_robot(0, np.array([1.0, 0.0, 0.0]), np.zeros(0))
    still(simulator, 1)
    assert simulator.data.ranges[0, 0, 36] == pytest.approx(1.0, abs=1e-3)


def test_a_simulator_that_takes_over_keeps_the_past():
    one, other = (
        FastSimulator(direct_model(), field(4.0, 2), 1, 2, longest_age=30)
        for _ in range(2)
    )
    one.reset([0])
    for _ in range(6):
        one.step(np.tile([0.1, 0.0, 0.0], (1, 2, 1)))
    other.reset([1])
    other.take_over(one, np.arange(2), np.arange(2))
    assert np.array_equal(other.data.past, one.data.past)
    assert np.array_equal(other.data.pose, one.data.pose)


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


def test_a_long_robot_passes_a_gap_lengthwise_and_not_across():
    walls = [(0.6, 0.15, 0.6, 2.0), (0.6, -2.0, 0.6, -0.15)]
    world = field(8.0, walls=walls)
    simulator = FastSimulator(box_model(BOX), world, 2)
    simulator.reset(
        [0, 0], starts=np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, np.pi / 2.0]]])
    )
    for _ in range(15):
        simulator.step([[[1.0, 0.0, 0.0]], [[0.0, -1.0, 0.0]]])
    assert simulator.data.pose[0, 0, 0] == pytest.approx(1.5)
    assert simulator.data.collided[:, 0].tolist() == [0, 1]
    assert simulator.data.pose[1, 0, 0] == pytest.approx(0.5, abs=OVERLAP)


def test_a_long_robot_that_turns_touches_what_it_turns_into():
    simulator = FastSimulator(box_model(BOX), field(8.0, walls=[(-2.0, 0.2, 2.0, 0.2)]))
    simulator.reset([0], starts=ORIGIN)
    for _ in range(10):
        simulator.step([[[0.0, 0.0, 1.0]]])
    assert simulator.data.collided[0, 0] == 1
    _, y, heading = simulator.data.pose[0, 0]
    corner = y + 0.3 * np.sin(heading) + 0.1 * np.cos(heading)
    assert corner == pytest.approx(0.2, abs=1e-5)


def test_two_long_robots_touch_by_their_outlines():
    simulator = FastSimulator(box_model(BOX), field(8.0), 1, 2)
    simulator.reset([0], starts=np.array([[[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]]))
    assert simulator.data.ranges[0, 0, 54] == pytest.approx(0.4, abs=1e-3)
    for _ in range(5):
        simulator.step([[[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0, 1] == pytest.approx(0.25)
    assert not simulator.data.collided.any()
    for _ in range(5):
        simulator.step([[[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0, 1] == pytest.approx(0.3, abs=OVERLAP)
    assert simulator.data.collided.all()


class MappedWorld(World):
    """A field with one solid square of 1 m, from (1, -0.5) on."""

    @property
    def grid(self) -> GridMap:
        cells = np.zeros((10, 10), np.int8)
        cells[3:5, 4:6] = 100
        return GridMap(cells, 0.5, (-1.0, -2.0, 0.0))


@pytest.mark.parametrize("model", [direct_model(), box_model(BOX)])
def test_a_robot_sees_and_touches_the_static_map(model):
    world = MappedWorld.model_validate(field(8.0).model_dump())
    simulator = FastSimulator(model, world)
    simulator.reset([0], starts=ORIGIN)
    assert simulator.data.ranges[0, 0, 36] == pytest.approx(1.0, abs=1e-4)
    for _ in range(15):
        simulator.step([[[1.0, 0.0, 0.0]]])
    front = FOOTPRINT if model.robot.footprint is None else 0.3
    assert simulator.data.pose[0, 0, 0] == pytest.approx(1.0 - front, abs=OVERLAP)
    assert simulator.data.collided[0, 0] == 1
    for _ in range(5):
        simulator.step([[[-1.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0, 0] < 0.6 - front + 0.02


def test_the_robots_of_a_crowd_see_what_a_scanner_sees_among_all_bodies():
    data = builtin_model("differential").lidar.model_dump() | {"mount": (0.5, 0.2, 0.3)}
    spec = LidarSpec.model_validate(data | {"beams": 72})
    model = direct_model(sensor=spec)
    crowd = FastSimulator(model, field(14.0, 20), 1, 70)
    crowd.reset([1])
    for command in random_commands(1, 5, 70):
        crowd.step(command)
    for m in (0, 33, 69):
        others = crowd.data.bodies.copy()
        others[0, 20 + m, 5] = 0.0
        pose = crowd.data.pose[0, m]
        seen = crowd._scanner.scan(pose, others, crowd.world.all_walls())[0]
        assert np.array_equal(seen, crowd.data.ranges[0, m])


STEPS = 120


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


@pytest.mark.parametrize("worlds", [1, 5])
def test_a_world_comes_to_the_same_bits_in_a_batch_of_any_size(expected, worlds):
    assert digests(worlds) == expected[:worlds]


def test_parts_stepped_by_themselves_come_to_the_same_bits(expected):
    assert digests(16, threads=3, parts=True) == expected


def test_a_crowd_in_cells_comes_to_the_bits_of_looking_at_all_bodies(monkeypatch):
    plain = digests(2, robots=12, steps=60)
    monkeypatch.setattr(sizes, "CROWD", 0)
    assert sizes.Sizes(1, 12, 3, 0, 0).crowded
    assert digests(2, robots=12, steps=60) == plain


def drive_among(world, worlds=3, threads=1, steps=200):
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
            assert np.array_equal(one, other, equal_nan=True)


def test_the_parts_are_all_worlds_in_order():
    for worlds, threads in ((1, 1), (5, 2), (7, 3), (2, 8)):
        parts = FastSimulator(model(), field(), worlds, threads=threads).parts
        assert len(parts) == min(worlds, threads)
        assert [n for part in parts for n in range(part.start, part.stop)] == list(
            range(worlds)
        )


def test_what_runs_in_parts_comes_back_in_their_order():
    simulator = FastSimulator(model(), field(), 5, threads=2)
    assert simulator.run_parts(lambda part: part.start) == [0, 2]


def test_commands_of_another_shape_are_refused():
    simulator = FastSimulator(model(), field(), 3)
    with pytest.raises(ConfigError, match=r"must be \(3, 1, 3\)"):
        simulator.step(np.zeros((1, 1, 3)))
    with pytest.raises(ConfigError, match=r"must be \(3, 1, 3\)"):
        simulator.step_part(simulator.parts[0], np.zeros((2, 1, 3)))


@pytest.mark.parametrize(
    "changes", [{"threads": 0}, {"longest_delay": 2}, {"longest_age": -1}]
)
def test_a_simulator_without_threads_or_room_is_refused(changes):
    with pytest.raises(ConfigError, match="at least 1 world, robot and thread"):
        FastSimulator(model(), field(), 3, **changes)
