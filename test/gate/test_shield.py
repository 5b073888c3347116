from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from shapely.geometry import LineString, Point

from gate.rig import LIDAR, Rig, config
from nics_drl_bridge.gate import moving_kernels, shield_kernels
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Tick
from nics_drl_bridge.gate.moving_kernels import entered
from nics_drl_bridge.gate.shield import obstacles, rehearse
from nics_drl_bridge.gate.shield_kernels import free, place
from nics_drl_bridge.gate.state import ShieldConfig

CAR = ShieldConfig(
    latency_s=0.15, deceleration=1.0, margin=0.05, hold_s=0.02, footprint_radius=0.15, wheelbase=0.2
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

    def __init__(self, seen, shield=CAR, wish=(1.0, 0.0, 0.0)):
        super().__init__(config(shield=shield, frozen_distance=1e9))
        self.ranges, self.frozen = seen, True
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


@pytest.mark.parametrize("wheelbase", [CAR.wheelbase, 0.0])
def test_nothing_remains_to_be_compiled_after_a_rehearsal(wheelbase, monkeypatch):
    fresh = {"free": njit(free.py_func), "entered": njit(entered.py_func)}
    monkeypatch.setattr(shield_kernels, "free", fresh["free"])
    monkeypatch.setattr(moving_kernels, "entered", fresh["entered"])
    rehearse()
    known = {name: list(kernel.signatures) for name, kernel in fresh.items()}
    assert all(known.values())
    Faced(ranges(0.3), replace(CAR, wheelbase=wheelbase, obstacle_speed=1.0)).settles(0.1)
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


def test_a_robot_stands_before_what_it_must_not_come_nearer_to():
    assert Faced(ranges(0.19)).settles() == 0.0


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
    assert obstacles(given, seen, ()) == pytest.approx(np.array([[0.1, 2.0, 0.0]]), abs=1e-6)


def test_the_sweep_agrees_with_geometry():
    rng = np.random.default_rng(0)
    room, step, unclear = 0.2, 0.005, 0
    for _ in range(400):
        twist = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-2, 2)])
        blind, point = rng.uniform(0.1, 0.8), rng.uniform(-1.2, 1.2, 2)
        duration = blind + np.hypot(*twist[:2]) / (2.0 * BRAKE)
        path = LineString([place(twist, t) for t in np.linspace(0.0, duration, 400)])
        away = path.distance(Point(point))
        if abs(away - room) < step or np.hypot(*point) <= room:
            unclear += 1
            continue
        swept_free = free(np.array([[*point, 0.0]]), twist[None], blind, BRAKE, room, step)
        assert swept_free == (away > room)
    assert unclear < 100


@pytest.mark.parametrize(("speed", "may"), [(0.3, False), (-0.3, True)])
def test_a_robot_in_the_margin_may_leave_and_not_come_nearer(speed, may):
    near = np.array([[0.17, 0.02, 0.0]])
    assert free(near, np.array([[speed, 0.0, 0.0]]), 0.5, BRAKE, 0.2, 0.02) == may


@pytest.mark.parametrize(("away", "may"), [(1.19, False), (1.21, True)])
def test_what_comes_on_is_met_no_sooner_than_the_robot_is_at_rest(away, may):
    """0.5 m/s for 0.4 s and then 0.25 s of braking: 0.2625 m, in which 1 m/s comes 0.65 m near."""
    near = 0.2 + 0.2625 + 0.65
    twists = np.array([[0.5, 0.0, 0.0]])
    comes = np.array([[near + away - 1.2, 0.0, 1.0]])
    assert free(comes, twists, 0.4, 2.0, 0.2, 0.005) == may
    assert free(comes * (1.0, 1.0, 0.0), twists, 0.4, 2.0, 0.2, 0.005)


@pytest.mark.parametrize(("away", "may"), [(0.3, False), (0.6, False), (1.5, True)])
def test_who_catches_up_from_behind_finds_the_robot_at_rest(away, may):
    """At 0.3 m/s it is no faster than who comes on, and would be met in motion."""
    behind = np.array([[-away, 0.1, 1.0]])
    assert free(behind, np.array([[0.3, 0.0, 0.0]]), 0.5, BRAKE, 0.2, 0.02) == may
    assert free(behind * (1.0, 1.0, 0.0), np.array([[0.3, 0.0, 0.0]]), 0.5, BRAKE, 0.2, 0.02)


def test_a_command_of_before_that_the_scan_does_not_show_yet_is_reckoned_with():
    """It was told a latency before the scan was made, and turns the robot towards what is there."""
    rig = Faced(ranges(0.45, where=np.abs(LIDAR.angles - 0.9) < 0.3), replace(CAR, latency_s=0.3))
    rig.wish = np.array([0.6, 0.0, 0.0])
    rig.settles()
    while rig.now - rig.state.scans.times[-1] < 0.09:
        rig.run(0.02, without="scan")
    straight = rig.decision.twist[0]
    told, before = np.array([0.6, 0.5]), rig.state
    for ago, cut in ((0.33, True), (0.6, False)):  # that of 0.6 s ago the scan shows
        later = (one for one in before.recent if one[0] > rig.now - ago)
        recent = ((rig.now - ago, told), *later)
        _, decision = decide(rig.config, replace(before, recent=recent), Tick(), rig.now + 0.02)
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


def test_what_was_told_before_a_pause_of_the_gate_counts_as_long_as_it_was_in_force():
    rig = Faced(ranges(0.45, where=np.abs(LIDAR.angles - 0.9) < 0.3), replace(CAR, latency_s=0.3))
    rig.wish = np.array([0.6, 0.0, 0.0])
    rig.settles()
    straight, before = rig.decision.twist[0], rig.state
    since = rig.now - before.scans.times[-1] + 0.3
    kept = tuple(one for one in before.recent if one[0] > rig.now - since + 0.05)
    recent = ((rig.now - since - 0.05, np.array([0.6, 0.5])), *kept)
    _, decision = decide(rig.config, replace(before, recent=recent), Tick(), rig.now + 0.02)
    assert decision.twist[0] < straight - 0.1
