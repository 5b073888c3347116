"""The sweep of a footprint against a fine one by exact distances, and what approaches it."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from nics_drl_bridge import geometry
from nics_drl_bridge.gate.evidence_kernels import (
    MountedBeams,
    Tolerance,
    find_beam,
    mark_agreeing,
    mark_entered,
)
from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.ground_kernels import Grid, mark_seen
from nics_drl_bridge.gate.shield_kernels import Stop, is_free
from nics_drl_bridge.gate.state import ShieldConfig

BRAKE = 1.5
STEP = 0.005
MARGIN = 0.05
LONG = ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
FORK = ((0.4, 0.2), (0.1, 0.15), (0.1, -0.15), (0.4, -0.2), (-0.2, -0.2), (-0.2, 0.2))


def stop(outline, blind=0.5):
    radius = 0.2 if not outline else float(np.hypot(*np.array(outline).T).max())
    shield = ShieldConfig(
        0.2, BRAKE, MARGIN, 0.2, radius, outline=outline, obstacle_speed=0.0
    )
    return Stop(get_body(shield), 0.0, 0.0, blind, BRAKE)


def star(rng):
    """A random outline, convex or not, anywhere near the robot's middle."""
    angles = np.sort(rng.uniform(-np.pi, np.pi, rng.integers(3, 9)))
    radii = rng.uniform(0.1, 0.4, len(angles))
    corners = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return tuple(map(tuple, corners + rng.uniform(-0.1, 0.1, 2)))


def signed(outline, points):
    """Distances of points (T, 2) from an outline, negative inside; of a circle without corners."""
    if not outline:
        return np.hypot(*points.T) - 0.2
    shape = shapely.Polygon(outline)
    made = shapely.points(points)
    away = shapely.distance(shape.exterior, made)
    return np.where(shapely.contains(shape, made), -away, away)


def nearest(outline, point, twist, blind):
    """Least of what is left of the distance that is to be kept, over a fine sweep; and that now."""
    reach = max((np.hypot(*corner) for corner in outline), default=0.0)
    pace = max(np.hypot(*twist[:2]), abs(twist[2]) * reach)
    times = np.linspace(0.0, blind + pace / BRAKE, 800)
    braking = np.maximum(times - blind, 0.0)
    part = np.minimum(times, blind) + braking - braking**2 * BRAKE / (2.0 * pace)
    poses = geometry.exp(part[:, None] * twist)
    places = geometry.rotate(point[:2] - poses[:, :2], -poses[:, 2])
    away = signed(outline, places)
    return (away - min(MARGIN, away[0]) - point[2] * times).min(), away[0]


@pytest.mark.slow
@pytest.mark.parametrize("make", [star, lambda _: LONG, lambda _: FORK, lambda _: ()])
@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_the_sweep_is_that_of_a_fine_one_by_exact_distances(make, speed):
    rng = np.random.default_rng(3)
    told = []
    for _ in range(120):
        outline = make(rng)
        twist = rng.uniform(-1.0, 1.0, 3) * rng.choice(
            [(1, 0, 2), (1, 1, 2), (0, 0, 2), (1, 0, 0)]
        )
        twist[:2] += 0.0 if outline else 0.05  # a turn alone does not move a circle
        blind = rng.uniform(0.1, 0.6)
        point = np.array([*rng.uniform(-0.7, 0.7, 2), speed])
        least, now = nearest(outline, point, twist, blind)
        leaves = now < MARGIN and least > -1e-12
        if abs(least) < STEP and not leaves:
            continue
        found = is_free(point[None], twist[None], stop(outline, blind), STEP)
        assert found == (least > 0.0 or leaves), (outline, point, twist, blind)
        told.append(found)
    assert 5 < sum(told) < len(told) - 5


@pytest.mark.parametrize(
    ("outline", "point", "twist", "may"),
    [
        (LONG, (1.0, 0.26), (0.5, 0.0, 0.0), True),  # passes beside it
        ((), (0.45, 0.1), (0.5, 0.0, 0.0), False),
        (LONG, (0.0, 0.26), (0.0, 0.0, 1.5), False),  # its corners sweep that
        ((), (0.0, 0.26), (0.0, 0.0, 1.5), True),
        (LONG, (0.54, 0.0), (0.3, 0.0, 0.0), True),  # 0.15 m, and 0.03 m to brake
        (LONG, (0.47, 0.0), (0.3, 0.0, 0.0), False),
        (FORK, (0.12, 0.0), (0.3, 0.0, 0.0), False),  # between the tines
        (FORK, (0.12, 0.0), (-0.3, 0.0, 0.0), True),
        (LONG, (0.24, 0.0), (0.3, 0.0, 0.0), False),  # inside, by noise
        (LONG, (0.24, 0.0), (-0.3, 0.0, 0.0), True),
        ((), (0.22, 0.02), (0.3, 0.0, 0.0), False),  # in the margin
        ((), (0.22, 0.02), (-0.3, 0.0, 0.0), True),
    ],
)
def test_a_robot_may_leave_what_is_near_and_not_come_nearer(outline, point, twist, may):
    obstacles = np.array([[*point, 0.0]])
    found = is_free(obstacles, np.array([twist]), stop(outline), STEP)
    assert found == may


