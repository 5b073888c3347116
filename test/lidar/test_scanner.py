from __future__ import annotations

import numpy as np
import pytest
import shapely
from robots import lidar

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.lidar.scanner import make_scanner

RADII = (0.1, 0.25, 0.4)
NO_WALLS = np.zeros((0, 4))
EDGE = 1e-3  # beams that pass an edge this closely [m] are left out of comparisons
HALF = np.pi / 2.0

SENSORS = {
    "full circle": lidar(beams=90),
    "full circle from zero": lidar(beams=90, angle_min=0.0, angle_max=2.0 * np.pi),
    "front": lidar(beams=61, angle_min=-2.0, angle_max=2.0),
    "over the rear": lidar(beams=61, angle_min=HALF, angle_max=3.0 * HALF),
    "clockwise of zero": lidar(beams=61, angle_min=-6.0, angle_max=-1.0),
    "off-centre": lidar(beams=90, mount=(0.2, -0.1, 0.7)),
    "half, off-centre": lidar(beams=45, angle_min=-HALF, angle_max=HALF, mount=(-0.3, 0.1, 3.0)),
    "short": lidar(beams=90, range_min=0.4, range_max=1.2),
}


def random_scene(seed):
    rng = np.random.default_rng(seed)
    pose = np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(-np.pi, np.pi)])
    circles = np.column_stack([rng.uniform(-2.5, 2.5, (5, 2)), rng.choice(RADII, 5)])
    circles[4, 2] = 0.0  # no circle
    walls = rng.uniform(-3.0, 3.0, (4, 4))
    return pose, circles, walls


def exact_by_shapely(spec, pose, circles, walls):
    """Ranges and which beams pass no edge closely, by a library of plane geometry."""
    sensor = geometry.compose(pose, spec.mount)
    angles = sensor[2] + spec.angles
    ends = sensor[:2] + 20.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rays = shapely.linestrings([[sensor[:2], end] for end in ends])
    here = shapely.points(sensor[:2])
    shapes = [shapely.Point(x, y).buffer(r, quad_segs=256).boundary for x, y, r in circles if r > 0]
    shapes += [shapely.linestrings([wall[:2], wall[2:]]) for wall in walls]
    ranges, clear = np.full(spec.beams, np.inf), np.ones(spec.beams, dtype=bool)
    for shape in shapes:
        hits = shapely.intersection(rays, shape)
        distance = shapely.distance(here, hits)
        ranges = np.fmin(ranges, np.where(np.isnan(distance), np.inf, distance))
    for x, y, r in circles:
        offset = np.array([x, y]) - sensor[:2]
        across = np.abs(np.cos(angles) * offset[1] - np.sin(angles) * offset[0])
        clear &= (np.abs(across - r) > EDGE) | (r == 0.0)
    tips = shapely.points(np.asarray(walls).reshape(-1, 2))
    for tip in tips:
        clear &= shapely.distance(rays, tip) > EDGE
    ranges, clear = limited(spec, ranges, clear)
    return ranges, clear


def limited(spec, ranges, clear):
    """REP-117 beyond the limits; the limits themselves are left out of comparisons."""
    clear &= np.abs(ranges - spec.range_max) > EDGE
    clear &= np.abs(ranges - spec.range_min) > EDGE
    ranges = np.where(ranges > spec.range_max, np.inf, ranges)
    return np.where(ranges < spec.range_min, -np.inf, ranges), clear


@pytest.mark.parametrize("name", SENSORS)
def test_exact_scans_of_random_scenes_agree_with_plane_geometry(name):
    spec = SENSORS[name]
    scanner = make_scanner(spec, RADII, "exact")
    seen = 0
    for seed in range(15):
        pose, circles, walls = random_scene(seed)
        scan = scanner.scan(pose, circles, walls)[0]
        expected, clear = exact_by_shapely(spec, pose, circles, walls)
        assert scan[clear] == pytest.approx(expected[clear], abs=1e-3), seed
        seen += np.isfinite(scan[clear]).sum()
    assert seen > 200


@pytest.mark.parametrize("name", SENSORS)
def test_baked_scans_of_random_scenes_agree_with_exact_ones(name):
    spec = SENSORS[name]
    baked, exact = make_scanner(spec, RADII), make_scanner(spec, RADII, "exact")
    errors, same = [], []
    for seed in range(60):
        pose, circles, walls = random_scene(seed)
        looked_up, computed = (s.scan(pose, circles, walls)[0] for s in (baked, exact))
        hit = np.isfinite(looked_up)
        same.append(hit == np.isfinite(computed))
        both = same[-1] & hit
        errors.append(looked_up[both] - computed[both])
    assert np.mean(same) > 0.999
    # A beam of these lidars is 4 degrees wide; at the rim of a circle that is centimetres.
    assert np.sqrt((np.concatenate(errors) ** 2).mean()) < 0.01
    assert np.abs(np.concatenate(errors)).max() < 0.25


