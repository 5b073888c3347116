from __future__ import annotations

import numpy as np
import pytest
from moving import PERIOD, scattered, sides
from shapely import LineString, MultiLineString, Point

from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import place
from nics_drl_bridge.sim import separation_kernels as at
from nics_drl_bridge.sim.obstacles import NO_DISTANCES, distance_arrays
from nics_drl_bridge.sim.separation_kernels import PLAN, clearance, map_distance, on_wall, restrain

HALF = np.array([1.5, 1.0])
WALLS = np.concatenate([sides(HALF), [(-1.5, 0.2, -0.4, 0.3), (0.5, -1.0, 0.5, -0.2)]])
TOUCH = 1e-9


def crowd(seed, count=5, robots=2):
    """Bodies (K + M, 7) close together in a small field with two inner walls."""
    rng = np.random.default_rng(seed)
    radii = rng.uniform(0.05, 0.25, count + robots)
    places = scattered(radii, HALF, rng, WALLS[4:], free=1e-3)
    poses = np.concatenate([places, np.zeros((count + robots, 1))], axis=1)
    return rng, place(poses, radii, np.zeros(count + robots))


def plans(kinds):
    rows = np.zeros((len(kinds), PLAN))
    rows[:, at.KIND] = kinds
    return rows


@pytest.mark.parametrize("bends", [True, False])
def test_whatever_all_of_them_wish_nothing_touches_at_any_time_of_the_period(bends):
    solid = MultiLineString([wall.reshape(2, 2) for wall in WALLS])
    for seed in range(100):
        rng, bodies = crowd(seed)
        scene, radii = (bodies, WALLS, HALF, NO_DISTANCES), bodies[:, 5]
        rows = plans(rng.integers(0, 4, 5))
        speeds = rng.uniform(-0.3, 0.3, (2, 2))
        wishes = rng.normal(0.0, 0.4, (5, 2)) * (rows[:, at.KIND] != at.STILL)[:, None]
        moved = np.zeros((7, 2))
        for k in range(5):
            moved[k] = restrain(*wishes[k], k, scene, 5, speeds, rows, PERIOD, bends)
            ends = bodies[k, :2], bodies[k, :2] + moved[k]
            assert LineString(ends).distance(solid) > radii[k] - TOUCH
            assert np.linalg.norm(moved[k]) <= np.linalg.norm(wishes[k]) + TOUCH
        for share in (0.3, 0.7, 1.0):
            now = bodies[:, :2] + share * moved
            away = np.linalg.norm(now[:, None] - now, axis=-1) - (radii[:, None] + radii)
            assert away[:5, :5][~np.eye(5, dtype=bool)].min() > -TOUCH


def test_nobody_runs_into_a_robot_that_keeps_its_velocity():
    stopped = 0
    for seed in range(300):
        rng, bodies = crowd(seed, count=1, robots=1)
        towards = rng.uniform(-1.0, 1.0, 2)
        speeds = towards[None] * 0.5
        before = np.linalg.norm(bodies[1, :2] - bodies[0, :2]) - bodies[:, 5].sum()
        wish = (bodies[1, :2] - bodies[0, :2]) * rng.uniform(0.5, 2.0)
        scene = (bodies, WALLS[:0], HALF, NO_DISTANCES)
        moved = restrain(*wish, 0, scene, 1, speeds, plans([at.WANDER]), PERIOD, True)
        after = bodies[1, :2] + speeds[0] * PERIOD - bodies[0, :2] - moved
        gap = np.linalg.norm(after) - bodies[:, 5].sum()
        assert gap > min(0.0, before - np.linalg.norm(speeds) * PERIOD) - TOUCH
        stopped += np.linalg.norm(moved) < 0.99 * np.linalg.norm(wish)
    assert stopped > 200


def test_a_wish_that_nothing_hinders_is_granted_to_the_bit():
    _, bodies = crowd(0, count=1, robots=0)
    bodies[0, :2], bodies[0, 5] = 0.0, 0.1
    wish = 0.0123, -0.0456
    scene = (bodies, sides(HALF), HALF, NO_DISTANCES)
    rows, nobody = plans([at.WANDER]), np.zeros((0, 2))
    for bends in (True, False):
        assert restrain(*wish, 0, scene, 1, nobody, rows, PERIOD, bends) == wish


def test_one_bends_along_a_wall_where_the_other_stops():
    _, bodies = crowd(0, count=1, robots=0)
    bodies[0, :2], bodies[0, 5] = (0.0, 0.9), 0.1
    scene, rows, nobody = (bodies, sides(HALF), HALF, NO_DISTANCES), plans([1]), np.zeros((0, 2))
    x, y = restrain(0.05, 0.05, 0, scene, 1, nobody, rows, PERIOD, True)
    assert x == pytest.approx(0.05)
    assert abs(y) < 1e-12
    assert np.abs(restrain(0.05, 0.05, 0, scene, 1, nobody, rows, PERIOD, False)).max() < 1e-12


