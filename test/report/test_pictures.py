from __future__ import annotations

import io
import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from robots import circles, field

from nics_drl_bridge.lidar.shapes import place
from nics_drl_bridge.policy.evaluation import Episode, rate
from nics_drl_bridge.recording.excite import DrivePlan
from nics_drl_bridge.report.pictures import (
    Point,
    draw_robustness,
    draw_seeded_world,
    draw_training_curve,
    draw_trajectories,
    draw_trajectory_gallery,
    draw_world,
    drive_picture,
)
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.world import World, load_world
from nics_drl_bridge.style import GOAL, MEASURED, MODEL

WORLD = World.model_validate(
    {
        "name": "shapes",
        "size": [6.0, 6.0],
        "goal_distance": [1.0, 2.0],
        "obstacles": [
            {
                "shapes": [
                    {"kind": "circle", "radius": 0.25},
                    {"kind": "rectangle", "size": [0.6, 0.3]},
                    {"kind": "segment", "ends": [[-0.5, 0.0], [0.5, 0.0]]},
                ],
                "count": 3,
            }
        ],
    }
)


def episode(seed=0, result="success", steps=20):
    t = np.linspace(0.0, 1.0, steps + 1)
    path = np.stack([t, t**2 * (seed + 1), t], axis=1)
    bodies = place([[1.0, 1.0, 0.0]], [0.25], [0])
    return Episode(seed, result, path, path, np.array([1.0, 1.0]), bodies, 3.0)


