from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gate.recorded import see
from gate.rig import LIDAR, Rig, config
from nics_drl_bridge import geometry
from nics_drl_bridge.gate import evidence
from nics_drl_bridge.gate.evidence import (
    add_view,
    estimate_motion,
    find_movers,
    find_obstacles,
    get_beams,
)
from nics_drl_bridge.gate.evidence_kernels import Tolerance
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Odometry, Scan, Tick
from nics_drl_bridge.gate.shield import CREEP_SPEED, _span_car_twists
from nics_drl_bridge.gate.state import ShieldConfig, View, begin
from nics_drl_bridge.interface import NS_PER_S

CAR = ShieldConfig(
    latency_s=0.15,
    deceleration=1.0,
    margin=0.05,
    hold_s=0.02,
    footprint_radius=0.15,
    wheelbase=0.2,
    obstacle_speed=0.0,
)
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


BESIDE = np.abs(np.abs(LIDAR.angles) - np.pi / 2) < 0.3
BEHIND = np.abs(LIDAR.angles) > 2.8
FEW = np.arange(LIDAR.beams) % 5 == 0


@pytest.mark.parametrize(
    ("scan", "shield", "speed"),
    [
        (FAR, CAR, 1.0),
        (ranges(np.inf), CAR, 1.0),
        (ranges(0.3), None, 1.0),
        (ranges(0.19), CAR, 0.0),
        (ranges(-np.inf), CAR, 0.0),
        (ranges(np.nan), CAR, 0.0),
        (ranges(np.nan, where=FEW), CAR, 1.0),
        (ranges(0.3, where=BESIDE), CAR, 1.0),
        (ranges(0.18, where=BEHIND), CAR, 1.0),
    ],
)
def test_what_bars_the_way_stops_the_robot_and_nothing_else_does(scan, shield, speed):
    assert Faced(scan, shield).settles() == speed


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


LONG = replace(
    CAR,
    wheelbase=0.0,
    outline=((0.4, 0.15), (-0.4, 0.15), (-0.4, -0.15), (0.4, -0.15)),
    footprint_radius=float(np.hypot(0.4, 0.15)),
)
AT_A_CORNER = ranges(0.46, where=np.abs(LIDAR.angles - 0.5) < 0.1)


AT_BOTH = AT_A_CORNER.copy()
AT_BOTH[np.abs(LIDAR.angles) > 3.0] = 0.46  # behind, so near that only a creep is safe
ROUND = replace(CAR, wheelbase=0.0)


@pytest.mark.parametrize(
    ("scan", "shield", "wish", "speed", "turn"),
    [
        (ranges(0.19), ROUND, (1.0, 0.0, 0.5), (0.0, 0.0), (0.5, 0.5)),
        (AT_A_CORNER, LONG, (0.0, 0.0, 0.5), (0.0, 0.0), (0.0, 0.2)),
        (AT_A_CORNER, LONG, (-0.3, 0.0, 0.5), (-0.3, -CREEP_SPEED), (0.0, 0.5)),
        (AT_BOTH, LONG, (-0.3, 0.0, 0.5), (0.0, 0.0), (0.0, 0.5)),
        (ranges(0.23), ROUND, (1.0, 0.0, 0.0), (1e-9, CREEP_SPEED), (0.0, 0.0)),
        (ranges(0.23), ROUND, (1.0, 0.0, 0.5), (0.0, 0.0), (0.5, 0.5)),
    ],
    ids=[
        "what bars the way bars no turn on the spot",
        "what bars a turn",
        "what bars a turn bars no way straight back",
        "a creep straight back is none",
        "a robot that does not turn creeps nearer",
        "a robot that turns does not creep nearer",
    ],
)
def test_speed_and_turn_are_barred_each_for_itself(scan, shield, wish, speed, turn):
    rig = Faced(scan, shield, wish, robot="differential")
    assert speed[0] <= rig.settles(0.5) <= speed[1]
    assert turn[0] - 1e-6 <= rig.decision.twist[2] <= turn[1] + 1e-6
    assert rig.decision.shielded


