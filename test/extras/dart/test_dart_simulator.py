from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("dartpy", reason="needs DART: the extra `dart`")

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.dart.simulator import PHYSICS, DartSimulator
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle, Segment
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import Obstacles, World, load_world

from .test_dart import PLACES, write_urdf

OTHERS = ("ackermann", "mecanum", "jackal")
NAMES = [
    "differential",
    *(pytest.param(name, marks=pytest.mark.campaign) for name in OTHERS),
]
NOTCHED = [(-0.4, -0.4), (0.4, -0.4), (0.4, 0.4), (0.1, 0.4), (0.0, 0.0), (-0.4, 0.3)]
BIASED = replace(PHYSICS, gyro_bias=0.05, gyro_noise=0.1)
pytestmark = pytest.mark.slow


def forward(model: SimulatorModel, speed: float, robots: int = 1) -> np.ndarray:
    """A command straight ahead for each robot (1, M, C)."""
    command = np.zeros((1, robots, len(model.robot.command)))
    command[..., 0] = speed
    return command


def drive(simulator: DartSimulator, command: np.ndarray, steps: int) -> None:
    for _ in range(steps):
        simulator.step(command)


def exact(name: str) -> SimulatorModel:
    """A shipped model whose lidar measures without noise."""
    model = builtin_model(name)
    lidar = model.lidar.model_copy(update={"noise_std": 0.0})
    return replace(model, lidar=lidar)


def world_of_shapes() -> World:
    group = Obstacles(
        shapes=(
            Circle(radius=0.3),
            Polygon(points=NOTCHED),
            Rectangle(size=(0.5, 0.2)),
            Segment(ends=((-0.4, 0.0), (0.4, 0.0))),
        ),
        count=8,
    )
    return World(
        name="shapes", size=(9.0, 9.0), obstacles=(group,), goal_distance=(1.0, 3.0)
    )


WORLDS = [world_of_shapes(), *map(load_world, ("crowd", "room"))]


@pytest.mark.parametrize("world", WORLDS, ids=lambda world: world.name)
def test_its_rays_measure_what_the_exact_scanner_computes(world):
    model = exact("differential")
    ours = DartSimulator(model, world)
    theirs = FastSimulator(model, world, renderer="exact")
    far = beams = 0
    for seed in range(6):
        for simulator in (ours, theirs):
            simulator.reset([seed])
        pair = ours.data.ranges[0, 0], theirs.data.ranges[0, 0]
        assert np.isfinite(pair[0]).sum() > 100
        same = np.isclose(*pair, rtol=0.0, atol=0.01)
        far += int((~same).sum())
        beams += len(same)
    assert far <= 0.001 * beams  # a beam past a corner may take either side


def test_lidar_faults_are_drawn_as_in_the_fast_simulator():
    model = builtin_model("differential")
    world = load_world("empty")
    faulty = Randomisation(name="faulty", lidar={"dropout": (0.5, 0.5)})
    pair = [
        kind(model, world, randomisation=faulty)
        for kind in (DartSimulator, FastSimulator)
    ]
    for simulator in pair:
        simulator.reset([3])
    ours, theirs = (simulator.data.ranges[0, 0] for simulator in pair)
    assert np.array_equal(np.isinf(ours), np.isinf(theirs))
    assert np.isinf(ours).sum() > 0.4 * model.lidar.beams


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_that_drives_into_a_wall_stops_there_and_has_collided(name):
    model = builtin_model(name)
    simulator = DartSimulator(model, load_world("empty"))
    simulator.reset([0], starts=np.array([[[2.0, 0.0, 0.0]]]))
    robot = model.robot
    outline = robot.footprint or [(robot.footprint_radius, 0.0)]
    free = 3.0 - max(x for x, _ in outline)
    collided = []
    for _ in range(30):
        simulator.step(forward(model, 0.7))
        collided.append(int(simulator.data.collided[0, 0]))
    assert simulator.data.pose[0, 0, 0] == pytest.approx(free, abs=0.015)
    assert abs(simulator.data.pose[0, 0, 1]) < 0.1
    first = collided.index(1)
    assert 8 < first < 25
    assert collided == [0] * first + [1] * (30 - first)
    simulator.reset([0])
    assert simulator.data.collided[0, 0] == 0


