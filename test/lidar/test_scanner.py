from __future__ import annotations

import numpy as np
import pytest
from lidar_scenes import (
    POLYGONS,
    Scene,
    by_plane_geometry,
    random_scene,
    random_shapes,
    ring,
)
from plain_scan import scan_robot
from robots import lidar

from nics_drl_bridge.errors import ConfigError, ModelError
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.scan_kernels import LANES
from nics_drl_bridge.lidar.scanner import RENDERERS, Scanner, make_scanner
from nics_drl_bridge.lidar.shapes import SQUARE, STRIP, Circle, Polygon, Rectangle
from nics_drl_bridge.lidar.table import Density

HALF = np.pi / 2.0
COARSE = Density(distances=3, rotations=1)
HERE = np.zeros((1, 3))

SENSORS = {
    "full circle": lidar(beams=90),
    "full circle from zero": lidar(beams=90, angle_min=0.0, angle_max=2.0 * np.pi),
    "front": lidar(beams=61, angle_min=-2.0, angle_max=2.0),
    "over the seam": lidar(beams=61, angle_min=HALF, angle_max=3.0 * HALF),
    "clockwise of zero": lidar(beams=61, angle_min=-6.0, angle_max=-1.0),
    "off-centre": lidar(beams=90, mount=(0.2, -0.1, 0.7)),
    "half, off-centre": lidar(
        beams=45, angle_min=-HALF, angle_max=HALF, mount=(-0.3, 0.1, 3.0)
    ),
    "short": lidar(beams=90, range_min=0.4, range_max=1.2),
    "one beam": lidar(beams=1),
    "one beam ahead": lidar(beams=1, angle_min=-0.1, angle_max=0.1),
    "seven beams": lidar(beams=7),
    "36 beams": lidar(beams=36),
    "2048 beams": lidar(beams=2048),
}
SOME = [
    name if n % 3 == 0 else pytest.param(name, marks=pytest.mark.campaign)
    for n, name in enumerate(SENSORS)
]
FEW = [
    name if n % 6 == 0 else pytest.param(name, marks=pytest.mark.campaign)
    for n, name in enumerate(SENSORS)
]


def scan(scanner, scene):
    bodies = scanner.place(scene.shapes, scene.poses)
    return scanner.scan(scene.robot, bodies, scene.walls)[0]


def finite(ranges, spec):
    """Ranges as distances: none is the limit, too close is 0."""
    return np.nan_to_num(ranges, posinf=spec.range_max, neginf=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME)
def test_exact_scans_of_random_scenes_agree_with_plane_geometry(name):
    spec = SENSORS[name]
    compared = 0
    for seed in range(20 if spec.beams > 1000 else 120):
        if seed % 20 == 0:
            shapes = random_shapes(seed)
            scanner = Scanner(spec, bake(spec, shapes, COARSE), "exact")
        scene = random_scene(seed, shapes, far=1e4 if seed % 3 == 0 else 0.0)
        expected, clear = by_plane_geometry(spec, scene)
        assert scan(scanner, scene)[clear] == pytest.approx(
            expected[clear], abs=1e-3
        ), seed
        compared += np.isfinite(expected[clear]).sum()
    assert compared > 10 * spec.beams


