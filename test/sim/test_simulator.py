from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lidar_scenes import scan_skewed, slice_poses
from robots import FOOTPRINT, RADIUS, circles, direct_model, field, lidar

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.allocation import SLICES
from nics_drl_bridge.sim.command_range import OutsideValidityWarning
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import CHECK_INTERVAL, FastSimulator
from nics_drl_bridge.sim.state import State
from nics_drl_bridge.sim.world import load_world

ORIGIN = np.zeros((1, 1, 3))
PERIOD = 0.1
OVERLAP = 1e-6
"""So deep may a robot be in what it touches [m]."""


def noisy_model(**changes):
    return direct_model(odometry=(0.05, 0.03), sensor=lidar(noise_std=0.01, **changes))


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


def assert_same(one, other, names, rows=slice(None), other_rows=slice(None)):
    for a, b in zip(one, other, strict=True):
        for name in names:
            assert np.array_equal(a[name][rows], b[name][other_rows]), name


ALL = State._fields


@pytest.mark.parametrize("renderer", ["baked", "exact"])
def test_the_same_seeds_give_the_same_bits_in_another_simulator(renderer):
    model = noisy_model()
    world = field(5.0, count=4)
    commands = random_commands(model, 15, 3, 2)
    one, other = (
        drive(FastSimulator(model, world, 3, 2, renderer), [4, 5, 6], commands)
        for _ in range(2)
    )
    assert_same(one, other, ALL)
    again = drive(FastSimulator(model, world, 3, 2, renderer), [7, 5, 6], commands)
    assert not np.array_equal(again[-1]["twist"][0], one[-1]["twist"][0])


