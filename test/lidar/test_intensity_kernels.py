from __future__ import annotations

import numpy as np
import pytest
from lidar_scenes import Scene, random_scene, random_shapes
from robots import lidar

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, ModelError
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.scanner import RENDERERS, Scanner
from nics_drl_bridge.lidar.sensor_models import IncidenceDropout, Intensity
from nics_drl_bridge.lidar.shapes import SQUARE, STRIP, Circle, Segment
from nics_drl_bridge.lidar.table import Density

HALF = np.pi / 2.0
HERE = np.zeros((1, 3))
COARSE = Density(distances=3, rotations=1)
SENSORS = {
    "full circle": lidar(beams=90),
    "front": lidar(beams=61, angle_min=-2.0, angle_max=2.0),
    "over the seam": lidar(beams=61, angle_min=HALF, angle_max=3.0 * HALF),
    "off-centre": lidar(beams=90, mount=(0.2, -0.1, 0.7)),
    "short": lidar(beams=90, range_min=0.4, range_max=1.2),
}


def edges_of(shape, pose):
    """(E, 2, 2) straight edges of a shape at a pose."""
    corners = pose[:2] + geometry.rotate(shape.outline, pose[2])
    if isinstance(shape, Segment):
        return corners[None]
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def met_edges(directions, edges):
    """Ranges and cosines (E, B) of rays from the origin to straight edges (E, 2, 2)."""
    first, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normal /= np.hypot(*normal.T)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (normal * first).sum(axis=1)[:, None] / (normal @ directions.T)
        hits = ranges[..., None] * directions - first[:, None]
        share = (hits * along[:, None]).sum(axis=-1) / (along**2).sum(axis=1)[:, None]
        met = (ranges > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(met, ranges, np.inf), np.abs(normal @ directions.T)


def met_circle(directions, centre, radius):
    """The same (2, B) for both crossings of a circle."""
    along = directions @ centre
    rest = radius**2 - (centre @ centre - along**2)
    root = np.sqrt(np.maximum(rest, 0.0))
    ranges = np.stack([along - root, along + root])
    ranges = np.where((rest > 0.0) & (ranges > 0.0), ranges, np.inf)
    return ranges, np.tile(root / radius, (2, 1))


def by_plane_geometry(spec, scene, model):
    """Intensities (B,), and which beams meet what is clearly the nearest."""
    sensor = geometry.compose(scene.robot, spec.mount)
    angles = sensor[2] + spec.angles
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    found = []
    for shape, pose in zip(scene.shapes, scene.poses, strict=True):
        white = model.reflectivity if shape.reflectivity is None else shape.reflectivity
        centre = pose[:2] - sensor[:2]
        if isinstance(shape, Circle):
            ranges, cosines = met_circle(directions, centre, shape.radius)
        else:
            ranges, cosines = met_edges(directions, edges_of(shape, pose) - sensor[:2])
        found.append((ranges, white * cosines**model.exponent))
    ranges, cosines = met_edges(directions, scene.walls.reshape(-1, 2, 2) - sensor[:2])
    found.append((ranges, model.reflectivity * cosines**model.exponent))
    ranges, light = (np.concatenate(each) for each in zip(*found, strict=True))
    first, second = np.nan_to_num(np.sort(ranges, axis=0)[:2], posinf=1e9)
    clear = (second - first > 1e-3) | (second == 1e9)
    best = np.argmin(ranges, axis=0), np.arange(spec.beams)
    nearest = ranges[best]
    seen = (nearest >= spec.range_min) & (nearest <= spec.range_max)
    value = np.where(seen, model.gain * light[best] / nearest**2, 0.0)
    for limit in (spec.range_min, spec.range_max):
        clear &= np.abs(nearest - limit) > 1e-3
    return value, clear


def lit(spec, shapes, model, renderer="baked", density=None, **options):
    return Scanner(spec, bake(spec, shapes, density, (model,)), renderer, **options)


def both(scanner, scene):
    """Ranges and intensities (B,)."""
    bodies = scanner.place(scene.shapes, scene.poses)
    ranges = scanner.scan(scene.robot, bodies, scene.walls)
    return ranges[0], scanner.intensities(ranges, scene.robot, bodies, scene.walls)[0]


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.5])
@pytest.mark.parametrize("name", SENSORS)
def test_exact_intensities_of_random_scenes_agree_with_plane_geometry(name, exponent):
    spec, compared = SENSORS[name], 0
    model = Intensity(gain=30.0, exponent=exponent, reflectivity=0.3)
    for seed in range(40):
        if seed % 10 == 0:
            shapes = tuple(
                shape.model_copy(update={"reflectivity": 0.1 + 0.1 * i if i % 2 else None})
                for i, shape in enumerate(random_shapes(seed))
            )
            scanner = lit(spec, shapes, model, "exact", COARSE)
        scene = random_scene(seed, shapes)
        found = both(scanner, scene)[1]
        expected, clear = by_plane_geometry(spec, scene, model)
        off = np.abs(found - expected) > 1e-3 * expected + 1e-3
        assert (off & clear).sum() <= 1, seed  # a beam through a corner meets either side
        compared += (expected[clear] > 0.0).sum()
    assert compared > 5 * spec.beams