@pytest.mark.slow
@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_lidar_inside_or_beside_any_shape_sees_what_plane_geometry_says(renderer):
    spec = lidar(beams=90, range_min=0.0)
    compared = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        shape = (*random_shapes(seed), ring(rng, 40))[seed % 12]
        scanner = Scanner(spec, bake(spec, [shape], COARSE), renderer)
        angle = rng.uniform(-np.pi, np.pi)
        part = rng.uniform(0.0, 0.999)
        away = part * shape.radius * np.array([np.cos(angle), np.sin(angle)])
        pose = np.array([*away, rng.uniform(-np.pi, np.pi)])
        scene = Scene(
            np.array([0.0, 0.0, angle]), (shape,), pose[None], np.zeros((0, 4))
        )
        expected, clear = by_plane_geometry(spec, scene)
        assert scan(scanner, scene)[clear] == pytest.approx(
            expected[clear], abs=1e-3
        ), seed
        compared += np.isfinite(expected[clear]).sum()
    assert compared > 1000


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_baked_scans_of_random_scenes_are_near_the_exact_ones(name):
    spec = SENSORS[name]
    if spec.beams > 1000:
        spec = lidar(
            beams=720
        )  # beams as narrow as these show the same, and bake sooner
    errors = []
    returns = 0
    wrong = 0
    for seed in range(40):
        if seed % 20 == 0:
            table = bake(spec, random_shapes(seed), Density())
            baked = Scanner(spec, table, "baked")
            exact = Scanner(spec, table, "exact")
        scene = random_scene(seed, table.shapes)
        looked_up = scan(baked, scene)
        computed = scan(exact, scene)
        assert not np.isnan(looked_up).any()
        errors.append(finite(looked_up, spec) - finite(computed, spec))
        returns += np.isfinite(computed).sum()
        wrong += (np.isinf(looked_up) != np.isinf(computed)).sum()
    # The wider the beams, the coarser the points of a row: 1/4 of 10 degrees is 2 cm at 0.5 m.
    limit = (
        0.01
        if spec.angle_increment < 0.01
        else 0.03
        if spec.angle_increment < 0.2
        else 0.05
    )
    assert np.sqrt(np.square(errors).mean()) < limit
    assert wrong <= 2 + 0.006 * returns
    assert returns > 0.1 * np.size(errors)


@pytest.mark.slow
@pytest.mark.parametrize(
    "density", [Density(), Density(distances=20, rotations=24, phases=1)]
)
@pytest.mark.parametrize("corners", [3, 8, 200])
@pytest.mark.parametrize("make", POLYGONS)
def test_silhouettes_of_any_polygon_are_exact_at_any_density(make, corners, density):
    spec = lidar(beams=360, range_min=0.0)
    shape = make(np.random.default_rng(corners), corners)
    table = bake(spec, [shape], density)
    rng = np.random.default_rng(1)
    # From touching on; not so far that the limit of range decides instead of the silhouette.
    distance = shape.radius * (1.0 + 1e-9) + rng.uniform(0.0, 1.0, 300) ** 3 * 1.5
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, 300))
    poses = np.stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), heading], axis=1
    )
    scans = [
        one.scan(np.zeros((300, 3)), one.place([shape], poses[:, None]))
        for one in (Scanner(spec, table, "baked"), Scanner(spec, table, "exact"))
    ]
    seen, truly = (np.isfinite(s) for s in scans)
    assert (seen != truly).mean() < 2e-5
    assert truly.any()


def test_the_papers_scenes_are_off_by_less_than_3_mm():
    spec = lidar(beams=720)
    rng = np.random.default_rng(0)
    table = bake(spec, (Circle(radius=0.15), SQUARE, STRIP))
    baked = Scanner(spec, table, "baked")
    exact = Scanner(spec, table, "exact")
    for shapes in ([Circle(radius=0.15)] * 10, [SQUARE] * 10, [STRIP] * 10):
        poses = rng.uniform(-1.0, 1.0, (200, 10, 3)) * [3.0, 3.0, np.pi]
        bodies = exact.place(shapes, poses)
        one, other = (
            finite(s.scan(np.zeros((200, 3)), bodies), spec) for s in (baked, exact)
        )
        assert (other < spec.range_max).mean() > 0.2
        assert np.sqrt(((one - other) ** 2).mean()) < 0.003


@pytest.mark.parametrize("renderer", RENDERERS)
def test_ranges_beyond_the_limits_are_infinite_with_the_sign_of_rep_117(renderer):
    spec = lidar(beams=4, range_min=0.5, range_max=2.0)
    scanner = make_scanner(spec, [Circle(radius=0.25)], renderer)
    #        behind (beam 0)  right           ahead           left
    poses = [(-0.6, 0.0, 0.0), (0.0, -2.2, 1.0), (2.3, 0.0, 2.0), (0.0, 0.8, 3.0)]
    ranges = scanner.scan(HERE, scanner.place(scanner.table.shapes * 4, poses))[0]
    assert ranges[[0, 2]].tolist() == [-np.inf, np.inf]
    assert ranges[[1, 3]] == pytest.approx([1.95, 0.55], abs=1e-4)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_lidar_inside_a_circle_sees_its_far_side(renderer):
    spec = lidar(beams=36)
    scanner = make_scanner(spec, [Circle(radius=0.25)], renderer)
    ranges = scanner.scan(HERE, scanner.place(scanner.table.shapes, [(0.1, 0.0, 0.0)]))[
        0
    ]
    c = np.cos(spec.angles)
    s = np.sin(spec.angles)
    assert ranges == pytest.approx(
        0.1 * c + np.sqrt(0.25**2 - (0.1 * s) ** 2), abs=1e-5
    )


