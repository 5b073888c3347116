from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import shapely
from robots import FOOTPRINT, RADIUS, circles, field
from scipy import ndimage
from shapely import affinity

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.exact_kernels import HEADING, SHAPE
from nics_drl_bridge.lidar.exact_kernels import RADIUS as BODY_RADIUS
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.scenes import SceneSampler, sample_scene, scaled
from nics_drl_bridge.sim.world import World, load_world

SHIPPED = ("arena", "empty", "corridor", "doorway", "clutter", "crowd", "room")
SEEDS = range(50)
ROBOT = 0.25
FINE = 0.04
SLACK = 1e-6


def solid(sampler, body):
    """A body as shapely sees it; circles are points, for their radius is subtracted."""
    shape = sampler.shapes[int(body[SHAPE])]
    assert body[BODY_RADIUS] == shape.radius
    if isinstance(shape, Circle):
        return shapely.Point(body[:2])
    make = shapely.LineString if len(shape.outline) == 2 else shapely.Polygon
    turned = affinity.rotate(
        make(shape.outline), body[HEADING], (0, 0), use_radians=True
    )
    return affinity.translate(turned, *body[:2])


def thickness(sampler, body):
    shape = sampler.shapes[int(body[SHAPE])]
    return shape.radius if isinstance(shape, Circle) else 0.0


def static_of(world):
    """All walls and all cells of the map that are not free, as one geometry."""
    parts = [shapely.linestrings(wall.reshape(2, 2)) for wall in world.all_walls()]
    if world.grid is not None:
        at = np.argwhere(~world.grid.free)
        corners = [world.grid.cell_to_world(at + d) for d in ((-0.5, -0.5), (0.5, 0.5))]
        boxes = shapely.box(*corners[0].T, *corners[1].T)
        parts += [shapely.union_all(boxes), shapely.box(*world.extent).exterior]
    return shapely.union_all(parts)


def check_obstacles(world, sampler, scene, static):
    there = [(k, b) for k, b in enumerate(scene.bodies) if b[BODY_RADIUS] > 0.0]
    field_ = shapely.box(*world.extent)
    groups = [group for group in world.obstacles for _ in range(group.counts[1])]
    for i, (k, body) in enumerate(there):
        thick = thickness(sampler, body)
        one = solid(sampler, body)
        assert sampler.shapes[int(body[SHAPE])] in groups[k].shapes
        assert field_.covers(one)
        if not groups[k].at:
            assert shapely.distance(one, static) > thick
        for other_k, other in there[:i]:
            if groups[k].at and groups[other_k].at:
                continue
            gap = (
                shapely.distance(one, solid(sampler, other))
                - thick
                - thickness(sampler, other)
            )
            assert gap >= max(groups[k].gap, groups[other_k].gap) - SLACK
            assert gap > 0.0
    return there, groups


def check_places(world, sampler, scene, static, there):
    room = ROBOT + world.clearance - SLACK
    for place in np.concatenate([scene.starts[:, :2], scene.goals]):
        point = shapely.Point(place)
        assert shapely.distance(point, static) >= room
        for _, body in there:
            gap = shapely.distance(point, solid(sampler, body)) - thickness(
                sampler, body
            )
            assert gap >= room
    least, greatest = world.goal_distance
    distance = np.linalg.norm(scene.goals - scene.starts[:, :2], axis=1)
    assert ((distance >= least - SLACK) & (distance <= greatest + SLACK)).all()
    assert (np.abs(scene.starts[:, 2]) <= np.pi).all()


def check_way(world, sampler, scene, static, there, groups, fine=FINE):
    """On a grid finer than the sampler's and turned against it: a robot gets through."""
    x1, y1, x2, y2 = world.extent
    x, y = np.meshgrid(np.arange(x1, x2, fine), np.arange(y1, y2, fine))
    points = shapely.points(x, y)
    shapely.prepare(static)
    free = shapely.distance(points, static) >= ROBOT
    for k, body in there:
        if groups[k].motion is None:
            reach = ROBOT + thickness(sampler, body)
            free &= shapely.distance(points, solid(sampler, body)) >= reach
    label, _ = ndimage.label(free)

    def area(place):
        return label[round((place[1] - y1) / fine), round((place[0] - x1) / fine)]

    for start, goal in zip(scene.starts, scene.goals, strict=True):
        assert area(start) == area(goal) != 0


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize(
    ("seeds", "fine"),
    [
        pytest.param(8, FINE, marks=pytest.mark.slow, id="some"),
        pytest.param(50, 0.02, marks=pytest.mark.campaign, id="many"),
    ],
)
def test_every_scene_of_a_shipped_world_is_as_its_file_says(name, seeds, fine):
    world = load_world(name)
    sampler = SceneSampler(
        world, ROBOT, robots=2 if name in ("arena", "clutter") else 1
    )
    static = static_of(world)
    for row, scene in enumerate(sampler.draw(range(seeds))):
        there, groups = check_obstacles(world, sampler, scene, static)
        check_places(world, sampler, scene, static, there)
        if row % 10 == 0:
            check_way(world, sampler, scene, static, there, groups, fine)


@pytest.fixture(scope="module")
def world():
    return field(6.0, count=5, walls=[[-1.0, -1.0, 1.0, 0.5]])


def test_a_seed_gives_the_same_scene_in_every_batch_and_another_seed_another(world):
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


