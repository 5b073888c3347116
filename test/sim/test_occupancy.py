from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.geometry import rotate
from nics_drl_bridge.lidar.maps import FREE, OCCUPIED, load_map, map_files
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Segment
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.sim.occupancy import MOST_CELLS, occupancy, standing
from nics_drl_bridge.sim.scenes import SceneSampler
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import load_worlds

LIDAR = load_lidar("rplidar_a2")


def world_of(**keys):
    return World.model_validate({"name": "made", "goal_distance": (0.0, 1.0), **keys})


def agreement(name, seed):
    """Share of beams whose end in the map is within a cell of what the beams beside it show."""
    worlds = load_worlds(name)
    sampler = SceneSampler(worlds, 0.2)
    scene = sampler.draw([seed])[0]
    world = worlds.members[int(scene.member)]
    placed = standing(sampler, int(scene.member), scene.bodies)
    grid = occupancy(world, placed)
    shapes = [shape for shape, _ in placed]
    exact = make_scanner(LIDAR, shapes, "exact", world.grid)
    mapped = make_scanner(LIDAR, [], "exact", grid)
    free = np.argwhere(grid.distance_field > 0.2)[::997]
    poses = np.column_stack(
        [grid.cell_to_world(free), np.linspace(-3.0, 3.0, len(free))]
    )
    at = np.array([pose for _, pose in placed]).reshape(-1, 3)
    bodies = np.tile(exact.place(shapes, at), (len(poses), 1, 1))
    true = exact.scan(poses, bodies, world.all_walls())
    around = np.stack([np.roll(true, k, axis=1) for k in (-1, 0, 1)])
    seen = mapped.scan(poses, [])
    slack = 1.5 * grid.resolution
    return np.mean(
        (seen >= around.min(axis=0) - slack) & (seen <= around.max(axis=0) + slack)
    )


@pytest.mark.parametrize("name", ["clutter", "room"])
def test_beams_in_the_map_end_where_they_end_in_the_world(name):
    assert agreement(name, 3) > 0.995


def test_a_map_of_a_world_is_kept_to_its_cells_however_coarse_they_are():
    world = load_worlds("room")
    for cell in (0.05, 0.03, 1.0):
        grid = occupancy(world, [], cell)
        parts = round(world.grid.resolution / grid.resolution)
        inner = grid.cells[1:-1, 1:-1]
        assert np.array_equal(inner, world.grid.cells.repeat(parts, 0).repeat(parts, 1))
        assert grid.cell_to_world([1, 1]) == pytest.approx(
            world.grid.cell_to_world([0, 0])
            + grid.resolution / 2
            - world.grid.resolution / 2
        )


def test_what_moves_is_left_out():
    worlds = load_worlds("crowd")
    sampler = SceneSampler(worlds, 0.2)
    scene = sampler.draw([0])[0]
    pillars = worlds.obstacles[-1]
    assert np.count_nonzero(scene.bodies[:, 5]) > len(pillars.at)
    assert [tuple(pose) for _, pose in standing(sampler, 0, scene.bodies)] == list(
        pillars.at
    )


def test_things_thinner_than_a_cell_do_not_vanish():
    world = world_of(bounds=(-1.0, -1.0, 1.0, 1.0), walls=[(-0.5, -0.5, 0.5, -0.4)])
    bar = Segment(ends=((0.0, 0.0), (0.3, 0.0)))
    sliver = Polygon(points=((0.0, 0.0), (0.6, 0.001), (0.6, 0.002), (0.0, 0.001)))
    placed = [(sliver, (-0.3, 0.3, 0.2)), (bar, (0.0, 0.7, 1.0))]
    grid = occupancy(world, placed, 0.05)
    ends = [[(-0.5, -0.5), (0.5, -0.4)]]
    for shape, pose in placed:
        ends.append(rotate(shape.outline[[0, 1]], pose[2]) + pose[:2])
    for begin, end in ends:
        line = np.linspace(begin, end, 50)
        assert (grid.cells[tuple(grid.world_to_cell(line).T)] == OCCUPIED).mean() > 0.9


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.025, 0.025), (0.31, -0.17)])
def test_a_pole_thinner_than_a_cell_does_not_vanish(at):
    world = world_of(bounds=(-1.0, -1.0, 1.0, 1.0))
    grid = occupancy(world, [(Circle(radius=0.01), (*at, 0.0))], 0.05)
    assert (grid.cells == OCCUPIED).sum() == 1
    assert grid.cells[tuple(grid.world_to_cell(at))] == OCCUPIED


def test_a_field_beside_a_turned_map_is_closed_all_around(tmp_path):
    map_files(load_map("room"), tmp_path / "own.yaml")
    text = (tmp_path / "own.yaml").read_text().replace("- 0.0\n", "- 0.3\n")
    (tmp_path / "own.yaml").write_text(text)
    world = world_of(size=(20.0, 20.0), map=str(tmp_path / "own.yaml"))
    grid = occupancy(world)
    outside = grid.world_to_cell([(10.02, 0.0), (0.0, -10.02), (9.9, 0.0)])
    assert grid.cells[tuple(outside.T)].tolist() == [OCCUPIED, OCCUPIED, FREE]


def test_a_large_world_has_larger_cells():
    grid = occupancy(
        world_of(size=(400.0, 100.0)), [(Circle(radius=3.0), (20.0, 0.0, 0.0))]
    )
    assert grid.cells.size < 1.1 * MOST_CELLS
    assert grid.cells[tuple(grid.world_to_cell([20.0, 0.0]))] == OCCUPIED


@pytest.mark.parametrize("values", [(FREE, OCCUPIED, -1), (FREE, OCCUPIED, -1, 30)])
def test_files_of_a_map_are_read_back_with_the_same_cells(values, tmp_path):
    grid = occupancy(load_worlds("arena"), [], 0.1)
    grid.cells[:] = np.random.default_rng(0).choice(values, grid.cells.shape)
    map_files(grid, tmp_path / "made.yaml")
    again = load_map(tmp_path / "made.yaml")
    assert np.array_equal(again.cells, grid.cells)
    assert (again.resolution, again.origin) == (grid.resolution, grid.origin)
