from __future__ import annotations

import shutil

import numpy as np
import pytest
import shapely
from robots import circles, field

from nics_drl_bridge.config import share_folder, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.sim.collision_kernels import wall_distance
from nics_drl_bridge.sim.world import World, check_places, load_world

CIRCLE = {"kind": "circle", "radius": 0.2}


def walls_of(world):
    return shapely.multilinestrings(world.all_walls().reshape(-1, 2, 2))


def test_a_world_of_a_map_alone_has_no_other_walls_and_the_extent_of_the_map():
    world = World(name="map", map="room", goal_distance=(1.0, 2.0))
    assert world.all_walls().shape == (0, 4)
    assert world.extent == pytest.approx((-3.0, -4.0, 7.0, 4.0))
    assert np.array_equal(world.grid.cells, load_map("room").cells)


def test_a_field_of_bounds_has_no_walls_and_lies_where_they_say():
    world = World(name="open", bounds=(1.0, 2.0, 4.0, 9.0), goal_distance=(1.0, 2.0))
    assert world.all_walls().shape == (0, 4)
    assert world.extent == (1.0, 2.0, 4.0, 9.0)


def test_bounds_are_part_of_the_fingerprint_of_the_worlds_that_have_them():
    assert load_world("arena").fingerprint == "arena-261566ec"
    fields = [
        World(name="open", bounds=(0.0, 0.0, 6.0, y), goal_distance=(1.0, 2.0))
        for y in (6.0, 7.0)
    ]
    assert fields[0].fingerprint != fields[1].fingerprint


def test_wall_distance_is_that_of_plane_geometry():
    world = field(6.0, walls=[[-1.0, -1.0, 1.0, 0.5]])
    walls = world.all_walls()
    for x, y in np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2)):
        expected = shapely.distance(shapely.Point(x, y), walls_of(world))
        assert wall_distance(x, y, walls) == pytest.approx(expected, abs=1e-12)
    assert wall_distance(0.0, 0.0, np.zeros((0, 4))) == np.inf
    assert wall_distance(3.0, 4.0, np.zeros((1, 4))) == 5.0


def test_worlds_of_equal_content_share_a_fingerprint_and_others_do_not():
    assert field().fingerprint == field().fingerprint
    others = [
        field(5.0),
        field(count=1),
        field(walls=[[0.0, 0.0, 1.0, 0.0]]),
        load_world("room"),
    ]
    assert len({world.fingerprint for world in (field(), *others)}) == 5


@pytest.fixture
def own_world(tmp_path):
    """A world file with a copy of the shipped map beside it."""
    folder = share_folder() / "config" / "maps"
    (tmp_path / "maps").mkdir()
    for name in ("room.yaml", "room.pgm"):
        shutil.copy(folder / name, tmp_path / "maps" / name)
    file = tmp_path / "own.yaml"
    file.write_text("name: room\nmap: maps/room.yaml\ngoal_distance: [1.0, 2.0]\n")
    return file


def test_a_map_is_looked_for_from_the_folder_of_the_world_file(own_world):
    assert np.array_equal(load_world(str(own_world)).grid.cells, load_map("room").cells)


def test_the_fingerprint_changes_with_the_content_of_the_map_but_not_with_its_path(
    own_world,
):
    before = load_world(str(own_world)).fingerprint
    named = World(name="room", map="room", goal_distance=(1.0, 2.0))
    assert before == named.fingerprint
    picture = own_world.parent / "maps" / "room.pgm"
    data = bytearray(picture.read_bytes())
    data[-1] = 254 if data[-1] == 0 else 0
    picture.write_bytes(bytes(data))
    assert load_world(str(own_world)).fingerprint != before


def test_a_missing_map_is_refused_when_the_world_is_loaded(own_world):
    own_world.write_text(
        "name: room\nmap: maps/rooom.yaml\ngoal_distance: [1.0, 2.0]\n"
    )
    with pytest.raises(ConfigError, match=r"rooom.yaml: no such file"):
        load_world(str(own_world))
    own_world.write_text("name: room\nmap: rom\ngoal_distance: [1.0, 2.0]\n")
    with pytest.raises(ConfigError, match="did you mean 'room'"):
        load_world(str(own_world))