@pytest.mark.parametrize("part", [0.3, 0.8, 1.5])
def test_an_outline_that_crosses_itself_is_seen_from_anywhere(part):
    star = 0.5 * np.stack(
        [f(0.8 * np.pi * np.arange(5)) for f in (np.cos, np.sin)], axis=1
    )
    bow = np.array([(-0.5, -0.3), (0.5, 0.3), (0.5, -0.3), (-0.5, 0.3)])
    for outline in (star, bow):
        shape = Polygon(points=tuple(map(tuple, outline)))
        scanner = make_scanner(lidar(beams=90), [shape], "exact")
        ends = np.concatenate([outline, np.roll(outline, -1, axis=0)], axis=1)
        for angle in np.linspace(0.1, 6.2, 20):
            robot = [part * 0.5 * np.cos(angle), part * 0.5 * np.sin(angle), angle]
            bodies = scanner.place([shape], [(0.0, 0.0, 0.0)])
            seen = scanner.scan(robot, bodies)[0]
            walls = scanner.scan(robot, [], ends)[0]
            assert np.array_equal(np.isinf(seen), np.isinf(walls))
            assert finite(seen, scanner.spec) == pytest.approx(
                finite(walls, scanner.spec)
            )


def test_a_wall_seen_edge_on_returns_nothing():
    scanner = make_scanner(lidar(beams=8), ())
    assert np.isinf(scanner.scan(HERE, [], [[1.0, 0.0, 2.0, 0.0]])).all()


def test_a_wall_in_line_with_the_lidar_but_for_rounding_hides_nothing():
    scanner = make_scanner(lidar(beams=360, range_min=0.05, range_max=10.0), ())
    wall = [
        -0.19583694396573836,
        -4.404163056034261,
        -1.8221825406947976,
        -2.7778174593052025,
    ]
    assert np.isinf(scanner.scan([-2.6, -2.0, -np.pi], [], [wall])[0]).all()
    assert (scanner.scan([-2.6, -2.0, -np.pi], [], [wall])[0] > 0.0).all()


@pytest.mark.parametrize("beams", [40, 360, 1100])
def test_a_wall_met_at_a_flat_angle_is_as_exact_as_another(beams):
    scanner = make_scanner(lidar(beams=beams, range_max=25.0), ())
    rng = np.random.default_rng(1)
    for beam in range(beams):
        along = rng.uniform(-3.0, 3.0)
        off = rng.uniform(0.01, 0.2)
        heading = along + np.arcsin(off / 20.0) - scanner.spec.angles[beam]
        ends = np.array([[-50.0, off], [50.0, off]]) @ [
            [np.cos(along), np.sin(along)],
            [-np.sin(along), np.cos(along)],
        ]
        seen = scanner.scan([0.0, 0.0, heading], [], [ends.ravel()])[0]
        assert seen[beam] == pytest.approx(20.0, abs=2e-5)