@pytest.mark.parametrize(
    ("ago_s", "kept_s", "counts"),
    [(0.33, 0.33, True), (0.6, 0.6, False), (0.5, 0.3, True)],
    ids=["not shown yet", "shown by the scan", "in force until a while ago"],
)
def test_a_command_of_before_counts_until_the_scan_shows_what_became_of_it(
    ago_s, kept_s, counts
):
    """It turns the robot towards what is there."""
    beside = ranges(0.45, where=np.abs(LIDAR.angles - 0.9) < 0.3)
    rig = Faced(beside, replace(CAR, latency_s=0.3), wish=(0.6, 0.0, 0.0))
    rig.settles()
    while rig.now - rig.state.scans.times[-1] < 0.09:
        rig.run(0.02, without="scan")
    straight = rig.decision.twist[0]
    later = (one for one in rig.state.recent if one[0] > rig.now - kept_s)
    recent = ((rig.now - ago_s, np.array([0.6, 0.5])), *later)
    state = replace(rig.state, recent=recent)
    _, decision = decide(rig.config, state, Tick(), rig.now + 0.02)
    assert (decision.twist[0] < straight - 0.1) == counts


SHIELD = ShieldConfig(0.2, 2.0, 0.05, 0.2, 0.15, 0.2, obstacle_speed=1.0, range_max=3.0)
GIVEN = config(shield=SHIELD)
WALL = np.array([[-9.0, 1.5, 9.0, 1.5]])
PILLARS = ((1.5, 0.4), (1.0, -0.9), (-0.8, 0.3), (-1.4, -0.8))
TIMES = (0.0, 0.1, 0.2, 0.3)


def octagon(x, y, radius=0.2):
    """Walls (8, 4) of a pillar or a person."""
    angles = np.arange(9) * np.pi / 4.0
    corners = np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles)], 1)
    return np.concatenate([corners[:-1], corners[1:]], axis=1)


def views_of(twist, walker=None, factor=1.0, held_s=np.inf, room=True, noise=0.0):
    """Views on an arc beside a wall, among pillars and before somebody who walks.

    Wheels show a turn that is too large by a factor, and spin once the body is held.
    """
    twist = np.array(twist, dtype=float)
    rng = np.random.default_rng(0)
    views = []
    for t in TIMES:
        walls = [WALL, *(octagon(*pillar) for pillar in PILLARS)] if room else []
        if walker is not None:
            walls.append(octagon(*walker(t)))
        pose = geometry.exp(min(t, held_s) * twist)
        ranges = see(pose, LIDAR.angles, np.concatenate([*walls, np.zeros((0, 4))]))
        ranges[ranges > LIDAR.range_max] = np.inf
        ranges = (ranges + rng.normal(0.0, noise, len(ranges))).astype(np.float32)
        shown = geometry.exp(t * twist * (1.0, 1.0, factor))
        views.append(View(round(t * NS_PER_S), shown, ranges))
    return tuple(views)


@pytest.mark.parametrize(
    ("twist", "changes"),
    [
        ((1.0, 0.0, 0.0), {}),
        ((0.7, -0.7, 2.0), {}),
        ((0.0, 0.0, 1.0), {"factor": 1.7}),
        ((0.5, 0.0, -0.8), {"factor": 0.8}),
        ((0.3, 0.0, -3.0), {"factor": 1.2}),
        ((0.8, 0.0, 0.0), {"held_s": 0.0}),
        ((-0.4, 0.0, 0.5), {"held_s": 0.1}),
        ((0.3, 0.5, 0.0), {"held_s": 0.2}),
        ((0.0, 0.0, 0.0), {"walker": lambda t: (1.0 + 0.8 * t, -0.3)}),
    ],
)
def test_what_stands_or_walks_away_does_not_move_whatever_the_wheels_do(twist, changes):
    assert not find_movers(GIVEN, SHIELD, views_of(twist, **changes)).any()


def walk_ahead(t):
    return 1.6 - 0.8 * t, 0.0


def walk_across(t):
    return 1.2, 0.6 - 1.2 * t


