from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("dartpy", reason="needs DART: the extra `dart`")

from nics_drl_bridge.extras.dart.simulator import PHYSICS, DartSimulator
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle, Segment
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import Obstacles, World, load_world

from ..physics.driving import drive, forward
from .test_dart import PLACES, write_urdf

NOTCHED = [(-0.4, -0.4), (0.4, -0.4), (0.4, 0.4), (0.1, 0.4), (0.0, 0.0), (-0.4, 0.3)]
BIASED = replace(PHYSICS, gyro_bias=0.05, gyro_noise=0.1)
pytestmark = pytest.mark.slow


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
    different = beams = 0
    for seed in range(6):
        ours.reset([seed])
        theirs.reset([seed])
        cast = ours.data.ranges[0, 0]
        assert np.isfinite(cast).sum() > 100
        same = np.isclose(cast, theirs.data.ranges[0, 0], rtol=0.0, atol=0.01)
        different += int((~same).sum())
        beams += len(same)
    # a beam past a corner may take either side
    assert different <= 0.001 * beams


def test_a_robot_of_a_file_touches_by_the_footprint_of_its_spec(tmp_path):
    model = builtin_model("jackal")
    file = write_urdf(tmp_path, PLACES)
    simulator = DartSimulator(model, load_world("empty"), file=file)
    simulator.reset([0], starts=np.array([[[2.4, 0.0, 0.0]]]))
    drive(simulator, forward(model, 0.7), 4)
    assert simulator.data.collided[0, 0] == 0
    drive(simulator, forward(model, 0.7), 12)
    assert simulator.data.collided[0, 0] == 1
    free = 3.0 - max(x for x, _ in model.robot.footprint)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(free, abs=0.02)


def test_a_gyro_has_a_bias_and_noise_that_the_seed_draws():
    model = builtin_model("jackal")
    world = load_world("empty")
    simulator = DartSimulator(model, world, physics=BIASED)
    rates = stand(simulator)
    assert np.array_equal(rates, stand(simulator))
    assert rates.mean() == pytest.approx(0.05, abs=0.01)
    assert rates.std() == pytest.approx(0.1 / np.sqrt(10), rel=0.5)


def stand(simulator: DartSimulator) -> np.ndarray:
    """Turn rates by odometry of a robot at rest, by period [rad/s]."""
    simulator.reset([3])
    headings = [simulator.wheels[0, 2]]
    for _ in range(20):
        drive(simulator, forward(simulator.model, 0.0), 1)
        headings.append(simulator.wheels[0, 2])
    return np.diff(headings) / simulator.model.control_period


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