def test_walls_are_seen_from_both_sides_whichever_end_comes_first():
    scanner = make_scanner(lidar(beams=8), ())
    for wall in ([1.0, -5.0, 1.0, 5.0], [1.0, 5.0, 1.0, -5.0]):
        for x, ahead in ((0.0, 0.0), (2.0, np.pi)):
            ranges = scanner.scan([x, 0.0, ahead], [], [wall])[0]
            assert ranges[4] == pytest.approx(1.0, abs=1e-6)
            assert np.isinf(ranges[0])


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_closed_room_returns_on_every_beam(renderer):
    room = Rectangle(size=(2.0, 2.0))
    scanner = make_scanner(lidar(beams=500), [room], renderer)
    sides = [[-1, -1, 1, -1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, 1, -1, -1]]
    for pose in np.random.default_rng(2).uniform(-0.9, 0.9, (50, 3)):
        assert np.isfinite(scanner.scan(pose, [], sides)).all()
        assert np.isfinite(
            scanner.scan(pose, scanner.place([room], [(0.0, 0.0, 0.3)]))
        ).any()
    assert np.isfinite(
        scanner.scan(HERE, scanner.place([room], [(0.1, 0.0, 0.3)]))
    ).all()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_the_nearest_of_several_objects_is_returned_whatever_their_order(renderer):
    scanner = make_scanner(lidar(beams=4), [Circle(radius=0.25)], renderer)
    wall = [[1.5, -1.0, 1.5, 1.0]]
    for poses in ([(2.0, 0, 0), (1.0, 0, 0)], [(1.0, 0, 0), (2.0, 0, 0)]):
        both = scanner.place(scanner.table.shapes * 2, poses)
        assert scanner.scan(HERE, both, wall)[0, 2] == pytest.approx(0.75, abs=1e-4)
    far = scanner.place(scanner.table.shapes, [(2.0, 0, 0)])
    assert scanner.scan(HERE, far, wall)[0, 2] == pytest.approx(1.5)


@pytest.mark.slow
@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_scan_in_a_batch_is_the_scan_alone_to_the_bit(renderer):
    spec = lidar(beams=180)
    scanner = make_scanner(spec, random_shapes(3), renderer)
    scenes = [random_scene(seed, scanner.table.shapes) for seed in range(40)]
    bodies = np.stack([scanner.place(scene.shapes, scene.poses) for scene in scenes])
    robots = np.stack([scene.robot for scene in scenes])
    walls = scenes[0].walls
    batch = scanner.scan(robots, bodies, walls)
    for n in range(40):
        assert np.array_equal(batch[n], scanner.scan(robots[n], bodies[n], walls)[0])
    order = np.random.default_rng(0).permutation(40)
    assert np.array_equal(
        scanner.scan(robots[order], bodies[order], walls), batch[order]
    )
    into = np.full_like(batch, np.nan)
    assert scanner.scan(robots, bodies, walls, out=into) is into
    assert np.array_equal(into, batch)


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@pytest.mark.parametrize("view", [4.0, 2.0 * np.pi])
@pytest.mark.parametrize("beams", [1, 7, 47, 48, 49, 720, 1081])
def test_any_number_of_walls_is_met_by_any_number_of_beams(beams, view):
    spec = lidar(
        beams=beams, angle_min=-0.5 * view, angle_max=0.5 * view, range_max=6.0
    )
    scanner = make_scanner(spec, ())
    rng = np.random.default_rng(beams)
    for count in (1, 7, 8, 9, 20):
        robot = rng.uniform(-1.0, 1.0, 3)
        walls = rng.uniform(-5.0, 5.0, (count, 4))
        seen = scanner.scan(robot, np.zeros((1, 0, 3)), walls)[0]
        angles = spec.angles + robot[2]
        ahead = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
        start = walls[:, :2] - robot[:2]
        along = walls[:, 2:] - walls[:, :2]
        across = cross(ahead, along)
        share = cross(start, ahead) / across
        expected = cross(start, along) / across
        expected[(share < 0.0) | (share > 1.0) | (expected < 0.0)] = np.inf
        expected = expected.min(axis=1)
        doubtful = (np.abs(share) < 1e-5) | (np.abs(share - 1.0) < 1e-5)
        sure = ~doubtful.any(axis=1) & (np.abs(expected - spec.range_max) > 1e-5)
        expected[expected > spec.range_max] = np.inf
        expected[expected < spec.range_min] = -np.inf
        assert np.allclose(seen[sure], expected[sure], rtol=1e-5, atol=0.0)
        assert sure.mean() > 0.9 or beams < 50


