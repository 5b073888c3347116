from __future__ import annotations

import numpy as np
import pytest
from lidar_scenes import (
    POLYGONS,
    Scene,
    by_plane_geometry,
    poses_around,
    random_scene,
    random_shapes,
    ring,
)
from robots import lidar

from nics_drl_bridge.errors import ConfigError, ModelError
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.scan_kernels import MOST_FOUND
from nics_drl_bridge.lidar.scanner import RENDERERS, Scanner, make_scanner
from nics_drl_bridge.lidar.shapes import SQUARE, STRIP, Circle, Polygon, Rectangle
from nics_drl_bridge.lidar.table import Density

HALF = np.pi / 2.0
COARSE = Density(distances=3, rotations=1)
HERE = np.zeros((1, 3))
DISC = Circle(radius=0.25)
SENSORS = {
    "full circle": lidar(beams=90),
    "over the seam": lidar(beams=61, angle_min=HALF, angle_max=3.0 * HALF),
    "half, off-centre": lidar(
        beams=45, angle_min=-HALF, angle_max=HALF, mount=(-0.3, 0.1, 3.0)
    ),
    "short": lidar(beams=90, range_min=0.4, range_max=1.2),
}


def scan(scanner, scene):
    bodies = scanner.place(scene.shapes, scene.poses)
    return scanner.scan(scene.robot, bodies, scene.walls)[0]


def both_ways(spec, table, shapes, poses):
    """Scans (N, B) of shapes (K,) at poses (N, K, 3), looked up and exact."""
    ways = [Scanner(spec, table, way) for way in ("baked", "exact")]
    return [
        way.scan(np.zeros((len(poses), 3)), way.place(shapes, poses)) for way in ways
    ]


def finite(ranges, spec):
    """Ranges as distances: none is the limit, too close is 0."""
    return np.nan_to_num(ranges, posinf=spec.range_max, neginf=0.0)


def rmse(spec, one, other):
    return np.sqrt(np.square(finite(one, spec) - finite(other, spec)).mean())


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_exact_scans_of_random_scenes_agree_with_plane_geometry(name):
    spec = SENSORS[name]
    compared = 0
    for seed in range(0, 24, 2):
        if seed % 12 == 0:
            shapes = random_shapes(seed)
            scanner = make_scanner(spec, shapes, "exact")
        scene = random_scene(seed, shapes, far=1e4 if seed % 3 == 0 else 0.0)
        expected, clear = by_plane_geometry(spec, scene)
        found = scan(scanner, scene)
        assert found[clear] == pytest.approx(expected[clear], abs=1e-3), seed
        compared += np.isfinite(expected[clear]).sum()
    assert compared > 2 * spec.beams


@pytest.mark.slow
def test_a_lidar_inside_or_beside_any_shape_sees_what_plane_geometry_says():
    spec = lidar(beams=90, range_min=0.0)
    for seed in range(24):
        rng = np.random.default_rng(seed)
        shape = (*random_shapes(seed), ring(rng, 40))[seed % 12]
        scanner = Scanner(spec, bake(spec, [shape], COARSE), "baked")
        pose = poses_around(rng, rng.uniform(0.0, 0.999, 1) * shape.radius)
        scene = Scene(np.array([0.0, 0.0, 0.5]), (shape,), pose, np.zeros((0, 4)))
        expected, clear = by_plane_geometry(spec, scene)
        found = scan(scanner, scene)
        assert found[clear] == pytest.approx(expected[clear], abs=1e-3), seed


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_baked_scans_of_random_scenes_are_near_the_exact_ones(name):
    spec = SENSORS[name]
    table = bake(spec, random_shapes(0)[::2], Density())
    scenes = [random_scene(seed, table.shapes) for seed in range(30)]
    baked, exact = (
        np.array([scan(Scanner(spec, table, way), scene) for scene in scenes])
        for way in ("baked", "exact")
    )
    returns = np.isfinite(exact).sum()
    # The wider the beams, the coarser the points of a row.
    steps = (spec.angle_increment >= 0.01) + (spec.angle_increment >= 0.2)
    assert rmse(spec, baked, exact) < 0.01 + 0.02 * steps
    assert (np.isinf(baked) != np.isinf(exact)).sum() <= 2 + 0.015 * returns
    assert not np.isnan(baked).any()
    assert returns > 0.1 * exact.size


@pytest.mark.slow
@pytest.mark.parametrize("make", POLYGONS)
def test_silhouettes_of_any_polygon_are_exact_at_any_density(make):
    spec = lidar(beams=360, range_min=0.0)
    shape = make(np.random.default_rng(8), 8)
    rng = np.random.default_rng(1)
    # From touching on; not so far that the limit of range decides instead of the silhouette.
    away = shape.radius * (1.0 + 1e-9) + rng.uniform(0.0, 1.0, (300, 1)) ** 3 * 1.5
    table = bake(spec, [shape], Density(distances=20, rotations=24))
    seen, truly = np.isfinite(both_ways(spec, table, [shape], poses_around(rng, away)))
    assert (seen != truly).mean() < 2e-5
    assert truly.any()