@pytest.mark.parametrize("shape", [Circle(radius=0.25), SQUARE, STRIP, Circle(radius=0.05)])
def test_baked_intensities_are_near_the_exact_ones(shape):
    spec, model = lidar(beams=720), Intensity()
    table = bake(spec, [shape], sensor_model=[model])
    rng = np.random.default_rng(0)
    away, bearing = rng.uniform(shape.radius + 0.05, 3.0, 300), rng.uniform(-np.pi, np.pi, 300)
    poses = np.stack(
        [away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-np.pi, np.pi, 300)], axis=1
    )
    light = []
    for renderer in ("exact", "baked"):
        scanner, robots = Scanner(spec, table, renderer), np.zeros((300, 3))
        bodies = scanner.place([shape], poses[:, None])
        ranges = scanner.scan(robots, bodies)
        light.append(scanner.intensities(ranges, robots, bodies) * ranges.clip(0.0, 9.0) ** 2)
    met = (light[0] > 0.0) & (light[1] > 0.0)
    off = np.abs(light[1] - light[0])[met] / model.reflectivity
    assert met.sum() > 3000
    assert np.median(off) < 0.01
    assert np.sqrt(np.mean(off**2)) < 0.08  # nearly all of it beside corners and silhouettes
    assert ((light[0] > 0.0) == (light[1] > 0.0)).mean() > 0.999


@pytest.mark.parametrize("renderer", RENDERERS)
def test_baked_or_exact_the_mixture_of_random_scenes_has_much_the_same_intensities(renderer):
    spec, model = lidar(beams=360), Intensity(gain=10.0)
    shapes = (Circle(radius=0.3, reflectivity=0.9), Circle(radius=0.2), SQUARE, STRIP)
    near, scanner = [], lit(spec, shapes, model, renderer)
    for seed in range(40):
        scene = random_scene(seed, shapes)
        expected, clear = by_plane_geometry(spec, scene, model)
        ranges, found = both(scanner, scene)
        clear &= (found > 0.0) & (expected > 0.0)
        near += list(np.abs(found - expected)[clear] * ranges[clear] ** 2 / model.gain)
    assert len(near) > 4000
    assert np.quantile(near, 0.5) < 0.005
    assert np.quantile(near, 0.95) < 0.03


def test_the_nearest_object_gives_the_intensity_and_what_is_beside_it_its_own():
    spec, dark, bright = lidar(beams=360), Circle(radius=0.1, reflectivity=0.1), Circle(radius=0.5)
    model = Intensity(reflectivity=1.0)
    for renderer in RENDERERS:
        for order in (1, -1):
            shapes, poses = (dark, bright)[::order], [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]][::order]
            scene = Scene(HERE[0], shapes, np.array(poses), np.zeros((0, 4)))
            ranges, found = both(lit(spec, (dark, bright), model, renderer), scene)
            ahead = np.argmin(np.abs(spec.angles))
            assert found[ahead] == pytest.approx(0.1 / ranges[ahead] ** 2, rel=0.03)
            beside = np.abs(np.abs(spec.angles) - 0.15) < 0.02
            assert (found[beside] * ranges[beside] ** 2 > 0.6).all()


def test_a_wall_and_a_side_of_a_baked_shape_in_its_place_are_equally_bright():
    spec, model = lidar(beams=360), Intensity(gain=4.0, reflectivity=0.25)
    wall = np.array([[2.0, -0.5, 2.0, 0.5]])
    scanner = lit(spec, [Segment(ends=((0.0, -0.5), (0.0, 0.5)))], model)
    body = scanner.place(scanner.table.shapes, [[2.0, 0.0, 0.0]])
    values = []
    for bodies, walls in ((body, np.zeros((0, 4))), (np.zeros((0, 7)), wall)):
        ranges = scanner.scan(HERE, bodies, walls)
        values.append(scanner.intensities(ranges, HERE, bodies, walls)[0])
    seen = np.abs(spec.angles) < np.arctan2(0.49, 2.0)
    truly = 4.0 * 0.25 * np.cos(spec.angles[seen]) ** 3 / 2.0**2
    assert values[1][seen] == pytest.approx(truly, rel=1e-4)
    assert values[0][seen] == pytest.approx(truly, rel=0.01)
    assert not values[1][np.abs(spec.angles) > 0.3].any()


