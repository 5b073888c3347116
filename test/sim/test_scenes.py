from __future__ import annotations

import numpy as np
import pytest
import shapely
from lidar_scenes import solid_of
from robots import FOOTPRINT, circles, field

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.exact_kernels import RADIUS as BODY_RADIUS
from nics_drl_bridge.lidar.exact_kernels import SHAPE
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.scenes import SceneSampler, sample_scene, scaled
from nics_drl_bridge.sim.world import World, load_world

OPEN = field(size=None, bounds=[10.0, -2.0, 14.01, 3.01], count=4)
WORLDS = ("arena", "empty", "corridor", "doorway", "clutter", "crowd", "room", "open")
SEEDS = range(50)
ROBOT = 0.25
NARROW = ROBOT - 0.01  # of the way that a robot needs: buffers are approximate
SLACK = 1e-6


def obstacles_of(world, sampler, scene):
    """Group, geometry and radius of each obstacle that is there."""
    groups = [group for group in world.obstacles for _ in range(group.counts[1])]
    found = []
    for group, body in zip(groups, scene.bodies, strict=True):
        shape = sampler.shapes[int(body[SHAPE])]
        if body[BODY_RADIUS] > 0.0:
            assert shape in group.shapes
            assert body[BODY_RADIUS] == shape.radius
            thick = shape.radius if isinstance(shape, Circle) else 0.0
            found.append((group, solid_of(shape, body[:3]), thick))
    return found


def static_of(world):
    """All walls and all cells of the map that are not free, as one geometry."""
    parts = [shapely.Point(1e6, 1e6)]  # as the distance from nothing is NaN
    parts += [shapely.linestrings(wall.reshape(2, 2)) for wall in world.all_walls()]
    if world.grid is not None:
        at = np.argwhere(~world.grid.free)
        corners = [world.grid.cell_to_world(at + d) for d in ((-0.5, -0.5), (0.5, 0.5))]
        boxes = shapely.box(*corners[0].T, *corners[1].T)
        parts += [shapely.union_all(boxes), shapely.box(*world.extent).exterior]
    return shapely.union_all(parts)


def check_scene(world, sampler, scene, static):
    """Obstacles are within the field and apart; a robot fits at its start and gets to its goal."""
    parts = obstacles_of(world, sampler, scene)
    whole = shapely.box(*world.extent)
    for i, (group, solid, thick) in enumerate(parts):
        assert whole.covers(solid)
        assert group.at or shapely.distance(solid, static) > thick
        for other, there, other_thick in parts[:i]:
            gap = shapely.distance(solid, there) - thick - other_thick
            least = max(group.gap, other.gap) - SLACK
            assert gap > max(least, 0.0) or (group.at and other.at)
    starts, goals = shapely.points(scene.starts[:, :2]), shapely.points(scene.goals)
    for places in (starts, goals):
        assert (shapely.distance(places[1:], places[:-1]) > 2.0 * ROBOT).all()
    room = ROBOT + world.clearance - SLACK
    for _, solid, thick in [*parts, (None, static, 0.0)]:
        for places in (starts, goals):
            assert (shapely.distance(places, solid) >= room + thick).all()
    least, greatest = world.goal_distance
    distance = shapely.distance(starts, goals)
    assert ((distance >= least - SLACK) & (distance <= greatest + SLACK)).all()
    solids = [(solid, thick) for group, solid, thick in parts if group.motion is None]
    blocked = [
        solid.buffer(thick + NARROW) for solid, thick in [*solids, (static, 0.0)]
    ]
    areas = shapely.get_parts(whole - shapely.union_all(blocked))
    for start, goal in zip(starts, goals, strict=True):
        assert any(area.contains(start) and area.contains(goal) for area in areas)


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_every_scene_of_a_world_is_as_its_file_says(name):
    world = OPEN if name == "open" else load_world(name)
    robots = 2 if name in ("arena", "clutter") else 1
    sampler = SceneSampler(world, ROBOT, robots=robots)
    static = static_of(world)
    for scene in sampler.draw(range(8)):
        check_scene(world, sampler, scene, static)
        assert (np.abs(scene.starts[:, 2]) <= np.pi).all()


def test_a_seed_gives_the_same_scene_in_every_batch_and_another_seed_another():
    world = field(6.0, count=5, walls=[[-1.0, -1.0, 1.0, 0.5]])
    sampler = SceneSampler(world, FOOTPRINT, robots=2)
    together = sampler.draw(SEEDS)
    for seed in (0, 1, 17, 49):
        for alone in (
            sampler.draw([seed])[0],
            sample_scene(world, FOOTPRINT, seed, robots=2),
        ):
            for name, array in vars(alone).items():
                assert np.array_equal(array, getattr(together[seed], name))
    assert len({scene.bodies.tobytes() for scene in together}) == len(SEEDS)


def there_are(scenes):
    return (scenes.bodies[..., BODY_RADIUS] > 0.0).sum(axis=1)


def test_each_number_of_obstacles_from_least_to_greatest_occurs():
    counts = there_are(
        SceneSampler(field(8.0, obstacles=[circles([2, 5])]), 0.1).draw(range(200))
    )
    assert np.bincount(counts, minlength=6)[2:] == pytest.approx(50, abs=20)
    assert counts.min() == 2