@pytest.mark.slow
@pytest.mark.parametrize("beams", [7, 720])
def test_a_world_of_more_bodies_than_lanes_is_the_minimum_of_its_parts_to_the_bit(
    beams,
):
    scanner = make_scanner(lidar(beams=beams), random_shapes(5), "baked")
    rng = np.random.default_rng(beams)
    shapes = scanner.table.shapes
    count = 2 * LANES + 5
    worlds = 3
    poses = rng.uniform(-1.0, 1.0, (worlds, count, 3)) * [4.0, 4.0, np.pi]
    bodies = scanner.place([shapes[k % len(shapes)] for k in range(count)], poses)
    robots = rng.uniform(-1.0, 1.0, (worlds, 3))
    for part in (1, 7, LANES - 1, LANES, LANES + 1):
        pieces = [
            scanner.scan(robots, bodies[:, k : k + part]) for k in range(0, count, part)
        ]
        assert np.array_equal(scanner.scan(robots, bodies), np.minimum.reduce(pieces))


@pytest.mark.slow
@pytest.mark.parametrize("beams", [72, 720])
def test_many_looked_up_at_once_are_each_looked_up_alone_to_the_bit(beams):
    scanner = make_scanner(lidar(beams=beams), random_shapes(5), "baked")
    rng = np.random.default_rng(beams)
    shapes = scanner.table.shapes
    poses = rng.uniform(-1.0, 1.0, (20, 9, 3)) * [4.0, 4.0, np.pi]
    bodies = scanner.place([shapes[k % len(shapes)] for k in range(9)], poses)
    robots = rng.uniform(-1.0, 1.0, (20, 3))
    walls = np.array([[-3.0, -2.0, 3.0, -2.5]])
    alone = np.empty(beams, np.float32)
    together = scanner.scan(robots, bodies, walls)
    for robot, around, scan in zip(robots, bodies, together, strict=True):
        scan_robot(alone, robot, around, -1, walls, scanner.arguments)
        assert alone.tobytes() == scan.tobytes()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_an_array_of_any_layout_is_filled(renderer):
    scanner = make_scanner(lidar(beams=40), [SQUARE, STRIP], renderer)
    poses = np.random.default_rng(0).uniform(-1.5, 1.5, (6, 10, 3))
    bodies = scanner.place([SQUARE, STRIP] * 5, poses)
    expected = scanner.scan(np.zeros((6, 3)), bodies)
    for out in (
        np.zeros((6, 80), np.float32)[:, ::2],
        np.zeros((6, 90), np.float32)[:, 7:47],
        np.zeros((12, 40), np.float32)[::-2],
        np.zeros((40, 6), np.float32).T,
    ):
        assert np.array_equal(scanner.scan(np.zeros((6, 3)), bodies, out=out), expected)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_nobody_and_nothing_can_be_scanned(renderer):
    spec = lidar(beams=20)
    for shapes in ((), (SQUARE,)):
        scanner = make_scanner(spec, shapes, renderer)
        assert scanner.scan(np.zeros((0, 3)), np.zeros((0, 4, 7))).shape == (0, 20)
        assert scanner.scan(np.zeros((0, 3)), []).shape == (0, 20)
        assert (
            scanner.scan(np.zeros((5, 3)), np.zeros((5, 0, 7))).tolist()
            == [[np.inf] * 20] * 5
        )
        assert np.isinf(scanner.scan(HERE, scanner.place([], np.zeros((0, 3))))).all()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_body_without_radius_is_not_there(renderer):
    scanner = make_scanner(lidar(), [SQUARE, Circle(radius=0.2)], renderer)
    bodies = scanner.place(
        [SQUARE, Circle(radius=0.2)], [(0.1, 0.0, 0.0), (1.0, 0.0, 0.0)]
    )
    assert np.isfinite(scanner.scan(HERE, bodies)).any()
    bodies[:, 5] = 0.0
    assert np.isinf(scanner.scan(HERE, bodies)).all()


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
@pytest.mark.parametrize("column", [0, 1, 2])
@pytest.mark.filterwarnings("error")
def test_a_pose_that_is_no_number_neither_hangs_nor_harms_the_others(
    renderer, wrong, column
):
    scanner = make_scanner(lidar(), [SQUARE], renderer)
    good = np.array([(1.0, 0.2, 0.3), (-0.8, 0.1, 1.0)])
    bad = np.array([(0.0, 1.0, 0.1)])
    bad[0, column] = wrong
    bodies = scanner.place([SQUARE] * 3, np.concatenate([good, bad]))
    expected = scanner.scan(HERE, scanner.place([SQUARE] * 2, good))
    assert np.array_equal(
        scanner.scan(HERE, bodies) <= expected, np.ones_like(expected, bool)
    )
    robots = np.zeros((2, 3))
    robots[0, column] = wrong
    pair = scanner.place([SQUARE] * 2, np.stack([good, good]))
    assert np.array_equal(scanner.scan(robots, pair)[1], expected[0])


