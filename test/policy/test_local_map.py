"""What planners see: distances from the outline, and the way to the goal around obstacles."""

from __future__ import annotations

import math
import tracemalloc
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from shapely.geometry import Point, Polygon
from shapely.prepared import prep

from nics_drl_bridge.env.task import Sight
from nics_drl_bridge.geometry import compute_depths
from nics_drl_bridge.policy.planners.local_map import (
    CELL_M,
    fill_outline,
    make_situation,
)
from nics_drl_bridge.policy.planners.local_map_kernels import (
    Clearance,
    find_contact_limit,
    find_room,
    find_way,
    map_scan,
    score_heading,
)
from nics_drl_bridge.robot.spec import build_robot, load_robot

CLOSE = Clearance(margin=0.05, soft=0.3)
GOAL = np.array([3.0, 0.0])
ROBOTS = ("differential", "tricycle")


@cache
def outline_of(robot):
    return fill_outline(load_robot(robot))


def map_rays(shares, directions, origin, robot="jackal", goal=GOAL):
    """The map of a scan with these rays, as fractions of 10 m."""
    sight = Sight(np.arctan2(*np.transpose(directions)[::-1]), np.array(origin), 10.0)
    task = SimpleNamespace(sight=sight, scan_parts=len(shares))
    around = make_situation(task, outline_of(robot), CLOSE, 3.0)
    map_scan(shares, goal, around)
    return around


def seen(points, robot="jackal"):
    """What a robot knows whose scan ends at points (P, 2)."""
    at = np.asarray(points, np.float64).reshape(-1, 2)
    return map_rays(np.linalg.norm(at, axis=1) / 10.0, at, (0.0, 0.0), robot)


def footprint(robot):
    spec = load_robot(robot)
    if spec.footprint is None:
        return Point(0.0, 0.0).buffer(spec.footprint_radius, quad_segs=64)
    return Polygon(spec.footprint)


def wall(x, low, high):
    return np.stack([np.full(200, x), np.linspace(low, high, 200)], axis=-1)


def test_depths_are_distances_to_the_border_and_negative_outside():
    # not convex
    shape = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 0.4], [0.0, 1.0]])
    points = np.random.default_rng(0).uniform(-1.0, 3.0, (300, 2))
    exact = Polygon(shape).exterior
    inside = prep(Polygon(shape))
    for point, depth in zip(points, compute_depths(points, shape), strict=True):
        assert abs(depth) == pytest.approx(exact.distance(Point(point)))
        assert (depth > 0.0) == inside.contains(Point(point))


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.slow
def test_room_is_the_distance_from_the_outline_up_to_a_cell(robot):
    rng = np.random.default_rng(1)
    shape = footprint(robot)
    for _ in range(200):
        x, y, heading = rng.uniform([-0.5, -0.5, -3.0], [0.5, 0.5, 3.0])
        c = math.cos(heading)
        s = math.sin(heading)
        ahead, left = rng.uniform(-0.5, 0.5, 2)
        hit = np.array([[x + c * ahead - s * left, y + s * ahead + c * left]])
        if np.linalg.norm(hit) < 1e-3:
            continue
        room = find_room(x, y, c, s, seen(hit, robot))
        exact = shape.exterior.distance(Point(ahead, left))
        if shape.contains(Point(ahead, left)):
            assert room < CELL_M
            assert exact < 2.0 * CELL_M or room < 0.0
        elif exact < CLOSE.margin + CLOSE.soft:
            assert room == pytest.approx(exact, abs=0.7 * CELL_M)
        else:
            assert room > CLOSE.margin + CLOSE.soft - CELL_M


def box(length, width):
    """A robot with a rectangular footprint."""
    x = length / 2.0
    y = width / 2.0
    corners = [[x, y], [-x, y], [-x, -y], [x, -y]]
    return build_robot({"name": "box", "kind": "differential", "footprint": corners})


@pytest.mark.parametrize(("length", "width"), [(0.6, 0.4), (6.0, 3.0)])
def test_the_discs_of_a_large_footprint_take_little_memory_and_leave_little_out(
    length, width
):
    tracemalloc.start()
    outline = fill_outline(box(length, width))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 30e6
    rng = np.random.default_rng(0)
    half = np.array([length, width]) / 2.0
    points = rng.uniform(-half, half, (2000, 2))
    apart = (
        np.linalg.norm(points[:, None] - outline.discs[:, :2], axis=-1)
        - outline.discs[:, 2]
    )
    assert apart.min(axis=1).max() < CELL_M
    assert (np.abs(outline.discs[:, :2]) + outline.discs[:, 2:] <= half + 1e-9).all()


def test_a_robot_that_is_too_near_already_may_only_move_away():
    around = seen([[0.254 + 0.02, 0.0]])
    assert find_contact_limit(around) == pytest.approx(
        find_room(0.0, 0.0, 1.0, 0.0, around), abs=2e-3
    )
    assert find_room(0.1, 0.0, 1.0, 0.0, around) < find_contact_limit(around)
    assert find_room(-0.1, 0.0, 1.0, 0.0, around) > find_contact_limit(around)
    assert find_contact_limit(seen([[2.0, 0.0]])) == CLOSE.margin


def test_the_way_in_the_open_is_straight_and_leads_around_a_wall():
    free = seen([[0.0, 9.0]])
    blocked = seen(wall(1.5, -1.2, 1.2))
    assert find_way(0.0, 0.0, free) == pytest.approx(3.0, rel=0.05)
    around = 2.0 * math.hypot(1.5, 1.2 + 0.215)
    assert around < find_way(0.0, 0.0, blocked) < 2.0 * around
    assert find_way(2.5, 0.0, blocked) < 1.0


def test_a_gap_too_narrow_for_the_robot_costs_more_than_the_way_around():
    narrow, wide = (
        seen(np.concatenate([wall(1.5, -1.0, -half), wall(1.5, half, 1.0)]))
        for half in (0.2, 0.5)
    )
    assert find_way(0.0, 0.0, wide) < find_way(0.0, 0.0, narrow) - 0.5


def test_a_heading_along_the_way_is_not_astray_and_the_other_way_is():
    around = seen([[0.0, 9.0]])
    way = find_way(0.0, 0.0, around)
    along, aside, against = (
        score_heading(0.0, 0.0, math.cos(a), math.sin(a), way, around)
        for a in (0.0, math.pi / 2, math.pi)
    )
    assert along < 0.1 < aside < 0.9 < against


def test_unknown_shares_and_those_without_a_return_are_no_obstacles():
    for share, free in ((0.0, True), (1.0, True), (0.015, False)):
        around = map_rays(np.full(3, share), [[1.0, 0.0]] * 3, (0.12, 0.0))
        assert (find_contact_limit(around) == CLOSE.margin) == free
