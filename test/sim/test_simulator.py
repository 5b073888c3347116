from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lidar_scenes import scan_skewed, slice_poses
from robots import FOOTPRINT, RADIUS, direct_model, field, lidar, noisy_model

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import (
    CHECK_INTERVAL,
    SLICES,
    FastSimulator,
    OutsideValidityWarning,
)

ORIGIN = np.zeros((1, 1, 3))
PERIOD = 0.1


def drive(simulator, seeds, commands, starts=None):
    """Everything that every period of a drive of commands (T, N, M, C) gave."""
    simulator.reset(seeds, starts=starts)
    history = []
    for command in commands:
        simulator.step(command)
        history.append(
            {name: array.copy() for name, array in simulator.data._asdict().items()}
        )
    return history


def random_commands(model, steps, worlds, robots, seed=0):
    rng = np.random.default_rng(seed)
    low = model.robot.command_low
    high = model.robot.command_high
    return rng.uniform(low, high, (steps, worlds, robots, len(low)))


def test_beginning_one_world_anew_leaves_the_others_alone():
    model = noisy_model()  # has commands on their way
    world = field(5.0, count=3)
    commands = random_commands(model, 10, 3, 1)
    simulator = FastSimulator(model, world, 3)
    simulator.reset([1, 2, 3])
    for step, command in enumerate(commands):
        if step == 5:
            simulator.reset([9], worlds=[1])
        simulator.step(command)
    plain = drive(FastSimulator(model, world, 3), [1, 2, 3], commands)[-1]
    fresh = drive(FastSimulator(model, world), [9], commands[5:, 1:2])[-1]
    for name, values in simulator.data._asdict().items():
        assert np.array_equal(values[[0, 2]], plain[name][[0, 2]]), name
        assert np.array_equal(values[1], fresh[name][0]), name


@pytest.mark.parametrize("latency", [0.0, 0.03, 0.1, 0.25])
def test_a_command_takes_effect_after_exactly_its_latency(latency):
    commands = np.zeros((12, 1, 1, 3))
    commands[:, 0, 0, 0] = np.random.default_rng(1).uniform(-1.0, 1.0, 12)
    history = drive(
        FastSimulator(direct_model(latency), field()), [0], commands, ORIGIN
    )
    # A command of period k acts during [k T + latency, (k + 1) T + latency).
    for period, data in enumerate(history):
        now = (period + 1) * PERIOD
        acted = np.clip(now - latency - np.arange(12) * PERIOD, 0.0, PERIOD)
        expected = acted @ commands[:, 0, 0, 0]
        assert data["pose"][0, 0] == pytest.approx([expected, 0.0, 0.0], abs=1e-12), (
            period
        )
        newest = np.floor((now - 0.01 - latency) / PERIOD + 1e-9)
        speed = commands[int(newest), 0, 0, 0] if newest >= 0 else 0.0
        assert data["twist"][0, 0, 0] == pytest.approx(speed)


