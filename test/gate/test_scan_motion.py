"""Scans that do not show the motion that odometry shows: a body that is held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gate.recorded import WALLS, see
from gate.rig import PERIOD_S, TICK_S, Rig, config
from nics_drl_bridge.gate import scan_motion
from nics_drl_bridge.gate.inputs import Scan
from nics_drl_bridge.gate.scan_motion import SETTINGS, Verdict, judge_motion, warm_up
from nics_drl_bridge.gate.state import View
from nics_drl_bridge.geometry import compose, exp
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar

CORRIDOR = np.array([[-500.0, -0.8, 500.0, -0.8], [500.0, 0.8, -500.0, 0.8]])


class Scene(Rig):
    """A rig that sees walls and people from where its body is, which odometry may not know."""

    def __init__(
        self,
        lidar=None,
        walls=WALLS,
        period_s=PERIOD_S,
        twist=(0.5, 0.0, 0.1),
        **changes,
    ):
        self.lidar = lidar or load_lidar("sick_tim571")
        given = config(
            "mecanum",
            beam_angles=self.lidar.angles,
            range_max=self.lidar.range_max,
            scan_rate=1.0 / period_s,
            odom_rate=1.0 / period_s,
            stop_when_held=True,
            range_noise=(self.lidar.noise_std, self.lidar.faults.noise_proportional),
            **changes,
        )
        super().__init__(given)
        self.period_s = period_s
        self.walls = walls
        self.wish = np.array(twist)
        self.body = np.zeros(3)
        self.held = False
        self.people = None
        self.scale = np.ones(3)
        self.rng = np.random.default_rng(3)

    def run(self, seconds, without=""):
        """Lets time pass; wheels do what the gate says, and the body does, unless it is held."""
        for _ in range(round(seconds / TICK_S)):
            self.now += TICK_S
            self.ticks += 1
            twist = self.decision.twist if self.decision else np.zeros(3)
            step = exp(twist * TICK_S)
            self.twist = twist * self.scale
            self.pose = compose(self.pose, exp(self.twist * TICK_S))
            if not self.held:
                self.body = compose(self.body, step)
            if self.ticks % round(self.period_s / TICK_S) == 0:
                self.stamp += round(
                    (self.period_s - PERIOD_S) * NS_PER_S
                )  # `send` adds the rest
                self.send(without)
            self.tick()
        return self.decision

    def odom(self, **changes):
        return super().odom(twist=self.twist.copy(), **changes)

    def scan(self, **changes):
        lidar = self.lidar
        walls = self.walls
        if self.people is not None:
            walls = np.concatenate([walls, self.people(self)])
        ranges = see(self.body, lidar.angles, walls)
        std = lidar.noise_std + lidar.faults.noise_proportional * np.where(
            np.isfinite(ranges), ranges, 0.0
        )
        ranges = ranges + self.rng.normal(size=len(ranges)) * std
        if quantum := lidar.faults.quantisation:
            ranges = np.round(ranges / quantum) * quantum
        ranges[(ranges > lidar.range_max) | (self.rng.random(len(ranges)) < 0.03)] = (
            np.inf
        )
        angles = (lidar.angle_min, lidar.angle_increment)
        return self.give(Scan(self.stamp, ranges.astype(np.float32), angles))

    def stops_after(self, limit_s):
        """Holds the body, and returns how long the gate lets the wheels spin [s]."""
        self.held = True
        began = self.now
        while self.moves:
            assert self.now - began < limit_s, f"still moves after {limit_s} s"
            self.run(TICK_S)
        return self.now - began


def started(*given, **changes):
    """A scene in which the robot drives."""
    scene = Scene(*given, **changes)
    scene.run(1.5)
    assert scene.arm().granted, scene.decision.answer
    scene.run(0.8)
    assert scene.moves, scene.decision.cause
    return scene


@pytest.mark.parametrize(
    ("lidar", "period_s", "twist"),
    [
        ("sick_tim571", 0.2, (0.5, 0.0, 0.0)),
        ("hokuyo_ust_10lx", 0.1, (0.0, 0.0, 0.8)),
        ("rplidar_a1", 0.02, (0.3, 0.0, -0.5)),
        ("paper_12m", 0.1, (0.5, 0.0, 0.0)),
    ],
)
def test_a_body_that_is_held_while_its_wheels_spin_is_stopped_within_a_second(
    lidar, period_s, twist
):
    scene = started(load_lidar(lidar), period_s=period_s, twist=twist)
    assert scene.stops_after(1.5) <= 1.0
    assert scene.rule == "body_held"


def person(x, y, half=0.25):
    return [[x - half, y, x + half, y], [x, y - half, x, y + half]]


@pytest.mark.parametrize(
    ("scale", "twist"),
    [
        ((1.0, 1.0, 1.3), (0.0, 0.0, 0.8)),
        ((1.1, 1.1, 1.0), (0.3, 0.0, 0.0)),
        ((0.9, 0.9, 0.8), (0.1, 0.0, -0.5)),
    ],
)
def test_odometry_that_shows_too_much_or_too_little_does_not_stop_the_robot(
    scale, twist
):
    scene = started(twist=twist)
    scene.scale = np.array(scale)
    assert scene.run(4.0).cause is None


def test_wheels_that_slip_in_each_of_many_short_pushes_do_not_stop_the_robot():
    scene = started(twist=(0.1, 0.0, 0.02))
    scene.scale = np.array([1.0, 1.0, 10.0])
    push = scene.wish
    for _ in range(8):
        scene.wish = np.zeros(3)
        scene.run(0.45)
        scene.wish = push
        assert scene.run(0.35).cause is None


@pytest.mark.parametrize(
    ("walls", "held", "people"),
    [
        (CORRIDOR, True, ()),
        (np.zeros((0, 4)), True, ()),
        (CORRIDOR, False, ((0.8, 0.0),)),
        (WALLS, False, ((0.2, 0.7), (-0.3, -0.7))),
    ],
    ids=["corridor", "nothing in range", "follows a person", "between people"],
)
def test_where_the_scans_do_not_tell_the_motion_nothing_is_decided(walls, held, people):
    scene = started(walls=walls, twist=(0.3, 0.0, 0.0))
    if people:
        scene.people = lambda one: np.array(
            [line for x, y in people for line in person(one.body[0] + x, y)]
        )
    scene.held = held
    assert scene.run(4.0).cause is None


def test_people_who_walk_about_a_held_body_do_not_hide_it():
    scene = started(twist=(0.4, 0.0, 0.2))
    begun = scene.now
    scene.people = lambda one: np.array(
        person(1.0 * np.cos(one.now - begun), 1.0 * np.sin(one.now - begun))
        + person(-0.8, 1.5 - 0.8 * (one.now - begun))
    )
    assert scene.stops_after(1.5) <= 1.0


def stamp_too_late(scene, late_s):
    """Lets each scan show what there was some time before its stamp."""
    past = [scene.body.copy()]
    scan = scene.scan

    def scan_of_before(**changes):
        past.append(scene.body.copy())
        now = scene.body
        scene.body = past[max(0, len(past) - 1 - round(late_s / PERIOD_S))]
        decision = scan(**changes)
        scene.body = now
        return decision

    scene.scan = scan_of_before


@pytest.mark.parametrize("late_s", [0.1, 0.2])
def test_scans_that_are_older_than_their_stamps_do_not_stop_a_robot_that_starts_and_stops(
    late_s,
):
    scene = started(twist=(0.6, 0.0, 0.0))
    stamp_too_late(scene, late_s)
    for k in range(12):
        scene.wish = np.array([0.0 if k % 2 else (0.6, -0.6)[k // 2 % 2], 0.0, 0.0])
        scene.run(0.7)
        assert scene.decision.cause is None


@pytest.mark.parametrize(
    ("ramp_s", "twist"), [(0.4, (0.8, 0.0, 0.0)), (1.6, (0.6, 0.0, -0.6))]
)
def test_scans_that_are_older_than_their_stamps_do_not_stop_a_robot_that_gains_speed(
    ramp_s, twist
):
    scene = started(twist=np.array(twist) / 20.0)
    stamp_too_late(scene, 0.2)
    for _ in range(3):
        for share in np.linspace(0.05, 1.0, round(ramp_s / TICK_S)):
            scene.wish = share * np.array(twist)
            assert scene.run(TICK_S).cause is None
        scene.wish = np.zeros(3)
        scene.run(0.6)


@pytest.mark.parametrize("twist", [(0.8, 0.0, 0.0), (0.0, 0.0, 1.2)])
def test_a_body_that_is_held_while_its_robot_gains_speed_is_stopped_within_a_second(
    twist,
):
    scene = started(twist=0.1 * np.array(twist))
    scene.held = True
    began = scene.now
    while scene.moves and scene.now - began < 2.0:
        share = np.interp(scene.now - began, [0.0, 0.3, 0.8], [0.1, 0.1, 1.0])
        scene.wish = share * np.array(twist)
        scene.run(TICK_S)
    assert scene.rule == "body_held"
    assert scene.now - began <= 1.0


@pytest.mark.parametrize("beams", [1, 2, 24])
def test_a_lidar_of_very_few_beams_decides_nothing_and_breaks_nothing(beams):
    lidar = LidarSpec(
        beams=beams,
        angle_min=-1.5,
        angle_max=1.5,
        range_min=0.1,
        range_max=10.0,
        rate=10.0,
    )
    scene = Scene(lidar)
    warm_up(scene.config)
    scene.run(1.5)
    assert scene.arm().granted
    assert scene.run(1.0).cause is None


def test_scans_from_before_the_stamps_jumped_back_are_not_compared():
    scene = Scene()
    scene.run(1.0)
    scene.stamp -= 100 * NS_PER_S
    scene.run(1.0)
    stamps = [view.stamp_ns for view in scene.state.scan_motion.views]
    assert len(stamps) > 2
    assert max(stamps) <= scene.stamp


def views_along(*steps, period_s=0.1):
    """Views of a robot that drives such steps [m] straight ahead, one after the other."""
    return tuple(
        View(round(k * period_s * NS_PER_S), np.array([x, 0.0, 0.0]), np.ones(3))
        for k, x in enumerate(np.cumsum([0.0, *steps]))
    )


def look(monkeypatch, observed, changed, steps=(0.25, 0.25)):
    """Judges the last of some views, whose sectors show fractions of the motion."""
    shown = np.array(observed, float), np.array(changed, float)
    monkeypatch.setattr(scan_motion, "_compare_scans", lambda *_: shown)
    *kept, newest = views_along(*steps)
    return judge_motion(config(), tuple(kept), newest)


SHOWN = SETTINGS.sector_share  # what a sector that agrees shows at least


@pytest.mark.parametrize(
    ("observed", "changed", "steps", "held"),
    [
        ([0.0] * 5, [0.0] * 5, (0.25, 0.25), True),
        ([0.0] * 5, [0.5] * 5, (0.25, 0.25), False),  # too much has changed
        ([0.0] * 3 + [SHOWN] * 2, [0.0] * 5, (0.25, 0.25), True),
        ([0.0] * 5 + [SHOWN] * 5, [0.0] * 10, (0.25, 0.25), False),
        ([0.2] * 5, [0.0] * 5, (0.25, 0.25), False),
        ([-0.2] * 5, [0.0] * 5, (0.25, 0.25), False),
        ([0.17] * 5, [0.0] * 5, (0.5, 0.125), False),  # the limits shrink by 0.8
        ([0.17] * 5, [0.0] * 5, (0.125, 0.5), False),
        ([0.17] * 5, [0.0] * 5, (0.375, 0.125), True),  # at the usual fraction
        ([0.0] * 5, [0.0] * 5, (0.02, 0.02), True),  # the least motion
        ([0.0] * 5, [0.0] * 5, (0.02, 0.09), True),  # the least in one half
    ],
)
def test_a_body_is_held_if_most_sectors_show_too_little_of_the_motion(
    monkeypatch, observed, changed, steps, held
):
    verdict = look(monkeypatch, observed, changed, steps)
    assert verdict.held == held
    assert verdict.share == np.median(observed)
    assert verdict.reference.stamp_ns == 0


@pytest.mark.parametrize(
    ("observed", "steps"),
    [
        ([0.0] * 4 + [np.nan] * 5, (0.25, 0.25)),  # too few sectors
        ([0.0] * 5, (0.019, 0.02)),  # too little motion
        ([0.0] * 5, (0.01, 0.09)),  # in one half
        ([0.0] * 5, (1.0, 0.1)),
        ([0.0] * 5, (0.25,)),  # no scan between
    ],
)
def test_too_little_evidence_decides_nothing(monkeypatch, observed, steps):
    verdict = look(monkeypatch, observed, np.zeros(len(observed)), steps)
    assert np.isnan(verdict.share)
    assert not verdict.held


@pytest.mark.parametrize(
    ("turn", "chosen"),
    [(0.0, 0), (0.6, 0), (0.61, 1), (0.71, 2), (1.4, 2), (1.41, 1), (1.51, None)],
)
def test_a_scan_is_compared_with_the_oldest_since_which_the_robot_turned_a_little(
    monkeypatch, turn, chosen
):
    """Not if it turned too far, because a room may repeat itself."""
    compared = np.zeros(9), np.zeros(9)
    monkeypatch.setattr(scan_motion, "_compare_scans", lambda *_: compared)
    views = views_along(0.5, 0.5, 0.5, 0.5)
    turns = (0.0, 0.1, 0.0, 0.3, turn)
    *kept, newest = (
        replace(view, pose=np.array([*view.pose[:2], angle]))
        for view, angle in zip(views, turns, strict=True)
    )
    reference = judge_motion(config(), tuple(kept), newest).reference
    assert reference == (None if chosen is None else kept[chosen])


@pytest.mark.parametrize(
    ("share", "held", "before_s", "since_s"),
    [
        (0.1, True, None, 9.0),
        (0.1, True, 8.0, 8.0),
        (0.1, True, 7.9, 9.0),  # forgotten
        (np.nan, False, 8.0, 8.0),
        (np.nan, False, 7.9, None),
        (1.0, False, 8.5, None),
    ],
)
def test_a_contradiction_lasts_until_a_scan_agrees_or_it_is_forgotten(
    share, held, before_s, since_s
):
    before_ns = None if before_s is None else round(before_s * NS_PER_S)
    since_ns = None if since_s is None else round(since_s * NS_PER_S)
    verdict = Verdict(share, held)
    assert scan_motion._update_held_since(before_ns, verdict, 9 * NS_PER_S) == since_ns


@pytest.mark.parametrize(
    ("size", "first", "step"), [(12, 0.0, 1.0), (6, 1.0, 2.0), (4, 1.0, 3.0)]
)
def test_a_direction_is_that_of_the_middle_of_its_beams(size, first, step):
    angles = np.deg2rad(np.arange(12.0) - 6.0)
    directions = scan_motion.make_directions(
        config(beam_angles=angles), size, half_window=0
    )
    assert directions.first == pytest.approx(angles[0] + np.deg2rad(first))
    assert directions.step == pytest.approx(np.deg2rad(step))
    assert not directions.full_circle