def test_few_beams_are_baked_as_finely_as_many():
    spec = lidar(beams=36)
    rng = np.random.default_rng(0)
    area = rng.uniform(STRIP.radius**2, (spec.range_max + STRIP.radius) ** 2, (200, 10))
    poses = poses_around(rng, np.sqrt(area))
    coarse, fine = (
        rmse(spec, *both_ways(spec, bake(spec, [STRIP], density), [STRIP] * 10, poses))
        for density in (Density(phases=1), None)
    )
    assert fine < min(0.05, 0.9 * coarse)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_ranges_beyond_the_limits_are_infinite_with_the_sign_of_rep_117(renderer):
    spec = lidar(beams=4, range_min=0.5, range_max=2.0)
    scanner = make_scanner(spec, [DISC], renderer)
    #        behind (beam 0)  right           ahead           left
    poses = [(-0.6, 0.0, 0.0), (0.0, -2.2, 1.0), (2.3, 0.0, 2.0), (0.0, 0.8, 3.0)]
    ranges = scanner.scan(HERE, scanner.place([DISC] * 4, poses))[0]
    assert ranges[[0, 2]].tolist() == [-np.inf, np.inf]
    assert ranges[[1, 3]] == pytest.approx([1.95, 0.55], abs=1e-4)


def test_a_wall_in_line_with_the_lidar_hides_nothing():
    scanner = make_scanner(lidar(beams=360, range_max=10.0), ())
    assert np.isinf(scanner.scan(HERE, [], [[1.0, 0.0, 2.0, 0.0]])).all()
    near = [-0.19583694396573836, -4.404163056034261]
    far = [-1.8221825406947976, -2.7778174593052025]
    seen = scanner.scan([-2.6, -2.0, -np.pi], [], [[*near, *far]])
    assert np.isposinf(seen).all()  # but for rounding in line


def test_a_wall_met_at_a_flat_angle_is_as_exact_as_another():
    scanner = make_scanner(lidar(beams=40, range_max=25.0), ())
    rng = np.random.default_rng(1)
    for beam in range(40):
        along = rng.uniform(-3.0, 3.0)
        off = rng.uniform(0.01, 0.2)
        heading = along + np.arcsin(off / 20.0) - scanner.spec.angles[beam]
        c, s = np.cos(along), np.sin(along)
        ends = np.array([[-50.0, off], [50.0, off]]) @ [[c, s], [-s, c]]
        seen = scanner.scan([0.0, 0.0, heading], [], [ends.ravel()])[0]
        assert seen[beam] == pytest.approx(20.0, abs=2e-5)


def test_a_closed_room_returns_on_every_beam():
    room = Rectangle(size=(2.0, 2.0))
    scanner = make_scanner(lidar(beams=500), [room], "exact")
    sides = [[-1, -1, 1, -1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, 1, -1, -1]]
    for pose in np.random.default_rng(2).uniform(-0.9, 0.9, (20, 3)):
        around = scanner.place([room], [0.6 * pose])
        assert np.isfinite(scanner.scan(pose, [], sides)).all()
        assert np.isfinite(scanner.scan(HERE, around)).all()


def test_a_scan_in_a_batch_is_the_scan_alone_to_the_bit():
    shapes = random_shapes(3)[:5]
    scanner = make_scanner(lidar(beams=180), shapes)
    scenes = [random_scene(seed, shapes) for seed in range(20)]
    bodies = np.stack([scanner.place(scene.shapes, scene.poses) for scene in scenes])
    robots = np.stack([scene.robot for scene in scenes])
    walls = scenes[0].walls
    batch = np.full((20, 180), np.nan, np.float32)
    assert scanner.scan(robots, bodies, walls, out=batch) is batch
    for n in range(20):
        assert np.array_equal(batch[n], scanner.scan(robots[n], bodies[n], walls)[0])
    apart = np.zeros((20, 360), np.float32)[:, ::2]
    with pytest.raises(ConfigError, match="contiguous"):
        scanner.scan(robots, bodies, walls, out=apart)


@pytest.mark.parametrize(("beams", "view"), [(1, 4.0), (49, 2.0 * np.pi), (1081, 4.0)])
def test_any_number_of_walls_is_met_by_any_number_of_beams(beams, view):
    low = -0.5 * view
    spec = lidar(beams=beams, angle_min=low, angle_max=-low, range_max=6.0)
    scanner = make_scanner(spec, ())
    rng = np.random.default_rng(beams)
    for count in (1, 2, 20):
        robot = rng.uniform(-1.0, 1.0, 3)
        walls = rng.uniform(-5.0, 5.0, (count, 4))
        scene = Scene(robot, (), np.zeros((0, 3)), walls)
        expected, clear = by_plane_geometry(spec, scene)
        seen = scanner.scan(robot, [], walls)[0]
        assert seen[clear] == pytest.approx(expected[clear], rel=1e-4)
        assert clear.mean() > 0.9 or beams < 50