def walk_around(t):
    return np.cos(0.6 * t), np.sin(0.6 * t)


@pytest.mark.parametrize(
    ("twist", "walker", "changes"),
    [
        ((0.0, 0.0, 0.0), walk_ahead, {}),
        ((0.5, 0.0, 1.0), walk_ahead, {}),
        ((0.8, 0.0, 0.0), walk_ahead, {"held_s": 0.0}),
        ((0.3, 0.0, 0.8), walk_across, {"factor": 1.35}),
        ((0.0, 0.0, 1.2), walk_around, {"room": False}),
    ],
)
def test_somebody_who_walks_moves_whatever_the_wheels_do(twist, walker, changes):
    views = views_of(twist, walker, **changes)
    moves = find_movers(GIVEN, SHIELD, views)
    assert 1 < moves.sum() < 60
    true_pose = geometry.exp(min(0.3, changes.get("held_s", 1.0)) * np.array(twist))
    x, y, _ = geometry.between(true_pose, np.array([*walker(0.3), 0.0]))
    assert (np.abs(LIDAR.angles[moves] - np.arctan2(y, x)) < 0.3).all()
    assert not find_movers(GIVEN, replace(SHIELD, obstacle_speed=0.0), views).any()
    unknown = np.full(LIDAR.beams, np.nan, np.float32)
    blind = [replace(view, ranges=unknown) for view in views[:-1]]
    assert not find_movers(GIVEN, SHIELD, (*blind, views[-1])).any()


def test_noise_that_is_declared_is_no_motion_and_neither_is_one_beam():
    noisy = replace(SHIELD, range_noise=(0.03, 0.0))
    assert find_movers(GIVEN, noisy, views_of((0.3, 0.0, 0.0), noise=0.03)).sum() < 10
    *before, newest = views_of((0.0, 0.0, 0.0))
    alone = newest.ranges.copy()
    alone[100] = 0.3
    views = (*before, replace(newest, ranges=alone))
    assert not find_movers(GIVEN, SHIELD, views).any()


@pytest.mark.parametrize("told", [True, False])
def test_a_robot_is_at_rest_before_somebody_who_walks_up_to_it_is_there(told):
    """Told that nothing moves, it still drives when they meet."""
    shield = replace(SHIELD, obstacle_speed=1.0 if told else 0.0)
    rig = Rig(config(shield=shield, frozen_distance=1e9, stuck_s=1e9))
    rig.frozen = True
    rig.wish = np.array([0.5, 0.0, 0.0])
    rig.ranges = see(rig.pose, LIDAR.angles, WALL).astype(np.float32)
    rig.settle()
    person = 2.8
    while person - 0.2 - rig.pose[0] > SHIELD.footprint_radius:
        rig.speed = float(rig.decision.twist[0])
        person -= 0.8 * 0.02
        walls = np.concatenate([WALL, octagon(person, 0.0)])
        rig.ranges = see(rig.pose, LIDAR.angles, walls).astype(np.float32)
        rig.run(0.02)
    assert (rig.speed > 0.01) != told


