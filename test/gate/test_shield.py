from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from shapely.geometry import LineString, Point

from gate.rig import LIDAR, Rig, config
from nics_drl_bridge import geometry
from nics_drl_bridge.gate import evidence_kernels, shield_kernels
from nics_drl_bridge.gate.evidence import (
    MEMORY_S,
    SPACING_S,
    add_view,
    find_movers,
    find_obstacles,
)
from nics_drl_bridge.gate.evidence_kernels import mark_agreeing, mark_entered
from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Odometry, Scan, Tick
from nics_drl_bridge.gate.shield import CREEP_SPEED, warm_up
from nics_drl_bridge.gate.shield_kernels import follow_arc, is_free
from nics_drl_bridge.gate.state import ShieldConfig, View, begin
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.robot.braking import TurnBraking

CAR = ShieldConfig(
    latency_s=0.15,
    deceleration=1.0,
    margin=0.05,
    hold_s=0.02,
    footprint_radius=0.15,
    wheelbase=0.2,
    obstacle_speed=0.0,
)
BRAKE = 1.0
FAR = np.full(LIDAR.beams, 3.0, np.float32)


def ahead(width=0.6):
    return np.abs(LIDAR.angles) < width / 2.0


def ranges(value, where=None):
    """A scan of open space with one value in some directions."""
    out = FAR + np.float32(1e-4) * np.arange(LIDAR.beams, dtype=np.float32)
    out[ahead() if where is None else where] = value
    return out.astype(np.float32)


class Faced(Rig):
    """A car that wants to go straight on, and a scan that never changes but by noise."""

    def __init__(self, seen, shield=CAR, wish=(1.0, 0.0, 0.0), robot="ackermann"):
        super().__init__(config(robot, shield=shield, frozen_distance=1e9))
        self.ranges = seen
        self.frozen = True
        self.wish = np.array(wish)

    def settles(self, seconds=1.5):
        """What it drives at in the end, when odometry shows what it is told."""
        self.run(1.5)
        assert self.arm().granted
        for _ in range(round(seconds / 0.02)):
            self.speed = float(self.decision.twist[0])
            self.run(0.02)
        return float(self.decision.twist[0])


def test_open_space_lets_the_robot_drive_at_full_speed():
    assert Faced(FAR).settles() == 1.0


def test_without_a_shield_nothing_is_cut():
    assert Faced(ranges(0.3), shield=None).settles() == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("wheelbase", [CAR.wheelbase, 0.0])
def test_nothing_remains_to_be_compiled_after_a_rehearsal(wheelbase, monkeypatch):
    fresh = {
        "free": njit(is_free.py_func),
        "entered": njit(mark_entered.py_func),
        "agreeing": njit(mark_agreeing.py_func),
    }
    monkeypatch.setattr(shield_kernels, "is_free", fresh["free"])
    monkeypatch.setattr(evidence_kernels, "mark_entered", fresh["entered"])
    monkeypatch.setattr(evidence_kernels, "mark_agreeing", fresh["agreeing"])
    warm_up()
    known = {name: list(kernel.signatures) for name, kernel in fresh.items()}
    assert all(known.values())
    Faced(ranges(0.3), replace(CAR, wheelbase=wheelbase, obstacle_speed=1.0)).settles(
        0.1
    )
    turning = drive((0.0, 0.0, 1.0), lambda _: [(1.5, 0.4, 0.2)])
    find_movers(GIVEN, SHIELD, by_slipping_odometry(turning, 1.35))
    assert {name: kernel.signatures for name, kernel in fresh.items()} == known


@pytest.mark.parametrize("distance", [0.4, 0.6, 0.8])
def test_the_speed_is_such_that_the_robot_stops_before_what_lies_ahead(distance):
    rig = Faced(ranges(distance))
    speed = rig.settles()
    room = distance - CAR.footprint_radius - CAR.margin
    least = (CAR.latency_s + CAR.hold_s) * speed + speed**2 / (2.0 * CAR.deceleration)
    assert least < room < 4.0 * least
    assert rig.decision.cause is None
    last = [twist[0] for _, twist in rig.published[-20:]]
    assert np.ptp(last) < 0.1 * speed  # and does not jerk


