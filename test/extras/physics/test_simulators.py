"""Robots in a world, in each engine, and beside the fast simulator."""

from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.physics.simulator import divide
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

from .driving import drive, forward
from .engines import Engine, list_rows

WALL_X = 3.0  # of the empty world [m]
OTHERS = ("ackermann", "mecanum", "jackal")
NAMES = [
    "differential",
    *(pytest.param(name, marks=pytest.mark.campaign) for name in OTHERS),
]
NOSE = [[0.25, 0.0], [-0.1, 0.1], [-0.05, 0.0], [-0.1, -0.1]]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=list_rows())
def engine(request) -> Engine:
    return request.param


def with_footprint(model: SimulatorModel, corners: list[list[float]]) -> SimulatorModel:
    data = model.robot.model_dump() | {"footprint": corners}
    del data["footprint_radius"]
    return replace(model, robot=RobotSpec.model_validate(data))


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_that_drives_into_a_wall_stops_there_and_has_collided(engine, name):
    model = builtin_model(name)
    simulator = engine.simulator(model, load_world("empty"))
    simulator.reset([0], starts=np.array([[[2.4, 0.0, 0.0]]]))
    outline = model.robot.footprint or [(model.robot.footprint_radius, 0.0)]
    front = max(x for x, _ in outline)
    collided = []
    for _ in range(20):
        simulator.step(forward(model, 0.7))
        collided.append(int(simulator.data.collided[0, 0]))
    x = simulator.data.pose[0, 0, 0]
    assert x == pytest.approx(WALL_X - front, abs=engine.wall_error)
    assert abs(simulator.data.pose[0, 0, 1]) < 0.1
    first = collided.index(1)
    assert 3 < first < 16
    assert collided == [0] * first + [1] * (20 - first)
    simulator.reset([0])
    assert simulator.data.collided[0, 0] == 0


def test_a_footprint_of_corners_touches_by_its_corners(engine):
    model = with_footprint(builtin_model("differential"), NOSE)
    simulator = engine.simulator(model, load_world("empty"))
    simulator.reset([0], starts=np.array([[[2.4, 0.0, 0.0]]]))
    drive(simulator, forward(model, 0.5), 4)
    assert simulator.data.collided[0, 0] == 0
    drive(simulator, forward(model, 0.5), 10)
    assert simulator.data.collided[0, 0] == 1
    assert simulator.data.pose[0, 0, 0] == pytest.approx(WALL_X - 0.25, abs=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_that_does_not_slip_moves_nearly_as_the_model_says(engine, name):
    """The steady motion is the textbook's; motors are slower where wheels would slip."""
    model = builtin_model(name)
    world = load_world("empty").model_copy(update={"size": (40.0, 40.0)})
    command = forward(model, 0.6)
    command[..., -1] = 0.4 * model.robot.command_high[-1]
    moved = []
    for kind in (engine.simulator, FastSimulator):
        simulator = kind(model, world)
        simulator.reset([0], starts=np.zeros((1, 1, 3)))
        drive(simulator, command, 15)
        before = simulator.data.pose[0, 0].copy()
        drive(simulator, command, 5)
        x, y, turn = geometry.between(before, simulator.data.pose[0, 0])
        moved.append([np.hypot(x, y), turn])
    assert moved[0] == pytest.approx(moved[1], rel=engine.slip_error)


def test_wheel_odometry_is_wrong_after_a_turn_in_which_the_wheels_skid(engine):
    """On ice, a robot at full speed does not turn as its wheels do."""
    model = builtin_model("differential")
    world = load_world("empty").model_copy(update={"size": (40.0, 40.0)})
    errors = {}
    for floor, friction in (("dry", 1.0), ("ice", 0.02)):
        physics = replace(engine.physics, friction=friction)
        simulator = engine.simulator(model, world, physics=physics)
        simulator.reset([0], starts=np.zeros((1, 1, 3)))
        command = forward(model, 0.6)
        drive(simulator, command, 10)
        command[..., 1] = 2.0
        drive(simulator, command, 10)
        error = geometry.between(simulator.wheels[0], simulator.data.pose[0, 0])
        errors[floor] = float(np.hypot(*error[:2]))
    assert errors["dry"] < 0.02
    assert errors["ice"] > 0.1


def test_faults_of_sensors_are_drawn_as_in_the_fast_simulator(engine):
    model = builtin_model("differential")
    world = load_world("empty")
    faulty = Randomisation(
        name="faulty",
        lidar={"dropout": (0.5, 0.5)},
        odometry={"odom_linear": (0.1, 0.1)},
    )
    ours = engine.simulator(model, world, randomisation=faulty)
    theirs = FastSimulator(model, world, randomisation=faulty)
    ours.reset([3])
    theirs.reset([3])
    lost = np.isinf(ours.data.ranges)
    assert np.array_equal(lost, np.isinf(theirs.data.ranges))
    assert np.array_equal(ours.data.noise, theirs.data.noise)
    assert lost.sum() > 0.4 * model.lidar.beams


def test_an_episode_is_the_same_bits_whatever_was_before(engine):
    model = builtin_model("differential")
    world = load_world("crowd")
    first = engine.simulator(model, world)
    second = engine.simulator(model, world)
    drive(first, forward(model, 0.3), 5)
    for simulator in (first, second):
        simulator.reset([9])
        drive(simulator, forward(model, 0.5), 10)
    for name, array in first.data._asdict().items():
        assert np.array_equal(array, getattr(second.data, name)), name


def test_two_robots_see_each_other_and_collide(engine):
    model = builtin_model("differential")
    simulator = engine.simulator(model, load_world("empty"), robots=2)
    starts = np.array([[[-0.4, 0.0, 0.0], [0.4, 0.0, np.pi]]])
    simulator.reset([0], starts=starts)
    radius = model.robot.footprint_radius
    ahead = model.lidar.beams // 2
    seen = simulator.data.ranges[0, :, ahead]
    assert seen == pytest.approx(0.8 - radius, abs=0.01)
    command = forward(model, 0.5, robots=2)
    command[0, 1] = 0.0
    drive(simulator, command, 5)
    assert simulator.data.pose[0, 1, :2] == pytest.approx(starts[0, 1, :2], abs=0.02)
    assert simulator.data.pose[0, 0, 0] > -0.35
    drive(simulator, command, 12)
    assert simulator.data.collided.tolist() == [[1, 1]]
    gap = simulator.data.pose[0, 1, 0] - simulator.data.pose[0, 0, 0]
    assert gap == pytest.approx(2 * radius, abs=0.02)


def test_a_wrong_command_is_refused(engine):
    model = builtin_model("ackermann")
    simulator = engine.simulator(model, load_world("empty"))
    with pytest.raises(ConfigError, match=r"\(1, 1, 2\)"):
        simulator.step(np.zeros((1, 2, 2)))
    with pytest.raises(BackendError, match="finite"):
        simulator.step(np.full((1, 1, 2), np.nan))


@pytest.mark.parametrize("period", [0.1, 0.02, 1 / 30, 0.0005])
def test_a_control_period_is_a_whole_number_of_time_steps(period):
    longest = 0.001
    parts, steps, timestep = divide(period, longest)
    assert parts * steps * timestep == pytest.approx(period, rel=1e-12)
    assert timestep <= longest * (1.0 + 1e-6)