def test_auto_looks_up_all_but_huge_shapes_and_those_with_notches():
    huge = Rectangle(size=(8.0, 0.1))
    notch = Polygon(points=((0.0, 0.0), (0.5, 0.0), (0.1, 0.1), (0.0, 0.5)))
    shapes = (Circle(radius=0.2), Circle(radius=0.1), SQUARE, huge, notch)
    table = bake(lidar(), shapes)
    scans = {}
    for renderer in RENDERERS:
        scanner = Scanner(lidar(), table, renderer)
        scans[renderer] = [
            scanner.scan(HERE, scanner.place([shape], [(shape.radius + 0.7, 0.3, 0.4)]))
            for shape in shapes
        ]
    for which, shape in enumerate(shapes):
        same = scans["exact" if shape in (huge, notch) else "baked"][which]
        assert np.array_equal(scans["auto"][which], same)
        assert np.isfinite(same).any()
    assert not np.array_equal(scans["exact"][3], scans["baked"][3])


def test_two_lidars_in_one_process_use_their_own_tables():
    wide = lidar(beams=90)
    narrow = lidar(beams=30, angle_min=-1.0, angle_max=1.0, range_max=2.0)
    scanners = [make_scanner(wide, (SQUARE, STRIP)), make_scanner(narrow, (STRIP,))]
    for scanner in (*scanners, *scanners):
        exact = Scanner(scanner.spec, scanner.table, "exact")
        ranges, computed = (
            s.scan(HERE, s.place([STRIP], [(1.0, 0.2, 1.4)])) for s in (scanner, exact)
        )
        assert ranges.shape == (1, scanner.spec.beams)
        hit = np.isfinite(ranges)
        assert np.array_equal(hit, np.isfinite(computed))
        assert hit.any()
        assert ranges[hit] == pytest.approx(computed[hit], abs=0.05)


def test_a_shape_that_was_not_baked_is_refused_by_its_description():
    scanner = make_scanner(lidar(), (Circle(radius=0.1), STRIP))
    with pytest.raises(
        ModelError, match=r"circle of radius 0.3 m is not in the lidar table, .*"
    ):
        scanner.place([Circle(radius=0.3)], [(1.0, 0.0, 0.0)])
    triangle = Polygon(points=((0, 0), (1, 0), (0, 1)))
    with pytest.raises(
        ModelError, match=r"polygon of 3 corners, radius 1 m .* 0.6 x 0.06 m; bake"
    ):
        scanner.place([triangle], [(1.0, 0.0, 0.0)])


@pytest.mark.parametrize(
    "change", [{"beams": 73}, {"range_max": 4.0}, {"angle_max": 2.0}]
)
def test_the_table_of_another_lidar_is_refused(change):
    table = bake(lidar(), (SQUARE,), COARSE)
    with pytest.raises(
        ModelError, match=r"table .*, not .*; bake one for the lidar 'lidar'"
    ):
        Scanner(lidar(**change), table)
    Scanner(lidar(**change), table, "exact")
    Scanner(lidar(range_max=2.0, range_min=0.3, mount=(0.1, 0.0, 1.0)), table)