@pytest.mark.parametrize("bends", [True, False])
def test_a_field_without_walls_holds_them_too(bends):
    rng, rows, nobody = np.random.default_rng(0), plans([at.WANDER]), np.zeros((0, 2))
    _, bodies = crowd(0, count=1, robots=0)
    bodies[0, 5], reached = 0.1, np.zeros(2)
    for _ in range(300):
        bodies[0, :2] = rng.uniform(-1.0, 1.0, 2) * (HALF - 0.1)
        scene = (bodies, WALLS[:0], HALF, NO_DISTANCES)
        moved = restrain(*rng.normal(0.0, 1.0, 2), 0, scene, 1, nobody, rows, PERIOD, bends)
        reached = np.maximum(reached, np.abs(bodies[0, :2] + moved))
    assert (reached <= HALF - 0.1 + TOUCH).all()
    assert (reached > HALF - 0.11).all()


@pytest.mark.parametrize("bends", [True, False])
@pytest.mark.parametrize("way", [0.05, 0.3, 2.0])
def test_nobody_jumps_through_a_thin_wall_of_a_map(bends, way):
    cells = np.zeros((60, 60), np.int8)
    cells[:, 40] = 100  # 5 cm thick, from x = 0.5 m
    _, bodies = crowd(0, count=1, robots=0)
    bodies[0, :2], bodies[0, 5] = 0.0, 0.2
    thin = distance_arrays(GridMap(cells, 0.05, (-1.5, -1.5, 0.0)))
    scene = (bodies, WALLS[:0], np.full(2, 5.0), thin)
    rows, nobody = plans([at.WANDER]), np.zeros((0, 2))
    for _ in range(20):
        moved = restrain(way, 0.0, 0, scene, 1, nobody, rows, PERIOD, bends)
        bodies[0, :2] += moved
    assert 0.28 < bodies[0, 0] < 0.3 + 1e-3
    assert restrain(-0.1, 0.0, 0, scene, 1, nobody, rows, PERIOD, bends) == (-0.1, 0.0)


def test_what_overlaps_already_may_leave_but_get_no_deeper():
    _, bodies = crowd(0, count=2, robots=0)
    bodies[:, :2], bodies[:, 5] = [(0.0, 0.0), (0.15, 0.0)], 0.1
    scene, nobody = (bodies, WALLS[:0], HALF, NO_DISTANCES), np.zeros((0, 2))
    rows = plans([at.WANDER, at.STILL])
    assert restrain(-0.05, 0.01, 0, scene, 2, nobody, rows, PERIOD, True) == (-0.05, 0.01)
    x, y = restrain(0.05, 0.01, 0, scene, 2, nobody, rows, PERIOD, True)
    assert (x, y) == (0.0, 0.01)


def test_clearance_is_the_distance_to_the_nearest_thing_and_points_at_it():
    for seed in range(50):
        rng, bodies = crowd(seed)
        x, y = rng.uniform(-1.0, 1.0, 2) * HALF
        least, nx, ny = clearance(x, y, 3, (bodies, WALLS, HALF, NO_DISTANCES))
        walls = [LineString(wall.reshape(2, 2)) for wall in WALLS]
        discs = [Point(*body[:2]).buffer(body[5], 256) for k, body in enumerate(bodies) if k != 3]
        spot = Point(x, y)
        if any(disc.contains(spot) for disc in discs):
            continue
        assert least == pytest.approx(
            min(spot.distance(thing) for thing in walls + discs), abs=1e-4
        )
        there = Point(x + least * nx, y + least * ny)
        assert min(there.distance(thing) for thing in walls + discs) < 1e-4
        assert np.hypot(nx, ny) == pytest.approx(1.0)


def test_the_nearest_point_of_a_wall_without_length_is_its_end():
    assert on_wall(3.0, 4.0, np.array([1.0, 2.0, 1.0, 2.0])) == (1.0, 2.0)


def test_the_distance_to_a_map_is_that_of_its_field_in_any_frame():
    cells = np.zeros((30, 40), np.int8)
    cells[10:12, 20:22] = 100
    grid = GridMap(cells, 0.1, (-1.0, 2.0, 0.7))
    arrays = distance_arrays(grid)
    centres = np.stack(np.meshgrid(np.arange(30), np.arange(40), indexing="ij"), axis=-1)
    for cell, (x, y) in zip(
        centres.reshape(-1, 2), grid.cell_to_world(centres).reshape(-1, 2), strict=True
    ):
        assert map_distance(x, y, arrays) == pytest.approx(
            grid.distance_field[tuple(cell)], abs=1e-6
        )


def test_where_there_is_no_map_or_nothing_in_it_the_distance_is_infinite():
    assert map_distance(1.0, 2.0, NO_DISTANCES) == np.inf
    empty = distance_arrays(GridMap(np.zeros((5, 5), np.int8), 0.1))
    assert map_distance(0.2, 0.2, empty) == np.inf
    assert distance_arrays(None) is NO_DISTANCES