def test_a_given_count_is_kept_and_shared_among_the_groups():
    groups = [
        circles(4),
        circles([0, 2], (0.1,)),
        circles(None) | {"at": [[0.0, 0.0, 0.0]]},
    ]
    sampler = SceneSampler(field(9.0, obstacles=groups), 0.1)
    scenes = sampler.draw(range(8), count=[-3, 0, 1, 2, 3, 5, 6, 99])
    assert there_are(scenes).tolist() == [
        1,
        1,
        2,
        3,
        4,
        6,
        7,
        7,
    ]  # one always stands there
    second = (scenes.bodies[:, 4:6, BODY_RADIUS] > 0.0).sum(axis=1)
    assert second.tolist()[-2:] == [2, 2]


def test_a_given_size_scales_every_obstacle_of_the_scene():
    sampler = SceneSampler(load_world("clutter"), 0.2, sizes=(1.0, 0.5))
    base = len(sampler.shapes) // 2
    assert sampler.shapes[base:] == tuple(scaled(s, 0.5) for s in sampler.shapes[:base])
    whole, half = sampler.draw([3, 3], size=[0, 1])
    assert np.array_equal(half.bodies[:, SHAPE], whole.bodies[:, SHAPE] + base)
    assert half.bodies[:, BODY_RADIUS] == pytest.approx(
        0.5 * whole.bodies[:, BODY_RADIUS]
    )


def test_obstacles_stand_where_the_file_says_and_know_how_they_move():
    world = load_world("crowd")
    sampler = SceneSampler(world, ROBOT)
    scenes = sampler.draw(SEEDS)
    assert np.array_equal(
        scenes.bodies[:, -2:, :3], np.tile(world.obstacles[2].at, (50, 1, 1))
    )
    kinds = [motion and motion.kind for motion in sampler.motions[0]]
    assert kinds == ["pedestrian"] * 8 + ["patrol", None, None]


def test_starts_and_goals_keep_to_their_places():
    starts = [[-2.0, -1.0, 0.5], [-3.0, 1.0, -0.5]]
    regions = [[1.0, -1.0, 3.0, 1.0], [3.0, 2.0, 2.0, 3.0]]
    places = {"starts": {"at": starts}, "goals": {"regions": regions}}
    world = field(8.0, count=2, goal_distance=[0.5, 9.0], **places)
    scenes = SceneSampler(world, FOOTPRINT).draw(range(200))
    assert {tuple(start) for start in scenes.starts[:, 0]} == set(map(tuple, starts))
    x, y = scenes.goals[:, 0].T
    low = (x >= 1.0) & (x <= 3.0) & (np.abs(y) <= 1.0)
    high = (x >= 2.0) & (x <= 3.0) & (y >= 2.0) & (y <= 3.0)
    assert (low | high).all()
    assert high.sum() == pytest.approx(40, abs=20)  # a fifth of the area


@pytest.mark.slow
def test_an_obstacle_never_shuts_the_only_door():
    world = field(
        4.0,
        obstacles=[circles(3, (0.3,), 0.0)],
        goal_distance=[1.0, 4.0],
        walls=[[0.0, -2.0, 0.0, -0.5], [0.0, 0.5, 0.0, 2.0]],
        starts={"regions": [[-1.9, -1.9, -0.3, 1.9]]},
        goals={"regions": [[0.3, -1.9, 1.9, 1.9]]},
    )
    sampler = SceneSampler(world, ROBOT)
    static = static_of(world)
    for scene in sampler.draw(range(8)):
        check_scene(world, sampler, scene, static)


def test_starts_are_spread_evenly_over_the_free_space():
    world = field(6.0, clearance=0.3, goal_distance=[1.0, 9.0])
    starts = SceneSampler(world, FOOTPRINT).draw(range(4000)).starts[:, 0]
    counts, _, _ = np.histogram2d(
        starts[:, 0], starts[:, 1], bins=5, range=[[-2.4, 2.4]] * 2
    )
    assert counts.sum() / 4000 == pytest.approx((4.8 / 5.0) ** 2, abs=0.03)
    assert counts == pytest.approx(np.full((5, 5), counts.mean()), rel=0.3)
    assert np.abs(np.mean(np.cos(starts[:, 2]))) < 0.05


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"size": [0.5, 0.5]}, "key 'clearance': no free space"),
        ({"goal_distance": [50.0, 60.0]}, "key 'goal_distance': a robot of radius"),
        ({"starts": {"at": [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]]}}, "key 'starts.at.1'"),
        ({"goals": {"regions": [[2.95, 2.95, 3.0, 3.0]]}}, "key 'goals.regions.0'"),
    ],
)
def test_a_world_without_room_is_refused_before_anything_is_drawn(changes, sentence):
    world = World.model_validate(field().model_dump() | changes)
    with pytest.raises(ConfigError) as caught:
        SceneSampler(world, FOOTPRINT)
    assert sentence in str(caught.value)
    assert "world 'field'" in str(caught.value)


def test_a_world_that_is_too_full_is_refused_with_what_to_change():
    with pytest.raises(ConfigError, match="no free place for 200 obstacles") as caught:
        sample_scene(field(2.0, count=200), FOOTPRINT, 0)
    assert "enlarge the field" in str(caught.value)
    with pytest.raises(
        ConfigError, match="key 'goal_distance': no free places for 9 start"
    ):
        sample_scene(field(2.0), FOOTPRINT, 0, robots=9)
