"""A robot whose lidar does not look behind it: where it may go, and that it hits nothing there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from gate.rig import LIDAR, Rig, config
from nics_drl_bridge import geometry
from nics_drl_bridge.gate.evidence import find_obstacles
from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.ground import CELL, CELLS, REMEMBERED_S, update_ground
from nics_drl_bridge.gate.shield import STEP
from nics_drl_bridge.gate.shield_kernels import is_free
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
BODY = get_body(SHIELD)
PERIOD_S = 0.1
REACT_S = 0.2
SEEDS = 8
FAR = np.zeros((0, 4))
BOX = np.array(
    [[-2, -2, 2, -2], [2, -2, 2, 2], [2, 2, -2, 2], [-2, 2, -2, -2]], dtype=float
)
BACK = (-0.3, 0.0, 0.0)
TURN = (0.0, 0.0, 0.6)


def scan(pose, walls):
    """Ranges (B,) to walls (W, 4), by geometry."""
    x, y, heading = geometry.compose(pose, BLIND.mount)
    along = np.stack([np.cos(ANGLES + heading), np.sin(ANGLES + heading)], axis=1)[
        :, None
    ]
    start = walls[:, :2] - (x, y)
    edge = walls[:, 2:] - walls[:, :2]
    turned = along[..., 0] * edge[:, 1] - along[..., 1] * edge[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]) / turned
        at = (start[:, 0] * along[..., 1] - start[:, 1] * along[..., 0]) / turned
    hit = (away > 0.0) & (at >= 0.0) & (at <= 1.0) & (away < 5.0)
    return np.where(hit, away, np.inf).min(axis=1, initial=np.inf).astype(np.float32)


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
        return is_free(
            self.seen, twists, get_body(self.given.shield), REACT_S, 2.0, STEP
        )

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


def test_at_the_start_it_may_turn_and_not_back_up():
    robot = Robot()
    assert robot.may(TURN)
    assert robot.may((0.5, 0.0, 0.0))
    assert not robot.may(BACK)


def test_at_the_start_beside_something_it_may_not_turn():
    """The wall to its left may go on behind it, and there may be others."""
    robot = Robot(np.array([[-0.1, 0.34, 3.0, 0.34]]))
    assert not robot.may(TURN)
    assert not robot.may(BACK)
    assert robot.may((0.5, 0.0, 0.0))


@pytest.mark.parametrize(
    ("away", "beams", "may"), [(0.33, 1, True), (0.38, 5, True), (0.33, 5, False)]
)
def test_at_the_start_the_ground_behind_is_free_as_far_as_all_that_it_sees(
    away, beams, may, monkeypatch
):
    ranges = scan(np.zeros(3), FAR)
    ranges[100 : 100 + beams] = away  # one alone errs
    monkeypatch.setitem(globals(), "scan", lambda pose, walls: ranges)
    robot = Robot()
    robot.seen = robot.seen[robot.seen[:, 0] < 0.0]  # of that behind
    assert robot.may((0.0, 0.0, 2.0)) == may


def test_it_backs_up_as_far_as_it_came():
    robot = Robot()
    back = 0.0
    robot.moves((0.3, 0.0, 0.0), 3.0)
    while robot.may(BACK) and back < 2.0:
        robot.moves(BACK)
        back += 0.03
    assert 0.75 < back < 1.0


def test_it_backs_up_no_faster_than_it_can_stop_on_what_it_knows():
    robot = Robot()
    robot.moves((0.3, 0.0, 0.0), 3.0)
    fast = (-3.0, 0.0, 0.0)
    assert robot.may(BACK)
    assert not robot.may(fast)


def test_what_it_saw_while_it_turned_is_known_when_it_has_turned_away():
    robot = Robot()
    robot.moves(TURN, np.pi / 0.6)
    assert robot.may(BACK)


@pytest.mark.parametrize(
    ("walls", "may"), [(np.array([[0.5, -3.0, 0.5, 3.0]]), False), (FAR, True)]
)
def test_a_wall_that_it_has_turned_away_from_is_not_forgotten(walls, may):
    robot = Robot(walls)
    robot.moves(TURN, np.pi / 0.6)
    assert np.isinf(scan(robot.pose, walls)[200:341]).all()
    assert robot.may((-0.6, 0.0, 0.0)) == may


def test_what_came_to_stand_where_the_ground_was_free_is_not_forgotten():
    robot = Robot()
    robot.walls = np.array([[0.5, -3.0, 0.5, 3.0]])
    robot.moves(TURN, np.pi / 0.6)
    assert not robot.may((-0.6, 0.0, 0.0))


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


def test_unknown_beams_show_no_free_ground():
    robot = Robot()
    for _ in range(10):
        robot.pose = geometry.compose(robot.pose, (0.03, 0.0, 0.0))
        view = View(0, robot.pose, np.full(len(ANGLES), np.nan, np.float32))
        robot.known = update_ground(BLIND, (view,), robot.known)
    beside = geometry.compose(robot.pose, (0.0, 0.6, 0.0))
    i, j = (int(beside[axis] // CELL) - robot.known.corner[axis] for axis in (1, 0))
    assert robot.known.times[i, j] == 0.0  # when the first scan saw it


def test_what_lies_beyond_the_cells_is_not_known():
    robot = Robot()
    robot.moves(TURN, 2.0 * np.pi / 0.6)
    edge = np.hypot(*robot.known.unseen.T)
    assert len(edge) > 10
    assert edge.max() < 0.75 * CELL * CELLS
    assert edge.min() > 0.4 * CELL * CELLS


def test_a_lidar_that_sees_all_around_needs_no_memory():
    view = View(0, np.zeros(3), np.full(LIDAR.beams, np.inf, np.float32))
    assert update_ground(config(shield=SHIELD), (view,), None) is None
    assert update_ground(config(beam_angles=ANGLES), (view,), None) is None


def test_a_circle_whose_lidar_is_blind_behind_backs_up_as_far_as_it_came_too():
    robot = Robot(given=replace(BLIND, shield=replace(SHIELD, outline=())))
    assert not robot.may(BACK)
    robot.moves((0.3, 0.0, 0.0), 3.0)
    assert robot.may(BACK)


@pytest.mark.parametrize("length", [1.0, 3.6, 16.0])
def test_a_long_robot_may_go_where_a_short_one_may(length):
    """Ground is remembered beyond its footprint, however far that reaches."""
    half = length / 2.0
    outline = ((half, 0.4), (-half, 0.4), (-half, -0.4), (half, -0.4))
    radius = float(np.hypot(half, 0.4))
    shield = replace(SHIELD, outline=outline, footprint_radius=radius, range_max=30.0)
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


def test_what_was_known_is_forgotten_when_the_gate_is_armed():
    """Somebody may have carried the robot elsewhere, which its odometry does not show."""
    part = slice(90, LIDAR.beams)  # it is blind behind, to the right
    given = config(
        shield=replace(SHIELD, range_max=3.0), beam_angles=LIDAR.angles[part]
    )
    rig = HalfBlind(replace(given, frozen_distance=1e9))
    rig.run(1.5)
    assert rig.arm().granted
    first = rig.state.ground
    rig.run(1.0)
    rig.state = replace(
        rig.state, ground=replace(first, times=np.zeros_like(first.times))
    )
    rig.run(0.1)
    assert np.hypot(*rig.state.ground.unseen.T).min() > 1.0
    assert rig.arm().granted
    assert rig.state.ground.since_ns == rig.state.views[-1].stamp_ns
    assert np.hypot(*rig.state.ground.unseen.T).min() < 0.5
    assert (
        rig.state.obstacles[-len(rig.state.ground.unseen) :, :2]
        == rig.state.ground.unseen
    ).all()


def test_what_was_known_is_forgotten_when_odometry_leaps():
    part = slice(90, LIDAR.beams)
    given = config(
        shield=replace(SHIELD, range_max=3.0), beam_angles=LIDAR.angles[part]
    )
    rig = HalfBlind(given)
    rig.run(1.0)
    assert rig.state.ground.since_ns < rig.state.views[-1].stamp_ns
    rig.odom(stamp_ns=rig.stamp + 1, pose=rig.pose + 50.0)
    assert rig.state.ground is None
    rig.run(0.1)
    assert rig.state.ground.since_ns == rig.state.views[-1].stamp_ns


class HalfBlind(Rig):
    """A robot that stands, whose lidar sees three quarters of a circle."""

    def __init__(self, given):
        super().__init__(given)
        self.wish = np.zeros(3)
        self.ranges = np.linspace(1.0, 2.0, len(given.beam_angles), dtype=np.float32)

    def scan(self, **changes):
        first = self.config.beam_angles[0]
        step = LIDAR.angle_increment
        return super().scan(angles=(first, step), **changes)
