from __future__ import annotations

import numpy as np
import pytest
from moving import PERIOD, scattered, sides
from shapely import LineString, MultiLineString, Point

from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import place
from nics_drl_bridge.sim import obstacle_kernels as at
from nics_drl_bridge.sim.obstacle_kernels import (
    Traffic,
    clearance,
    map_distance,
    restrain,
)
from nics_drl_bridge.sim.simulator import map_field
from nics_drl_bridge.sim.state import NO_FIELD, PLAN

HALF = np.array([1.5, 1.0])
WALLS = np.concatenate([sides(HALF), [(-1.5, 0.2, -0.4, 0.3), (0.5, -1.0, 0.5, -0.2)]])
NOBODY = np.zeros((0, 2))
TOUCH = 1e-9


def crowd(seed, count=5, robots=2):
    """Bodies (K + M, 7) close together in a small field with two inner walls."""
    rng = np.random.default_rng(seed)
    radii = rng.uniform(0.05, 0.25, count + robots)
    places = scattered(radii, HALF, rng, WALLS[4:], free=1e-3)
    poses = np.concatenate([places, np.zeros((count + robots, 1))], axis=1)
    return rng, place(poses, radii, np.zeros(count + robots))


def traffic(bodies, kinds, speeds=NOBODY, walls=WALLS, half=HALF, grid=NO_FIELD):
    """Obstacles that move by some kinds of motion, then robots with some speeds (M, 2)."""
    plans = np.zeros(len(kinds), PLAN)
    plans["kind"] = kinds
    field = np.concatenate([-half, half])
    return Traffic(bodies, len(kinds), speeds, plans, walls, field, grid, PERIOD)


@pytest.mark.parametrize("bends", [True, False])
def test_whatever_all_of_them_wish_nothing_touches_at_any_time_of_the_period(bends):
    solid = MultiLineString([wall.reshape(2, 2) for wall in WALLS])
    for seed in range(60):
        rng, bodies = crowd(seed)
        kinds = rng.integers(0, 3, 5)
        radii = bodies[:, 5]
        around = traffic(bodies, kinds, rng.uniform(-0.3, 0.3, (2, 2)))
        wishes = rng.normal(0.0, 0.4, (5, 2)) * (kinds != at.STILL)[:, None]
        moved = np.zeros((7, 2))
        for k in range(5):
            moved[k] = restrain(*wishes[k], k, around, bends)
            ends = bodies[k, :2], bodies[k, :2] + moved[k]
            assert LineString(ends).distance(solid) > radii[k] - TOUCH
            assert np.linalg.norm(moved[k]) <= np.linalg.norm(wishes[k]) + TOUCH
        for share in (0.3, 0.7, 1.0):
            now = bodies[:, :2] + share * moved
            away = np.linalg.norm(now[:, None] - now, axis=-1)
            away -= radii[:, None] + radii
            assert away[:5, :5][~np.eye(5, dtype=bool)].min() > -TOUCH


def test_nobody_runs_into_a_robot_that_keeps_its_velocity():
    stopped = 0
    for seed in range(150):
        rng, bodies = crowd(seed, count=1, robots=1)
        towards = rng.uniform(-1.0, 1.0, 2)
        speeds = towards[None] * 0.5
        before = np.linalg.norm(bodies[1, :2] - bodies[0, :2]) - bodies[:, 5].sum()
        wish = (bodies[1, :2] - bodies[0, :2]) * rng.uniform(0.5, 2.0)
        around = traffic(bodies, [at.PEDESTRIAN], speeds, WALLS[:0])
        moved = restrain(*wish, 0, around, True)
        after = bodies[1, :2] + speeds[0] * PERIOD - bodies[0, :2] - moved
        gap = np.linalg.norm(after) - bodies[:, 5].sum()
        assert gap > min(0.0, before - np.linalg.norm(speeds) * PERIOD) - TOUCH
        stopped += np.linalg.norm(moved) < 0.99 * np.linalg.norm(wish)
    assert stopped > 100


def test_one_bends_along_a_wall_where_the_other_stops():
    _, bodies = crowd(0, count=1, robots=0)
    bodies[0, :2] = (0.0, 0.9)
    bodies[0, 5] = 0.1
    around = traffic(bodies, [at.PEDESTRIAN], walls=sides(HALF))
    x, y = restrain(0.05, 0.05, 0, around, True)
    assert x == pytest.approx(0.05)
    assert abs(y) < 1e-12
    assert np.abs(restrain(0.05, 0.05, 0, around, False)).max() < 1e-12


@pytest.mark.parametrize("bends", [True, False])
@pytest.mark.parametrize("way", [0.05, 0.3, 2.0])
def test_nobody_jumps_through_a_thin_wall_of_a_map(bends, way):
    cells = np.zeros((60, 60), np.int8)
    cells[:, 40] = 100  # 5 cm thick, from x = 0.5 m
    thin = map_field(GridMap(cells, 0.05, (-1.5, -1.5, 0.0)))
    body = place([[0.0, 0.0, 0.0]], [0.2], [0])
    around = traffic(body, [at.PEDESTRIAN], NOBODY, WALLS[:0], np.full(2, 5.0), thin)
    for _ in range(20):
        body[0, :2] += restrain(way, 0.0, 0, around, bends)
    assert 0.28 < body[0, 0] < 0.3 + 1e-3
    assert restrain(-0.1, 0.0, 0, around, bends) == (-0.1, 0.0)


def test_what_overlaps_already_may_leave_but_get_no_deeper():
    _, bodies = crowd(0, count=2, robots=0)
    bodies[:, :2] = [(0.0, 0.0), (0.15, 0.0)]
    bodies[:, 5] = 0.1
    around = traffic(bodies, [at.PEDESTRIAN, at.STILL], walls=WALLS[:0])
    assert restrain(-0.05, 0.01, 0, around, True) == (-0.05, 0.01)
    x, y = restrain(0.05, 0.01, 0, around, True)
    assert (x, y) == (0.0, 0.01)


def test_clearance_is_the_distance_to_the_nearest_thing():
    lines = MultiLineString([wall.reshape(2, 2) for wall in WALLS])
    for seed in range(50):
        rng, bodies = crowd(seed)
        spot = rng.uniform(-1.0, 1.0, 2) * HALF
        away = np.linalg.norm(bodies[:, :2] - spot, axis=1) - bodies[:, 5]
        expected = min(Point(spot).distance(lines), np.delete(away, 3).min())
        if expected > 0.0:
            found = clearance(*spot, 3, traffic(bodies, [at.PEDESTRIAN] * 5))
            assert found == pytest.approx(expected)


def test_the_distance_to_a_map_is_that_of_its_field_in_any_frame():
    cells = np.zeros((30, 40), np.int8)
    cells[10:12, 20:22] = 100
    grid = GridMap(cells, 0.1, (-1.0, 2.0, 0.7))
    arrays = map_field(grid)
    centres = grid.cell_to_world(np.argwhere(cells > -1))
    found = [map_distance(x, y, arrays) for x, y in centres]
    assert found == pytest.approx(grid.distance_field.ravel(), abs=1e-6)


def test_where_there_is_no_map_or_nothing_in_it_the_distance_is_infinite():
    assert map_distance(1.0, 2.0, NO_FIELD) == np.inf
    empty = map_field(GridMap(np.zeros((5, 5), np.int8), 0.1))
    assert map_distance(0.2, 0.2, empty) == np.inf
    assert map_field(None) is NO_FIELD
