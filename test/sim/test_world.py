from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
import shapely
from robots import circles, field

from nics_drl_bridge.config import share_folder, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.sim.collision_kernels import wall_distance
from nics_drl_bridge.sim.world import World, load_world

CIRCLE = {"kind": "circle", "radius": 0.2}


def walls_of(world):
    return shapely.multilinestrings(world.all_walls().reshape(-1, 2, 2))


def test_the_field_is_closed_by_its_walls():
    walls = field(4.0, walls=[[0.0, 0.0, 1.0, 0.0]]).all_walls()
    assert walls.shape == (5, 4)
    ring = shapely.polygonize(
        [shapely.linestrings(wall.reshape(2, 2)) for wall in walls[:4]]
    )
    assert shapely.area(ring) == pytest.approx(16.0)


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


def test_an_obstacle_beyond_the_bounds_is_refused(tmp_path):
    file = tmp_path / "open.yaml"
    file.write_text(
        "name: open\nbounds: [2.0, 2.0, 5.0, 5.0]\ngoal_distance: [1.0, 2.0]\n"
        "obstacles: [{shapes: [{kind: circle, radius: 0.1}], at: [[1.0, 3.0, 0.0]]}]\n"
    )
    with pytest.raises(
        ConfigError, match=r"'obstacles.0.at.0': .* is outside the world"
    ):
        load_world(file)


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


def test_an_unknown_key_is_named_with_the_file_and_the_nearest_key(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("name: own\nsize: [3.0, 3.0]\ngoal_distanze: [1.0, 2.0]\n")
    with pytest.raises(ConfigError) as caught:
        load_world(str(file))
    assert str(file) in str(caught.value)
    assert "did you mean 'goal_distance'?" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"size": [0.0, 3.0]},
            "key 'size.0': input should be greater than or equal to 0.01",
        ),
        ({"size": None}, "needs a `size`, `bounds`, or a `map`"),
        (
            {"bounds": [0.0, 0.0, 1.0, 1.0]},
            "either a `size` and walls, or `bounds` and none",
        ),
        (
            {"size": None, "bounds": [1.0, 0.0, 0.0, 1.0]},
            "bounds must be [least x, least y",
        ),
        (
            {"size": None, "bounds": [0.0, 0.0, 1.0, 2e4]},
            "bounds must be [least x, least y",
        ),
        (
            {"size": None, "bounds": [0.0, 0.0, 1.0]},
            "'bounds': number of entries must be more",
        ),
        ({"goal_distance": [3.0, 1.0]}, "goal_distance must be"),
        (
            {"obstacles": [circles(1, (0.0,))]},
            "key 'obstacles.0.shapes.0.circle.radius'",
        ),
        ({"obstacles": [circles(1, ())]}, "key 'obstacles.0.shapes'"),
        (
            {"obstacles": [circles(-1)]},
            "count must be a whole number, or [minimum, maximum]",
        ),
        (
            {"obstacles": [circles([3, 1])]},
            "count must be a whole number, or [minimum, maximum]",
        ),
        (
            {"obstacles": [circles("many")]},
            "key 'obstacles.0.count': count must be a whole number",
        ),
        ({"obstacles": [circles(9_000), circles(9_000)]}, "together may have 10000"),
        (
            {"obstacles": [circles(1) | {"at": [[0.0, 0.0, 0.0]]}]},
            "either `count` or `at`",
        ),
        ({"obstacles": [{"shapes": [CIRCLE]}]}, "either `count` or `at`"),
        ({"obstacles": [circles(1) | {"gab": 0.1}]}, "did you mean 'gap'"),
        (
            {
                "obstacles": [
                    {"shapes": [{"kind": "rectangle", "sise": [1, 1]}], "count": 1}
                ]
            },
            "did you mean 'size'",
        ),
        (
            {"obstacles": [circles(1) | {"motion": {"kind": "fly"}}]},
            "key 'obstacles.0.motion'",
        ),
        ({"walls": [[0.0, 1.0]]}, "key 'walls.0"),
        ({"starts": {}}, "either `regions` or `at`"),
        ({"goals": {"at": [[0.0, 0.0, 0.0]]}}, "key 'goals.at.0"),
        ({"clearanze": 0.1}, "did you mean 'clearance'"),
    ],
)
def test_a_world_that_cant_be_is_refused_in_one_sentence(changes, sentence):
    with pytest.raises(ConfigError) as caught:
        validate(field().model_dump(mode="json") | changes, World, "world.yaml")
    assert sentence in str(caught.value)
    assert str(caught.value).startswith("world.yaml: ")
    assert "\n" not in str(caught.value)
    assert not re.search(r"\.\S*\. ", str(caught.value))


