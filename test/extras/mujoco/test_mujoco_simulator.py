from dataclasses import replace

import numpy as np
import pytest
from robots import direct_model

pytest.importorskip("mujoco", reason="needs MuJoCo: the extra `mujoco`")

import mujoco

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.mujoco.simulator import MujocoSimulator
from nics_drl_bridge.extras.physics.machines import Physics
from nics_drl_bridge.extras.physics.simulator import divide
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.lidar.exact_kernels import X, Y
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World, load_world
from nics_drl_bridge.sim.world_set import load_worlds

OTHERS = ("ackermann", "mecanum", "jackal")
NAMES = [
    "differential",
    *(pytest.param(name, marks=pytest.mark.campaign) for name in OTHERS),
]
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
ICE = replace(Physics(), friction=0.1)


def forward(model: SimulatorModel, speed: float, robots: int = 1) -> np.ndarray:
    """A command straight ahead for each robot (1, M, C)."""
    command = np.zeros((1, robots, len(model.robot.command)))
    command[..., 0] = speed
    return command


def drive(simulator: MujocoSimulator, command: np.ndarray, steps: int) -> None:
    for _ in range(steps):
        simulator.step(command)


def with_footprint(model: SimulatorModel, corners: list[list[float]]) -> SimulatorModel:
    data = model.robot.model_dump() | {"footprint": corners}
    del data["footprint_radius"]
    return replace(model, robot=RobotSpec.model_validate(data))


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
    other = MujocoSimulator(model, worlds)
    for simulator in (ours, other):  # and goes on the same whatever was before
        simulator.reset([9])
        drive(simulator, forward(model, 0.5), 10)
    for name, array in ours.data._asdict().items():
        assert np.array_equal(array, getattr(other.data, name)), name


def test_a_latency_that_is_drawn_delays_the_motors_and_the_rest_is_drawn_as_elsewhere():
    model = builtin_model("differential")
    world = load_world("empty")
    late = Randomisation(
        name="late",
        action_latency=(1.0, 1.0),
        lidar={"dropout": (0.5, 0.5)},
        odometry={"odom_linear": (0.1, 0.1)},
    )
    ours, theirs = (
        kind(model, world, randomisation=late)
        for kind in (MujocoSimulator, FastSimulator)
    )
    prompt = MujocoSimulator(model, world)
    for simulator in (ours, theirs, prompt):
        simulator.reset([3])
    assert np.array_equal(ours.data.noise, theirs.data.noise)
    assert np.array_equal(ours.data.ranges, theirs.data.ranges)
    assert np.isinf(ours.data.ranges).sum() > 0.4 * model.lidar.beams
    start = ours.data.pose[0, 0, :2].copy()
    paths = []
    for simulator in (ours, prompt):
        paths.append([])
        for _ in range(4):
            drive(simulator, forward(model, 0.5), 1)
            paths[-1].append(
                float(np.linalg.norm(simulator.data.pose[0, 0, :2] - start))
            )
    assert paths[0][0] < 1e-3 < paths[1][0]
    assert paths[0][1:] == pytest.approx(
        paths[1][:-1], abs=1e-3
    )  # a period later, the same


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
    hit = np.zeros(1, np.int32)
    near = 0
    for angle, seen in zip(
        model.lidar.angles, simulator.data.ranges[0, 0], strict=True
    ):
        ray = np.array([np.cos(heading + angle), np.sin(heading + angle), 0.0])
        away = mujoco.mj_ray(
            engine, data, np.array([x, y, EYE_HEIGHT]), ray, None, 1, -1, hit
        )
        if 0.0 <= away < model.lidar.range_max - 0.05:
            # A wall is 1 mm thicker on each side, which is more along a slanting beam.
            near += abs(away - seen) > 0.01
    assert near <= 0.01 * model.lidar.beams  # a beam past a corner may take either side


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_that_drives_into_a_wall_stops_there(name):
    model = builtin_model(name)
    simulator = MujocoSimulator(model, load_world("empty"))
    simulator.reset([0], starts=np.array([[[2.0, 0.0, 0.0]]]))
    robot = model.robot
    wall = simulator.data
    outline = robot.footprint or [(robot.footprint_radius, 0.0)]
    free = 3.0 - max(x for x, _ in outline)
    collided = []
    for _ in range(30):
        simulator.step(forward(model, 0.7))
        collided.append(int(wall.collided[0, 0]))
    assert wall.pose[0, 0, 0] == pytest.approx(free, abs=0.01)
    assert abs(wall.pose[0, 0, 1]) < 0.1
    first = collided.index(1)
    assert 8 < first < 25
    assert collided == [0] * first + [1] * (30 - first)
    simulator.reset([0])
    assert wall.collided[0, 0] == 0