@pytest.mark.parametrize(
    ("poses", "bodies"),
    [
        (np.zeros((2, 3)), np.zeros((3, 4, 7))),
        (np.zeros((2, 3)), np.zeros((4, 7))),
        (np.zeros((1, 3)), np.zeros((4, 6))),
        (np.zeros((1, 2)), np.zeros((4, 7))),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(poses, bodies):
    with pytest.raises(ConfigError, match=r"must be \(N, 3\) and \(N, K, 7\)"):
        make_scanner(lidar(), [SQUARE]).scan(poses, bodies)


@pytest.mark.parametrize("walls", [np.zeros(3), np.zeros((2, 2)), np.zeros((1, 1, 4))])
def test_walls_that_are_not_four_numbers_each_are_refused(walls):
    with pytest.raises(ConfigError, match=r"walls \(.*\) must be \(W, 4\)"):
        make_scanner(lidar(), []).scan(HERE, [], walls)


@pytest.mark.parametrize("index", [2.0, -1.0, np.nan])
@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_body_of_another_scanner_is_refused_before_it_is_looked_for(renderer, index):
    scanner = make_scanner(lidar(), [SQUARE, STRIP], renderer)
    bodies = scanner.place([SQUARE], [(1.0, 0.0, 0.0)])
    bodies[0, -1] = index
    with pytest.raises(
        ModelError, match="none of the 2 in the lidar table; make bodies by"
    ):
        scanner.scan(HERE, bodies)


def test_an_unknown_renderer_is_refused_with_the_nearest():
    with pytest.raises(
        ConfigError, match="unknown renderer 'backed'; did you mean 'baked'"
    ):
        make_scanner(lidar(), [SQUARE], "backed")


def rmse(spec, table):
    """Of ranges among ten obstacles spread evenly over what the lidar sees."""
    exact = Scanner(spec, table, "exact")
    baked = Scanner(spec, table, "baked")
    rng = np.random.default_rng(0)
    radius = table.outlines.radii[0]
    away = np.sqrt(rng.uniform(radius**2, (spec.range_max + radius) ** 2, (400, 10)))
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, 400, 10))
    poses = np.stack([away * np.cos(bearing), away * np.sin(bearing), heading], axis=-1)
    bodies = exact.place([table.shapes[0]] * 10, poses)
    one, other = (
        np.nan_to_num(
            each.scan(np.zeros((400, 3)), bodies), posinf=spec.range_max, neginf=0.0
        )
        for each in (baked, exact)
    )
    return np.sqrt(np.mean((one - other) ** 2))


@pytest.mark.parametrize("beams", [1, 7, 36, 360])
def test_few_beams_are_baked_as_finely_as_many(beams):
    spec = lidar(beams=beams)
    coarse = rmse(spec, bake(spec, [STRIP], Density(phases=1)))
    assert rmse(spec, bake(spec, [STRIP])) < min(0.05, 0.9 * coarse)


@pytest.mark.parametrize("out", [np.zeros((2, 72), np.float32), np.zeros((1, 72))])
def test_an_array_that_can_not_hold_the_scans_is_refused(out):
    with pytest.raises(ConfigError, match=r"must be \(1, 72\) float32"):
        make_scanner(lidar(), []).scan(HERE, [], out=out)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_static_map_is_seen_beside_the_bodies_and_within_the_limits(renderer):
    spec = lidar(
        beams=4, angle_min=0.0, angle_max=2.0 * np.pi, range_min=0.3, range_max=3.0
    )
    cells = np.zeros((100, 100), np.int8)
    # east at 2 m, north at 4.8 m, south, near
    cells[:, 70] = cells[98, :] = cells[48, 50] = 100
    scanner = make_scanner(
        spec, [SQUARE], renderer, GridMap(cells, 0.1, origin=(-5.0, -5.0, 0.0))
    )
    bodies = scanner.place([SQUARE], [[-1.0, 0.05, 0.0]])
    ranges = scanner.scan([0.05, 0.05, 0.0], bodies)[0]
    assert ranges == pytest.approx([1.95, np.inf, 0.9, -np.inf], abs=1e-3)