def test_robots_see_each_other_and_not_themselves():
    starts = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    simulator = FastSimulator(direct_model(), field(8.0), 1, 2)
    simulator.reset([0], starts=starts)
    for expected in (1.0, 0.9, 0.8):
        ahead = simulator.data.ranges[0, 0, 36]
        behind = simulator.data.ranges[0, 1, 0]
        assert ahead == pytest.approx(expected - FOOTPRINT, abs=1e-3)
        assert behind == pytest.approx(expected - FOOTPRINT, abs=1e-3)
        assert np.isinf(simulator.data.ranges[0, 0, 0])
        simulator.step([[[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])


@pytest.mark.parametrize("skew", ["counter_clockwise", "clockwise"])
def test_a_skewed_scan_is_put_together_from_where_the_robot_was(skew):
    spec = lidar(beams=180, rate=10.0, mount=(0.1, 0.0, 0.3), faults={"skew": skew})
    model = direct_model(sensor=spec)
    simulator = FastSimulator(model, field(6.0, 4), 1, 2, "exact")
    simulator.reset([3])
    command = np.array([[[1.0, 0.2, 1.5], [-0.5, 0.0, -1.0]]])
    for _ in range(3):
        simulator.step(command)
    data = simulator.data
    scanner = Scanner(spec, model.table, "exact")
    for m in range(2):
        others = np.delete(data.bodies[0], m - 2, axis=0)  # it does not see itself

        def scan_from(pose, others=others):
            return scanner.scan(pose, others, simulator.world.all_walls())[0]

        pose = data.pose[0, m]
        poses = slice_poses(pose, command[0, m], spec.sweep_time, SLICES, skew)
        expected = scan_skewed(scan_from, poses)
        assert data.ranges[0, m] == pytest.approx(expected, abs=2e-3)
        assert (np.abs(scan_from(pose) - expected) > 0.02).any()


def test_without_noise_odometry_is_the_truth():
    model = direct_model()
    commands = random_commands(model, 60, 4, 1, seed=2) * 0.3
    for data in drive(FastSimulator(model, field(20.0), 4), range(4), commands):
        assert not data["collided"].any()
        off = geometry.between(data["pose"], data["odom"])
        assert np.abs(off).max() < 1e-12
    assert data["twist"] == pytest.approx(commands[-1])


SPARE = field(40.0).with_spare((Circle(radius=0.1),) * 100)
MANY = Randomisation(name="many", obstacles={"count": (0, 100)})
NEEDS_ONE = "at least 1 world, robot and thread"
TOO_MUCH = "copies of .* fit in memory"


@pytest.mark.parametrize(
    ("match", "options"),
    [
        (NEEDS_ONE, {"worlds": 0}),
        (NEEDS_ONE, {"robots": 0}),
        (NEEDS_ONE, {"threads": 0}),
        ("longest_delay of at least", {"longest_delay": -1}),
        ("longest_age of at least 0", {"longest_age": -1}),
        ("1000000000 robots: a world may have at most 1000", {"robots": 10**9}),
        (TOO_MUCH, {"worlds": 10**9}),
        (TOO_MUCH, {"worlds": 10**4, "longest_age": 10**6}),
        (TOO_MUCH, {"worlds": 10**4, "longest_delay": 10**6}),
        (TOO_MUCH, {"worlds": 300_000, "world": SPARE}),
        (TOO_MUCH, {"worlds": 300_000, "randomisation": MANY}),
    ],
)
def test_sizes_that_no_simulator_has_are_refused_before_anything_is_made(
    match, options
):
    given = {"world": field(40.0, count=1), **options}
    with pytest.raises(ConfigError, match=match):
        FastSimulator(direct_model(), **given)


def test_commands_of_another_shape_are_refused():
    simulator = FastSimulator(direct_model(), field(), 3)
    for step in (simulator.step, lambda x: simulator.step_part(simulator.parts[0], x)):
        with pytest.raises(ConfigError, match=r"must be \(3, 1, 3\)"):
            step(np.zeros((2, 1, 3)))


@pytest.mark.parametrize(
    "worlds",
    [[0, 0, 1], [1, -1], [0, 3], [[0], [1]], [0.5, 1.5], [True, False]],
)
def test_worlds_that_cannot_be_reset_are_refused(worlds):
    simulator = FastSimulator(direct_model(), field(), 3)
    simulator.reset([0, 1, 2])
    before = simulator.data.pose.copy()
    with pytest.raises(ConfigError, match="indices from 0 to 2, each at most once"):
        simulator.reset(np.arange(len(worlds)), worlds=worlds)
    assert np.array_equal(simulator.data.pose, before)


def narrow_model():
    """A model that was fitted to slow drives only."""
    model = direct_model()
    fitted = replace(model.kinematics, low=np.full(3, -0.5), high=np.full(3, 0.5))
    return replace(model, kinematics=fitted)


FAST = np.array([[[1.0, 0.0, 0.0]]])


def test_each_command_outside_the_fit_is_reported_once_whatever_is_reset():
    told: list[str] = []
    simulator = FastSimulator(
        narrow_model(), field(40.0), 4, threads=2, warn=told.append
    )
    simulator.reset(range(4))
    for worlds in ([3], [0], [0, 1, 2, 3]):
        for _ in range(CHECK_INTERVAL + 1):
            simulator.step(np.tile(FAST, (4, 1, 1)))
        simulator.reset(worlds, worlds=worlds)
    assert [each.split()[0] for each in told] == ["forward"]
    simulator.step(np.tile([[[1.0, 0.0, -1.0]]], (4, 1, 1)))
    assert [each.split()[0] for each in told] == ["forward", "turn"]


def test_the_warning_names_the_line_that_steps():
    simulator = FastSimulator(narrow_model(), field(40.0))
    simulator.reset([0])
    with pytest.warns(OutsideValidityWarning) as warned:
        simulator.step(FAST)
    assert warned[0].filename == __file__


@pytest.mark.parametrize("count", [2, 40])
def test_a_reset_gives_the_scene_that_was_drawn_and_equal_shapes_as_the_first(count):
    disc = Circle(radius=RADIUS)
    world = field(12.0, count=count).with_spare((disc, disc))
    simulator = FastSimulator(direct_model(), world)
    scenes = simulator.reset([0])
    assert np.array_equal(scenes.bodies, simulator.obstacles)
    drawn = simulator.scenes([0])
    assert np.array_equal(np.sort(scenes.bodies, axis=1), np.sort(drawn.bodies, axis=1))
    assert np.array_equal(drawn.goals, simulator.goals)


def test_putting_a_robot_or_obstacles_leaves_the_order_of_other_worlds_alone():
    simulator = FastSimulator(direct_model(), field(30.0, count=40), 2)
    simulator.reset([0, 1])
    simulator.data.bodies[1, 0, :2] = simulator.data.bodies[1, 39, :2] + 0.01
    before = simulator.data.bodies[1].copy()
    simulator.put_robot(0, np.zeros(3), np.zeros(0))
    simulator.put_bodies(simulator.obstacles[0])
    assert np.array_equal(simulator.data.bodies[1], before)