def test_a_footprint_of_corners_touches_by_its_corners():
    nose = [[0.25, 0.0], [-0.1, 0.1], [-0.05, 0.0], [-0.1, -0.1]]
    model = with_footprint(builtin_model("differential"), nose)
    simulator = MujocoSimulator(model, load_world("empty"))
    simulator.reset([0], starts=np.array([[[2.0, 0.0, 0.0]]]))
    drive(simulator, forward(model, 0.5), 12)
    assert simulator.data.collided[0, 0] == 0
    drive(simulator, forward(model, 0.5), 15)
    assert simulator.data.collided[0, 0] == 1
    assert simulator.data.pose[0, 0, 0] == pytest.approx(3.0 - 0.25, abs=0.02)


def test_odometry_drifts_where_the_wheels_slip():
    model = builtin_model("mecanum")
    errors = {}
    for floor, physics in (("dry", Physics()), ("ice", ICE)):
        simulator = MujocoSimulator(model, load_world("empty"), physics=physics)
        simulator.reset([0], starts=np.zeros((1, 1, 3)))
        for turn in (1.0, -1.0) * 4:
            command = forward(model, 0.7 * turn)
            command[..., 1] = 0.5 * turn
            drive(simulator, command, 5)
        off = simulator.data.odom[0, 0] - simulator.data.pose[0, 0]
        errors[floor] = float(np.hypot(*off[:2]))
    assert errors["dry"] < 0.05
    assert errors["ice"] > 3.0 * errors["dry"]


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


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_that_does_not_slip_moves_nearly_as_the_model_says(name):
    """The steady motion is the textbook's; motors are slower where wheels would slip."""
    model = builtin_model(name)
    world = load_world("empty").model_copy(update={"size": (40.0, 40.0)})
    ours = MujocoSimulator(model, world)
    theirs = FastSimulator(model, world)
    command = forward(model, 0.6)
    command[..., -1] = 0.4 * model.robot.command_high[-1]
    moved = []
    for simulator in (ours, theirs):
        simulator.reset([0], starts=np.zeros((1, 1, 3)))
        drive(simulator, command, 15)
        before = simulator.data.pose[0, 0].copy()
        drive(simulator, command, 5)
        moved.append(
            [
                np.hypot(*(simulator.data.pose[0, 0] - before)[:2]),
                simulator.data.pose[0, 0, 2] - before[2],
            ]
        )
    assert moved[0] == pytest.approx(moved[1], rel=0.05)


def test_moving_obstacles_stand_in_mujoco_where_they_are_seen():
    model = builtin_model("differential")
    world = load_world("crowd")
    simulator = MujocoSimulator(model, world)
    simulator.reset([2])
    began = simulator.obstacles.copy()
    drive(simulator, forward(model, 0.0), 10)
    now = simulator.obstacles[0]
    assert np.hypot(*(now - began[0])[:, :2].T).max() > 0.2
    for k, mocap in simulator._mocap:
        assert simulator._data.mocap_pos[mocap, :2] == pytest.approx(now[k, [X, Y]])


def test_two_robots_see_each_other_and_collide():
    model = builtin_model("differential")
    simulator = MujocoSimulator(model, load_world("empty"), robots=2)
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


@pytest.mark.parametrize(
    ("period", "longest"),
    [(0.1, 0.001), (0.02, 0.001), (1 / 30, 0.001), (0.0005, 0.001)],
)
def test_a_control_period_is_a_whole_number_of_time_steps(period, longest):
    parts, steps, timestep = divide(period, longest)
    assert parts * steps * timestep == pytest.approx(period, rel=1e-12)
    assert timestep <= longest * (1.0 + 1e-6)


def test_a_wrong_command_is_refused():
    model = builtin_model("ackermann")
    simulator = MujocoSimulator(model, load_world("empty"))
    with pytest.raises(ConfigError, match=r"\(1, 1, 2\)"):
        simulator.step(np.zeros((1, 2, 2)))
    with pytest.raises(BackendError, match="finite"):
        simulator.step(np.full((1, 1, 2), np.nan))


def test_a_robot_without_textbook_kinematics_is_no_machine():
    world = World(name="plain", size=(8.0, 8.0), goal_distance=(1.0, 2.0))
    with pytest.raises(ConfigError, match="no textbook kinematics"):
        MujocoSimulator(direct_model(), world)