def star_of(corners, depth):
    """Corners in turn on a circle of 0.4 m and inside of it."""
    angles = 2.0 * np.pi / corners * np.arange(corners)
    radii = 0.4 * (1.0 - depth * (np.arange(corners) % 2))
    return Polygon(
        points=np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    )


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.3, -0.2, 2.5)])
def test_auto_looks_up_a_concave_shape_of_any_corners_where_that_errs_little(mount):
    spec = lidar(beams=360, angle_min=-1.0, angle_max=1.5, mount=mount)
    rng = np.random.default_rng(3)
    for shape, looked_up in ((star_of(40, 0.5), False), (star_of(40, 0.01), True)):
        auto = make_scanner(spec, [shape])
        poses = rng.uniform(-1.0, 1.0, (300, 1, 3)) * [2.5, 2.5, np.pi]
        bodies = auto.place([shape], poses)
        robots = np.zeros((300, 3))
        scans = {
            way: Scanner(spec, auto.table, way).scan(robots, bodies)
            for way in RENDERERS
        }
        as_baked, as_exact = (
            (scans["auto"] == scans[way]).all(axis=1) for way in ("baked", "exact")
        )
        assert (as_baked | as_exact).all()
        assert (~as_exact).any() == looked_up
        assert not np.array_equal(scans["baked"], scans["exact"])
        both = np.isfinite(scans["auto"]) & np.isfinite(scans["exact"])
        assert both.sum() > 1000
        assert (
            np.sqrt(np.square(scans["auto"][both] - scans["exact"][both]).mean())
            < 0.012
        )


@pytest.mark.parametrize(
    ("beams", "same"), [(1, "exact"), (7, "exact"), (30, "exact"), (60, "baked")]
)
def test_auto_computes_the_rays_of_few_and_wide_beams(beams, same):
    spec = lidar(beams=beams)
    auto = make_scanner(spec, [STRIP, Circle(radius=0.1)])
    disc = Circle(radius=0.1)
    poses = np.random.default_rng(0).uniform(-1.0, 1.0, (300, 1, 3)) * [2.0, 2.0, np.pi]
    scans = {
        way: Scanner(spec, auto.table, way).scan(
            np.zeros((300, 3)), auto.place([disc], poses)
        )
        for way in RENDERERS
    }
    as_baked, as_exact = (
        (scans["auto"] == scans[way]).all(axis=1) for way in ("baked", "exact")
    )
    assert (as_baked | as_exact).all()
    assert (~as_exact).any() == (same == "baked")
    assert not np.array_equal(scans["baked"], scans["exact"])


@pytest.mark.parametrize(
    ("view", "few", "every"),
    [((-np.pi, np.pi), 1000, 100), ((-0.5, 0.7), 370, 271), ((2.0, 4.0), 370, 271)],
)
def test_a_lidar_of_the_most_beams_scans_exactly_without_a_table(view, few, every):
    spec = lidar(beams=100_000, angle_min=view[0], angle_max=view[1])
    shapes = (Circle(radius=0.25), SQUARE, star_of(20, 0.5))
    scanner = make_scanner(spec, shapes, "exact")
    poses = np.array([(1.5, 0.2, 0.3), (-0.8, 0.4, 1.0), (-1.2, -0.9, 0.2)])
    scene = Scene(np.zeros(3), shapes, poses, np.zeros((0, 4)))
    expected, clear = by_plane_geometry(spec.model_copy(update={"beams": few}), scene)
    assert scan(scanner, scene)[::every][clear] == pytest.approx(
        expected[clear], abs=1e-3
    )
    assert np.isfinite(expected[clear]).sum() > 50
    with pytest.raises(
        ModelError, match="no rows to look up with the renderer 'baked'; bake one"
    ):
        Scanner(spec, scanner.table, "baked")


def test_a_full_circle_of_the_most_beams_can_be_looked_up():
    spec = lidar(beams=100_000, range_min=0.0)
    density = Density(distances=60, rotations=96, phases=1)
    table = bake(spec, [SQUARE], density)
    assert table.widths.max() > 2**15
    baked = Scanner(spec, table, "baked")
    exact = Scanner(spec, table, "exact")
    rng = np.random.default_rng(0)
    away, (bearing, heading) = (
        rng.uniform(0.213, 0.6, 10),
        rng.uniform(-np.pi, np.pi, (2, 10)),
    )
    poses = np.stack([away * np.cos(bearing), away * np.sin(bearing), heading], axis=1)
    one, other = (
        s.scan(np.zeros((10, 3)), s.place([SQUARE], poses[:, None]))
        for s in (baked, exact)
    )
    assert (np.isfinite(one) != np.isfinite(other)).sum() < 20
    both = np.isfinite(one) & np.isfinite(other)
    assert np.sqrt(np.square(one[both] - other[both]).mean()) < 0.02