def test_a_car_whose_speed_is_reduced_steers_as_fast_as_any_other():
    def steer(distance):
        rig = Faced(ranges(distance), wish=(1.0, 0.0, 0.0))
        rig.settles()
        rig.wish = np.array([1.0, 0.0, 0.3])
        before = len(rig.published)
        rig.run(0.5)
        steps = [twist[2] for _, twist in rig.published[before:]]
        return rig.decision.shielded, np.array(steps)

    is_shielded, slowed = steer(0.6)
    assert is_shielded
    is_shielded, free = steer(3.0)
    assert not is_shielded
    assert free[-1] > 0.25
    assert slowed == pytest.approx(free)


def test_a_robot_stands_before_what_it_must_not_come_nearer_to():
    assert Faced(ranges(0.19)).settles() == 0.0


def test_what_bars_the_way_bars_no_turn_on_the_spot():
    round_one = replace(CAR, wheelbase=0.0)
    rig = Faced(ranges(0.19), round_one, wish=(1.0, 0.0, 0.5), robot="differential")
    assert rig.settles(0.5) == 0.0
    assert rig.decision.twist[2] == pytest.approx(0.5)
    assert rig.decision.shielded
    corners = ((0.4, 0.15), (-0.4, 0.15), (-0.4, -0.15), (0.4, -0.15))
    box = replace(
        round_one, outline=corners, footprint_radius=float(np.hypot(0.4, 0.15))
    )
    at_a_corner = ranges(0.46, where=np.abs(LIDAR.angles - 0.5) < 0.1)
    barred = Faced(at_a_corner, box, (0.0, 0.0, 0.5), "differential")
    barred.settles(0.5)
    assert 0.0 <= barred.decision.twist[2] < 0.2


def test_what_bars_a_turn_bars_no_way_straight_back():
    corners = ((0.4, 0.15), (-0.4, 0.15), (-0.4, -0.15), (0.4, -0.15))
    radius = float(np.hypot(0.4, 0.15))
    box = replace(CAR, wheelbase=0.0, outline=corners, footprint_radius=radius)
    at_a_corner = ranges(0.46, where=np.abs(LIDAR.angles - 0.5) < 0.1)
    rig = Faced(at_a_corner, box, (-0.3, 0.0, 0.5), "differential")
    assert rig.settles(0.5) < -CREEP_SPEED
    assert rig.decision.shielded
    behind = at_a_corner.copy()
    behind[np.abs(LIDAR.angles) > 3.0] = 0.46  # so near that only a creep would be safe
    assert Faced(behind, box, (-0.3, 0.0, 0.5), "differential").settles(0.5) == 0.0


def test_a_robot_that_turns_does_not_creep_nearer():
    wishes = {"ahead": (1.0, 0.0, 0.0), "turning": (1.0, 0.0, 0.5)}
    rigs = {
        name: Faced(
            ranges(0.23), replace(CAR, wheelbase=0.0), wish, robot="differential"
        )
        for name, wish in wishes.items()
    }
    assert 0.0 < rigs["ahead"].settles(0.5) < CREEP_SPEED
    assert rigs["turning"].settles(0.5) == 0.0
    assert rigs["turning"].decision.twist[2] == pytest.approx(0.5)


def test_something_too_close_to_measure_counts_as_an_obstacle():
    assert Faced(ranges(-np.inf)).settles() == 0.0


def test_too_many_unknown_beams_ahead_count_as_an_obstacle():
    assert Faced(ranges(np.nan)).settles() == 0.0


def test_a_few_unknown_beams_do_not():
    assert Faced(ranges(np.nan, where=np.arange(LIDAR.beams) % 5 == 0)).settles() == 1.0


def test_no_return_is_free_space():
    assert Faced(ranges(np.inf)).settles() == 1.0


def test_what_lies_beside_or_behind_the_way_does_not_stop_the_robot():
    beside = np.abs(np.abs(LIDAR.angles) - np.pi / 2) < 0.3
    behind = np.abs(LIDAR.angles) > 2.8
    assert Faced(ranges(0.3, where=beside)).settles() == 1.0
    assert Faced(ranges(0.18, where=behind)).settles() == 1.0