def test_baked_scans_of_the_papers_circle_scene_are_off_by_less_than_5_mm():
    spec = lidar(beams=720)
    baked, exact = make_scanner(spec, RADII), make_scanner(spec, RADII, "exact")
    rng = np.random.default_rng(1)
    scenes = 200
    bearing, distance = (
        rng.uniform(-np.pi, np.pi, (scenes, 10)),
        rng.uniform(0.6, 3.0, (scenes, 10)),
    )
    circles = np.stack(
        [
            distance * np.cos(bearing),
            distance * np.sin(bearing),
            rng.choice(RADII, (scenes, 10)),
        ],
        axis=-1,
    )
    poses = np.zeros((scenes, 3))
    one, other = (
        np.minimum(scanner.scan(poses, circles, NO_WALLS), spec.range_max)
        for scanner in (baked, exact)
    )
    assert (other < spec.range_max).mean() > 0.2
    assert np.sqrt(((one - other) ** 2).mean()) < 0.005


@pytest.mark.parametrize("renderer", ["baked", "exact"])
def test_a_lidar_inside_a_circle_sees_its_far_side(renderer):
    spec = lidar(beams=36)
    circle = [[0.1, 0.0, 0.25]]
    scan = make_scanner(spec, (0.25,), renderer).scan([0.0, 0.0, 0.0], circle, NO_WALLS)[0]
    c, s = np.cos(spec.angles), np.sin(spec.angles)
    assert scan == pytest.approx(0.1 * c + np.sqrt(0.25**2 - (0.1 * s) ** 2), abs=1e-5)


@pytest.mark.parametrize("renderer", ["baked", "exact"])
def test_ranges_beyond_the_limits_are_infinite_with_the_sign_of_rep_117(renderer):
    spec = lidar(beams=4, range_min=0.5, range_max=2.0)
    scanner = make_scanner(spec, (0.25,), renderer)
    #        behind (beam 0)     right           ahead            left
    circles = [[-0.6, 0.0, 0.25], [0.0, -2.2, 0.25], [2.3, 0.0, 0.25], [0.0, 0.8, 0.25]]
    scan = scanner.scan([0.0, 0.0, 0.0], circles, NO_WALLS)[0]
    assert scan[0] == -np.inf
    assert scan[1] == pytest.approx(1.95, abs=1e-4)
    assert scan[2] == np.inf
    assert scan[3] == pytest.approx(0.55, abs=1e-4)


def test_a_wall_seen_edge_on_returns_nothing():
    scanner = make_scanner(lidar(beams=8), (0.1,))
    assert np.isinf(scanner.scan([0.0, 0.0, 0.0], [], [[1.0, 0.0, 2.0, 0.0]])).all()


def test_walls_are_seen_from_both_sides_whichever_end_comes_first():
    scanner = make_scanner(lidar(beams=8), (0.1,))
    for wall in ([1.0, -5.0, 1.0, 5.0], [1.0, 5.0, 1.0, -5.0]):
        for x, ahead in ((0.0, 0.0), (2.0, np.pi)):
            scan = scanner.scan([x, 0.0, ahead], [], [wall])[0]
            assert scan[4] == pytest.approx(1.0, abs=1e-6)
            assert np.isinf(scan[0])


def test_a_closed_room_returns_on_every_beam():
    scanner = make_scanner(lidar(beams=500), (0.1,))
    room = [[-1, -1, 1, -1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, 1, -1, -1]]
    for pose in np.random.default_rng(2).uniform(-0.9, 0.9, (50, 3)):
        scan = scanner.scan(pose, [], room)
        assert np.isfinite(scan).all()


def test_the_nearest_of_several_objects_is_returned():
    scanner = make_scanner(lidar(beams=4), (0.25,), "exact")
    circles = [[2.0, 0.0, 0.25], [1.0, 0.0, 0.25]]
    wall = [[1.5, -1.0, 1.5, 1.0]]
    assert scanner.scan([0.0, 0.0, 0.0], circles, wall)[0, 2] == pytest.approx(0.75)
    assert scanner.scan([0.0, 0.0, 0.0], circles[:1], wall)[0, 2] == pytest.approx(1.5)


def test_a_scan_in_a_batch_is_the_scan_alone():
    scanner = make_scanner(lidar(), RADII)
    scenes = [random_scene(seed) for seed in range(8)]
    walls = scenes[0][2]
    poses, circles = (np.array([scene[i] for scene in scenes]) for i in (0, 1))
    batch = scanner.scan(poses, circles, walls)
    for n in range(8):
        assert np.array_equal(batch[n], scanner.scan(poses[n], circles[n], walls)[0])


def test_two_lidars_in_one_process_use_their_own_tables():
    wide, narrow = lidar(beams=90), lidar(beams=30, angle_min=-1.0, angle_max=1.0, range_max=2.0)
    scanners = [make_scanner(wide, RADII), make_scanner(narrow, (0.4,))]
    circle = [[1.0, 0.2, 0.4]]
    for scanner in (*scanners, *scanners):
        exact = make_scanner(scanner.spec, RADII, "exact")
        scan = scanner.scan([0.0, 0.0, 0.0], circle, NO_WALLS)
        computed = exact.scan([0.0, 0.0, 0.0], circle, NO_WALLS)
        assert scan.shape == (1, scanner.spec.beams)
        assert np.array_equal(np.isfinite(scan), np.isfinite(computed))
        hit = np.isfinite(scan)
        assert scan[hit] == pytest.approx(computed[hit], abs=0.05)


def test_a_circle_that_was_not_baked_is_refused():
    scanner = make_scanner(lidar(), (0.1, 0.25))
    with pytest.raises(ModelError, match=r"radius 0.3 m is not in the lidar table \(it holds 0.1"):
        scanner.scan([0.0, 0.0, 0.0], [[1.0, 0.0, 0.3]], NO_WALLS)