def decoded(png):
    image = Image.open(io.BytesIO(png))
    image.load()
    assert image.format == "PNG"
    return np.asarray(image.convert("RGB"))


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4])
def test_there_is_one_panel_per_episode(count):
    episodes = [episode(seed) for seed in range(count)]
    image = decoded(draw_trajectories({"one": episodes, "two": episodes}, WORLD, 0.2))
    assert image.shape[0] > 400 * -(-count // 3)
    assert image.std() > 5.0


def test_another_path_gives_another_picture():
    pictures = [
        draw_trajectories({"run": [episode(seed)]}, WORLD, 0.2) for seed in (0, 0, 1)
    ]
    assert np.array_equal(decoded(pictures[0]), decoded(pictures[1]))
    assert not np.array_equal(decoded(pictures[0]), decoded(pictures[2]))


@pytest.mark.slow
def test_a_run_that_ended_early_is_drawn_as_far_as_it_went():
    runs = {"all": [episode(0), episode(1)], "short": [episode(0)]}
    drawn_short = decoded(draw_trajectories(runs, WORLD, 0.2))
    whole = {"all": runs["all"], "short": runs["all"]}
    assert not np.array_equal(
        drawn_short, decoded(draw_trajectories(whole, WORLD, 0.2))
    )


def pixels_of(image, colour, off=8):
    """Rows and columns of the pixels of a colour."""
    wanted = 255.0 * np.array(to_rgb(colour))
    return np.argwhere((np.abs(image - wanted) < off).all(axis=-1))


@pytest.mark.slow
def test_the_picture_of_a_world_shows_the_episode_of_its_seed():
    first, again, other = (
        decoded(draw_seeded_world(WORLD, 0.2, seed)) for seed in (0, 0, 1)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_robot_with_an_outline_is_drawn_with_it():
    outline = ((0.4, 0.2), (-0.4, 0.2), (-0.4, -0.2), (0.4, -0.2))
    disc, box = (
        pixels_of(decoded(draw_seeded_world(WORLD, 0.45, 0, given)), MEASURED, off=60)
        for given in (None, outline)
    )
    disc, box = (np.count_nonzero(one[:, 0] > 60) for one in (disc, box))
    assert box / disc == pytest.approx(0.32 / (math.pi * 0.45**2), rel=0.1)


def test_the_picture_of_an_open_field_is_as_wide_and_deep_as_its_bounds():
    places = {"starts": {"at": [[9.0, 1.0, 0.0]]}, "goals": {"at": [[9.8, 7.0]]}}
    bounds = {
        "name": "open",
        "bounds": [8.0, 0.0, 10.0, 8.0],
        "goal_distance": [1.0, 9.0],
    }
    image = decoded(draw_seeded_world(World.model_validate(bounds | places), 0.3, 0))
    robot, goal = (pixels_of(image, colour) for colour in (MEASURED, GOAL))
    robot, goal = (
        one[one[:, 0] > 60].mean(axis=0) for one in (robot, goal)
    )  # below the legend
    up = robot[0] - goal[0]
    right = goal[1] - robot[1]
    assert up / right == pytest.approx(6.0 / 0.8, rel=0.03)


@pytest.mark.slow
def test_obstacles_that_move_are_marked_with_the_ways_of_those_that_patrol():
    patrol = {"kind": "patrol", "waypoints": [[-2.0, -2.0], [2.0, -2.0]], "speed": 0.5}
    rings = []
    for motion in (None, {"kind": "pedestrian", "speed": [0.1, 0.2]}, patrol):
        world = field(count=1, obstacles=[circles(1) | {"motion": motion}])
        image = decoded(draw_seeded_world(world, 0.2, 0))
        rings.append(len(pixels_of(image, MODEL, off=30)))
    assert rings[0] < 20
    assert rings[0] + 100 < rings[1] < rings[2] - 20


def drawn(world, bodies):
    figure = Figure(figsize=(6.0, 6.0), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_world(axes, world, bodies)
    x1, y1, x2, y2 = world.extent
    axes.set(xlim=(x1, x2), ylim=(y1, y2))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    image = decoded(buffer.getvalue())
    rows, columns = image.shape[:2]

    def dark(x, y):
        row = (y2 - y) / (y2 - y1) * rows
        column = (x - x1) / (x2 - x1) * columns
        return image[int(row), int(column)].max() < 230

    return dark


def test_every_shape_is_drawn_where_it_stands():
    poses = [[1.0, 1.0, 0.0], [-1.0, 0.0, np.pi / 2], [0.0, -2.0, 0.0]]
    radii = [0.25, 0.0, 0.5]
    radii[1] = WORLD.shapes[1].radius
    dark = drawn(WORLD, place(poses, radii, [0, 1, 2]))
    for x, y in ((1.2, 1.0), (-1.0, 0.28), (-1.13, 0.0), (0.45, -2.0), (-0.45, -2.0)):
        assert dark(x, y)
    for x, y in ((1.3, 1.0), (-1.25, 0.0), (-1.0, 0.4), (0.6, -2.0), (0.0, -1.9)):
        assert not dark(x, y)


def test_a_map_is_drawn_where_it_lies():
    world = load_world("room")
    dark = drawn(world, np.zeros((0, 7)))
    cells = np.argwhere(world.grid.free | world.grid.blocked)[::97]
    middle = world.grid.cell_to_world(cells)
    solid = world.grid.blocked[tuple(cells.T)]
    assert [dark(x, y) for x, y in middle] == solid.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mecanum"])
def test_a_drive_is_drawn(name):
    robot = load_robot(name)
    png = drive_picture(DrivePlan(robot, duration=20.0).preview(), robot)
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    assert len(png) > 10_000


@pytest.mark.parametrize(
    "points",
    [
        [Point(8192, math.nan, math.nan)],
        [Point(8192, 0.1, 0.9), Point(16384, 0.6, 0.4)],
    ],
)
def test_a_training_is_drawn_from_its_first_rollout_on(points):
    assert draw_training_curve(points).startswith(b"\x89PNG")


def test_success_under_each_perturbation_is_drawn_as_low_as_it_is():
    best = rate(500, 500)
    worst = rate(10, 500)
    drawn = draw_robustness({"as it is": best, "action_latency": worst})
    assert drawn.startswith(b"\x89PNG")
    assert drawn != draw_robustness({"as it is": best, "action_latency": best})


def field_of(width, height):
    """An empty field with walls around it."""
    plan = {"name": "field", "size": [width, height], "goal_distance": [0.5, 1.0]}
    return World.model_validate(plan)


def shape_of(png):
    """Width and height of a picture [pixels]."""
    return Image.open(io.BytesIO(png)).size


def walls_in(png):
    """Left, top, right and bottom edge of the walls in a picture [pixels]."""
    drawn = decoded(png).astype(int)
    dark = (np.abs(drawn - 0x33) < 12).all(axis=-1)
    length = 100  # letters are shorter
    rows = np.flatnonzero(dark.sum(axis=1) > length)
    columns = np.flatnonzero(dark.sum(axis=0) > length)
    return columns[0], rows[0], columns[-1], rows[-1]


def short_episode(seed=0):
    path = np.array([[0.0, 0.0, 0.0], [0.2, 0.1, 0.0]])
    return Episode(
        seed, "success", path, path, np.array([0.3, 0.2]), np.zeros((0, 7)), 1.0
    )


DRAWINGS = {
    "world": lambda world: draw_seeded_world(world, 0.1, 0),
    "episodes": lambda world: draw_trajectories({"run": [short_episode()]}, world, 0.1),
    "gallery": lambda world: draw_trajectory_gallery(
        [{"run": short_episode()}], world, 0.1
    )[0],
}


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
@pytest.mark.parametrize("size", [(40.0, 4.0), (9.0, 3.0), (3.0, 9.0)])
def test_a_picture_of_a_world_has_the_proportions_of_the_world(draw, size):
    left, top, right, bottom = walls_in(draw(field_of(*size)))
    assert (right - left) / (bottom - top) == pytest.approx(size[0] / size[1], rel=0.08)


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
def test_a_flat_world_has_a_flat_picture_and_a_tall_one_a_tall_one(draw):
    width, height = shape_of(draw(field_of(40.0, 4.0)))
    assert width > 3.0 * height
    width, height = shape_of(draw(field_of(4.0, 40.0)))
    assert height > 2.5 * width


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
@pytest.mark.parametrize("size", [(500.0, 1.0), (1.0, 500.0)])
def test_the_picture_of_an_extreme_world_is_neither_huge_nor_a_line(draw, size):
    width, height = shape_of(draw(field_of(*size)))
    assert min(width, height) > 200
    assert max(width, height) < 1600


def test_panels_are_equal_whatever_their_titles_legends_and_paths_are():
    far = replace(short_episode(1), path=np.array([[0.0, 0.0, 0.0], [-3.4, 0.0, 0.0]]))
    lost = replace(
        short_episode(2), result="left the field and was never seen there again, alas"
    )
    shown = [
        {
            "in process": short_episode(),
            "over DDS": short_episode(),
            "deployed": short_episode(),
        },
        {"in process": far, "over DDS": far},
        {"in process": lost},
    ]
    drawn = draw_trajectory_gallery(shown, field_of(6.0, 6.0), 0.1)
    assert len({shape_of(png) for png in drawn}) == 1
    assert len({walls_in(png) for png in drawn}) == 1


def test_an_episode_that_only_one_run_has_is_drawn_too():
    world = field_of(6.0, 6.0)
    both = {"one": [short_episode(0), short_episode(1)], "two": [short_episode(0)]}
    width, height = shape_of(draw_trajectories(both, world, 0.1))
    assert width > 1.5 * height
    drawn = decoded(draw_trajectories(both, world, 0.1))
    second = drawn[:, width // 2 :]
    assert len(pixels_of(second, GOAL, off=60)) > 20


def test_the_curves_of_a_page_have_equal_panels():
    curve = draw_training_curve([Point(8192, 0.1, 0.9), Point(16384, 0.6, 0.4)])
    bars = draw_robustness(
        {"as it is": rate(500, 500), "observation_latency": rate(10, 500)}
    )
    assert shape_of(curve) == shape_of(bars)
    assert ink_at_the_edges(curve) == ink_at_the_edges(bars) == 0


def ink_at_the_edges(png):
    """Number of pixels at the edges of a picture that are not white: of words that are cut off."""
    image = decoded(png)
    edges = image[:2], image[-2:], image[:, :2], image[:, -2:]
    return sum(int((edge < 250).any(axis=-1).sum()) for edge in edges)


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
@pytest.mark.parametrize("size", [(6.0, 6.0), (200.0, 200.0), (4.0, 40.0), (40.0, 4.0)])
def test_no_word_is_cut_off_at_the_edge_of_a_picture(draw, size):
    assert ink_at_the_edges(draw(field_of(*size))) == 0