def test_a_scan_shows_its_returns_where_they_are():
    given = config(shield=CAR, mount=(0.1, 0.0, np.pi / 2))
    seen = np.full(LIDAR.beams, np.inf, np.float32)
    seen[LIDAR.beams // 2] = 2.0  # straight ahead of the lidar, left of the robot
    assert find_obstacles(given, seen, ()) == pytest.approx(
        np.array([[0.1, 2.0, 0.0]]), abs=1e-6
    )


def test_unknown_beams_are_a_wall_on_the_outline_and_blind_directions_are_none():
    corners = ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
    some = slice(180, 540)  # of 720, those to the front
    for unseen, front in (
        (slice(0), False),
        (slice(None), True),
        (slice(0, 90), False),
    ):
        given = config(
            shield=replace(CAR, outline=corners), beam_angles=LIDAR.angles[some]
        )
        seen = np.full(360, np.inf, np.float32)
        seen[unseen] = np.nan
        wall = find_obstacles(given, seen, ())[:, :2]
        assert (np.abs(wall) == (0.25, 0.2)).any(axis=1).all()
        assert (len(wall) > 0) == (unseen != slice(0))
        assert (wall[:, 0] == 0.25).any() == front
        assert (wall[:, 0] >= -0.05).all()
        assert front or (wall[:, 1] < 0.0).all()


def disc(room):
    """A robot that is a circle with its margin."""
    return get_body(replace(CAR, footprint_radius=0.75 * room, margin=0.25 * room))


def test_the_sweep_agrees_with_geometry():
    rng = np.random.default_rng(0)
    room = 0.2
    step = 0.005
    unclear = 0
    for _ in range(200):
        twist = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-2, 2)])
        blind = rng.uniform(0.1, 0.8)
        point = rng.uniform(-1.2, 1.2, 2)
        duration = blind + np.hypot(*twist[:2]) / (2.0 * BRAKE)
        path = LineString(
            [follow_arc(twist, t)[:2] for t in np.linspace(0.0, duration, 400)]
        )
        away = path.distance(Point(point))
        if abs(away - room) < step or np.hypot(*point) <= room:
            unclear += 1
            continue
        swept_free = is_free(
            np.array([[*point, 0.0]]), twist[None], disc(room), blind, BRAKE, step
        )
        assert swept_free == (away > room)
    assert unclear < 50


@pytest.mark.parametrize(("speed", "may"), [(0.3, False), (-0.3, True)])
def test_a_robot_in_the_margin_may_leave_and_not_come_nearer(speed, may):
    near = np.array([[0.17, 0.02, 0.0]])
    assert (
        is_free(near, np.array([[speed, 0.0, 0.0]]), disc(0.2), 0.5, BRAKE, 0.02) == may
    )


@pytest.mark.parametrize(("away", "may"), [(1.19, False), (1.21, True)])
def test_what_comes_on_is_met_no_sooner_than_the_robot_is_at_rest(away, may):
    """0.5 m/s for 0.4 s and then 0.25 s of braking: 0.2625 m, in which 1 m/s comes 0.65 m near."""
    near = 0.2 + 0.2625 + 0.65
    twists = np.array([[0.5, 0.0, 0.0]])
    comes = np.array([[near + away - 1.2, 0.0, 1.0]])
    assert is_free(comes, twists, disc(0.2), 0.4, 2.0, 0.005) == may
    assert is_free(comes * (1.0, 1.0, 0.0), twists, disc(0.2), 0.4, 2.0, 0.005)


@pytest.mark.parametrize(("away", "may"), [(0.3, False), (0.6, False), (1.5, True)])
def test_who_catches_up_from_behind_finds_the_robot_at_rest(away, may):
    """At 0.3 m/s it is no faster than who comes on, and would be met in motion."""
    behind = np.array([[-away, 0.1, 1.0]])
    assert (
        is_free(behind, np.array([[0.3, 0.0, 0.0]]), disc(0.2), 0.5, BRAKE, 0.02) == may
    )
    assert is_free(
        behind * (1.0, 1.0, 0.0),
        np.array([[0.3, 0.0, 0.0]]),
        disc(0.2),
        0.5,
        BRAKE,
        0.02,
    )


