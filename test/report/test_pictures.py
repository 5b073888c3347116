import io
import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from robots import circles, field

from nics_drl_bridge.lidar.shapes import place
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.recording.excite import Pattern
from nics_drl_bridge.report.pictures import (
    Point,
    draw_seeded_world,
    draw_training_curve,
    draw_trajectories,
    drive_picture,
)
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.world import World
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


def pixels_of(image, colour, off=8):
    """Rows and columns of the pixels of a colour."""
    wanted = 255.0 * np.array(to_rgb(colour))
    return np.argwhere((np.abs(image - wanted) < off).all(axis=-1))


def test_a_robot_with_an_outline_is_drawn_with_it():
    outline = ((0.4, 0.2), (-0.4, 0.2), (-0.4, -0.2), (0.4, -0.2))
    disc, box = (
        pixels_of(decoded(draw_seeded_world(WORLD, 0.45, 0, given)), MEASURED, off=60)
        for given in (None, outline)
    )
    disc, box = (np.count_nonzero(one[:, 0] > 60) for one in (disc, box))
    assert box / disc == pytest.approx(0.32 / (math.pi * 0.45**2), rel=0.1)


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


def field_of(width, height):
    """An empty field with walls around it."""
    plan = {"name": "field", "size": [width, height], "goal_distance": [0.5, 1.0]}
    return World.model_validate(plan)


def walls_in(png):
    """Left, top, right and bottom edge of the walls in a picture [pixels]."""
    drawn = decoded(png).astype(int)
    dark = (np.abs(drawn - 0x33) < 12).all(axis=-1)
    length = 100  # letters are shorter
    rows = np.flatnonzero(dark.sum(axis=1) > length)
    columns = np.flatnonzero(dark.sum(axis=0) > length)
    return columns[0], rows[0], columns[-1], rows[-1]


def ink_at_the_edges(png):
    """Number of pixels at the edges of a picture that are not white: of words that are cut off."""
    image = decoded(png)
    edges = image[:2], image[-2:], image[:, :2], image[:, -2:]
    return sum(int((edge < 250).any(axis=-1).sum()) for edge in edges)


def short(seed=0, **changes):
    path = np.array([[0.0, 0.0, 0.0], [0.2, 0.1, 0.0]])
    own = {"path": path, "goal": np.array([0.3, 0.2]), "bodies": np.zeros((0, 7))}
    return replace(episode(seed), **own | changes)


DRAWINGS = {
    "world": lambda world: draw_seeded_world(world, 0.1, 0),
    "episodes": lambda world: draw_trajectories({"run": [short()]}, world, 0.1),
}


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
@pytest.mark.parametrize("size", [(40.0, 4.0), (3.0, 9.0)])
def test_a_picture_has_the_proportions_of_its_world_and_cuts_no_word_off(draw, size):
    png = draw(field_of(*size))
    left, top, right, bottom = walls_in(png)
    assert (right - left) / (bottom - top) == pytest.approx(size[0] / size[1], rel=0.1)
    assert ink_at_the_edges(png) == 0


@pytest.mark.parametrize("size", [(500.0, 1.0), (200.0, 200.0)])
def test_the_picture_of_an_extreme_world_is_neither_huge_nor_a_line(size):
    png = draw_seeded_world(field_of(*size), 0.1, 0)
    height, width, _ = decoded(png).shape
    assert 200 < min(width, height) <= max(width, height) < 1600
    assert ink_at_the_edges(png) == 0


@pytest.mark.slow
def test_each_seed_has_a_panel_with_the_paths_of_the_runs_that_drove_it():
    drawn = {
        name: decoded(draw_trajectories(runs, WORLD, 0.2))
        for name, runs in {
            "both": {"one": [episode(0), episode(1)], "two": [episode(0), episode(1)]},
            "short": {"one": [episode(0), episode(1)], "two": [episode(0)]},
            "other": {"one": [episode(2), episode(1)], "two": [episode(0)]},
        }.items()
    }
    assert {image.shape for image in drawn.values()} == {drawn["both"].shape}
    rows, columns, _ = drawn["both"].shape
    assert columns > 1.5 * rows
    second = drawn["short"][:, columns // 2 :]
    assert len(pixels_of(second, GOAL, off=60)) > 20
    assert not np.array_equal(drawn["both"], drawn["short"])
    assert not np.array_equal(drawn["short"], drawn["other"])


def test_a_curve_shows_a_training_from_its_first_report_on():
    unknown = draw_training_curve([Point(8192, math.nan, math.nan)])
    curve = draw_training_curve([Point(8192, 0.1, 0.9), Point(16384, 0.6, 0.4)])
    assert decoded(unknown).shape == decoded(curve).shape
    assert ink_at_the_edges(curve) == 0
    assert curve != unknown


def test_a_drive_is_drawn():
    x = np.linspace(0.0, 1.4, 21)
    pose = np.stack([x, x**2, x], axis=1)
    pattern = Pattern(0.1, np.zeros((20, 3)), pose, bound=2.0, footprint=0.2)
    png = drive_picture(pattern, load_robot("mecanum"))
    assert len(pixels_of(decoded(png), MEASURED)) > 100
