from __future__ import annotations

import shutil

import numpy as np
import pytest
import shapely
import yaml
from robots import field

from nics_drl_bridge.config import share_folder, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.sim.collision_kernels import wall_distance
from nics_drl_bridge.sim.world import World, check_places, load_world

CIRCLE = {"kind": "circle", "radius": 0.2}


def walls_of(world):
    return shapely.multilinestrings(world.all_walls().reshape(-1, 2, 2))


@pytest.mark.parametrize(
    ("place", "extent"),
    [
        ({"map": "room"}, (-3.0, -4.0, 7.0, 4.0)),
        ({"bounds": (1.0, 2.0, 4.0, 9.0)}, (1.0, 2.0, 4.0, 9.0)),
    ],
)
def test_a_map_alone_or_bounds_say_where_a_world_lies_and_have_no_walls(place, extent):
    world = World(name="open", goal_distance=(1.0, 2.0), **place)
    assert world.all_walls().shape == (0, 4)
    assert world.extent == pytest.approx(extent)


def test_wall_distance_is_that_of_plane_geometry():
    world = field(6.0, walls=[[-1.0, -1.0, 1.0, 0.5]])
    walls = world.all_walls()
    for x, y in np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2)):
        expected = shapely.distance(shapely.Point(x, y), walls_of(world))
        assert wall_distance(x, y, walls) == pytest.approx(expected, abs=1e-12)
    assert wall_distance(0.0, 0.0, np.zeros((0, 4))) == np.inf
    assert wall_distance(3.0, 4.0, np.zeros((1, 4))) == 5.0


def test_worlds_of_equal_content_share_a_fingerprint_and_others_do_not():
    assert load_world("arena").fingerprint == "arena-261566ec"
    assert field().fingerprint == field().fingerprint
    others = [
        field(5.0),
        field(count=1),
        field(walls=[[0.0, 0.0, 1.0, 0.0]]),
        field(None, bounds=(0.0, 0.0, 6.0, 6.0)),
        field(None, bounds=(0.0, 0.0, 6.0, 7.0)),
        load_world("room"),
    ]
    assert len({world.fingerprint for world in (field(), *others)}) == 7


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


def test_a_map_lies_beside_its_world_and_its_content_counts_in_the_fingerprint(
    own_world,
):
    own = load_world(str(own_world))
    assert np.array_equal(own.grid.cells, load_map("room").cells)
    before = own.fingerprint
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


ROUND = "shapes: [{kind: circle, radius: 0.2}]"
NOT_BOTH = "either `count` or `at`"
WRONG_RADIUS = "'obstacles.0.shapes.0.circle.radius'"


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("size: [0.0, 3.0]", "'size.0'"),
        ("size: [1.0e+12, 3.0]", "'size.0'"),
        ("size: null", "needs a `size`"),
        ("bounds: [0, 0, 1, 1]", "either a `size` (with walls)"),
        ("{size: null, bounds: [1, 0, 0, 1]}", "bounds must be"),
        ("{size: null, bounds: [0, 0, 1, 2.0e+4]}", "bounds must be"),
        ("{size: null, bounds: [0, 0, 4000, 4000]}", "5657 m across"),
        ("goal_distance: [3.0, 1.0]", "goal_distance must be"),
        ("goal_distance: [1.0, 1.0e+308]", "'goal_distance.1'"),
        ("obstacles: [{shapes: [{kind: circle, radius: 0}], count: 1}]", WRONG_RADIUS),
        ("obstacles: [{shapes: [{kind: circle, radius: 1.0e+308}]}]", WRONG_RADIUS),
        ("obstacles: [{shapes: [], count: 1}]", "'obstacles.0.shapes'"),
        (f"obstacles: [{{{ROUND}, count: -1}}]", "'obstacles.0.count'"),
        (f"obstacles: [{{{ROUND}, count: [3, 1]}}]", "'obstacles.0.count'"),
        (f"obstacles: [{{{ROUND}, count: many}}]", "'obstacles.0.count'"),
        (f"obstacles: [{{{ROUND}, count: 1000000000}}]", "'obstacles.0.count'"),
        (
            f"obstacles: [{{{ROUND}, count: 9000}}, {{{ROUND}, count: 9000}}]",
            "together may have at most 10000",
        ),
        (f"obstacles: [{{{ROUND}, count: 1, at: [[0, 0, 0]]}}]", NOT_BOTH),
        (f"obstacles: [{{{ROUND}}}]", NOT_BOTH),
        (f"obstacles: [{{{ROUND}, count: 1, gap: 1.0e+300}}]", "'obstacles.0.gap'"),
        (f"obstacles: [{{{ROUND}, count: 1, gab: 0.1}}]", "did you mean 'gap'"),
        (f"obstacles: [{{{ROUND}, at: [[1, 1, -90]]}}]", "in radians"),
        ("walls: [[0.0, 1.0]]", "'walls.0"),
        ("starts: {}", "either `regions` or `at`"),
        ("starts: {regions: [[1.0e+300, 0, 0, 0]]}", "'starts.regions.0.0'"),
        ("goals: {at: [[0, 0, 0]]}", "'goals.at.0"),
    ],
)
def test_a_world_that_cant_be_is_refused_by_the_key(text, key):
    content = field().model_dump(mode="json") | yaml.safe_load(text)
    with pytest.raises(ConfigError) as caught:
        validate(content, World, "world.yaml")
    assert key in str(caught.value)
    assert str(caught.value).startswith("world.yaml: ")
    assert len(str(caught.value)) < 400


def test_a_world_of_too_many_walls_is_refused_by_the_key():
    content = field().model_dump() | {"walls": [[0.0, 0.0, 1.0, 1.0]] * 20_000}
    with pytest.raises(ConfigError, match="'walls'"):
        validate(content, World, "world.yaml")


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