def test_a_world_of_more_bodies_than_wait_to_be_fused_is_the_minimum_of_its_parts():
    count = 2 * MOST_FOUND + 5
    scanner = make_scanner(lidar(beams=72), random_shapes(5)[:4], "baked")
    shapes = [scanner.table.shapes[k % 4] for k in range(count)]
    rng = np.random.default_rng(count)
    poses = rng.uniform(-1.0, 1.0, (3, count, 3)) * [4.0, 4.0, np.pi]
    bodies = scanner.place(shapes, poses)
    robots = rng.uniform(-1.0, 1.0, (3, 3))
    whole = scanner.scan(robots, bodies)
    for part in (1, MOST_FOUND - 1, MOST_FOUND):
        pieces = [
            scanner.scan(robots, bodies[:, k : k + part]) for k in range(0, count, part)
        ]
        assert np.array_equal(whole, np.minimum.reduce(pieces))


def test_nobody_nothing_and_a_body_without_radius_can_be_scanned():
    scanner = make_scanner(lidar(beams=20), (SQUARE, DISC))
    assert scanner.scan(np.zeros((0, 3)), np.zeros((0, 4, 7))).shape == (0, 20)
    assert np.isposinf(scanner.scan(np.zeros((5, 3)), np.zeros((5, 0, 7)))).all()
    bodies = scanner.place([SQUARE, DISC], [(0.1, 0.0, 0.0), (1.0, 0.0, 0.0)])
    assert np.isfinite(scanner.scan(HERE, bodies)).any()
    bodies[:, 5] = 0.0
    assert np.isposinf(scanner.scan(HERE, bodies)).all()


@pytest.mark.parametrize("renderer", ["baked", "exact"])
@pytest.mark.parametrize(("wrong", "column"), [(np.nan, 0), (np.inf, 2)])
@pytest.mark.filterwarnings("error")
def test_a_pose_that_is_no_number_neither_hangs_nor_harms_the_others(
    renderer, wrong, column
):
    scanner = make_scanner(lidar(), [SQUARE], renderer)
    poses = np.array([(1.0, 0.2, 0.3), (0.0, 1.0, 0.1)])
    poses[1, column] = wrong
    bodies = scanner.place([SQUARE] * 2, poses)
    expected = scanner.scan(HERE, bodies[:1])
    assert (scanner.scan(HERE, bodies) <= expected).all()
    robots = np.stack([poses[1], HERE[0]])
    pair = np.stack([bodies[:1], bodies[:1]])
    assert np.array_equal(scanner.scan(robots, pair)[1:], expected)


NOTCHED = Polygon(points=((0.0, 0.0), (0.5, 0.0), (0.1, 0.1), (0.0, 0.5)))


@pytest.mark.parametrize(
    ("beams", "shape", "same"),
    [
        (1, Circle(radius=0.1), "exact"),
        (30, Circle(radius=0.1), "exact"),
        (60, Circle(radius=0.1), "baked"),
        (72, SQUARE, "baked"),
        (72, Rectangle(size=(8.0, 0.1)), "exact"),
        (72, NOTCHED, "exact"),
    ],
)
def test_auto_looks_up_all_but_wide_beams_huge_shapes_and_notches(beams, shape, same):
    rng = np.random.default_rng(0)
    poses = poses_around(rng, shape.radius + rng.uniform(0.5, 1.5, (100, 1)))
    spec = lidar(beams=beams)
    table = bake(spec, [shape])
    bodies = Scanner(spec, table).place([shape], poses)
    robots = np.zeros((len(poses), 3))
    scans = {way: Scanner(spec, table, way).scan(robots, bodies) for way in RENDERERS}
    assert np.array_equal(scans["auto"], scans[same])
    assert np.isfinite(scans["exact"]).any()
    assert not np.array_equal(scans["baked"], scans["exact"])


def test_two_lidars_in_one_process_use_their_own_tables():
    narrow = lidar(beams=30, angle_min=-1.0, angle_max=1.0, range_max=2.0)
    scanners = [
        make_scanner(lidar(beams=90), (SQUARE, STRIP)),
        make_scanner(narrow, (STRIP,)),
    ]
    for scanner in (*scanners, *scanners):
        exact = Scanner(scanner.spec, scanner.table, "exact")
        looked_up, computed = (
            s.scan(HERE, s.place([STRIP], [(1.0, 0.2, 1.4)])) for s in (scanner, exact)
        )
        hit = np.isfinite(looked_up)
        assert np.array_equal(hit, np.isfinite(computed))
        assert hit.any()
        assert looked_up[hit] == pytest.approx(computed[hit], abs=0.05)


