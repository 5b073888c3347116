from __future__ import annotations

import numpy as np
import pytest
import shapely
from robots import FOOTPRINT, RADIUS, field

from nics_drl_bridge.config import validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.world import World, load_world, sample_scene, wall_distance

SEEDS = range(40)


@pytest.fixture(scope="module")
def world():
    return field(6.0, count=5, walls=[[-1.0, -1.0, 1.0, 0.5]])


@pytest.fixture(scope="module")
def scenes(world):
    return [sample_scene(world, FOOTPRINT, seed, robots=2) for seed in SEEDS]


def walls_of(world):
    return shapely.multilinestrings(world.all_walls().reshape(-1, 2, 2))


def test_obstacles_stand_inside_the_field_and_apart(world, scenes):
    for scene in scenes:
        discs = [shapely.Point(x, y) for x, y, _ in scene.circles]
        for i, disc in enumerate(discs):
            assert np.abs(scene.circles[i, :2]).max() < 3.0
            assert shapely.distance(disc, walls_of(world)) > RADIUS
            for other in discs[:i]:
                assert shapely.distance(disc, other) >= 2.0 * RADIUS + 0.3
        assert np.array_equal(scene.circles[:, 2], np.full(5, RADIUS))


def test_starts_and_goals_are_free_and_as_far_apart_as_asked(world, scenes):
    for scene in scenes:
        places = np.concatenate([scene.starts[:, :2], scene.goals])
        for place in places:
            assert shapely.distance(shapely.Point(place), walls_of(world)) >= FOOTPRINT + 0.1
            gaps = np.linalg.norm(scene.circles[:, :2] - place, axis=1)
            assert gaps.min() >= RADIUS + FOOTPRINT + 0.1
        distance = np.linalg.norm(scene.goals - scene.starts[:, :2], axis=1)
        assert ((distance >= 1.0) & (distance <= 3.0)).all()
        assert np.linalg.norm(scene.starts[0, :2] - scene.starts[1, :2]) > 2.0 * FOOTPRINT
        assert (np.abs(scene.starts[:, 2]) <= np.pi).all()


def test_a_seed_fixes_the_scene_and_another_seed_gives_another(world, scenes):
    for seed, scene in zip(SEEDS, scenes, strict=True):
        again = sample_scene(world, FOOTPRINT, seed, robots=2)
        for name, array in vars(scene).items():
            assert np.array_equal(getattr(again, name), array)
    assert len({scene.circles.tobytes() for scene in scenes}) == len(SEEDS)


def test_the_scene_of_one_robot_is_the_beginning_of_that_of_two(world, scenes):
    alone = sample_scene(world, FOOTPRINT, 0)
    assert np.array_equal(alone.circles, scenes[0].circles)
    assert np.array_equal(alone.starts, scenes[0].starts[:1])


def test_several_radii_all_occur():
    world = field(8.0, obstacles={"count": 8, "radii": [0.1, 0.3], "gap": 0.1})
    radii = np.concatenate([sample_scene(world, 0.1, seed).circles[:, 2] for seed in range(10)])
    assert set(radii) == {0.1, 0.3}
    assert 0.25 < (radii == 0.1).mean() < 0.75


def test_a_world_that_is_too_full_is_refused_with_what_to_change():
    with pytest.raises(ConfigError, match="no free place for 200 obstacles") as caught:
        sample_scene(field(2.0, count=200), FOOTPRINT, 0)
    assert "enlarge `size`" in str(caught.value)


def test_the_field_is_closed_by_its_walls():
    walls = field(4.0, walls=[[0.0, 0.0, 1.0, 0.0]]).all_walls()
    assert walls.shape == (5, 4)
    ring = shapely.polygonize([shapely.linestrings(wall.reshape(2, 2)) for wall in walls[:4]])
    assert shapely.area(ring) == pytest.approx(16.0)


def test_wall_distance_is_that_of_plane_geometry(world):
    walls = world.all_walls()
    for x, y in np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2)):
        expected = shapely.distance(shapely.Point(x, y), walls_of(world))
        assert wall_distance(x, y, walls) == pytest.approx(expected, abs=1e-12)
    assert wall_distance(0.0, 0.0, np.zeros((0, 4))) == np.inf
    assert wall_distance(3.0, 4.0, np.zeros((1, 4))) == 5.0


@pytest.mark.parametrize("name", ["arena", "empty"])
def test_shipped_worlds_have_room(name):
    world = load_world(name)
    for seed in range(30):
        sample_scene(world, 0.17, seed)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"size": [0.0, 3.0]}, "size must be greater than 0"),
        ({"goal_distance": [3.0, 1.0]}, "goal_distance must be"),
        ({"obstacles": {"count": 1, "radii": [0.0]}}, "radii must be greater than 0"),
        ({"obstacles": {"count": 1, "radii": []}}, "key 'obstacles.radii'"),
        ({"obstacles": {"count": -1, "radii": [0.1]}}, "key 'obstacles.count'"),
        ({"walls": [[0.0, 1.0]]}, "key 'walls.0"),
        ({"clearanze": 0.1}, "did you mean 'clearance'"),
    ],
)
def test_a_world_that_cant_be_is_refused_in_one_sentence(changes, sentence):
    with pytest.raises(ConfigError) as caught:
        validate(field().model_dump(mode="json") | changes, World, "world.yaml")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)
