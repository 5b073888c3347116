from __future__ import annotations

import numpy as np
import pytest
from lidar_scenes import Scene, by_plane_geometry
from robots import lidar

from nics_drl_bridge.geometry import rotate
from nics_drl_bridge.lidar import map_kernels
from nics_drl_bridge.lidar.beam_kernels import LidarPose, make_beams
from nics_drl_bridge.lidar.maps import NO_MAP, GridMap
from nics_drl_bridge.lidar.scan_kernels import scan_scratch

BEAMS = 37
KERNELS = ("exact", "baked")


def directions(beams=BEAMS):
    angles = -np.pi + 2.0 * np.pi / beams * np.arange(beams)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def scan(kernel, grid, pose, range_max=100.0, rays=None, before=np.inf):
    """A scan (B,) from x, y, heading."""
    rays = directions() if rays is None else np.asarray(rays, dtype=np.float64)
    scratch = scan_scratch(len(rays))
    out = scratch.scan.view(np.float32)
    out[:] = before
    c = np.cos(pose[2])
    s = np.sin(pose[2])
    arrays = grid if isinstance(grid, tuple) else grid.arrays
    beams = make_beams(np.ascontiguousarray(rays.T), -np.pi, 2.0 * np.pi / len(rays))
    lidar = LidarPose(*map(float, pose[:2]), c, s, float(pose[2]))
    map_kernels.scan_map(
        scratch.scan,
        beams,
        lidar,
        range_max,
        arrays,
        kernel == "exact",
        scratch.singles,
        scratch.integers,
    )
    return out[: len(rays)]


def random_map(seed):
    rng = np.random.default_rng(seed)
    shape = rng.integers(1, 30, 2)
    cells = (rng.random(shape) < rng.choice([0.02, 0.1, 0.4])) * np.int8(100)
    origin = (*rng.uniform(-2.0, 2.0, 2), rng.uniform(-np.pi, np.pi))
    return GridMap(
        cells.astype(np.int8), float(rng.choice([0.05, 0.1, 0.3])), origin
    ), rng


def random_pose(grid, rng):
    """Anywhere in the map, or up to half its size outside."""
    size = np.array(grid.cells.shape)
    place = rng.uniform(-0.5, 1.5, 2) if rng.random() < 0.3 else rng.random(2)
    return np.array(
        [*grid.cell_to_world(place * size - 0.5), rng.uniform(-np.pi, np.pi)]
    )


def by_shapely(grid, pose):
    """Ranges to the edges that only one solid cell has, and which beams are fit to compare."""
    solid = np.pad(grid.blocked, 1)
    upright = np.argwhere(solid[:, 1:] != solid[:, :-1])[:, ::-1]
    level = np.argwhere(solid[1:] != solid[:-1])[:, ::-1]
    lines = [(column, row - 1, column, row) for column, row in upright]
    lines += [(column - 1, row, column, row) for column, row in level]
    ends = np.array(lines, float).reshape(-1, 2) * grid.resolution
    walls = (rotate(ends, grid.origin[2]) + grid.origin[:2]).reshape(-1, 4)
    spec = lidar(beams=BEAMS, range_min=0.0, range_max=100.0)
    return by_plane_geometry(spec, Scene(pose, (), np.zeros((0, 3)), walls))


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_scans_of_random_maps_agree_with_plane_geometry(kernel):
    seen = 0
    solid = 0
    outside = 0
    for seed in range(70):
        grid, rng = random_map(seed)
        pose = random_pose(grid, rng)
        expected, clear = by_shapely(grid, pose)
        found = scan(kernel, grid, pose)
        assert found[clear] == pytest.approx(expected[clear], rel=1e-5, abs=1e-6), seed
        seen += np.isfinite(found[clear]).sum()
        row, column = grid.world_to_cell(pose[:2])
        inside = 0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]
        outside += not inside
        solid += inside and grid.blocked[row, column]
    assert seen > 800
    assert min(solid, outside) > 2


def test_both_ways_agree_from_the_corners_edges_and_centres_of_cells():
    turn = 0.1  # else many beams run into corners, which are on both sides of them
    rng = np.random.default_rng(4)
    grid = GridMap((rng.random((40, 50)) < 0.05).astype(np.int8) * np.int8(100), 0.125)
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.5, 0.5)):
        for place in np.argwhere(~grid.blocked)[::7]:
            at = np.array([*(place[::-1] + shift) * 0.125, turn])
            one, other = (
                scan(kernel, grid, at, rays=directions(720)) for kernel in KERNELS
            )
            touching = one == 0.0  # a lidar on the corner of a solid, looking past it
            assert (np.isclose(one, other, atol=1e-5) | (one == other) | touching).all()


@pytest.mark.parametrize("kernel", KERNELS)
def test_beams_exactly_along_the_axes_meet_the_faces_of_cells(kernel):
    cells = np.zeros((9, 9), np.int8)
    cells[4, 7] = cells[8, 4] = cells[4, 0] = 100
    rays = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]
    found = scan(kernel, GridMap(cells, 0.1), (0.45, 0.45, 0.0), rays=rays)
    assert found == pytest.approx([0.25, 0.35, 0.35, np.inf], abs=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_return_at_range_max_is_kept_and_one_beyond_is_not(kernel):
    cells = np.zeros((1, 100), np.int8)
    cells[0, 80] = 100
    grid = GridMap(cells, 0.05)
    for limit, expected in ((3.0, 3.0), (2.99, np.inf)):
        found = scan(kernel, grid, (1.0, 0.025, 0.0), limit, rays=[[1.0, 0.0]])
        assert found[0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
def test_no_map_leaves_the_scan_alone(kernel):
    assert (scan(kernel, NO_MAP, (0.0, 0.0, 0.0), before=1.5) == 1.5).all()


def test_squares_larger_than_a_byte_are_taken_in_several_jumps():
    cells = np.zeros((3, 900), np.int8)
    cells[1, 890] = 100
    wide = GridMap(np.repeat(cells, 300, axis=0), 0.1)
    found = scan("baked", wide, (0.05, 45.05, 0.0), rays=[[1.0, 0.0]])
    assert found[0] == pytest.approx(88.95, abs=1e-4)
