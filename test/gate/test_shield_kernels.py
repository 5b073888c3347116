"""The sweep of a footprint against a fine one by exact distances, and what approaches it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from nics_drl_bridge import geometry
from nics_drl_bridge.gate.evidence_kernels import (
    MountedBeams,
    Tolerance,
    mark_entered,
)
from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.ground_kernels import Grid, mark_seen
from nics_drl_bridge.gate.shield_kernels import compute_clearance, fill_grid, is_free
from nics_drl_bridge.gate.state import ShieldConfig

BRAKE = 1.5
STEP = 0.005
MARGIN = 0.05
LONG = ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
FORK = ((0.4, 0.2), (0.1, 0.15), (0.1, -0.15), (0.4, -0.2), (-0.2, -0.2), (-0.2, 0.2))


def body(outline, margin=MARGIN):
    radius = 0.2 if not outline else float(np.hypot(*np.array(outline).T).max())
    return get_body(
        ShieldConfig(
            0.2, BRAKE, margin, 0.2, radius, outline=outline, obstacle_speed=0.0
        )
    )


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
    for _ in range(200):
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
        found = is_free(point[None], twist[None], body(outline), blind, BRAKE, STEP)
        assert found == (least > 0.0 or leaves), (outline, point, twist, blind)
        told.append(found)
    assert 10 < sum(told) < len(told) - 10


def test_the_distance_from_an_outline_is_that_of_geometry():
    rng = np.random.default_rng(0)
    for _ in range(50):
        outline = star(rng)
        points = rng.uniform(-0.6, 0.6, (20, 2))
        found = [compute_clearance(x, y, body(outline)) for x, y in points]
        assert found == pytest.approx(signed(outline, points), abs=1e-12)


def test_one_point_among_many_and_one_twist_among_many_are_found():
    many = np.array([[3.0, y, 0.0] for y in np.linspace(-1.0, 1.0, 400)])
    twists = np.array([[0.3, 0.0, turn] for turn in np.linspace(-0.5, 0.5, 20)])
    assert is_free(many, twists, body(LONG), 0.5, BRAKE, STEP)
    many[250] = (0.32, 0.26, 0.0)  # beside the way of all but those that turn left
    assert not is_free(many, twists, body(LONG), 0.5, BRAKE, STEP)
    assert is_free(many, twists[:10], body(LONG), 0.5, BRAKE, STEP)


@pytest.mark.parametrize(("outline", "may"), [(LONG, True), ((), False)])
def test_a_robot_passes_where_its_outline_does_and_its_circle_does_not(outline, may):
    beside = np.array(
        [[x, side, 0.0] for x in np.linspace(0.3, 2.0, 60) for side in (-0.26, 0.26)]
    )
    round_ = get_body(
        ShieldConfig(0.2, BRAKE, MARGIN, 0.2, 0.32, outline=outline, obstacle_speed=0.0)
    )
    assert is_free(beside, np.array([[0.5, 0.0, 0.0]]), round_, 0.5, BRAKE, STEP) == may


@pytest.mark.parametrize(("outline", "may"), [(LONG, False), ((), True)])
def test_a_turn_on_the_spot_sweeps_corners_but_no_circle(outline, may):
    beside = np.array([[0.0, 0.26, 0.0]])
    assert (
        is_free(beside, np.array([[0.0, 0.0, 1.5]]), body(outline), 0.5, BRAKE, STEP)
        == may
    )


@pytest.mark.parametrize("turn", [-1.5, 1.5])
def test_a_turn_brakes_as_its_corners_do(turn):
    """1.5 rad/s moves corners 0.32 m away by 0.48 m/s, for 0.5 s and then 0.32 s of braking."""
    reach = np.hypot(*LONG[0])
    angle = np.arctan2(0.2, 0.25) + 1.5 * (0.5 + 1.5 * reach / (2.0 * BRAKE))
    for further, may in ((0.0, False), (0.3, True)):
        corner = (reach + 0.01) * np.array(
            [np.cos(angle + further), np.sin(angle + further), 0.0]
        )
        there = corner * (1.0, np.sign(turn), 1.0)
        swept = is_free(
            there[None], np.array([[0.0, 0.0, turn]]), body(LONG), 0.5, BRAKE, STEP
        )
        assert swept == may


@pytest.mark.parametrize(("speed", "may"), [(0.3, False), (-0.3, True)])
def test_between_the_tines_a_robot_may_leave_and_not_go_on(speed, may):
    within = np.array([[0.12, 0.0, 0.0]])
    assert (
        is_free(within, np.array([[speed, 0.0, 0.0]]), body(FORK), 0.5, BRAKE, STEP)
        == may
    )


@pytest.mark.parametrize(("speed", "may"), [(0.3, False), (-0.3, True)])
def test_what_noise_puts_inside_the_outline_must_not_get_deeper(speed, may):
    inside = np.array([[0.24, 0.0, 0.0]])
    assert (
        is_free(inside, np.array([[speed, 0.0, 0.0]]), body(LONG), 0.5, BRAKE, STEP)
        == may
    )


def test_a_speed_next_to_nothing_is_swept():
    twist = np.array([[1e-300, 0.0, 0.0]])
    ahead = np.array([[0.29, 0.0, 0.0], [9.0, 0.0, 1e-9]])
    assert is_free(ahead, twist, body(LONG), 0.5, BRAKE, STEP)
    assert is_free(ahead, 0.0 * twist, body(LONG), 0.5, BRAKE, STEP)


def test_a_grid_of_twists_has_both_ends_and_what_lies_evenly_between():
    low = np.array([-0.1, 0.0, -0.7])
    high = np.array([0.5, 0.0, 0.3])
    axes = [np.linspace(*ends) for ends in zip(low, high, (3, 1, 9), strict=True)]
    expected = {(x, y, turn) for x in axes[0] for y in axes[1] for turn in axes[2]}
    assert set(map(tuple, fill_grid(low, high, np.array([3, 1, 9])))) == expected


def test_a_margin_is_kept_around_the_outline():
    ahead = np.array([[0.25 + 0.3, 0.0, 0.0]])
    twist = np.array([[0.3, 0.0, 0.0]])  # 0.15 m, and 0.03 m to brake
    assert is_free(ahead, twist, body(LONG, 0.10), 0.5, BRAKE, STEP)
    assert not is_free(ahead, twist, body(LONG, 0.13), 0.5, BRAKE, STEP)


def test_a_body_is_kept_as_long_as_its_shield_is():
    shield = ShieldConfig(
        0.2, BRAKE, MARGIN, 0.2, 0.32, outline=LONG, obstacle_speed=0.0
    )
    assert get_body(shield) is get_body(replace(shield))
    assert get_body(shield).farthest_corner == pytest.approx(np.hypot(0.25, 0.2))
    assert get_body(replace(shield, outline=())).farthest_corner == 0.0


DEGREE_BEAMS = MountedBeams(np.deg2rad(-20.0), np.deg2rad(1.0), 0.0, 0.0, 0.0)
UNKNOWN_AMONG_OTHERS = [(19,), (20,), (21,), (19, 21)]


@pytest.mark.parametrize("unknown", UNKNOWN_AMONG_OTHERS)
def test_an_unknown_beam_among_far_ones_marks_no_ground_as_free(unknown):
    """A cell of 5 cm at a distance of 1 m is as wide as five of these beams."""
    grid = Grid(0.975, -0.025, 0.05, 1.0, 0.0)  # a single cell, straight ahead

    def see(ranges):
        times = np.full((1, 1), -np.inf, np.float32)
        mark_seen(times, grid, ranges, DEGREE_BEAMS, 10.0, 0.03, 1.0)
        return times[0, 0]

    ranges = np.full(41, 5.0, np.float32)
    assert see(ranges) == 1.0
    ranges[list(unknown)] = np.nan
    assert see(ranges) == -np.inf


@pytest.mark.parametrize("unknown", UNKNOWN_AMONG_OTHERS)
def test_an_unknown_beam_of_an_old_scan_tells_nothing_about_what_moved(unknown):
    new = np.full(41, np.nan, np.float32)
    new[20] = 1.0

    def mark(old):
        entered = np.zeros(41, np.bool_)
        tolerance = Tolerance(0.03, 0.0)
        mark_entered(entered, new, old, DEGREE_BEAMS, np.zeros(3), 10.0, tolerance)
        return entered[20]

    old = np.full(41, 5.0, np.float32)
    assert mark(old)
    old[list(unknown)] = np.nan
    assert not mark(old)