def test_a_command_of_before_that_the_scan_does_not_show_yet_is_reckoned_with():
    """It was told a latency before the scan was made, and turns the robot towards what is there."""
    rig = Faced(
        ranges(0.45, where=np.abs(LIDAR.angles - 0.9) < 0.3),
        replace(CAR, latency_s=0.3),
    )
    rig.wish = np.array([0.6, 0.0, 0.0])
    rig.settles()
    while rig.now - rig.state.scans.times[-1] < 0.09:
        rig.run(0.02, without="scan")
    straight = rig.decision.twist[0]
    told = np.array([0.6, 0.5])
    before = rig.state
    for ago, cut in ((0.33, True), (0.6, False)):  # that of 0.6 s ago the scan shows
        later = (one for one in before.recent if one[0] > rig.now - ago)
        recent = ((rig.now - ago, told), *later)
        _, decision = decide(
            rig.config, replace(before, recent=recent), Tick(), rig.now + 0.02
        )
        assert (decision.twist[0] < straight - 0.1) == cut


def test_a_stop_in_between_does_not_make_it_forget_what_the_robot_was_told():
    """The base may take up what was told before the stop, and the scan does not show it yet."""
    rig = Faced(FAR)
    rig.settles()
    rig.command((np.nan, 0.0, 0.0))
    assert rig.decision.cause.rule == "command_malformed"
    rig.run(0.04)
    assert max(value[0] for _, value in rig.state.recent) == 1.0
    rig.run(1.0)
    told = [told for told, _ in rig.state.recent]
    reach = CAR.latency_s + rig.config.scan_age_s
    assert rig.now - reach - 0.05 < told[0] <= rig.now - reach + 0.02


def test_commands_are_kept_for_as_long_as_a_slow_turn_follows_them():
    slow_turn = replace(CAR, wheelbase=0.0, turn=TurnBraking(0.6, 2.0))
    rig = Faced(FAR, slow_turn, robot="differential")
    rig.settles(2.0)
    reach = 0.6 + rig.config.scan_age_s
    oldest = rig.state.recent[0][0]
    assert rig.now - reach - 0.05 < oldest <= rig.now - reach + 0.02


def test_what_was_told_before_a_pause_of_the_gate_counts_as_long_as_it_was_in_force():
    rig = Faced(
        ranges(0.45, where=np.abs(LIDAR.angles - 0.9) < 0.3),
        replace(CAR, latency_s=0.3),
    )
    rig.wish = np.array([0.6, 0.0, 0.0])
    rig.settles()
    straight = rig.decision.twist[0]
    before = rig.state
    since = rig.now - before.scans.times[-1] + 0.3
    kept = tuple(one for one in before.recent if one[0] > rig.now - since + 0.05)
    recent = ((rig.now - since - 0.05, np.array([0.6, 0.5])), *kept)
    _, decision = decide(
        rig.config, replace(before, recent=recent), Tick(), rig.now + 0.02
    )
    assert decision.twist[0] < straight - 0.1


SHIELD = ShieldConfig(0.2, 2.0, 0.05, 0.2, 0.15, 0.2, obstacle_speed=1.0, range_max=3.0)
GIVEN = config(shield=SHIELD)
WALL_Y = 1.5


def seen(pose, discs=(), noise=0.0, rng=None):
    """A scan (B,) of a wall to the left at `WALL_Y` and of discs x, y, radius, by geometry."""
    angles = LIDAR.angles + pose[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = (WALL_Y - pose[1]) / np.sin(angles)
    out = np.where((wall > 0.0) & (wall < LIDAR.range_max), wall, np.inf)
    for x, y, radius in discs:
        dx = x - pose[0]
        dy = y - pose[1]
        along = dx * np.cos(angles) + dy * np.sin(angles)
        beside2 = dx**2 + dy**2 - along**2
        hit = (along > 0.0) & (beside2 < radius**2)
        far = along - np.sqrt(np.maximum(radius**2 - beside2, 0.0))
        out = np.where(hit, np.minimum(out, far), out)
    if noise:
        out = out + rng.normal(0.0, noise, len(out))
    return out.astype(np.float32)


def drive(twist, discs_at, times=(0.0, 0.1, 0.2, 0.3), **noise):
    """Views along an arc, of discs that are somewhere at each time."""
    poses = [geometry.exp(t * np.array(twist)) for t in times]
    return tuple(
        View(round(t * NS_PER_S), pose, seen(pose, discs_at(t), **noise))
        for t, pose in zip(times, poses, strict=True)
    )


def facing(views, bearing, width=0.05):
    """The beams of the newest view around a bearing in its own frame."""
    return np.abs(LIDAR.angles - bearing) < width


@pytest.mark.parametrize(
    "twist", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.7, -0.7, 2.0), (0, 0, -2)]
)
def test_what_stands_does_not_move_however_the_robot_does(twist):
    discs = [(1.5, 0.4, 0.2), (1.0, -0.9, 0.15), (-0.8, 0.3, 0.25), (2.4, -0.2, 0.2)]
    assert not find_movers(GIVEN, SHIELD, drive(twist, lambda _: discs)).any()


