from __future__ import annotations

import numpy as np
import pytest

from gate.rig import LIDAR, TICK_S, Rig, config, driving
from nics_drl_bridge.gate.frozen import is_at_rest, watch_motion, watch_pictures
from nics_drl_bridge.gate.inputs import Odometry, Reset
from nics_drl_bridge.gate.state import Sameness, begin, replace


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


def assert_frozen(rig):
    rig.until_stopped(4.0)
    assert rig.rule == "scan_frozen"


@pytest.mark.parametrize(("count", "flickering"), [(1, 0), (2, 5), (10, 0)])
def test_a_lidar_that_shows_a_few_pictures_in_turn_is_frozen(count, flickering):
    rig = Looking().drive()
    assert rig.run(3.0).cause is None
    pictures = rig.shown[-count:]

    def broken(true):
        shown = pictures[len(rig.shown) % count].copy()
        shown[:flickering] += np.float32(1e-3 * len(rig.shown))
        return shown

    rig.broken = broken
    assert_frozen(rig)


@pytest.mark.parametrize(("beams", "flickers"), [(24, 12), (36, 0)])
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
    assert_frozen(rig)


@pytest.mark.parametrize(
    ("angle", "beams", "count", "words"),
    [
        (0.0, 5, 2, "3 scans are the same over a motion of 0.30 m or rad"),
        (1.5, 3, 2, "3 scans are the same over a motion of 0.30 m or rad"),
        (1.5, 2, 2, ""),
        (0.0, 5, 1, ""),
    ],
)
def test_a_third_scan_of_a_single_pole_is_frozen_if_three_beams_must_change(
    angle, beams, count, words
):
    pole = np.full(LIDAR.beams, np.inf, np.float32)
    pole[np.argsort(np.abs(LIDAR.angles - angle))[:beams]] = 1.5
    seen = (Sameness(pole, count, np.zeros(3)),)
    moved = np.array([0.3, 0.0, 0.0])
    (picture,), fault = watch_pictures(config(), seen, pole, moved)
    assert (picture.count, fault) == (count + 1 if words or count == 1 else 1, words)


def test_a_picture_counts_from_the_third_time_it_is_shown_and_once_there_is_odometry():
    rig = Looking()
    rig.broken = lambda true: room(0.0)
    rig.run(0.5, without="odom")
    assert rig.state.frozen == ""
    rig.broken = None
    rig.drive()
    picture = rig.shown[-1]
    rig.run(0.6)
    for stopped in (False, True):  # for the second time, and for the third
        rig.broken = lambda true: picture
        rig.run(0.1)
        rig.broken = None
        assert (rig.rule == "scan_frozen") == stopped


@pytest.mark.parametrize(("speed", "turn"), [(0.05, 0.0), (0.0, 0.1)])
def test_a_robot_rests_below_its_bounds_and_not_at_them(speed, turn):
    twist = np.array([speed, 0.0, turn])
    assert not is_at_rest(config(), twist)
    assert is_at_rest(config(), 0.999 * twist)
    assert is_at_rest(config(odom_std=(0.01, 0.01)), twist)


def test_between_two_long_walls_a_scan_without_noise_may_stay_the_same():
    rig = Looking().drive()
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


def test_a_frozen_scan_of_a_corner_is_frozen_for_a_robot_that_turns():
    rig = Turning()
    rig.ranges = room(0.4)
    rig.settle()
    rig.run(0.3)
    assert_frozen(rig)


@pytest.mark.parametrize(("phase", "speed"), [(0, 1.0), (17, 0.1)])
def test_a_robot_that_stops_following_is_stopped_within_a_second_at_any_phase(
    phase, speed
):
    rig = Rig()
    rig.wish = np.array([speed, 0.0, 0.0])
    rig.drive(1.0 + phase * TICK_S)
    rig.speed = 0.0
    assert rig.until_stopped(2.0) <= 1.0 + 2 * TICK_S
    assert rig.rule == "no_motion"
    assert rig.state.latched is not None


def test_a_robot_that_creeps_as_it_is_told_is_fine():
    rig = Rig()
    rig.wish = np.array([0.04, 0.0, 0.0])
    assert rig.drive(5.0).moves


def test_a_push_after_a_long_pause_has_its_second():
    rig = driving()
    rig.wish = np.array([0.0, 0.0, 0.0])
    rig.run(0.5)
    rig.speed = 0.0
    rig.run(5.0)
    rig.wish = np.array([0.5, 0.0, 0.0])
    rig.run(0.9)
    assert rig.decision.cause is None
    rig.run(0.3)
    assert rig.rule == "no_motion"


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
    rig.wish = np.array([1.0, 0.0, 0.0])
    rig.speed = 1.0
    rig.run(0.32, without="odom")
    assert rig.run(0.4).cause is None


def test_a_pose_beyond_half_a_turn_is_no_leap():
    rig = Turning()
    rig.pose = np.array([0.0, 0.0, np.pi - 0.25])
    rig.settle()
    rig.run(1.0)
    assert rig.pose[2] < 0.0
    assert rig.decision.cause is None


def test_without_odometry_or_limits_no_motion_is_watched():
    state = begin(config())
    seen = replace(state, odometry=Odometry(0, np.zeros(3), np.zeros(3)))
    assert watch_motion(config(), state, 1.0) is state
    assert watch_motion(config(limits=None), seen, 1.0) is seen