@pytest.mark.process
def test_a_seed_gives_the_same_scene_in_another_process(world):
    code = (
        "from nics_drl_bridge.sim.scenes import sample_scene\n"
        "from nics_drl_bridge.sim.world import load_world\n"
        "scene = sample_scene(load_world('clutter'), 0.2, 7)\n"
        "print((scene.bodies.tobytes() + scene.starts.tobytes() + scene.goals.tobytes()).hex())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ,
    )
    scene = sample_scene(load_world("clutter"), 0.2, 7)
    expected = scene.bodies.tobytes() + scene.starts.tobytes() + scene.goals.tobytes()
    assert done.stdout.strip() == expected.hex()


def test_the_scene_of_one_robot_is_the_beginning_of_that_of_two(world):
    alone, both = (
        sample_scene(world, FOOTPRINT, 0, robots=robots) for robots in (1, 2)
    )
    assert np.array_equal(alone.bodies, both.bodies)
    assert np.array_equal(alone.starts, both.starts[:1])


def test_robots_begin_apart_and_so_do_their_goals(world):
    scenes = SceneSampler(world, FOOTPRINT, robots=3).draw(SEEDS)
    for places in (scenes.starts[..., :2], scenes.goals):
        between = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        assert (between + np.eye(3) > 2.0 * FOOTPRINT).all()


def test_all_shapes_of_a_group_occur_equally_often():
    sampler = SceneSampler(field(8.0, obstacles=[circles(8, (0.1, 0.3), 0.1)]), 0.1)
    shapes = sampler.draw(range(200)).bodies[..., SHAPE]
    assert (shapes == 0).mean() == pytest.approx(0.5, abs=0.05)


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
    scenes = sampler.draw([3, 3], size=[0, 1])
    assert (scenes.bodies[0, :, SHAPE] < base).all()
    assert (scenes.bodies[1, :, SHAPE] >= base).all()
    for scene in scenes:
        for body in scene.bodies:
            assert body[BODY_RADIUS] == sampler.shapes[int(body[SHAPE])].radius
    for one, half in zip(sampler.shapes[:base], sampler.shapes[base:], strict=True):
        assert half == scaled(one, 0.5)
        assert half.radius == pytest.approx(0.5 * one.radius)


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
    world = field(
        8.0,
        count=2,
        goal_distance=[0.5, 9.0],
        starts={"at": [[-2.0, -1.0, 0.5], [-3.0, 1.0, -0.5]]},
        goals={"regions": [[1.0, -1.0, 3.0, 1.0], [3.0, 2.0, 2.0, 3.0]]},
    )
    scenes = SceneSampler(world, FOOTPRINT).draw(range(200))
    assert {tuple(start) for start in scenes.starts[:, 0]} == set(world.starts.at)
    x, y = scenes.goals[:, 0].T
    low = (x >= 1.0) & (x <= 3.0) & (np.abs(y) <= 1.0)
    high = (x >= 2.0) & (x <= 3.0) & (y >= 2.0) & (y <= 3.0)
    assert (low | high).all()
    assert high.sum() == pytest.approx(40, abs=20)  # a fifth of the area


def test_start_and_goal_lie_on_one_side_of_a_wall_without_a_door():
    world = field(6.0, walls=[[0.0, -3.0, 0.0, 3.0]])
    scenes = SceneSampler(world, FOOTPRINT).draw(range(200))
    sides = np.sign([scenes.starts[:, 0, 0], scenes.goals[:, 0, 0]])
    assert np.array_equal(*sides)
    assert set(sides[0]) == {-1.0, 1.0}


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
        there, groups = check_obstacles(world, sampler, scene, static)
        check_way(world, sampler, scene, static, there, groups)


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


def test_in_an_open_field_all_is_within_its_bounds_wherever_they_lie():
    world = World.model_validate(
        {
            "name": "open",
            "bounds": [10.0, -2.0, 14.01, 3.01],
            "obstacles": [circles(4)],
            "goal_distance": [1.0, 3.0],
        }
    )
    scenes = SceneSampler(world, FOOTPRINT).draw(range(50))
    for points in (scenes.bodies[..., :2], scenes.starts[..., :2], scenes.goals):
        assert points.min(axis=(0, 1)) == pytest.approx((10.0, -2.0), abs=0.5)
        assert points.max(axis=(0, 1)) == pytest.approx((14.0, 3.0), abs=0.5)
        assert ((points >= (10.0, -2.0)) & (points <= (14.01, 3.01))).all()


def test_a_world_that_is_too_full_is_refused_with_what_to_change():
    with pytest.raises(ConfigError, match="no free place for 200 obstacles") as caught:
        sample_scene(field(2.0, count=200), FOOTPRINT, 0)
    assert "enlarge the field" in str(caught.value)
    with pytest.raises(
        ConfigError, match="key 'goal_distance': no free places for 9 start"
    ):
        sample_scene(field(2.0), FOOTPRINT, 0, robots=9)


@pytest.mark.parametrize("seed", [-1, 2**63, 0.5])
def test_a_seed_out_of_range_is_refused(seed):
    with pytest.raises(ConfigError, match="must be a whole number from 0"):
        sample_scene(field(), FOOTPRINT, seed)


def test_a_choice_that_does_not_fit_the_seeds_is_refused():
    sampler = SceneSampler(field(count=1), RADIUS)
    with pytest.raises(ConfigError, match="must be"):
        sampler.draw([0, 1], count=[1])
    with pytest.raises(ConfigError, match="size must be from 0 to 0"):
        sampler.draw([0], size=[1])