def by_slipping_odometry(views, factor):
    """The same views, with poses of an odometry whose turns are too large by a factor."""
    first = views[0].pose
    scale = np.array([1.0, 1.0, factor])
    return tuple(
        replace(
            view,
            pose=geometry.exp(geometry.log(geometry.between(first, view.pose)) * scale),
        )
        for view in views
    )


@pytest.mark.parametrize("factor", [0.8, 1.2, 1.35, 1.54, 1.7, 2.5])
@pytest.mark.parametrize(
    "twist", [(0.0, 0.0, 1.0), (0.5, 0.0, -0.8), (0.0, 0.0, 2.0), (0.3, 0.0, -3.0)]
)
def test_what_stands_does_not_move_where_wheels_slip_in_a_turn(twist, factor):
    discs = [(1.5, 0.4, 0.2), (1.0, -0.9, 0.15), (-0.8, 0.3, 0.25), (2.4, -0.2, 0.2)]
    views = by_slipping_odometry(drive(twist, lambda _: discs), factor)
    assert not find_movers(GIVEN, SHIELD, views).any()


@pytest.mark.parametrize("factor", [1.0, 1.35, 1.7])
def test_somebody_who_crosses_moves_where_wheels_slip_in_a_turn(factor):
    def discs_at(t):
        return [(1.2, 0.6 - 1.2 * t, 0.2), (-0.8, 0.3, 0.25)]

    views = by_slipping_odometry(drive((0.3, 0.0, 0.8), discs_at), factor)
    true_pose = geometry.exp(0.3 * np.array([0.3, 0.0, 0.8]))
    x, y, _ = geometry.between(true_pose, np.array([1.2, 0.6 - 0.36, 0.0]))
    leading_edge = np.arctan2(y, x) - 0.17
    assert find_movers(GIVEN, SHIELD, views)[facing(views, leading_edge)].any()


STANDING = [(1.5, 0.4, 0.2), (1.0, -0.9, 0.15), (-0.8, 0.3, 0.25), (-1.4, -0.8, 0.2)]


def hold_body(twist, discs_at, held_s):
    """Views of a body that is held from a time on, while its wheels go on."""
    views = []
    for t in (0.0, 0.1, 0.2, 0.3):
        by_odometry = geometry.exp(t * np.array(twist))
        true_pose = geometry.exp(min(t, held_s) * np.array(twist))
        ranges = seen(true_pose, discs_at(t))
        views.append(View(round(t * NS_PER_S), by_odometry, ranges))
    return tuple(views)


@pytest.mark.parametrize("held_s", [0.0, 0.1, 0.2])
@pytest.mark.parametrize(
    "twist", [(0.8, 0.0, 0.0), (-0.4, 0.0, 0.5), (0.8, 0.0, -0.8), (0.3, 0.5, 0.0)]
)
def test_what_stands_does_not_move_while_the_wheels_of_a_held_body_spin(twist, held_s):
    views = hold_body(twist, lambda _: STANDING, held_s)
    assert not find_movers(GIVEN, SHIELD, views).any()


@pytest.mark.parametrize("twist", [(0.8, 0.0, 0.0), (0.8, 0.0, -0.8)])
def test_somebody_who_comes_on_moves_while_the_wheels_of_a_held_body_spin(twist):
    def discs_at(t):
        return [(1.8 - 1.2 * t, 0.0, 0.2), *STANDING]

    views = hold_body(twist, discs_at, 0.0)
    assert find_movers(GIVEN, SHIELD, views)[facing(views, 0.0)].all()