@pytest.mark.parametrize("robot", ["direct", "ackermann", "mecanum"])
@pytest.mark.parametrize("batch", [4, 16, 300])
@pytest.mark.slow
def test_a_world_gives_the_same_bits_in_a_batch_of_any_size(robot, batch):
    model = noisy_model() if robot == "direct" else builtin_model(robot)
    radius = RADIUS if robot == "direct" else model.robot.footprint_radius
    world = field(3.0 if robot == "mecanum" else 4.0, obstacles=[circles(3, (radius,))])
    commands = random_commands(model, 25, batch, 1)
    together = drive(FastSimulator(model, world, batch), range(batch), commands)
    single = FastSimulator(model, world)
    touched = 0
    for n in (0, 1, 2, 3, batch // 2, batch - 1):
        alone = drive(single, [n], commands[:, n : n + 1])
        assert_same(alone, together, ALL, other_rows=slice(n, n + 1))
        touched += alone[-1]["collided"].sum()
    assert 0 < together[-1]["collided"].sum() < batch


def test_beginning_one_world_anew_leaves_the_others_alone():
    model = noisy_model()
    world = field(5.0, count=3)
    commands = random_commands(model, 10, 3, 1)
    plain = drive(FastSimulator(model, world, 3), [1, 2, 3], commands)
    simulator = FastSimulator(model, world, 3)
    simulator.reset([1, 2, 3])
    for step, command in enumerate(commands):
        if step == 5:
            simulator.reset([9], worlds=[1])
        simulator.step(command)
    for name in ALL:
        assert np.array_equal(
            getattr(simulator.data, name)[[0, 2]], plain[-1][name][[0, 2]]
        )
    assert simulator.data.steps.tolist() == [10, 5, 10]
    fresh = drive(FastSimulator(model, world), [9], commands[5:, 1:2])
    for name in ALL:
        assert np.array_equal(getattr(simulator.data, name)[1], fresh[-1][name][0]), (
            name
        )


@pytest.mark.parametrize("latency", [0.0, 0.01, 0.03, 0.09, 0.1, 0.11, 0.25, 0.4])
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


def test_a_reset_forgets_commands_on_their_way():
    simulator = FastSimulator(direct_model(latency=0.3), field())
    drive(simulator, [0], np.ones((2, 1, 1, 3)), ORIGIN)
    simulator.reset([0], starts=ORIGIN)
    for _ in range(5):
        simulator.step(np.zeros((1, 1, 3)))
    assert not simulator.data.pose.any()


def test_robots_move_as_the_readable_model_does():
    model = builtin_model("differential")
    commands = random_commands(model, 20, 1, 1) * [0.3, 1.0]
    history = drive(FastSimulator(model, load_world("empty")), [0], commands, ORIGIN)
    pose = np.zeros(3)
    state = np.zeros(len(model.robot.state))
    for command, data in zip(commands, history, strict=True):
        for _ in range(model.timing[1]):
            pose, state = model.kinematics.step(pose, state, command[0, 0])
        assert data["state"][0, 0] == pytest.approx(state, abs=1e-10)
        assert geometry.between(pose, data["pose"][0, 0]) == pytest.approx(
            np.zeros(3), abs=1e-10
        )


def test_a_robot_stops_at_a_wall_and_is_marked():
    history = drive(
        FastSimulator(direct_model(), field(2.0)),
        [0],
        np.tile([1.0, 0.0, 0.0], (15, 1, 1, 1)),
        ORIGIN,
    )
    x = np.array([data["pose"][0, 0, 0] for data in history])
    collided = np.array([data["collided"][0, 0] for data in history])
    assert x[:7] == pytest.approx(0.1 * np.arange(1, 8))
    assert not collided[:7].any()
    assert collided[8:].all()
    assert x[-1] == pytest.approx(1.0 - FOOTPRINT, abs=OVERLAP)
    assert (x[8:] == x[8]).all()


def test_no_robot_ever_enters_anything():
    model = direct_model()
    world = field(4.0, count=3)
    simulator = FastSimulator(model, world, 32, 3)
    scenes = simulator.reset(range(32))
    for command in random_commands(model, 40, 32, 3):
        simulator.step(command)
        pose = simulator.data.pose
        assert (np.abs(pose[..., :2]) <= 2.0 - FOOTPRINT + OVERLAP).all()
        for n, scene in enumerate(scenes):
            away = np.linalg.norm(pose[n, :, None, :2] - scene.bodies[:, :2], axis=-1)
            assert (away >= FOOTPRINT + RADIUS - OVERLAP).all()
            others = np.linalg.norm(
                pose[n, :, None, :2] - pose[n, None, :, :2], axis=-1
            )
            assert (others + np.eye(3) >= 2.0 * FOOTPRINT - OVERLAP).all()
    assert 0 < simulator.data.collided.sum() < 96


def test_a_robot_that_touched_nothing_is_not_marked():
    history = drive(
        FastSimulator(direct_model(), field()),
        [0],
        np.tile([0.0, 0.0, 2.0], (30, 1, 1, 1)),
        ORIGIN,
    )
    assert not history[-1]["collided"].any()


@pytest.mark.parametrize("renderer", ["baked", "exact"])
def test_robots_see_each_other_and_not_themselves(renderer):
    starts = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    simulator = FastSimulator(direct_model(), field(8.0), 1, 2, renderer)
    simulator.reset([0], starts=starts)
    for expected in (1.0, 0.9, 0.8):
        ahead = simulator.data.ranges[0, 0, 36]
        behind = simulator.data.ranges[0, 1, 0]
        assert ahead == pytest.approx(expected - FOOTPRINT, abs=1e-3)
        assert behind == pytest.approx(expected - FOOTPRINT, abs=1e-3)
        assert np.isinf(simulator.data.ranges[0, 0, 0])
        simulator.step([[[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])


@pytest.mark.parametrize("renderer", ["baked", "exact"])
@pytest.mark.parametrize("skew", ["counter_clockwise", "clockwise"])
def test_a_skewed_scan_is_put_together_from_where_the_robot_was(skew, renderer):
    spec = lidar(beams=180, rate=10.0, mount=(0.1, 0.0, 0.3), faults={"skew": skew})
    model = direct_model(sensor=spec)
    world = field(6.0, 4)
    simulator = FastSimulator(model, world, 2, 2, renderer)
    simulator.reset([3, 4])
    command = np.array(
        [[[1.0, 0.2, 1.5], [-0.5, 0.0, -1.0]], [[0.3, 0.0, 2.0], [0.5, 0.5, 0.0]]]
    )
    for _ in range(3):
        simulator.step(command)
    data = simulator.data
    scanner = Scanner(spec, model.table, renderer)
    for n in range(2):
        for m in range(2):
            others = data.bodies[n].copy()
            others[-2 + m, 5] = 0.0  # it does not see itself
            poses = slice_poses(
                data.pose[n, m], command[n, m], spec.sweep_time, SLICES, skew
            )
            expected = scan_skewed(
                lambda p, b=others: scanner.scan(p, b, world.all_walls())[0], poses
            )
            assert data.ranges[n, m] == pytest.approx(expected, abs=2e-3)
            at_once = scanner.scan(data.pose[n, m], others, world.all_walls())[0]
            assert (np.abs(at_once - expected) > 0.02).any()


def test_robots_that_touch_are_both_marked():
    starts = np.array([[[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]]])
    commands = np.tile([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], (6, 1, 1, 1))
    history = drive(
        FastSimulator(direct_model(), field(8.0), 1, 2), [0], commands, starts
    )
    assert history[-1]["pose"][0, 0, 0] == pytest.approx(0.2, abs=OVERLAP)
    assert history[-1]["collided"][0].tolist() == [1, 1]


def test_a_robot_that_touched_a_wall_may_leave_it_again():
    there = np.tile([1.0, 0.0, 0.0], (10, 1, 1, 1))
    back = np.tile([-1.0, 0.0, 0.0], (5, 1, 1, 1))
    simulator = FastSimulator(direct_model(), field(2.0))
    history = drive(simulator, [0], np.concatenate([there, back]), ORIGIN)
    assert history[9]["collided"].all()
    assert history[-1]["pose"][0, 0, 0] == pytest.approx(
        history[9]["pose"][0, 0, 0] - 0.5
    )


def test_without_noise_odometry_is_the_truth():
    model = direct_model()
    commands = random_commands(model, 60, 4, 1, seed=2) * 0.3
    for data in drive(FastSimulator(model, field(20.0), 4), range(4), commands):
        assert not data["collided"].any()
        off = geometry.between(data["pose"], data["odom"])
        assert np.abs(off).max() < 1e-12
    assert data["twist"] == pytest.approx(commands[-1])


def test_odometry_drifts_with_the_configured_deviation():
    worlds = 3000
    steps = 25
    linear = 0.05
    angular = 0.03
    model = direct_model(odometry=(linear, angular))
    simulator = FastSimulator(model, field(), worlds)
    starts = np.zeros((worlds, 1, 3))
    history = drive(simulator, range(worlds), np.zeros((steps, worlds, 1, 3)), starts)
    twists = np.array([data["twist"][:, 0] for data in history])
    assert twists.std(axis=(0, 1)) == pytest.approx([linear, linear, angular], rel=0.02)
    assert np.abs(twists.mean(axis=(0, 1))).max() < 0.001
    final = history[-1]["odom"][:, 0]
    walk = PERIOD * np.sqrt(steps)
    assert final.std(axis=0) == pytest.approx(
        np.array([linear, linear, angular]) * walk, rel=0.05
    )
    assert not history[-1]["pose"].any()
    for k in range(3):  # each period draws again, independent of the one before
        correlation = np.corrcoef(twists[:-1, :, k].ravel(), twists[1:, :, k].ravel())[
            0, 1
        ]
        assert abs(correlation) < 0.02


def test_ranges_have_the_configured_noise_within_their_limits():
    std = 0.02
    model = direct_model(sensor=lidar(noise_std=std, range_max=2.5))
    clean = direct_model(sensor=lidar(range_max=2.5))
    worlds = 200
    starts = np.tile([0.3, -0.2, 0.4], (worlds, 1, 1))
    noisy, true = (FastSimulator(m, field(4.0), worlds) for m in (model, clean))
    for simulator in (noisy, true):
        simulator.reset(range(worlds), starts=starts)
    expected = true.data.ranges
    seen = noisy.data.ranges
    inside = np.isfinite(expected) & (expected < 2.4)
    difference = seen[inside] - expected[inside]
    assert difference.std() == pytest.approx(std, rel=0.02)
    assert abs(difference.mean()) < 0.001
    assert np.array_equal(np.isfinite(seen), np.isfinite(expected))
    assert seen[np.isfinite(seen)].max() <= 2.5


def test_a_scan_after_reset_is_there_before_the_first_step():
    simulator = FastSimulator(direct_model(), field(4.0))
    simulator.reset([0], starts=ORIGIN)
    assert simulator.data.ranges[0, 0, 36] == pytest.approx(2.0, abs=1e-5)


def test_goals_are_those_of_the_scene():
    simulator = FastSimulator(direct_model(), field(), 2)
    scenes = simulator.reset([5, 6])
    assert np.array_equal(simulator.goals, [scene.goals for scene in scenes])


@pytest.mark.parametrize(("worlds", "robots"), [(0, 1), (1, 0)])
def test_a_simulator_of_nothing_is_refused(worlds, robots):
    with pytest.raises(ConfigError, match="at least 1 world, robot"):
        FastSimulator(direct_model(), field(), worlds, robots)


def test_more_robots_than_fit_in_a_world_are_refused():
    with pytest.raises(ConfigError, match="a world may have 1000 robots"):
        FastSimulator(direct_model(), field(), 1, 10**9)


@pytest.mark.parametrize(
    ("worlds", "robots", "options"),
    [
        (10**9, 1, {}),
        (10**6, 500, {}),
        (10**4, 1, {"longest_age": 10**6}),
        (10**4, 1, {"longest_delay": 10**6}),
    ],
)
def test_more_copies_than_fit_in_memory_are_refused_before_any_is_made(
    worlds, robots, options
):
    with pytest.raises(ConfigError, match="copies of it are the most"):
        FastSimulator(direct_model(), field(), worlds, robots, **options)


def test_obstacles_that_are_spare_or_drawn_count_for_memory():
    model = direct_model()
    copies = 300_000
    refused = "300000 copies of .* are the most"
    spare = field(40.0).with_spare((Circle(radius=0.1),) * 100)
    with pytest.raises(ConfigError, match=refused):
        FastSimulator(model, spare, copies)
    many = Randomisation(name="many", obstacles={"count": (0, 100)})
    with pytest.raises(ConfigError, match=refused):
        FastSimulator(model, field(40.0, count=1), copies, randomisation=many)


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


def test_no_world_may_be_reset():
    simulator = FastSimulator(direct_model(), field(), 3)
    simulator.reset([0, 1, 2])
    assert len(simulator.reset([], worlds=[])) == 0


def narrow_model():
    """A model that was fitted to slow drives only."""
    model = direct_model()
    fitted = replace(model.kinematics, low=np.full(3, -0.5), high=np.full(3, 0.5))
    return replace(model, kinematics=fitted)


FAST = np.array([[[1.0, 0.0, 0.0]]])


def test_each_command_outside_the_fit_is_reported_once_whatever_is_reset():
    told: list[str] = []
    simulator = FastSimulator(
        narrow_model(), field(40.0), 4, threads=2, tell=told.append
    )
    simulator.reset(range(4))
    for worlds in ([3], [0], [0, 1, 2, 3]):
        for _ in range(CHECK_INTERVAL + 1):
            simulator.step(np.tile(FAST, (4, 1, 1)))
        simulator.reset(worlds, worlds=worlds)
    assert [each.split()[0] for each in told] == ["forward"]
    simulator.step(np.tile([[[1.0, 0.0, -1.0]]], (4, 1, 1)))
    assert [each.split()[0] for each in told] == ["forward", "turn"]


def test_commands_outside_the_fit_are_found_in_any_part_of_the_worlds():
    told: list[str] = []
    simulator = FastSimulator(
        narrow_model(), field(40.0), 4, threads=2, tell=told.append
    )
    simulator.reset(range(4))
    for part in simulator.parts:
        commands = FAST * (part.start > 0)
        simulator.step_part(part, np.tile(commands, (2, 1, 1)))
    assert len(told) == 1


def test_the_warning_names_the_line_that_steps():
    simulator = FastSimulator(narrow_model(), field(40.0))
    simulator.reset([0])
    with pytest.warns(OutsideValidityWarning) as warned:
        simulator.step(FAST)
    assert warned[0].filename == __file__


def test_equal_shapes_come_back_as_the_first_of_them():
    disc = Circle(radius=RADIUS)
    world = field(8.0, count=2).with_spare((disc, disc))
    simulator = FastSimulator(direct_model(), world)
    scenes = simulator.reset([0])
    assert np.array_equal(scenes.bodies, simulator.obstacles)


def test_putting_a_robot_or_obstacles_leaves_the_order_of_other_worlds_alone():
    simulator = FastSimulator(direct_model(), field(30.0, count=40), 2)
    simulator.reset([0, 1])
    simulator.data.bodies[1, 0, :2] = simulator.data.bodies[1, 39, :2] + 0.01
    before = simulator.data.bodies[1].copy()
    simulator.put_robot(0, np.zeros(3), np.zeros(0))
    simulator.put_bodies(simulator.obstacles[0])
    assert np.array_equal(simulator.data.bodies[1], before)