@pytest.mark.parametrize(("away", "may"), [(0.3, False), (0.6, False), (1.5, True)])
def test_who_catches_up_from_behind_finds_the_robot_at_rest(away, may):
    """At 0.3 m/s it is no faster than who comes on, and would be met in motion."""
    twists = np.array([[0.3, 0.0, 0.0]])
    for speed in (1.0, 0.0):
        behind = np.array([[-away, 0.1, speed]])
        found = is_free(behind, twists, stop(()), 0.02)
        assert found == (may or speed == 0.0)


@pytest.mark.parametrize("speed", [1e-300, 0.0])
def test_a_speed_next_to_nothing_is_swept(speed):
    twist = np.array([[speed, 0.0, 0.0]])
    ahead = np.array([[0.29, 0.0, 0.0], [9.0, 0.0, 1e-9]])
    assert is_free(ahead, twist, stop(LONG), STEP)


@pytest.mark.parametrize("unknown", [(), (19,), (20,), (21,), (19, 21)])
def test_an_unknown_beam_shows_no_free_ground_now_or_before(unknown):
    """A cell of 5 cm at a distance of 1 m is as wide as five of these beams."""
    lidar = MountedBeams(np.deg2rad(-20.0), np.deg2rad(1.0), 0.0, 0.0, 0.0)
    ranges = np.full(41, 5.0, np.float32)
    ranges[list(unknown)] = np.nan
    times = np.full((1, 1), -np.inf, np.float32)
    grid = Grid(0.975, -0.025, 0.05, 1.0, 0.0)  # a single cell, straight ahead
    mark_seen(times, grid, ranges, lidar, 10.0, 0.03, 1.0)
    assert (times[0, 0] == 1.0) == (not unknown)
    new = np.full(41, np.nan, np.float32)
    new[20] = 1.0
    entered = np.zeros(41, np.bool_)
    tolerance = Tolerance(0.03, 0.0)
    mark_entered(entered, new, ranges, lidar, np.zeros(3), 10.0, tolerance)
    assert entered[20] == (not unknown)


def test_what_ends_beside_the_view_of_the_old_scan_did_not_enter_it():
    """The robot has turned around; what lies in memory behind the old scan is far away."""
    lidar = MountedBeams(np.deg2rad(-20.0), np.deg2rad(1.0), 0.0, 0.0, 0.0)
    behind = np.full(400, 9.0, np.float32)
    old = behind[:41]
    new = np.full(41, 1.0, np.float32)
    entered = np.zeros(41, np.bool_)
    tolerance = Tolerance(0.03, 0.0)
    mark_entered(entered, new, old, lidar, np.array([0.0, 0.0, np.pi]), 10.0, tolerance)
    assert not entered.any()


@pytest.mark.parametrize("step", [np.pi / 180, -np.pi / 180])
@pytest.mark.parametrize("heading", [0.0, 2.5, -2.5])
def test_a_point_belongs_to_the_beam_towards_it_whatever_the_mount(step, heading):
    lidar = MountedBeams(-2.0 * np.sign(step), step, 0.2, -0.1, heading)
    for beam in range(360):
        for off in (-0.49, 0.49):
            angle = lidar.first + (beam + off) * step + heading
            x = lidar.x + 3.0 * np.cos(angle)
            y = lidar.y + 3.0 * np.sin(angle)
            assert find_beam(x, y, lidar) == beam


@pytest.mark.parametrize(
    ("twist", "tolerance", "agrees"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0), True),
        ((0.25, 0.0, 0.0), (0.25, 0.0), True),  # at the tolerance
        ((0.25, 0.0, 0.0), (0.1875, 0.0), False),
        ((0.25, 0.0, 0.0), (0.0, 0.25), True),
        ((0.25, 0.0, 0.0), (0.0, 0.125), False),
        ((0.0, 0.0, np.pi / 2), (0.25, 0.0), False),
    ],
)
def test_a_beam_agrees_if_it_ends_where_the_old_scan_did(twist, tolerance, agrees):
    """Four beams, of which the first looks ahead; every second one is compared."""
    lidar = MountedBeams(0.0, np.pi / 2, 0.0, 0.0, 0.0)
    ranges = np.array([1.0, 9.0, np.inf, 9.0], np.float32)
    old = np.array([1.0, 2.0, 1.0, 2.0], np.float32)
    agreeing = np.ones((1, 2), np.bool_)
    motions = np.array([twist])
    mark_agreeing(agreeing, ranges, old, lidar, motions, Tolerance(*tolerance), 2)
    assert agreeing.tolist() == [[agrees, False]]