def test_somebody_who_walks_around_a_turning_robot_in_the_open_does_not_pass_for_a_turn():
    beyond_the_wall = 2.0 * LIDAR.range_max
    twist = np.array([0.0, 0.0, 1.2])
    views = []
    for t in (0.0, 0.1, 0.2, 0.3):
        pose = geometry.exp(t * twist) - (0.0, beyond_the_wall, 0.0)
        walker = (np.cos(0.6 * t), np.sin(0.6 * t) - beyond_the_wall, 0.25)
        views.append(View(round(t * NS_PER_S), pose, seen(pose, [walker])))
    assert find_movers(GIVEN, SHIELD, tuple(views)).any()


@pytest.mark.parametrize("around", [0.4, 0.6, 0.9])
def test_somebody_who_circles_a_turning_robot_within_round_walls_moves(around):
    room = np.float32(2.5)
    beyond_the_wall = 2.0 * LIDAR.range_max
    twist = np.array([0.0, 0.0, 1.2])
    views = []
    for t in (0.0, 0.1, 0.2, 0.3):
        pose = geometry.exp(t * twist) - (0.0, beyond_the_wall, 0.0)
        bearing = 0.3 + around * 1.2 * t
        walker = (np.cos(bearing), np.sin(bearing) - beyond_the_wall, 0.25)
        scan = np.minimum(seen(pose, [walker]), room)
        views.append(View(round(t * NS_PER_S), pose, scan))
    assert find_movers(GIVEN, SHIELD, tuple(views)).any()


@pytest.mark.parametrize("speed", [0.3, 0.5, 1.0, 1.6])
@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.0), (0.5, 0.0, 1.0)])
def test_somebody_who_comes_on_moves(speed, twist):
    views = drive(twist, lambda t: [(2.0 - speed * t, 0.3, 0.2)])
    found = find_movers(GIVEN, SHIELD, views)
    pose = views[-1].pose
    where = geometry.between(pose, np.array([2.0 - speed * 0.3, 0.3, 0.0]))
    assert found[facing(views, np.arctan2(where[1], where[0]))].all()
    assert found.sum() < 60


def test_the_leading_edge_of_somebody_who_crosses_moves():
    views = drive((0.0, 0.0, 0.0), lambda t: [(1.5, -0.6 + 0.8 * t, 0.2)])
    edge = np.arctan2(-0.6 + 0.24 + 0.19, 1.5)
    assert find_movers(GIVEN, SHIELD, views)[facing(views, edge, 0.02)].any()


def test_who_walks_away_and_what_was_hidden_does_not():
    away = drive((0.0, 0.0, 0.0), lambda t: [(1.0 + 0.8 * t, -0.3, 0.2)])
    assert not find_movers(GIVEN, SHIELD, away).any()
    behind = [
        (1.0, 0.0, 0.15),
        (2.0, -0.1, 0.2),
    ]  # the second comes out from behind the first
    assert not find_movers(
        GIVEN, SHIELD, drive((0.0, 0.7, 0.0), lambda _: behind)
    ).any()


def test_noise_that_is_declared_is_no_motion():
    rng = np.random.default_rng(0)
    noisy = replace(SHIELD, range_noise=(0.03, 0.0))
    discs = [(1.5, 0.4, 0.2)]
    found = [
        find_movers(
            GIVEN, noisy, drive((0.3, 0.0, 0.0), lambda _: discs, noise=0.03, rng=rng)
        ).sum()
        for _ in range(20)
    ]
    assert np.mean(found) < 3.0


def test_one_beam_alone_is_noise():
    views = list(drive((0.0, 0.0, 0.0), lambda _: []))
    alone = views[-1].ranges.copy()
    alone[100] = 1.0
    views[-1] = replace(views[-1], ranges=alone)
    assert not find_movers(GIVEN, SHIELD, tuple(views)).any()


def test_where_nothing_was_known_nothing_moves():
    views = list(drive((0.0, 0.0, 0.0), lambda t: [(2.0 - t, 0.0, 0.2)]))
    for index in range(3):
        views[index] = replace(
            views[index], ranges=np.full(LIDAR.beams, np.nan, np.float32)
        )
    assert not find_movers(GIVEN, SHIELD, tuple(views)).any()


