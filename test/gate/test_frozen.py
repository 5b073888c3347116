from __future__ import annotations

import re

import numpy as np
import pytest

from gate.rig import LIDAR, PERIOD_S, TICK_S, Rig, config, driving
from nics_drl_bridge.gate.inputs import Reset
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

BEND = np.abs(LIDAR.angles)


def room(x, size=(2.5, 1.5)):
    """Ranges of the paper's lidar in a rectangular room, seen from `x` on its middle line."""
    cos = np.cos(LIDAR.angles)
    sin = np.sin(LIDAR.angles)
    with np.errstate(divide="ignore"):
        along = np.where(cos > 0, size[0] - x, size[0] + x) / np.abs(cos)
        across = size[1] / np.abs(sin)
    return np.minimum(along, across).astype(np.float32)


class Looking(Rig):
    """A rig that sees a room, or what a broken lidar makes of it."""

    def __init__(self, given=None):
        super().__init__(given)
        self.broken = None
        self.shown = []

    def scan(self, **changes):
        true = room(float(self.pose[0]) - 1.5)
        self.shown.append(true)
        self.frozen, self.ranges = (
            True,
            true if self.broken is None else self.broken(true),
        )
        return super().scan(**changes)


def looking():
    return Looking().drive()


def stopped_by_scan(rig):
    rig.until_stopped(2.0)
    assert rig.rule == "scan_frozen"


def test_a_room_that_changes_as_the_robot_drives_is_fine():
    rig = looking()
    assert rig.run(3.0).cause is None


def test_a_lidar_that_shows_two_pictures_in_turn_is_frozen():
    rig = looking()
    pictures = [rig.shown[-2], rig.shown[-1]]
    rig.broken = lambda true: pictures[len(rig.shown) % 2]
    stopped_by_scan(rig)


def test_a_lidar_that_repeats_a_second_is_frozen():
    rig = looking()
    pictures = rig.shown[-10:]
    rig.broken = lambda true: pictures[len(rig.shown) % 10]
    rig.until_stopped(4.0)
    assert rig.rule == "scan_frozen"


@pytest.mark.parametrize("beams", [1, 5])
def test_a_lidar_that_is_frozen_but_for_a_few_beams_is_frozen(beams):
    rig = looking()
    held = rig.shown[-1]

    def broken(true):
        shown = held.copy()
        shown[:beams] += np.float32(1e-3 * len(rig.shown))
        return shown

    rig.broken = broken
    stopped_by_scan(rig)


@pytest.mark.parametrize("beams", [24, 36, 72])
@pytest.mark.parametrize("flickers", [0, 12])
def test_a_lidar_of_few_beams_that_is_frozen_but_for_one_is_frozen(beams, flickers):
    every = LIDAR.beams // beams
    rig = Looking(config(beam_angles=LIDAR.angles[::every]))
    rig.broken = lambda true: true[::every]
    angles = (LIDAR.angle_min, LIDAR.angle_increment * every)
    rig.scan = lambda: Looking.scan(rig, angles=angles)
    rig.drive()
    held = rig.shown[-1][::every]

    def broken(true):
        shown = held.copy()
        shown[flickers] += np.float32(1e-3 * len(rig.shown))
        return shown

    assert rig.run(2.0).cause is None  # one that lives is fine
    held = rig.shown[-1][::every]
    rig.broken = broken
    stopped_by_scan(rig)


@pytest.mark.parametrize("angle", [0.0, 1.5])
def test_a_frozen_scan_of_a_single_pole_is_frozen(angle):
    rig = looking()
    pole = np.full(LIDAR.beams, np.inf, np.float32)
    pole[np.argsort(np.abs(LIDAR.angles - angle))[:5]] = 1.5
    rig.broken = lambda true: pole
    stopped_by_scan(rig)


def test_between_two_long_walls_a_scan_without_noise_may_stay_the_same():
    rig = looking()
    walls = room(0.0, (np.inf, 0.75))
    walls[walls > LIDAR.range_max] = np.inf
    rig.broken = lambda true: walls
    assert rig.run(6.0).cause is None


class Turning(Rig):
    """A robot that turns in the middle of a round room."""

    def __init__(self):
        super().__init__(config("differential"))
        self.ranges = np.full(LIDAR.beams, 1.0, np.float32)
        self.frozen = True
        self.wish = np.array([0.0, 0.0, 1.0])

    def odom(self, **changes):
        self.pose[2] = (
            np.mod(self.pose[2] + 0.1 * self.moves + np.pi, 2.0 * np.pi) - np.pi
        )
        return super().odom(**changes)


def test_in_the_middle_of_a_round_room_a_scan_may_stay_the_same():
    rig = Turning()
    rig.run(1.5)
    assert rig.arm().granted
    assert rig.run(5.0).cause is None


def test_a_frozen_scan_of_a_corner_is_frozen_for_a_robot_that_turns():
    rig = Turning()
    rig.ranges = room(0.4)
    rig.run(1.5)
    assert rig.arm().granted
    rig.run(0.3)
    stopped_by_scan(rig)


