import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs MuJoCo: the extra `mujoco`")

import mujoco

from nics_drl_bridge import geometry
from nics_drl_bridge.extras.mujoco.simulator import MujocoSimulator
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.exact_kernels import X, Y
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.sim.world_set import load_worlds

from ..physics.driving import drive, forward

WORLDS = [
    "crowd",
    "room",
    *(
        pytest.param(name, marks=pytest.mark.campaign)
        for name in ("arena", "clutter", "doorway")
    ),
]
pytestmark = pytest.mark.slow
EYE_HEIGHT = 0.3


def test_each_episode_of_a_set_of_worlds_begins_as_in_the_fast_simulator():
    model = builtin_model("differential")
    worlds = load_worlds(["room", "crowd", "corridor"])
    ours = MujocoSimulator(model, worlds)
    theirs = FastSimulator(model, worlds, renderer="exact")
    members = set()
    for seed in range(6):
        for simulator in (ours, theirs):
            simulator.reset([seed])
        for name in ("pose", "bodies", "ranges", "odom", "steps", "member"):
            arrays = (getattr(each.data, name) for each in (ours, theirs))
            assert np.array_equal(*arrays), name
        assert np.array_equal(ours.goals, theirs.goals)
        members.add(int(ours.data.member[0]))
        # The map is many boxes.
        assert (ours._simulation.ngeom > 50) == (ours.data.member[0] == 0)
        drive(ours, forward(model, 0.2), 1)
    assert members == {0, 1, 2}


def test_a_latency_that_is_drawn_delays_the_motors():
    model = builtin_model("differential")
    world = load_world("empty")
    late = Randomisation(name="late", action_latency=(1.0, 1.0))
    distances = []
    for drawn in (late, None):
        simulator = MujocoSimulator(model, world, randomisation=drawn)
        simulator.reset([3])
        start = simulator.data.pose[0, 0, :2].copy()
        places = []
        for _ in range(4):
            drive(simulator, forward(model, 0.5), 1)
            places.append(simulator.data.pose[0, 0, :2].copy())
        distances.append(np.linalg.norm(places - start, axis=1))
    delayed, at_once = distances
    assert delayed[0] < 1e-3 < at_once[0]
    # the same, a period later
    assert delayed[1:] == pytest.approx(at_once[:-1], abs=1e-3)


@pytest.mark.parametrize("name", WORLDS)
def test_what_the_lidar_sees_is_what_stands_in_mujoco(name):
    """MuJoCo's own rays, among the geoms that hold up a robot, know nothing of the scanner."""
    model = builtin_model("differential")
    world = load_world(name)
    simulator = MujocoSimulator(model, world, renderer="exact")
    simulator.reset([5])
    drive(simulator, forward(model, 0.3), 3)
    engine = simulator._simulation
    data = simulator._data
    mujoco.mj_forward(engine, data)
    x, y, heading = simulator.data.pose[0, 0]
    eye = np.array([x, y, EYE_HEIGHT])
    hit = np.zeros(1, np.int32)
    far = model.lidar.range_max - 0.05
    different = 0
    for angle, seen in zip(
        model.lidar.angles, simulator.data.ranges[0, 0], strict=True
    ):
        ray = np.array([np.cos(heading + angle), np.sin(heading + angle), 0.0])
        expected = mujoco.mj_ray(engine, data, eye, ray, None, 1, -1, hit)
        if 0.0 <= expected < far:
            # A wall is 1 mm thicker on each side, which is more along a slanting beam.
            different += abs(expected - seen) > 0.01
    # a beam past a corner may take either side
    assert different <= 0.01 * model.lidar.beams


@pytest.mark.parametrize(
    ("name", "before", "command", "steps", "path_error", "turn_error"),
    [
        # what the rollers lose
        ("mecanum", [0.0, 0.0, 0.0], [-0.5, 0.6, 0.0], 50, 0.004, 0.1),
        # a diagonal on which two wheels stand beside the middles of their rollers
        ("mecanum", [0.4, 0.2, 0.3], [-0.7, 0.7, 0.0], 30, 0.1, 1e-3),
        # where a robot that skids turns faster than its wheels tell
        ("jackal", [0.0, 0.0], [1.8, 2.0], 20, 1.0, 0.01),
    ],
)
def test_odometry_knows_how_far_wheels_that_skid_or_roll_sideways_come(
    name, before, command, steps, path_error, turn_error
):
    world = load_world("empty").model_copy(update={"size": (40.0, 40.0)})
    simulator = MujocoSimulator(builtin_model(name), world)
    simulator.reset([0], starts=np.zeros((1, 1, 3)))
    drive(simulator, np.array([[before]]), 8)
    start = simulator.data.pose[0, 0].copy()
    believed = simulator.wheels[0].copy()
    drive(simulator, np.array([[command]]), steps)
    driven = geometry.between(start, simulator.data.pose[0, 0])
    off = geometry.between(believed, simulator.wheels[0]) - driven
    assert np.hypot(*off[:2]) < path_error * np.hypot(*driven[:2])
    assert abs(off[2]) < turn_error


def test_moving_obstacles_stand_in_mujoco_where_they_are_seen():
    model = builtin_model("differential")
    world = load_world("crowd")
    simulator = MujocoSimulator(model, world)
    simulator.reset([2])
    began = simulator.obstacles.copy()
    drive(simulator, forward(model, 0.0), 10)
    now = simulator.obstacles[0]
    assert np.hypot(*(now - began[0])[:, :2].T).max() > 0.2
    for k, mocap in simulator._mocap.items():
        assert simulator._data.mocap_pos[mocap, :2] == pytest.approx(now[k, [X, Y]])