def use_table_of(**changes):
    Scanner(lidar(**changes), bake(lidar(), (SQUARE,), COARSE))


def scan_square(poses=HERE, bodies=(), walls=(), shape=None, **options):
    scanner = make_scanner(lidar(), [SQUARE, STRIP])
    if shape is not None:
        bodies = scanner.place([SQUARE], [(1.0, 0.0, 0.0)])
        bodies[0, -1] = shape
    scanner.scan(poses, bodies, walls, **options)


@pytest.mark.parametrize(
    ("call", "keys", "error", "match"),
    [
        (use_table_of, {"beams": 73}, ModelError, "table .* for beams that are"),
        (use_table_of, {"range_max": 4.0}, ModelError, "table reaches .*, not 4 m"),
        (scan_square, {"bodies": np.zeros((3, 4, 7))}, ConfigError, r"\(N, K, 7\)"),
        (scan_square, {"bodies": np.zeros((4, 6))}, ConfigError, r"\(N, K, 7\)"),
        (scan_square, {"poses": np.zeros((1, 2))}, ConfigError, r"\(N, 3\)"),
        (scan_square, {"walls": np.ones((2, 2))}, ConfigError, r"\(W, 4\)"),
        (scan_square, {"walls": np.ones((1, 1, 4))}, ConfigError, r"\(W, 4\)"),
        (scan_square, {"shape": 2.0}, ModelError, "none of the 2 in the lidar"),
        (scan_square, {"shape": -1.0}, ModelError, "none of the 2 in the lidar"),
        (scan_square, {"shape": np.nan}, ModelError, "none of the 2 in the lidar"),
        (scan_square, {"out": np.zeros((1, 72))}, ConfigError, r"\(1, 72\) float32"),
        (
            lambda: make_scanner(lidar(), [SQUARE], "backed"),
            {},
            ConfigError,
            "did you mean 'baked'",
        ),
        (
            lambda: make_scanner(lidar(), (STRIP,)).place([DISC], HERE),
            {},
            ModelError,
            "circle of radius 0.25 m is not in",
        ),
        (
            lambda: Scanner(lidar(), make_scanner(lidar(), [DISC], "exact").table),
            {},
            ModelError,
            "no rows to look up with the renderer 'auto'",
        ),
    ],
)
def test_what_does_not_belong_together_is_refused(call, keys, error, match):
    with pytest.raises(error, match=match):
        call(**keys)


def test_the_table_of_another_lidar_serves_where_nothing_is_looked_up_beyond_it():
    table = bake(lidar(), (SQUARE,), COARSE)
    nearer = lidar(range_max=2.0, range_min=0.3, mount=(0.1, 0.0, 1.0))
    for scanner in (
        Scanner(lidar(beams=73), table, "exact"),
        Scanner(nearer, table, "baked"),
    ):
        hits = np.isfinite(scanner.scan(HERE, scanner.place([SQUARE], HERE + 1.0)))
        assert 0 < hits.sum() < 20


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_static_map_is_seen_beside_the_bodies_and_within_the_limits(renderer):
    spec = lidar(
        beams=4, angle_min=0.0, angle_max=2.0 * np.pi, range_min=0.3, range_max=3.0
    )
    cells = np.zeros((100, 100), np.int8)
    # east at 2 m, north at 4.8 m, south, near
    cells[:, 70] = cells[98, :] = cells[48, 50] = 100
    grid = GridMap(cells, 0.1, origin=(-5.0, -5.0, 0.0))
    scanner = make_scanner(spec, [SQUARE], renderer, grid)
    bodies = scanner.place([SQUARE], [[-1.0, 0.05, 0.0]])
    ranges = scanner.scan([0.05, 0.05, 0.0], bodies)[0]
    assert ranges == pytest.approx([1.95, np.inf, 0.9, -np.inf], abs=1e-3)


def test_a_full_circle_of_the_most_beams_can_be_looked_up():
    spec = lidar(beams=100_000, range_min=0.0)
    table = bake(spec, [SQUARE], Density(distances=60, rotations=96, phases=1))
    assert table.widths.max() > 2**15
    rng = np.random.default_rng(0)
    poses = poses_around(rng, rng.uniform(0.213, 0.6, (10, 1)))
    one, other = both_ways(spec, table, [SQUARE], poses)
    both = np.isfinite(one) & np.isfinite(other)
    assert (np.isfinite(one) != np.isfinite(other)).sum() < 20
    assert np.sqrt(np.square(one[both] - other[both]).mean()) < 0.02
