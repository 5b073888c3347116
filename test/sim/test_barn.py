from __future__ import annotations

import csv

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.barn import barn_numbers, barn_path, barn_world
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import check_places

JACKAL = 0.333  # radius of the circle around its footprint of 0.508 m x 0.43 m [m]


def rows(file):
    """Number, x, y (rows, 3) of all worlds, as the benchmark's authors gave them."""
    with file.open() as file:
        return np.array(
            [[float(value) for value in row] for row in list(csv.reader(file))[1:]]
        )


def ordered(points):
    return points[np.lexsort(np.round(points, 3).T)]


def places(number):
    return np.array(barn_world(number).obstacles[0].at)[:, :2]


def test_the_test_set_is_not_among_the_worlds():
    numbers = barn_numbers()
    assert len(numbers) == 250
    assert set(numbers) == {number for number in range(300) if number % 6}


def test_every_cylinder_stands_where_the_benchmark_has_it(shared_barn):
    given = rows(shared_barn / "cylinders.csv")
    for number in barn_numbers():
        expected = given[given[:, 0] == number, 1:]
        assert ordered(places(number)) == pytest.approx(ordered(expected), abs=1e-6)


def test_the_reference_paths_are_those_of_the_benchmark_in_their_order(shared_barn):
    given = rows(shared_barn / "reference_paths.csv")
    for number in barn_numbers():
        expected = given[given[:, 0] == number, 1:]
        assert barn_path(number) == pytest.approx(expected, abs=1e-6)


def test_a_robot_begins_and_ends_where_the_benchmark_says():
    world = barn_world(2)
    check_places(world)
    scene = sample_scene(world, JACKAL, seed=0)
    assert scene.starts[0] == pytest.approx((-2.25, 3.0, 1.57))
    assert scene.goals[0] == pytest.approx((-2.25, 13.0))
    assert len(scene.bodies) == 234


@pytest.mark.parametrize("number", [6, 300, -1])
def test_a_number_without_a_world_is_refused(number):
    with pytest.raises(
        ConfigError, match=rf"no BARN world {number}; the numbers are 1 to 299"
    ):
        barn_world(number)