def test_views_from_before_the_stamps_jumped_back_are_dropped():
    state = begin(GIVEN)
    for stamp in (100 * NS_PER_S, NS_PER_S, 11 * NS_PER_S // 10):
        state = replace(state, odometry=Odometry(stamp, np.zeros(3), np.zeros(3)))
        scan = Scan(stamp, np.full(LIDAR.beams, 1.0, np.float32), (0.0, 0.01))
        state = replace(state, views=add_view(GIVEN, state, scan))
    assert [view.stamp_ns for view in state.views] == [NS_PER_S, 11 * NS_PER_S // 10]


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


def test_a_decision_that_publishes_nothing_adds_no_command():
    rig = Rig(config(shield=SHIELD))
    rig.run(1.5)  # it publishes zeros
    before = rig.state.recent
    rig.now += 1e-3
    assert not rig.odom(stamp_ns=rig.stamp + 1).publish
    assert rig.state.recent is before
    assert rig.tick().publish
    assert rig.state.recent[-1][0] == rig.now


@pytest.mark.parametrize(("missing", "moves"), [(0, True), (1, False)])
def test_the_first_and_the_last_beam_are_neighbours_only_in_a_full_circle(
    missing, moves
):
    count = LIDAR.beams - missing
    given = config(shield=SHIELD, beam_angles=LIDAR.angles[:count])
    old = np.full(count, 2.0, np.float32)
    new = old.copy()
    new[[0, -1]] = 1.0
    turned = np.array([0.0, 0.0, 8 * LIDAR.angle_increment])  # away from the gap
    views = (View(0, np.zeros(3), old), View(NS_PER_S // 10, turned, new))
    entered = np.flatnonzero(find_movers(given, SHIELD, views))
    assert entered.tolist() == ([0, count - 1] if moves else [])


@pytest.mark.parametrize(
    ("sectors", "turn", "expected"),
    [(4, 0.3, 0.0), (3, 0.3, 0.3), (4, 0.0199, 0.0199), (4, 0.0201, 0.0)],
)
def test_scans_correct_a_turn_that_is_worth_it_if_half_the_directions_show_another(
    sectors, turn, expected
):
    """The wheels turn, and the scans show a body that does not."""
    rng = np.random.default_rng(0)
    ranges = rng.uniform(1.0, 3.0, LIDAR.beams).astype(np.float32)
    ranges[LIDAR.beams * sectors // 8 :] = np.inf
    old = View(0, np.zeros(3), ranges)
    new = View(NS_PER_S // 10, np.array([0.0, 0.0, turn]), ranges)
    motion = estimate_motion(old, new, get_beams(GIVEN), Tolerance(0.03, 0.0))
    assert motion == pytest.approx([0.0, 0.0, expected], abs=5e-3)


@pytest.mark.parametrize("turn", [0.05, -2.0])
def test_the_turns_and_the_motions_that_are_tried_are_close_to_each_other(turn):
    turns = evidence._vary_turn(np.array([0.0, 0.0, turn]))[:, 2] / turn
    assert (np.diff(np.abs(turns - 1.0)) > -1e-9).all()  # odometry's comes first
    assert np.diff(np.sort(turns)).max() * abs(turn) < 0.03
    assert (turns.min(), turns.max()) == pytest.approx((0.0, 1.3))
    lesser = evidence._lessen_motion(np.array([0.49, 0.0, 0.0]))[:, 0]
    assert lesser == pytest.approx(0.049 * np.arange(10))


def test_among_turns_that_fit_equally_well_the_one_closest_to_odometrys_is_taken():
    """What is around repeats itself every 24 beams, so standing still fits, too."""
    rng = np.random.default_rng(0)
    part = rng.uniform(1.0, 3.0, 24).astype(np.float32)
    ranges = np.tile(part, LIDAR.beams // 24)
    turn = 24 * LIDAR.angle_increment
    tried = evidence._vary_turn(np.array([0.0, 0.0, turn / 0.7]))[:, 2]
    fraction = tried[np.abs(tried - turn).argmin()] / (turn / 0.7)
    old = View(0, np.zeros(3), ranges)
    new = View(NS_PER_S // 10, np.array([0.0, 0.0, turn / fraction]), ranges)
    motion = estimate_motion(old, new, get_beams(GIVEN), Tolerance(0.03, 0.0))
    assert motion == pytest.approx([0.0, 0.0, turn])


@pytest.mark.parametrize(
    ("odometry", "speeds", "curvature"),
    [(None, {0.5}, 0.0), ((1.0, 0.0, 0.5), {0.5, 1.0}, 0.5)],
)
def test_a_car_may_go_on_at_the_speed_and_curvature_of_odometry(
    odometry, speeds, curvature
):
    driven = None if odometry is None else np.array(odometry)
    twists = _span_car_twists(CAR.wheelbase, np.array([[0.5, 0.0, 0.0]]), driven)
    assert set(twists[:, 0]) == speeds
    assert (twists[:, 2] / twists[:, 0]).max() == pytest.approx(curvature)
