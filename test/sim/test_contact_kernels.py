"""Robots of any size and speed, against an oracle that steps finely along their arcs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
from robots import DIRECT, direct_model, field, lidar

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import compose, exp, rotate
from nics_drl_bridge.lidar.shapes import Circle, Polygon
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.simulator import FastSimulator

DT = 0.01
SKIN = 1e-3  # a robot stops this near to what it touches [m]
FASTEST = 50.0
TURNS = 100.0
BAR = Polygon(points=((0.3, 0.05), (-0.3, 0.05), (-0.3, -0.05), (0.3, -0.05)))
DART = Polygon(points=((0.2, 0.0), (-0.1, 0.12), (0.0, 0.0), (-0.1, -0.12)))
SEGMENT = {"kind": "segment", "ends": [[-0.3, 0.0], [0.4, 0.1]]}
CIRCLE = {"kind": "circle", "radius": 0.2}
PLATE = {"kind": "rectangle", "size": [0.8, 0.02]}
HOOK = {
    "kind": "polygon",
    "points": [
        [-0.5, -0.4],
        [0.5, -0.4],
        [0.5, -0.3],
        [-0.4, -0.3],
        [-0.4, 0.5],
        [-0.5, 0.5],
    ],
}
TIMES = np.linspace(0.0, DT, 1001)
NEAR = 2e-3  # a robot moves less from one of these times to the next, and stops no nearer [m]


def fast_model(footprint):
    """A robot with a radius, or a shape, that is told its twist 100 times a second."""
    about = DIRECT.model_dump(exclude={"footprint_radius", "footprint"})
    for command, most in zip(about["command"], (FASTEST, FASTEST, TURNS), strict=True):
        command["min"] = -most
        command["max"] = most
    if isinstance(footprint, Polygon):
        about["footprint"] = footprint.points
    else:
        about["footprint_radius"] = footprint
    robot = RobotSpec.model_validate(about)
    model = direct_model(sensor=lidar(rate=1.0 / DT))
    return dataclasses.replace(model, robot=robot, control_period=DT)


def silent(_message):
    """The commands leave the range that the model was fitted to, and are meant to."""


def drawn(shape, poses):
    """A shape, or a radius, at poses (T, 3), as shapely's geometries and a radius around them."""
    if isinstance(shape, float | Circle):
        return shapely.points(poses[:, :2]), getattr(shape, "radius", shape)
    corners = rotate(np.asarray(shape.outline)[None], poses[:, None, 2])
    make = shapely.linestrings if len(shape.outline) == 2 else shapely.polygons
    return make(corners + poses[:, None, :2]), 0.0


def gaps(shape, poses, scene):
    """(T,) clearance of a shape at poses (T, 3) from the parts of a scene; 0 inside of one."""
    own, radius = drawn(shape, poses)
    return np.min(
        [shapely.distance(own, part) - radius - r for part, r in scene], axis=0
    )


def scene_of(simulator, n):
    """The walls of world n, and its obstacles where they are, see `gaps`."""
    walls = shapely.multilinestrings(simulator.world.all_walls().reshape(-1, 2, 2))
    parts = [(walls, 0.0)]
    for body in simulator.obstacles[n]:
        shape = simulator.sampler.shapes[int(body[6])]
        (part,), radius = drawn(shape, body[None, :3])
        parts.append((part, radius))
    return parts


def assert_flagged(flagged, clearance):
    """A robot is marked if it touched something at one of the times, unless it was too close."""
    if (clearance <= 0.0).any():
        assert flagged
    elif clearance.min() > NEAR:
        assert not flagged