def patrolled(*waypoints):
    motion = {"kind": "patrol", "waypoints": list(waypoints), "speed": 0.5}
    return {"shapes": [CIRCLE], "count": 1, "motion": motion}


@pytest.mark.parametrize(
    ("group", "sentence"),
    [
        (
            {"shapes": [CIRCLE], "at": [[0, 0, 0], [9, 0, 0]]},
            "'obstacles.0.at.1': [9.0, 0.0, 0.0]",
        ),
        (
            patrolled([0, 0], [9, 0]),
            "'obstacles.0.motion.waypoints.1': an obstacle of radius 0.2",
        ),
        (patrolled([-1.9, 0], [0, 0]), "'obstacles.0.motion.waypoints.0'"),
        (patrolled([0, 0], [0.1, 1]), "'obstacles.0.motion.waypoints.1'"),
    ],
    ids=["at", "outside", "at a side", "at a wall"],
)
def test_a_place_where_an_obstacle_cant_be_is_refused_by_name_at_load(
    tmp_path, group, sentence
):
    file = tmp_path / "own.yaml"
    wall = [0.0, 0.5, 0.0, 1.5]
    about = {"name": "own", "size": [4, 4], "walls": [wall], "goal_distance": [1, 2]}
    file.write_text(json.dumps(about | {"obstacles": [group]}))
    with pytest.raises(ConfigError) as caught:
        load_world(str(file))
    assert str(caught.value).startswith(f"{file}: key {sentence}")


def test_a_waypoint_within_the_solid_of_a_map_is_refused(own_world):
    about = {"name": "own", "map": "maps/room.yaml", "goal_distance": [1, 2]}
    grid = load_map("room")
    solid = grid.cell_to_world(np.argwhere(grid.distance_field == 0.0)[-1]).tolist()
    open_ = grid.cell_to_world(
        np.unravel_index(np.argmax(grid.distance_field), grid.cells.shape)
    ).tolist()
    own_world.write_text(json.dumps(about | {"obstacles": [patrolled(open_, solid)]}))
    with pytest.raises(ConfigError, match=r"'obstacles.0.motion.waypoints.1'"):
        load_world(str(own_world))


def test_what_concerns_several_keys_is_said_without_the_whole_file():
    with pytest.raises(ConfigError) as caught:
        validate(
            field().model_dump(mode="json") | {"goal_distance": [3, 1]},
            World,
            "world.yaml",
        )
    assert (
        str(caught.value)
        == "world.yaml: goal_distance must be [minimum, maximum] in metres."
    )


def world_with(**changes):
    return {"name": "w", "size": [6.0, 6.0], "goal_distance": [1.0, 4.0]} | changes


def copies(**keys):
    return [{"shapes": [CIRCLE], **keys}]


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"obstacles": copies(count=10**9)}, "obstacles.0"),
        ({"obstacles": copies(count=[0, 10**18])}, "obstacles.0"),
        ({"obstacles": copies(count=9000) * 2}, "all groups"),
        ({"obstacles": copies(count=1, gap=1e300)}, "gap"),
        ({"size": [1e300, 1e-3]}, "size"),
        ({"size": [1e12, 1e12]}, "size"),
        ({"size": [1e-320, 1e-320]}, "size"),
        ({"walls": [[0.0, 0.0, 1.0, 1.0]] * 20_000}, "walls"),
        ({"walls": [[0.0, 0.0, 1e300, 1.0]]}, "walls.0.2"),
        ({"clearance": 1e300}, "clearance"),
        ({"goal_distance": [1.0, 1e308]}, "goal_distance.1"),
        ({"starts": {"regions": [[1e300] * 4]}}, "starts.regions.0.0"),
        (
            {"starts": {"at": [[1.0, 1.0, 90]]}},
            "starts.at.0.2': must be in radians, within 2 pi",
        ),
        (
            {"obstacles": copies(at=[[1, 1, -90]])},
            "obstacles.0.at.0.2': must be in radians",
        ),
        ({"goals": {"at": [[0.0, 0.0]] * 20_000}}, "goals.at"),
        (
            {"obstacles": [{"count": 1, "shapes": [CIRCLE | {"radius": 1e308}]}]},
            "radius",
        ),
        (
            {"obstacles": [{"count": 1, "shapes": [CIRCLE | {"radius": 1e-320}]}]},
            "radius",
        ),
        ({"obstacles": [{"count": 1, "shapes": [CIRCLE] * 2000}]}, "shapes"),
    ],
)
def test_what_no_world_has_is_refused_before_anything_of_it_is_made(changes, key):
    with pytest.raises(ConfigError) as told:
        validate(world_with(**changes), World, "w.yaml")
    assert key in str(told.value)
    assert len(str(told.value)) < 400
