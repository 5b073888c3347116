"""A robot whose lidar does not look behind it: where it may go, and that it hits nothing there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from gate.recorded import see
from gate.rig import LIDAR, Rig, config
from nics_drl_bridge import geometry
from nics_drl_bridge.gate.evidence import find_obstacles, make_static
from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.ground import REMEMBERED_S, update_ground
from nics_drl_bridge.gate.ground_kernels import (
    Grid,
    find_unseen,
    forget_old,
    mark_covered,
)
from nics_drl_bridge.gate.shield import STEP
from nics_drl_bridge.gate.shield_kernels import Stop, is_free
from nics_drl_bridge.gate.state import ShieldConfig, View
from nics_drl_bridge.interface import NS_PER_S

OUTLINE = ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
SHIELD = ShieldConfig(
    0.1,
    2.0,
    0.05,
    0.1,
    float(np.hypot(0.25, 0.2)),
    range_max=5.0,
    outline=OUTLINE,
    obstacle_speed=0.0,
)
ANGLES = np.deg2rad(np.linspace(-135.0, 135.0, 541))
BLIND = config(shield=SHIELD, beam_angles=ANGLES, mount=(0.12, 0.0, 0.0))
STOP = Stop(get_body(SHIELD), 0.0, 0.0, 0.2, 2.0)
PERIOD_S = 0.1
SEEDS = 5
FAR = np.zeros((0, 4))
BOX = np.array(
    [[-2, -2, 2, -2], [2, -2, 2, 2], [2, 2, -2, 2], [-2, 2, -2, -2]], dtype=float
)
BACK = (-0.3, 0.0, 0.0)
TURN = (0.0, 0.0, 0.6)


def scan(pose, walls):
    """Ranges (B,) to walls (W, 4), by geometry."""
    ranges = see(geometry.compose(pose, BLIND.mount), ANGLES, walls)
    return np.where(ranges < 5.0, ranges, np.inf).astype(np.float32)


class Robot:
    """A robot that does at once what it is told, and a shield that looks every period."""

    def __init__(self, walls=FAR, given=BLIND):
        self.walls = walls
        self.given = given
        self.pose = np.zeros(3)
        self.time = 0.0
        self.known = None
        self.looks()

    def looks(self):
        view = View(round(self.time * NS_PER_S), self.pose, scan(self.pose, self.walls))
        self.known = update_ground(self.given, (view,), self.known)
        self.seen = find_obstacles(self.given, view.ranges, (view,), self.known)

    def may(self, twist):
        twists = np.array([twist], dtype=float)
        stop = STOP._replace(body=get_body(self.given.shield))
        return is_free(self.seen, twists, stop, STEP)

    def moves(self, twist, seconds=PERIOD_S):
        for _ in range(round(seconds / PERIOD_S)):
            self.pose = geometry.compose(
                self.pose, geometry.exp(PERIOD_S * np.array(twist))
            )
            self.time += PERIOD_S
            self.looks()

    @property
    def place(self):
        corners = geometry.rotate(np.array(OUTLINE), self.pose[2]) + self.pose[:2]
        return shapely.Polygon(corners)


@pytest.mark.parametrize(
    ("away", "beams", "may"), [(0.33, 1, True), (0.38, 5, True), (0.33, 5, False)]
)
def test_at_the_start_the_ground_behind_is_free_as_far_as_all_that_it_sees(
    away, beams, may
):
    ranges = scan(np.zeros(3), FAR)
    ranges[100 : 100 + beams] = away  # one alone errs
    view = View(0, np.zeros(3), ranges)
    behind = make_static(update_ground(BLIND, (view,), None).unseen)
    twist = np.array([[0.0, 0.0, 2.0]])
    assert is_free(behind, twist, STOP, STEP) == may


def test_it_backs_up_as_far_as_it_came_and_no_faster_than_it_can_stop():
    robot = Robot()
    back = 0.0
    assert robot.may(TURN)
    assert not robot.may(BACK)
    robot.moves((0.3, 0.0, 0.0), 3.0)
    assert not robot.may((-3.0, 0.0, 0.0))
    while robot.may(BACK) and back < 2.0:
        robot.moves(BACK)
        back += 0.03
    assert 0.75 < back < 1.0


WALL = np.array([[0.5, -3.0, 0.5, 3.0]])


@pytest.mark.parametrize(
    ("before", "walls", "may"),
    [(FAR, FAR, True), (WALL, WALL, False), (FAR, WALL, False)],
)
def test_what_it_saw_while_it_turned_is_known_when_it_has_turned_away(
    before, walls, may
):
    robot = Robot(before)
    robot.walls = walls
    robot.moves(TURN, np.pi / 0.6)
    assert robot.may((-0.6, 0.0, 0.0)) == may


def test_ground_is_forgotten_but_for_what_is_beside_the_robot():
    robot = Robot()
    robot.moves((0.3, 0.0, 0.0), 3.0)
    fast = (-0.6, 0.0, 0.0)
    assert robot.may(fast)
    for _ in range(4):
        robot.time += 0.3 * REMEMBERED_S
        robot.looks()
    assert not robot.may(fast)
    assert robot.may(TURN)


@pytest.mark.parametrize("length", [0.0, 16.0])
def test_a_circle_and_a_long_robot_may_go_where_a_short_one_may(length):
    """Ground is remembered beyond its footprint, however far that reaches."""
    half = length / 2.0
    outline = ((half, 0.4), (-half, 0.4), (-half, -0.4), (half, -0.4))
    shield = replace(SHIELD, outline=())
    if length:
        radius = float(np.hypot(half, 0.4))
        shield = replace(
            SHIELD, outline=outline, footprint_radius=radius, range_max=30.0
        )
    robot = Robot(given=replace(BLIND, shield=shield))
    assert robot.may(TURN)
    assert not robot.may(BACK)
    robot.moves((0.3, 0.0, 0.0), 3.0)
    assert robot.may(BACK)
    assert robot.may(TURN)


def drive(seed, remembers):
    """Drives at random, mostly backwards, where the shield lets it; the way back, and a touch."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-1.8, 1.8, (6, 2))
    ends = ends[np.hypot(*ends.T) > 0.8]
    walls = np.concatenate(
        [BOX, np.hstack([ends, ends + rng.uniform(-0.3, 0.3, ends.shape)])]
    )
    lines = shapely.linestrings(walls.reshape(-1, 2, 2))
    robot = Robot(walls)
    way = 0.0
    for _ in range(25):
        twist = np.array([rng.choice([-0.5, -0.3, 0.4]), 0.0, rng.uniform(-1.0, 1.0)])
        twist[0] *= rng.random() > 0.3
        for _ in range(int(rng.integers(2, 10))):
            if not remembers:
                robot.seen = robot.seen[: len(robot.seen) - len(robot.known.unseen)]
            if not robot.may(twist):
                break
            robot.moves(twist)
            way += max(0.0, -twist[0]) * PERIOD_S
            if shapely.intersects(robot.place, lines).any():
                return way, True
    return way, False