@pytest.mark.parametrize("renderer", ["exact", "auto"])
def test_a_map_is_as_bright_as_walls_along_the_sides_of_its_cells(renderer):
    cells = np.zeros((40, 40), np.int8)
    cells[:2], cells[-2:], cells[:, :2], cells[:, -2:] = 100, 100, 100, 100
    spec, model = lidar(beams=360, range_max=5.0), Intensity()
    turn = 0.4
    origin = np.array([*geometry.rotate(np.array([-2.0, -2.0]), turn), turn])
    scanner = lit(spec, (), model, renderer, grid=GridMap(cells, 0.1, tuple(origin)))
    x = 1.8
    corners = geometry.rotate(np.array([(-x, -x), (x, -x), (x, x), (-x, x)]), turn)
    walls = np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1)
    poses, none = np.array([[0.3, -0.5, 1.0], [-1.0, 0.2, -2.0]]), np.zeros((2, 0, 7))
    found = scanner.intensities(scanner.scan(poses, none), poses, none)
    plain = lit(spec, (), model, renderer)
    expected = plain.intensities(plain.scan(poses, none, walls), poses, none, walls)
    assert expected.min() > 0.0
    assert (np.abs(found - expected) > 1e-3 * expected).sum() <= 4  # in the corners


def test_only_beams_that_return_have_an_intensity():
    spec = lidar(beams=90, range_min=0.5, range_max=2.0)
    scanner = lit(spec, [SQUARE], Intensity())
    walls = np.array([[0.3, -5.0, 0.3, 5.0], [-1.0, -5.0, -1.0, 5.0]])
    ranges = scanner.scan(HERE, [], walls)
    found = scanner.intensities(ranges, HERE, [], walls)
    assert np.isneginf(ranges).any()
    assert np.isposinf(ranges).any()
    assert np.array_equal(found > 0.0, np.isfinite(ranges))
    ranges[0, ::2] = np.inf
    ranges[0, 1::4] = np.nan
    lossy = scanner.intensities(ranges, HERE, [], walls)
    assert np.array_equal(lossy, np.where(np.isfinite(ranges), found, 0.0))


@pytest.mark.parametrize("renderer", RENDERERS)
def test_what_is_too_close_and_reported_nevertheless_is_as_bright_as_at_range_min(renderer):
    spec, shape = lidar(beams=90, range_min=0.5), Circle(radius=0.5)
    scanner = lit(spec, [shape], Intensity(reflectivity=1.0), renderer)
    body = scanner.place([shape], [[0.8, 0.0, 0.0]])
    ranges = scanner.scan(HERE, body)
    ahead = np.argmin(np.abs(spec.angles))
    assert np.isneginf(ranges[0, ahead])
    ranges[np.isneginf(ranges)] = spec.range_min
    assert scanner.intensities(ranges, HERE, body)[0, ahead] == pytest.approx(4.0, rel=0.02)


def test_a_device_reports_no_more_than_its_saturation():
    spec = lidar(beams=90)
    walls = [[1.0, -9.0, 1.0, 9.0]]
    ranges = lit(spec, (), Intensity()).scan(HERE, [], walls)
    free, held = (
        lit(spec, (), Intensity(gain=10.0, saturation=most)).intensities(ranges, HERE, [], walls)
        for most in (None, 2.0)
    )
    assert free.max() > 4.0
    assert np.array_equal(held, np.minimum(free, 2.0))


def test_robots_of_a_batch_have_the_intensities_that_each_has_alone():
    spec, shapes = lidar(beams=90), (Circle(radius=0.3), SQUARE)
    scanner, rng = lit(spec, shapes, Intensity()), np.random.default_rng(1)
    poses, places = rng.uniform(-1.0, 1.0, (5, 3)), rng.uniform(-2.0, 2.0, (5, 2, 3))
    bodies = scanner.place(shapes, places)
    ranges, out = scanner.scan(poses, bodies), np.empty((5, 90), np.float32)
    assert scanner.intensities(ranges, poses, bodies, out=out) is out
    for n in range(5):
        alone = scanner.intensities(ranges[n], poses[n], bodies[n])
        assert np.array_equal(alone[0], out[n])


def test_ranges_are_the_same_to_the_bit_with_and_without_intensities_in_the_table():
    spec, shapes = lidar(beams=360), (Circle(radius=0.3), SQUARE, STRIP)
    scene, scans = random_scene(3, shapes), []
    for model in ((), (Intensity(),)):
        scanner = Scanner(spec, bake(spec, shapes, sensor_model=model))
        bodies = scanner.place(scene.shapes, scene.poses)
        scans.append(scanner.scan(scene.robot, bodies, scene.walls))
    assert np.array_equal(*scans)


def test_a_table_without_intensities_says_how_to_get_them():
    spec = lidar(beams=90)
    for model in ((), (IncidenceDropout(greatest_incidence=1.0),)):
        scanner = Scanner(spec, bake(spec, [SQUARE], COARSE, model))
        with pytest.raises(ModelError, match=r"holds no intensities; bake it with .* `intensity`"):
            scanner.intensities(np.zeros((1, 90)), HERE, [])


def test_ranges_of_another_number_of_beams_are_refused():
    with pytest.raises(ConfigError, match=r"ranges \(1, 8\) must be \(1, 90\)"):
        lit(lidar(beams=90), (), Intensity()).intensities(np.zeros((1, 8)), HERE, [])