def test_a_footprint_of_corners_touches_by_its_corners():
    model = builtin_model("differential")
    nose = [[0.25, 0.0], [-0.1, 0.1], [-0.05, 0.0], [-0.1, -0.1]]
    data = model.robot.model_dump() | {"footprint": nose}
    del data["footprint_radius"]
    model = replace(model, robot=RobotSpec.model_validate(data))
    simulator = DartSimulator(model, load_world("empty"))
    simulator.reset([0], starts=np.array([[[2.0, 0.0, 0.0]]]))
    drive(simulator, forward(model, 0.5), 12)
    assert simulator.data.collided[0, 0] == 0
    drive(simulator, forward(model, 0.5), 15)
    assert simulator.data.collided[0, 0] == 1
    assert simulator.data.pose[0, 0, 0] == pytest.approx(3.0 - 0.25, abs=0.02)


def test_a_robot_of_a_file_touches_by_the_footprint_of_its_spec(tmp_path):
    model = builtin_model("jackal")
    file = write_urdf(tmp_path, PLACES)
    simulator = DartSimulator(model, load_world("empty"), file=file)
    simulator.reset([0], starts=np.array([[[2.0, 0.0, 0.0]]]))
    drive(simulator, forward(model, 0.7), 8)
    assert simulator.data.collided[0, 0] == 0
    drive(simulator, forward(model, 0.7), 20)
    assert simulator.data.collided[0, 0] == 1
    free = 3.0 - max(x for x, _ in model.robot.footprint)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(free, abs=0.02)


def test_wheel_odometry_is_wrong_after_a_turn_in_which_the_wheels_skid():
    """On ice, a robot at full speed does not turn as its wheels do."""
    model = builtin_model("differential")
    world = load_world("empty").model_copy(update={"size": (40.0, 40.0)})
    errors = {}
    for floor, friction in (("dry", 1.0), ("ice", 0.02)):
        physics = replace(PHYSICS, friction=friction)
        simulator = DartSimulator(model, world, physics=physics)
        simulator.reset([0], starts=np.zeros((1, 1, 3)))
        drive(simulator, forward(model, 0.6), 10)
        command = forward(model, 0.6)
        command[..., 1] = 2.0
        drive(simulator, command, 10)
        off = geometry.between(simulator.wheels[0], simulator.data.pose[0, 0])
        errors[floor] = float(np.hypot(*off[:2]))
    assert errors["dry"] < 0.02
    assert errors["ice"] > 0.1


def test_a_gyro_has_a_bias_and_noise_that_the_seed_draws():
    model = builtin_model("jackal")
    world = load_world("empty")
    exact_turns, turns, again = (
        stand(DartSimulator(model, world, physics=physics))
        for physics in (PHYSICS, BIASED, BIASED)
    )
    assert np.array_equal(turns, again)
    errors = turns - exact_turns
    assert errors.mean() == pytest.approx(0.05, abs=0.01)
    assert errors.std() == pytest.approx(0.1 / np.sqrt(10), rel=0.5)


