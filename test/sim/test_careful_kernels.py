"""Robots of any size and speed, against an oracle that steps finely along their arcs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from robots import DIRECT, direct_model, field, lidar

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import compose, exp, rotate
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.simulator import FastSimulator

DT = 0.01
OVERLAP = 1e-6
FASTEST = 50.0
TURNS = 100.0
BAR = ((0.3, 0.05), (-0.3, 0.05), (-0.3, -0.05), (0.3, -0.05))
DART = ((0.2, 0.0), (-0.1, 0.12), (0.0, 0.0), (-0.1, -0.12))
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


def fast_model(footprint):
    """A robot with a radius, or an outline, that is told its twist 100 times a second."""
    about = DIRECT.model_dump(exclude={"footprint_radius", "footprint"})
    for command, most in zip(about["command"], (FASTEST, FASTEST, TURNS), strict=True):
        command["min"] = -most
        command["max"] = most
    about |= (
        {"footprint_radius": footprint}
        if isinstance(footprint, float)
        else {"footprint": footprint}
    )
    model = direct_model(sensor=lidar(rate=1.0 / DT))
    return dataclasses.replace(
        model, robot=RobotSpec.model_validate(about), control_period=DT
    )


def silent(_message):
    """The commands leave the range that the model was fitted to, and are meant to."""


def edges_of(shape, pose):
    """((E, 4) edges of a placed shape, and the radius around them)."""
    if shape.kind == "circle":
        return np.tile(pose[:2], 2)[None], shape.radius
    corners = rotate(np.asarray(shape.outline), pose[2]) + pose[:2]
    if len(corners) == 2:
        return corners.reshape(1, 4), 0.0
    return np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1), 0.0


def points_from(p, q):
    """(..., P, Q) distance of points (..., P, 2) from segments (..., Q, 4)."""
    p = p[..., :, None, :]
    q = q[..., None, :, :]
    along = q[..., 2:] - q[..., :2]
    length = np.maximum((along**2).sum(axis=-1), 1e-300)
    share = np.clip(((p - q[..., :2]) * along).sum(axis=-1) / length, 0.0, 1.0)
    return np.linalg.norm(p - q[..., :2] - share[..., None] * along, axis=-1)


def between(p, q):
    """(...) least distance of segments (..., P, 4) and (..., Q, 4); 0 where two cross."""
    least = np.minimum(
        np.minimum(points_from(p[..., :2], q), points_from(p[..., 2:], q)).min(
            axis=(-1, -2)
        ),
        np.minimum(points_from(q[..., :2], p), points_from(q[..., 2:], p)).min(
            axis=(-1, -2)
        ),
    )

    def side(a, b, c):
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (
            b[..., 1] - a[..., 1]
        ) * (c[..., 0] - a[..., 0])

    p = p[..., :, None, :]
    q = q[..., None, :, :]
    a = p[..., :2]
    b = p[..., 2:]
    c = q[..., :2]
    d = q[..., 2:]
    crossing = (side(a, b, c) * side(a, b, d) < 0.0) & (
        side(c, d, a) * side(c, d, b) < 0.0
    )
    return np.where(crossing.any(axis=(-1, -2)), 0.0, least)


class Mover:
    """Edges with a radius, which move by a body twist from a pose, or by a velocity in the map."""

    def __init__(self, edges, radius, pose, twist, in_map=False):
        self.edges = edges
        self.radius = radius
        self.pose = pose
        self.in_map = in_map
        self.twist = np.asarray(twist)
        reach = np.linalg.norm(edges.reshape(-1, 2), axis=-1).max()
        self.speed = np.hypot(*self.twist[:2]) + abs(self.twist[2]) * reach

    def poses(self, times):
        if self.in_map:
            return self.pose + times[:, None] * self.twist
        return compose(self.pose, exp(times[:, None] * self.twist))

    def at(self, times):
        poses = self.poses(times)
        ends = self.edges.reshape(1, -1, 2)
        turned = np.stack([rotate(ends[0], heading) for heading in poses[:, 2]])
        return (turned + poses[:, None, :2]).reshape(len(times), -1, 4)


def clearance(one, other, times):
    return between(one.at(times), other.at(times)) - one.radius - other.radius


def first_touch(one, others):
    """When one first touches any of the others within DT, inf if never, and the least clearance.

    Each stretch of time in which the clearance can't fall below zero at their speeds is left; the
    rest is looked at ten times as finely.
    """
    touch = np.inf
    least = np.inf
    for other in others:
        speed = one.speed + other.speed
        spans = np.array([0.0])
        step = DT
        for _ in range(9):
            edges = np.linspace(0.0, step, 11)
            times = (spans[:, None] + edges).ravel()
            gaps = clearance(one, other, times).reshape(-1, 11)
            least = min(least, float(gaps.min()))
            if (gaps <= 0.0).any():
                touch = min(touch, float(times.reshape(-1, 11)[gaps <= 0.0].min()))
            low = (gaps[:, :-1] + gaps[:, 1:] - speed * step / 10.0) / 2.0
            begin = spans[:, None] + edges[:-1]
            chosen = np.sort(begin[(low <= max(0.0, least)) & (begin < touch)])[:40]
            if len(chosen) == 0:
                break
            spans = chosen
            step = step / 10.0
    return touch, least


def footprint_mover(footprint, pose, twist):
    if isinstance(footprint, float):
        return Mover(np.zeros((1, 4)), footprint, pose, twist)
    corners = np.array(footprint)
    edges = np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1)
    return Mover(edges, 0.0, pose, twist)


def still(edges, radius=0.0):
    return Mover(np.asarray(edges, dtype=float), radius, np.zeros(3), np.zeros(3))


def random_walls(rng, count, size):
    ends = rng.uniform(-size, size, (count, 2))
    angle = rng.uniform(-np.pi, np.pi, count)
    length = rng.uniform(0.1, 2.0, count)
    away = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.clip(np.concatenate([ends, ends + away], axis=1), -size, size)


def free_starts(rng, footprint, scenes, size, number):
    """Poses at which a footprint overlaps nothing of its scene."""
    starts = np.zeros((number, 1, 3))
    for n in range(number):
        while True:
            pose = np.array([*rng.uniform(-size, size, 2), rng.uniform(-np.pi, np.pi)])
            here = footprint_mover(footprint, pose, np.zeros(3))
            if all(
                clearance(here, other, np.zeros(1))[0] > 1e-3 for other in scenes[n]
            ):
                starts[n, 0] = pose
                break
    return starts


SHAPES = [CIRCLE, PLATE, HOOK, SEGMENT]
MORE = {"marks": pytest.mark.campaign}
FOOTPRINTS = [
    pytest.param(0.01, **MORE, id="1cm"),
    pytest.param(0.1, id="10cm"),
    pytest.param(0.5, **MORE, id="50cm"),
    pytest.param(BAR, id="bar"),
    pytest.param(DART, id="dart"),
]


@pytest.mark.parametrize("footprint", FOOTPRINTS)
@pytest.mark.slow
@pytest.mark.timeout(600)  # a cold start compiles
def test_a_robot_ends_where_its_arc_first_touches_at_any_size_and_speed(footprint):
    number = 160
    rng = np.random.default_rng(5)
    walls = random_walls(rng, 8, 3.4)
    groups = [{"shapes": [shape], "count": 1} for shape in SHAPES]
    world = field(7.0, obstacles=groups, walls=[tuple(wall) for wall in walls])
    simulator = FastSimulator(
        fast_model(footprint), world, number, renderer="exact", tell=silent
    )
    drawn = simulator.reset(range(number))
    shapes = simulator.sampler.shapes
    scenes = [
        [still(world.all_walls())]
        + [still(*edges_of(shapes[int(body[6])], body[:3])) for body in bodies]
        for bodies in drawn.bodies
    ]
    starts = free_starts(rng, footprint, scenes, 3.4, number)
    speed = FASTEST * rng.uniform(0.0, 1.0, number)
    course = rng.uniform(-np.pi, np.pi, number)
    turn = TURNS * rng.uniform(-1.0, 1.0, number) ** 3
    twists = np.stack([speed * np.cos(course), speed * np.sin(course), turn], axis=1)
    simulator.reset(range(number), starts=starts)
    simulator.step(twists[:, None])
    touched = 0
    for n in range(number):
        robot = footprint_mover(footprint, starts[n, 0], twists[n])
        touch, least = first_touch(robot, scenes[n])
        flagged = bool(simulator.data.collided[n, 0])
        if abs(least) > OVERLAP:
            assert flagged == (least < 0.0 or touch < np.inf), (n, least, touch)
        end = simulator.data.pose[n, 0]
        if not flagged:
            assert end[:2] == pytest.approx(
                robot.poses(np.array([DT]))[0, :2], abs=1e-6
            )
            continue
        touched += 1
        here = footprint_mover(footprint, end, np.zeros(3))
        gaps = [clearance(here, other, np.zeros(1))[0] for other in scenes[n]]
        assert -OVERLAP <= min(gaps) <= OVERLAP
        if touch < np.inf:
            at = robot.poses(np.array([touch]))[0]
            # Where it touches at a slant the time is less sharp than the clearance.
            assert np.hypot(*(end - at)[:2]) < 1e-3
    assert touched > 5


def test_a_robot_of_a_centimetre_does_not_pass_a_wall_at_50_m_per_s():
    world = field(6.0, walls=[(0.3, -3.0, 0.3, 3.0)])
    simulator = FastSimulator(fast_model(0.01), world, tell=silent)
    simulator.reset([0], starts=np.zeros((1, 1, 3)))
    for _ in range(3):
        simulator.step([[[50.0, 0.0, 0.0]]])
        assert simulator.data.collided[0, 0] == 1
        assert simulator.data.pose[0, 0, 0] == pytest.approx(0.29, abs=OVERLAP)


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape", [CIRCLE, PLATE, HOOK], ids=["circle", "plate", "hook"]
)
def test_a_robot_and_a_moving_obstacle_stop_where_they_touch(shape):
    number = 100
    rng = np.random.default_rng(7)
    world = field(10.0, obstacles=[{"shapes": [shape], "count": 1}])
    simulator = FastSimulator(fast_model(0.05), world, number, tell=silent)
    simulator.reset(range(number), starts=np.tile([0.0, 0.0, 0.3], (number, 1, 1)))
    outline = simulator.sampler.shapes[0]
    away = rng.uniform(0.8, 1.2, number)
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, number))
    bodies = simulator.data.bodies[:, 0]
    bodies[:, 0], bodies[:, 1], bodies[:, 2] = (
        away * np.cos(bearing),
        away * np.sin(bearing),
        heading,
    )
    bodies[:, 3], bodies[:, 4] = np.cos(heading), np.sin(heading)
    before = bodies[:, :3].copy()
    own = rng.uniform(0.0, 40.0, number)[:, None] * np.stack(
        [np.cos(bearing - 0.3), np.sin(bearing - 0.3)], axis=1
    )
    twists = np.concatenate([own, rng.uniform(-30.0, 30.0, (number, 1))], axis=1)
    velocity = np.concatenate(
        [
            rng.uniform(20.0, 90.0, number)[:, None]
            * np.stack([-np.cos(bearing + 0.2), -np.sin(bearing + 0.2)], axis=1),
            rng.uniform(-20.0, 20.0, (number, 1)),
        ],
        axis=1,
    )
    simulator.data.velocity[:, 0] = velocity
    simulator.step(twists[:, None])
    touched = 0
    edges = edges_of(outline, np.zeros(3))
    for n in range(number):
        robot = footprint_mover(0.05, np.array([0.0, 0.0, 0.3]), twists[n])
        other = Mover(*edges, before[n], velocity[n], in_map=True)
        touch, least = first_touch(robot, [other])
        flagged = bool(simulator.data.collided[n, 0])
        if abs(least) > OVERLAP:
            assert flagged == (touch < np.inf), (n, least)
        here = footprint_mover(0.05, simulator.data.pose[n, 0], np.zeros(3))
        there = Mover(*edges, simulator.data.bodies[n, 0, :3], np.zeros(3), in_map=True)
        assert clearance(here, there, np.zeros(1))[0] >= -OVERLAP
        touched += flagged
    assert 10 < touched < number


@pytest.mark.slow
def test_robots_that_run_into_each_other_stop_there_and_are_marked():
    number = 200
    rng = np.random.default_rng(9)
    simulator = FastSimulator(fast_model(0.03), field(10.0), number, 2, tell=silent)
    starts = np.zeros((number, 2, 3))
    starts[:, 1, :2] = rng.uniform(-0.05, 0.05, (number, 2)) + np.array([0.0, 0.2])
    twists = rng.uniform(-1.0, 1.0, (number, 2, 3)) * [FASTEST, FASTEST, TURNS]
    simulator.reset(range(number), starts=starts)
    simulator.step(twists)
    touched = 0
    for n in range(number):
        one, other = (
            footprint_mover(0.03, starts[n, m], twists[n, m]) for m in range(2)
        )
        touch, least = first_touch(one, [other])
        flags = simulator.data.collided[n].tolist()
        if abs(least) > OVERLAP:
            assert flags == [int(touch < np.inf)] * 2, (n, least)
        apart = np.hypot(*(simulator.data.pose[n, 1] - simulator.data.pose[n, 0])[:2])
        assert apart >= 0.06 - OVERLAP
        touched += sum(flags)
    assert touched > 10


def test_robots_that_follow_each_other_at_any_speed_do_not_touch():
    simulator = FastSimulator(fast_model(0.05), field(20.0), 1, 3, tell=silent)
    starts = np.array([[[-9.0 + 0.101 * m, 0.0, 0.0] for m in range(3)]])
    for order in ([0, 1, 2], [2, 1, 0]):
        simulator.reset([0], starts=starts[:, order])
        for _ in range(20):
            simulator.step(np.tile([40.0, 0.0, 0.0], (1, 3, 1)))
        assert not simulator.data.collided.any()
        assert simulator.data.pose[0, :, 0] == pytest.approx(starts[0, order, 0] + 8.0)


def test_a_robot_that_is_run_into_from_behind_drives_on():
    simulator = FastSimulator(fast_model(0.05), field(20.0), 1, 2, tell=silent)
    simulator.reset([0], starts=np.array([[[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]]))
    for _ in range(10):
        simulator.step([[[40.0, 0.0, 0.0], [10.0, 0.0, 0.0]]])
    assert simulator.data.collided.all()
    assert simulator.data.pose[0, 1, 0] == pytest.approx(1.3)
    assert simulator.data.pose[0, 0, 0] <= 1.2 + OVERLAP


@pytest.mark.parametrize("deviation", [0.0, 0.3])
def test_nothing_overlaps_in_a_long_drive_of_fast_robots(deviation):
    model = fast_model(0.04)
    robots = 4
    groups = [
        {"shapes": [CIRCLE], "count": 3},
        {
            "shapes": [CIRCLE],
            "count": 3,
            "motion": {"kind": "pedestrian", "speed": [0.5, 2.0]},
        },
    ]
    simulator = FastSimulator(
        model, field(4.0, obstacles=groups), 24, robots, tell=silent
    )
    simulator.data.noise[..., 2:5] = deviation
    simulator.reset(range(24))
    rng = np.random.default_rng(2)
    for _ in range(150):
        simulator.step(rng.uniform(-1.0, 1.0, (24, robots, 3)) * [30.0, 30.0, 30.0])
        bodies = simulator.data.bodies
        place = bodies[:, -robots:, :2]
        assert (np.abs(place) <= 2.0 - 0.04 + OVERLAP).all()
        apart = np.linalg.norm(place[:, :, None] - bodies[:, None, :, :2], axis=-1)
        near = 0.04 + bodies[:, None, :, 5]
        own = np.eye(robots, bodies.shape[1], bodies.shape[1] - robots, dtype=bool)
        assert ((apart >= near - OVERLAP) | own).all()
    assert simulator.data.collided.any()


def test_a_robot_that_slides_along_a_wall_gets_along():
    simulator = FastSimulator(fast_model(0.1), field(8.0), tell=silent)
    simulator.reset([0], starts=np.array([[[-3.0, 3.8, 0.0]]]))
    simulator.step([[[1.0, 30.0, 0.0]]])
    assert simulator.data.pose[0, 0, 1] == pytest.approx(3.9, abs=OVERLAP)
    before = simulator.data.pose[0, 0, 0]
    for _ in range(10):
        simulator.step([[[10.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0, 0] == pytest.approx(before + 1.0)


def test_a_robot_that_is_placed_in_something_may_leave_it_and_gets_no_deeper():
    simulator = FastSimulator(fast_model(0.1), field(8.0), 3, tell=silent)
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


def at_a_wall(footprint, x, heading=0.0):
    """One robot at (x, 0), a wall along y at x = 1."""
    world = field(8.0, walls=[(1.0, -4.0, 1.0, 4.0)])
    simulator = FastSimulator(fast_model(footprint), world, tell=silent)
    simulator.reset([0], starts=np.array([[[x, 0.0, heading]]]))
    return simulator


def test_a_round_robot_that_pushes_against_a_wall_turns_as_told_and_leaves():
    simulator = at_a_wall(0.2, 0.7)
    simulator.step([[[30.0, 0.0, 0.0]]])
    assert simulator.data.pose[0, 0] == pytest.approx([0.8, 0.0, 0.0], abs=OVERLAP)
    assert turned_by(simulator, [0.5, 0.0, 2.0], 75) == pytest.approx(1.5, abs=1e-6)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.8, abs=OVERLAP)
    assert turned_by(simulator, [0.5, 0.0, 2.0], 75) == pytest.approx(1.5, abs=1e-6)
    turned_by(simulator, [0.5, 0.0, 0.0], 100)
    assert simulator.data.pose[0, 0, 0] < 0.4


def test_a_robot_whose_push_against_a_wall_dies_away_is_not_held_there():
    simulator = at_a_wall(0.2, 0.7)
    for k in range(400):
        simulator.step([[[0.5 * 0.9**k, 0.0, 0.0]]])
    assert turned_by(simulator, [0.0, 0.0, 2.0], 150) == pytest.approx(3.0)
    turned_by(simulator, [1.0, 0.0, 0.0], 10)
    assert simulator.data.pose[0, 0, 0] < 0.71


def test_a_robot_that_drives_into_a_wall_at_a_slant_slides_along_it():
    simulator = at_a_wall(0.2, 0.7, heading=0.5)
    turned_by(simulator, [1.0, 0.0, 0.0], 20)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.8, abs=1e-6)
    before = simulator.data.pose[0, 0, 1]
    turned_by(simulator, [1.0, 0.0, 0.0], 100)
    after = [0.8, before + np.sin(0.5), 0.5]
    assert simulator.data.pose[0, 0] == pytest.approx(after, abs=1e-6)


def test_a_wall_turns_a_robot_with_corners_parallel_and_lets_it_leave():
    simulator = at_a_wall(BAR, 0.7, heading=np.pi / 2.0 - 0.4)
    turned_by(simulator, [1.0, 0.0, 0.0], 350)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.95, abs=5e-3)
    assert simulator.data.pose[0, 0, 2] == pytest.approx(np.pi / 2.0, abs=2e-2)
    assert turned_by(simulator, [0.0, 0.0, 2.0], 150) > 0.8
    turned_by(simulator, [1.0, 0.0, 0.0], 60)
    assert simulator.data.pose[0, 0, 0] < 0.6


def test_a_robot_that_is_pushed_flat_against_a_wall_stands():
    simulator = at_a_wall(BAR, 0.6)
    turned_by(simulator, [1.0, 0.0, 0.3], 100)
    assert simulator.data.pose[0, 0, 0] == pytest.approx(0.7, abs=1e-2)
    stands = simulator.data.pose[0, 0].copy()
    turned_by(simulator, [1.0, 0.0, 0.3], 100)
    assert simulator.data.pose[0, 0] == pytest.approx(stands, abs=1e-3)


def test_a_robot_in_a_narrow_corner_stands_still_and_comes_out_again():
    walls = [(1.0, 0.0, -1.0, 0.3), (1.0, 0.0, -1.0, -0.3)]
    simulator = FastSimulator(fast_model(0.1), field(8.0, walls=walls), tell=silent)
    simulator.reset([0], starts=np.array([[[-0.5, 0.0, 0.3]]]))
    turned_by(simulator, [1.0, 0.0, 0.0], 100)
    stuck = simulator.data.pose[0, 0].copy()
    turned_by(simulator, [1.0, 0.0, 0.0], 20)
    assert simulator.data.pose[0, 0] == pytest.approx(stuck, abs=1e-5)
    turned_by(simulator, [-1.0, 0.0, 0.0], 20)
    assert simulator.data.pose[0, 0, 0] < stuck[0] - 0.15


@pytest.mark.parametrize("footprint", [BAR, DART], ids=["bar", "dart"])
@pytest.mark.slow
def test_nothing_overlaps_where_robots_with_corners_push_and_slide(footprint):
    rng = np.random.default_rng(3)
    number = 24
    groups = [{"shapes": [CIRCLE, PLATE], "count": 4}]
    world = field(3.0, obstacles=groups, walls=[(0.0, 0.0, 1.0, 0.4)])
    simulator = FastSimulator(fast_model(footprint), world, number, 2, tell=silent)
    drawn = simulator.reset(range(number))
    shapes = simulator.sampler.shapes
    moved = 0.0
    scenes = [
        [still(world.all_walls())]
        + [still(*edges_of(shapes[int(body[6])], body[:3])) for body in bodies]
        for bodies in drawn.bodies
    ]
    for k in range(120):
        if k % 15 == 0:
            twists = rng.uniform(-1.0, 1.0, (number, 2, 3)) * [4.0, 4.0, 10.0]
        before = simulator.data.pose[..., :2].copy()
        simulator.step(twists)
        touching = simulator.data.collided != 0
        moved += np.abs(simulator.data.pose[..., :2] - before)[touching].sum()
        if k % 10:
            continue
        for n in range(number):
            ends = simulator.data.pose[n]
            robots = [footprint_mover(footprint, end, np.zeros(3)) for end in ends]
            for robot, rest in (
                (robots[0], [*scenes[n], robots[1]]),
                (robots[1], scenes[n]),
            ):
                gaps = [clearance(robot, other, np.zeros(1))[0] for other in rest]
                assert min(gaps) > 0.0, (n, k)
    assert simulator.data.collided.any(axis=1).sum() > number // 2
    assert moved > 1.0


def test_a_model_that_could_cross_the_world_in_a_step_is_refused():
    model = fast_model(0.05)
    about = model.robot.model_dump()
    about["command"][0]["max"] = 900.0
    absurd = dataclasses.replace(model, robot=RobotSpec.model_validate(about))
    with pytest.raises(ConfigError, match=r"9 m in a step of 0.01 s.*6 m"):
        FastSimulator(absurd, field(6.0))