NO_FIELD = {"size": None}


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"size": [0.0, 3.0]}, "'size.0'"),
        ({"size": [1e12, 1e12]}, "'size.0'"),
        (NO_FIELD, "needs a `size`"),
        ({"bounds": [0.0, 0.0, 1.0, 1.0]}, "either a `size` (with walls)"),
        (NO_FIELD | {"bounds": [1.0, 0.0, 0.0, 1.0]}, "bounds must be"),
        (NO_FIELD | {"bounds": [0.0, 0.0, 1.0, 2e4]}, "bounds must be"),
        (NO_FIELD | {"bounds": [0.0, 0.0, 4e3, 4e3]}, "5657 m across"),
        ({"goal_distance": [3.0, 1.0]}, "goal_distance must be"),
        ({"goal_distance": [1.0, 1e308]}, "'goal_distance.1'"),
        ({"obstacles": [circles(1, (0.0,))]}, "'obstacles.0.shapes.0.circle.radius'"),
        ({"obstacles": [circles(1, (1e308,))]}, "'obstacles.0.shapes.0.circle.radius'"),
        ({"obstacles": [circles(1, ())]}, "'obstacles.0.shapes'"),
        ({"obstacles": [circles(-1)]}, "'obstacles.0.count'"),
        ({"obstacles": [circles([3, 1])]}, "'obstacles.0.count'"),
        ({"obstacles": [circles("many")]}, "'obstacles.0.count'"),
        ({"obstacles": [circles(10**9)]}, "'obstacles.0.count'"),
        (
            {"obstacles": [circles(9_000), circles(9_000)]},
            "together may have at most 10000",
        ),
        ({"obstacles": [circles(1) | {"at": [[0.0] * 3]}]}, "either `count` or `at`"),
        ({"obstacles": [{"shapes": [CIRCLE]}]}, "either `count` or `at`"),
        ({"obstacles": [circles(1, gap=1e300)]}, "'obstacles.0.gap'"),
        ({"obstacles": [circles(1) | {"gab": 0.1}]}, "did you mean 'gap'"),
        ({"obstacles": [circles(None) | {"at": [[1, 1, -90]]}]}, "in radians"),
        ({"walls": [[0.0, 1.0]]}, "'walls.0"),
        ({"walls": [[0.0, 0.0, 1.0, 1.0]] * 20_000}, "'walls'"),
        ({"starts": {}}, "either `regions` or `at`"),
        ({"starts": {"regions": [[1e300] * 4]}}, "'starts.regions.0.0'"),
        ({"goals": {"at": [[0.0, 0.0, 0.0]]}}, "'goals.at.0"),
    ],
)
def test_a_world_that_cant_be_is_refused_by_the_key(changes, key):
    with pytest.raises(ConfigError) as caught:
        validate(field().model_dump(mode="json") | changes, World, "world.yaml")
    assert key in str(caught.value)
    assert str(caught.value).startswith("world.yaml: ")
    assert len(str(caught.value)) < 400


def patrolled(*waypoints):
    motion = {"kind": "patrol", "waypoints": list(waypoints), "speed": 0.5}
    return {"shapes": [CIRCLE], "count": 1, "motion": motion}


@pytest.mark.parametrize(
    ("group", "key"),
    [
        ({"shapes": [CIRCLE], "at": [[0, 0, 0], [9, 0, 0]]}, "at.1"),
        (patrolled([0, 0], [9, 0]), "motion.waypoints.1"),
        (patrolled([-1.9, 0], [0, 0]), "motion.waypoints.0"),
        (patrolled([0, 0], [0.1, 1]), "motion.waypoints.1"),
    ],
    ids=["at", "outside", "at a side", "at a wall"],
)
def test_a_place_where_an_obstacle_cant_be_is_refused_by_name(group, key):
    world = field(4.0, walls=[[0.0, 0.5, 0.0, 1.5]], obstacles=[group])
    with pytest.raises(ConfigError, match=f"world 'field': key 'obstacles.0.{key}'"):
        check_places(world)