def stand(simulator: DartSimulator) -> np.ndarray:
    """Turn rates by odometry of a robot at rest, by period [rad/s]."""
    simulator.reset([3])
    headings = [simulator.wheels[0, 2]]
    for _ in range(20):
        drive(simulator, forward(simulator.model, 0.0), 1)
        headings.append(simulator.wheels[0, 2])
    return np.diff(headings) / simulator.model.control_period


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_that_does_not_slip_moves_nearly_as_the_model_says(name):
    model = builtin_model(name)
    world = load_world("empty").model_copy(update={"size": (40.0, 40.0)})
    ours = DartSimulator(model, world)
    theirs = FastSimulator(model, world)
    command = forward(model, 0.6)
    command[..., -1] = 0.4 * model.robot.command_high[-1]
    moved = []
    for simulator in (ours, theirs):
        simulator.reset([0], starts=np.zeros((1, 1, 3)))
        drive(simulator, command, 15)
        before = simulator.data.pose[0, 0].copy()
        drive(simulator, command, 5)
        step = geometry.between(before, simulator.data.pose[0, 0])
        moved.append([np.hypot(*step[:2]), step[2]])
    assert moved[0] == pytest.approx(moved[1], rel=0.07)


def test_an_episode_is_the_same_bits_whatever_was_before():
    model = builtin_model("differential")
    world = load_world("crowd")
    first, second = (DartSimulator(model, world) for _ in range(2))
    drive(first, forward(model, 0.3), 5)
    for simulator in (first, second):
        simulator.reset([9])
        drive(simulator, forward(model, 0.5), 10)
    for name, array in first.data._asdict().items():
        assert np.array_equal(array, getattr(second.data, name)), name


def test_a_robot_that_is_put_back_drives_the_same_bits_again():
    model = builtin_model("differential")
    simulator = DartSimulator(model, load_world("empty"))
    simulator.reset([4])
    drive(simulator, forward(model, 0.5), 5)
    pose = simulator.data.pose[0, 0].copy()
    state = simulator.data.state[0, 0].copy()
    drive(simulator, forward(model, 0.5), 5)
    undisturbed = simulator.data.pose[0, 0].copy()
    ends = []
    for _ in range(2):
        simulator.put_robot(0, pose, state)
        assert np.allclose(simulator._rigs[0].read().pose, pose)
        drive(simulator, forward(model, 0.5), 5)
        ends.append(simulator.data.pose[0, 0].copy())
    assert np.array_equal(*ends)
    assert ends[0] == pytest.approx(undisturbed, abs=0.005)


def test_putting_obstacles_keeps_the_motion_of_the_robots():
    model = builtin_model("differential")
    simulator = DartSimulator(model, load_world("crowd"))
    simulator.reset([2])
    drive(simulator, forward(model, 0.3), 5)
    before = simulator._rigs[0].read()
    simulator.put_bodies(simulator.obstacles[0].copy())
    after = simulator._rigs[0].read()
    assert np.array_equal(before.pose, after.pose)
    assert np.array_equal(before.twist, after.twist)


def test_two_robots_see_each_other_and_collide():
    model = exact("differential")
    simulator = DartSimulator(model, load_world("empty"), robots=2)
    starts = np.array([[[-1.0, 0.0, 0.0], [1.0, 0.0, np.pi]]])
    simulator.reset([0], starts=starts)
    ahead = model.lidar.beams // 2
    assert simulator.data.ranges[0, :, ahead] == pytest.approx(2.0 - 0.15, abs=0.01)
    command = forward(model, 0.5, robots=2)
    command[0, 1] = 0.0
    drive(simulator, command, 10)
    assert simulator.data.pose[0, 1, :2] == pytest.approx(starts[0, 1, :2], abs=0.02)
    assert simulator.data.pose[0, 0, 0] > -0.8
    drive(simulator, command, 30)
    assert simulator.data.collided.tolist() == [[1, 1]]
    gap = simulator.data.pose[0, 1, 0] - simulator.data.pose[0, 0, 0]
    assert gap == pytest.approx(2 * 0.15, abs=0.02)


def test_a_wrong_command_is_refused():
    model = builtin_model("ackermann")
    simulator = DartSimulator(model, load_world("empty"))
    with pytest.raises(ConfigError, match=r"\(1, 1, 2\)"):
        simulator.step(np.zeros((1, 2, 2)))
    with pytest.raises(BackendError, match="finite"):
        simulator.step(np.full((1, 1, 2), np.nan))