@pytest.mark.parametrize("footprint", [0.1, BAR], ids=["10cm", "bar"])
@pytest.mark.slow
@pytest.mark.timeout(600)  # a cold start compiles
def test_a_robot_is_marked_and_overlaps_nothing_if_its_arc_touches_something(footprint):
    number = 60
    rng = np.random.default_rng(5)
    walls = rng.uniform(-3.4, 3.4, (8, 4))
    groups = [
        {"shapes": [shape], "count": 1} for shape in (CIRCLE, PLATE, HOOK, SEGMENT)
    ]
    world = field(7.0, obstacles=groups, walls=[tuple(wall) for wall in walls])
    simulator = FastSimulator(
        fast_model(footprint), world, number, renderer="exact", warn=silent
    )
    simulator.reset(range(number))
    scenes = [scene_of(simulator, n) for n in range(number)]
    starts = np.zeros((number, 1, 3))
    for start, scene in zip(starts, scenes, strict=True):
        while gaps(footprint, start, scene)[0] < NEAR or not start.any():
            start[0] = rng.uniform(-1.0, 1.0, 3) * [3.4, 3.4, np.pi]
    speed = FASTEST * rng.uniform(0.0, 1.0, number)
    course = rng.uniform(-np.pi, np.pi, number)
    turn = TURNS * rng.uniform(-1.0, 1.0, number) ** 3
    twists = np.stack([speed * np.cos(course), speed * np.sin(course), turn], axis=1)
    simulator.reset(range(number), starts=starts)
    simulator.step(twists[:, None])
    for n, scene in enumerate(scenes):
        poses = compose(starts[n], exp(TIMES[:, None] * twists[n]))
        clearance = gaps(footprint, poses, scene)
        end = simulator.data.pose[n]
        assert_flagged(simulator.data.collided[n, 0], clearance)
        assert (gaps(footprint, end, scene) > 0.0).all()
        if not simulator.data.collided[n, 0]:
            assert end[0, :2] == pytest.approx(poses[-1, :2], abs=1e-6)
    assert simulator.data.collided.sum() > 1


def test_robots_that_follow_each_other_at_any_speed_do_not_touch():
    simulator = FastSimulator(fast_model(0.05), field(20.0), 1, 3, warn=silent)
    starts = np.array([[[-9.0 + 0.101 * m, 0.0, 0.0] for m in range(3)]])
    for order in ([0, 1, 2], [2, 1, 0]):
        simulator.reset([0], starts=starts[:, order])
        for _ in range(20):
            simulator.step(np.tile([40.0, 0.0, 0.0], (1, 3, 1)))
        assert not simulator.data.collided.any()
        assert simulator.data.pose[0, :, 0] == pytest.approx(starts[0, order, 0] + 8.0)