def test_where_all_is_taken_to_stand_nothing_moves():
    still = replace(SHIELD, obstacle_speed=0.0)
    assert not find_movers(
        GIVEN, still, drive((0, 0, 0), lambda t: [(2.0 - t, 0.0, 0.2)])
    ).any()


def test_the_views_of_the_last_moments_are_kept_apart_from_each_other():
    state = begin(GIVEN)
    step = NS_PER_S // 40
    for index in range(40):
        state = replace(
            state, odometry=Odometry(index * step, np.zeros(3), np.zeros(3))
        )
        scan = Scan(index * step, np.full(LIDAR.beams, 1.0, np.float32), (0.0, 0.01))
        state = replace(state, views=add_view(GIVEN, state, scan))
    stamps = np.array([view.stamp_ns for view in state.views])
    assert stamps[-1] == 39 * step
    assert (np.diff(stamps[:-1]) >= SPACING_S * NS_PER_S).all()
    assert MEMORY_S / 2 < (stamps[-1] - stamps[0]) / NS_PER_S <= MEMORY_S
    assert 4 <= len(stamps) <= 6


def test_views_from_before_the_stamps_jumped_back_are_dropped():
    state = begin(GIVEN)
    for stamp in (100 * NS_PER_S, NS_PER_S, 11 * NS_PER_S // 10):
        state = replace(state, odometry=Odometry(stamp, np.zeros(3), np.zeros(3)))
        scan = Scan(stamp, np.full(LIDAR.beams, 1.0, np.float32), (0.0, 0.01))
        state = replace(state, views=add_view(GIVEN, state, scan))
    assert [view.stamp_ns for view in state.views] == [NS_PER_S, 11 * NS_PER_S // 10]


def test_views_are_forgotten_when_the_gate_is_armed_and_when_odometry_leaps():
    """Their poses may be those of another place."""
    rig = Rig(config(shield=CAR))
    rig.run(1.5)
    newest = rig.state.views[-1]
    assert len(rig.state.views) > 2
    assert rig.arm().granted
    assert rig.state.views == (newest,)
    rig.run(0.3)
    assert len(rig.state.views) > 2
    rig.odom(stamp_ns=rig.stamp + 1, pose=rig.pose + 50.0)
    assert rig.rule == "odom_jumped"
    assert rig.state.views == ()


def test_a_view_is_from_where_the_robot_was_when_it_was_scanned():
    odometry = Odometry(
        5 * NS_PER_S, np.array([1.0, 2.0, np.pi / 2]), np.array([1.0, 0.0, 0.0])
    )
    state = replace(begin(GIVEN), odometry=odometry)
    scan = Scan(
        5 * NS_PER_S + NS_PER_S // 10, np.ones(LIDAR.beams, np.float32), (0.0, 0.01)
    )
    assert add_view(GIVEN, state, scan)[-1].pose == pytest.approx([1.0, 2.1, np.pi / 2])
    assert add_view(config(), state, scan) == ()


def test_a_robot_is_at_rest_before_somebody_who_walks_up_to_it_is_there():
    """The same robot, told that nothing moves, still drives when they meet."""

    def speed_at_meeting(obstacle_speed):
        given = replace(SHIELD, obstacle_speed=obstacle_speed)
        rig = Rig(config(shield=given, frozen_distance=1e9, stuck_s=1e9))
        rig.frozen, rig.wish = True, np.array([0.5, 0.0, 0.0])
        rig.ranges = seen(rig.pose)
        rig.run(1.5)
        assert rig.arm().granted
        person = 2.8
        for tick in range(400):
            rig.speed = float(rig.decision.twist[0])
            person -= 0.8 * 0.02
            if tick % 5 == 4:
                rig.ranges = seen(rig.pose, [(person, 0.0, 0.2)])
            rig.run(0.02)
            if person - 0.2 - rig.pose[0] < SHIELD.footprint_radius:
                return rig.speed
        raise AssertionError("they never met")

    assert speed_at_meeting(1.0) == 0.0
    assert speed_at_meeting(0.0) > 0.01