@pytest.mark.slow
@pytest.mark.parametrize("world", ["corridor", "arena", "doorway", "room"])
@pytest.mark.parametrize("quantum", [0.0, 0.01])
def test_no_drive_in_the_simulator_looks_frozen(world, quantum):
    model = builtin_model("differential")
    sim, given = FastSimulator(model, load_world(world)), config("differential")
    sim.reset([3])
    rig = Rig(given)
    rng = np.random.default_rng(0)
    command = np.zeros((1, 1, 2))
    rig.frozen = True
    known = 0

    def sense():
        nonlocal known
        ranges = sim.data.ranges[0, 0]
        if quantum:
            ranges = (np.round(ranges / quantum) * quantum).astype(np.float32)
        rig.pose, rig.ranges = sim.data.odom[0, 0].copy(), ranges.copy()
        known += 1

    for k in range(400):
        if k % 15 == 0:
            command[0, 0] = [rng.choice([0.2, 1.0]), rng.choice([0.0, 0.0, 1.0, -1.0])]
        sim.step(command)
        sense()
        rig.now += PERIOD_S
        rig.stamp += round(PERIOD_S * 1e9)
        rig.odom()
        rig.scan()
        assert not rig.state.frozen
    assert known == 400


def told(rig, speed):
    rig.wish = np.array([speed, 0.0, 0.0])


@pytest.mark.parametrize("phase", range(0, 50, 17))
@pytest.mark.parametrize("speed", [1.0, 0.3, 0.1])
def test_a_robot_that_stops_following_is_stopped_within_a_second_at_any_phase(
    phase, speed
):
    rig = Rig()
    told(rig, speed)
    rig.drive(1.0 + phase * TICK_S)
    rig.speed = 0.0
    assert rig.until_stopped(2.0) <= 1.0 + 2 * TICK_S
    assert rig.rule == "no_motion"
    rig.speed = speed
    rig.run(1.0)
    assert not rig.moves


def test_a_robot_that_never_starts_is_stopped_a_second_after_it_was_told_to():
    rig = Rig()
    rig.run(1.5)
    assert rig.arm().granted
    rig.run(0.04)
    began = rig.now
    while rig.rule != "no_motion":
        rig.run(TICK_S)
        assert rig.now - began < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("lag_s", [0.3, 0.7])
def test_a_robot_that_follows_late_is_not_taken_for_stuck(lag_s):
    rig = Rig(config("mecanum"))
    rig.wish = np.array([0.5, 0.0, 0.0])
    rig.run(1.5)
    assert rig.arm().granted
    late = [0.0] * round(lag_s / TICK_S)
    rng = np.random.default_rng(0)
    for k in range(800):
        if k % 40 == 0:
            rig.wish = np.array([rng.choice([-0.5, 0.0, 0.2, 0.5]), 0.0, 0.0])
        rig.run(TICK_S)
        late.append(float(rig.decision.twist[0]))
        rig.speed = late.pop(0)
        assert rig.decision.cause is None, (k, rig.decision.cause)


@pytest.mark.parametrize("speed", [0.02, 0.04])
def test_a_robot_that_creeps_as_it_is_told_is_fine(speed):
    rig = Rig()
    told(rig, speed)
    rig.drive(5.0)


def test_a_push_after_a_long_pause_has_its_second():
    rig = driving()
    told(rig, 0.0)
    rig.run(0.5)
    rig.speed = 0.0
    rig.run(5.0)
    told(rig, 0.5)
    rig.run(0.9)
    assert rig.decision.cause is None
    rig.run(0.3)
    assert rig.rule == "no_motion"


@pytest.mark.parametrize("leap", [(3.0, 0.0, 0.0), (0.0, -0.6, 0.0), (0.0, 0.0, 2.0)])
def test_odometry_that_teleports_is_refused_and_stops_the_robot_for_good(leap):
    rig = driving()
    rig.pose = rig.pose + np.array(leap)
    rig.until_stopped(0.2)
    assert rig.rule == "odom_jumped"
    rig.speed = 0.0
    rig.run(2.0)
    assert not rig.moves
    assert rig.give(Reset()).granted
    assert rig.arm().granted


def test_a_leap_beyond_all_numbers_is_told_in_a_few_digits():
    rig = driving()
    rig.pose = np.array([1e308, 0.0, 0.0])
    rig.until_stopped(0.2)
    assert rig.rule == "odom_jumped"
    assert re.search(
        r"its pose jumped by 1e\+308 m and 0 rad in", rig.decision.cause.line
    )


@pytest.mark.parametrize("armed", [True, False])
def test_a_simulator_that_is_reset_wants_the_gate_to_be_armed_anew_and_no_more(armed):
    rig = driving()
    if not armed:
        rig.give(Reset())
    rig.speed, rig.pose = 0.0, np.array([5.0, -3.0, 2.0])
    rig.run(1.5)
    assert rig.rule == ("odom_jumped" if armed else "disarmed")
    rig.give(Reset())
    rig.drive()


def test_odometry_may_be_silent_and_have_driven_on_meanwhile():
    rig = driving()
    told(rig, 1.0)
    rig.speed = 1.0
    rig.run(0.32, without="odom")
    assert rig.run(0.4).cause is None


def test_a_pose_beyond_half_a_turn_is_no_leap():
    rig = Turning()
    rig.pose = np.array([0.0, 0.0, np.pi - 0.25])
    rig.run(1.5)
    assert rig.arm().granted
    rig.run(1.0)
    assert rig.pose[2] < 0.0
    assert rig.decision.cause is None