def test_a_robot_that_is_run_into_from_behind_drives_on():
    simulator = FastSimulator(fast_model(0.05), field(20.0), 1, 2, warn=silent)
    simulator.reset([0], starts=np.array([[[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]]))
    for _ in range(10):
        simulator.step([[[40.0, 0.0, 0.0], [10.0, 0.0, 0.0]]])
    assert simulator.data.collided.all()
    assert simulator.data.pose[0, 1, 0] == pytest.approx(1.3)
    assert simulator.data.pose[0, 0, 0] <= 1.2 + SKIN


@pytest.mark.slow
@pytest.mark.parametrize("footprint", [0.04, DART], ids=["round", "dart"])
def test_nothing_overlaps_where_robots_push_slide_and_drift(footprint):
    number = 12
    robots = 3
    walk = {"kind": "pedestrian", "speed": [0.5, 2.0]}
    groups = [
        {"shapes": [CIRCLE, PLATE], "count": 3},
        {"shapes": [CIRCLE], "count": 2, "motion": walk},
    ]
    world = field(3.5, obstacles=groups, walls=[(0.0, 0.0, 1.0, 0.4)])
    simulator = FastSimulator(fast_model(footprint), world, number, robots, warn=silent)
    simulator.data.noise[..., 2:5] = 0.3
    simulator.reset(range(number))
    pose = simulator.data.pose
    rng = np.random.default_rng(3)
    moved = 0.0
    for k in range(90):
        if k % 15 == 0:
            twists = rng.uniform(-1.0, 1.0, (number, robots, 3)) * [4.0, 4.0, 10.0]
        before = pose[..., :2].copy()
        simulator.step(twists)
        touching = simulator.data.collided != 0
        moved += np.abs(pose[..., :2] - before)[touching].sum()
        for n in range(number if k % 10 == 0 else 0):
            scene = scene_of(simulator, n)
            for m in range(robots):
                (me,), radius = drawn(footprint, pose[n, m : m + 1])
                assert (
                    gaps(footprint, np.delete(pose[n], m, axis=0), [(me, radius)]) > 0.0
                ).all()
            assert (gaps(footprint, pose[n], scene) > 0.0).all(), (n, k)
    assert simulator.data.collided.any(axis=1).sum() > number // 2
    assert moved > 1.0


def test_a_robot_that_is_placed_in_something_may_leave_it_and_gets_no_deeper():
    simulator = FastSimulator(fast_model(0.1), field(8.0), 3, warn=silent)
    starts = np.array([[[0.0, 3.95, 0.0]], [[0.0, 3.95, 0.0]], [[0.0, 3.9, 0.0]]])
    simulator.reset(range(3), starts=starts)
    simulator.step([[[0.0, -10.0, 0.0]], [[0.0, 10.0, 0.0]], [[0.0, -10.0, 0.0]]])
    assert simulator.data.pose[:, 0, 1] == pytest.approx([3.85, 3.95, 3.8])
    assert simulator.data.collided[:, 0].tolist() == [1, 1, 0]


def turned_by(simulator, twist, steps):
    """Drives one robot by a twist; returns how far it turned [rad]."""
    turned = 0.0
    before = simulator.data.pose[0, 0, 2]
    for _ in range(steps):
        simulator.step([[twist]])
        after = simulator.data.pose[0, 0, 2]
        turned = turned + (after - before + np.pi) % (2.0 * np.pi) - np.pi
        before = after
    return turned


def at_a_wall(footprint, x, heading=0.0, walls=((1.0, -4.0, 1.0, 4.0),)):
    """One robot at (x, 0), by default with a wall along y at x = 1."""
    world = field(8.0, walls=walls)
    simulator = FastSimulator(fast_model(footprint), world, warn=silent)
    simulator.reset([0], starts=np.array([[[x, 0.0, heading]]]))
    return simulator


def test_a_round_robot_that_pushes_against_a_wall_turns_as_told_and_leaves():
    simulator = at_a_wall(0.2, 0.7)
    simulator.step([[[30.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0] == pytest.approx([0.8, 0.0, 0.0], abs=SKIN)
    assert turned_by(simulator, [0.5, 0.0, 2.0], 75) == pytest.approx(1.5, abs=1e-6)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.8, abs=SKIN)
    assert turned_by(simulator, [0.5, 0.0, 2.0], 75) == pytest.approx(1.5, abs=1e-6)
    turned_by(simulator, [0.5, 0.0, 0.0], 100)
    assert simulator.data.pose[0, 0, 0] < 0.4


def test_a_robot_that_drives_into_a_wall_at_a_slant_slides_along_it():
    simulator = at_a_wall(0.2, 0.7, heading=0.5)
    turned_by(simulator, [1.0, 0.0, 0.0], 20)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.8, abs=SKIN)
    before = simulator.data.pose[0, 0, 1]
    turned_by(simulator, [1.0, 0.0, 0.0], 100)
    after = [0.8, before + np.sin(0.5), 0.5]
    assert simulator.data.pose[0, 0] == pytest.approx(after, abs=SKIN)


def test_a_wall_turns_a_robot_with_corners_parallel_and_lets_it_leave():
    simulator = at_a_wall(BAR, 0.7, heading=np.pi / 2.0 - 0.4)
    turned_by(simulator, [1.0, 0.0, 0.0], 350)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.95, abs=5e-3)
    assert simulator.data.pose[0, 0, 2] == pytest.approx(np.pi / 2.0, abs=2e-2)
    assert turned_by(simulator, [0.0, 0.0, 2.0], 150) > 0.8
    turned_by(simulator, [1.0, 0.0, 0.0], 60)
    assert simulator.data.pose[0, 0, 0] < 0.6


def test_a_robot_in_a_narrow_corner_stands_still_and_comes_out_again():
    walls = [(1.0, 0.0, -1.0, 0.3), (1.0, 0.0, -1.0, -0.3)]
    simulator = at_a_wall(0.1, -0.5, 0.3, walls)
    turned_by(simulator, [1.0, 0.0, 0.0], 100)
    stuck = simulator.data.pose[0, 0].copy()
    turned_by(simulator, [1.0, 0.0, 0.0], 20)
    assert simulator.data.pose[0, 0] == pytest.approx(stuck, abs=1e-5)
    turned_by(simulator, [-1.0, 0.0, 0.0], 20)
    assert simulator.data.pose[0, 0, 0] < stuck[0] - 0.15


def test_a_model_that_could_cross_the_world_in_a_step_is_refused():
    model = fast_model(0.05)
    about = model.robot.model_dump()
    about["command"][0]["max"] = 900.0
    absurd = dataclasses.replace(model, robot=RobotSpec.model_validate(about))
    with pytest.raises(ConfigError, match=r"9 m in a step of 0.01 s.*6 m"):
        FastSimulator(absurd, field(6.0))