@pytest.mark.slow
def test_what_stands_is_not_touched_wherever_the_lidar_does_not_look():
    driven = [drive(seed, remembers=True) for seed in range(SEEDS)]
    assert not any(touch for _, touch in driven)
    assert np.mean([way for way, _ in driven]) > 0.3
    assert sum(drive(seed, remembers=False)[1] for seed in range(SEEDS)) > 1


@pytest.mark.parametrize("how", ["armed", "leaps"])
def test_what_was_known_is_forgotten_when_the_gate_is_armed_and_when_odometry_leaps(
    how,
):
    """Somebody may have carried the robot elsewhere, which its odometry does not show."""
    angles = LIDAR.angles[90:]  # it is blind behind, to the right
    given = config(shield=replace(SHIELD, range_max=3.0), beam_angles=angles)
    rig = Rig(replace(given, frozen_distance=1e9))
    rig.ranges = np.linspace(1.0, 2.0, len(angles), dtype=np.float32)
    rig.wish = np.zeros(3)
    first = (angles[0], LIDAR.angle_increment)
    rig.scan = lambda: Rig.scan(rig, angles=first)
    rig.run(2.0)
    assert rig.state.ground.since_ns < rig.state.views[-1].stamp_ns
    if how == "armed":
        assert rig.arm().granted
        newest = rig.state.views[-1]
        seen = find_obstacles(given, newest.ranges, (newest,), rig.state.ground)
        assert np.array_equal(rig.state.obstacles, seen)
    else:
        rig.odom(stamp_ns=rig.stamp + 1, pose=rig.pose + 50.0)
        assert rig.state.ground is None
        assert rig.state.views == ()
        rig.run(0.1)
    assert rig.state.ground.since_ns == rig.state.views[-1].stamp_ns
    assert len(rig.state.views) == 1


def test_the_border_is_what_is_unknown_and_next_to_what_is_known_or_in_view():
    rng = np.random.default_rng(0)
    heading = 0.7
    grid = Grid(-0.5, -0.4, 0.1, np.cos(heading), np.sin(heading))
    for _ in range(20):
        times = np.where(rng.random((9, 9)) < 0.5, 1.0, -np.inf).astype(np.float32)
        in_view = rng.random((9, 9)) < 0.2
        known = in_view | np.isfinite(times)
        inner = np.pad(np.ones((7, 7), np.bool_), 1)
        edges = np.pad(known, 1, mode="edge")
        beside = edges[:-2, 1:-1] | edges[2:, 1:-1] | edges[1:-1, :-2] | edges[1:-1, 2:]
        rows, columns = np.nonzero(~in_view & ~(inner & known) & beside)
        middles = np.stack([-0.5 + 0.1 * columns, -0.4 + 0.1 * rows], axis=1) + 0.05
        expected = geometry.rotate(middles, -heading)
        assert find_unseen(times, in_view, grid) == pytest.approx(expected)


@pytest.mark.parametrize("corners", [OUTLINE, ()])
def test_only_the_cells_under_the_footprint_are_covered(corners):
    heading = 0.4
    grid = Grid(-0.5, -0.52, 0.05, np.cos(heading), np.sin(heading))
    shape = (
        shapely.Polygon(corners) if corners else shapely.Point(0, 0).buffer(0.33, 64)
    )
    body = get_body(replace(SHIELD, outline=corners, footprint_radius=0.33))
    times = np.full((20, 20), -np.inf, np.float32)
    mark_covered(times, grid, body, 3.0)
    rows, columns = np.indices(times.shape)
    middles = np.stack([columns * 0.05 - 0.475, rows * 0.05 - 0.495], axis=-1)
    points = shapely.points(geometry.rotate(middles, -heading))
    assert np.array_equal(times == 3.0, shapely.contains(shape, points))


def test_cells_are_forgotten_once_they_are_too_old_and_those_beside_the_robot_are_new():
    times = np.array([[5.0, 6.0, 4.9, -np.inf]], np.float32)
    grid = Grid(-0.125, -0.125, 0.25, 1.0, 0.0)  # the first is under the robot
    forget_old(times, grid, 0.25, now=9.0, oldest=5.0)
    assert times.tolist() == [[9.0, 9.0, -np.inf, -np.inf]]
    forget_old(times, grid, 0.0, now=9.5, oldest=9.0)
    assert times.tolist() == [[9.5, 9.0, -np.inf, -np.inf]]
