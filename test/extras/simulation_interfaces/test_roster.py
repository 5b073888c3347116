from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.simulation_interfaces.roster import (
    Entities,
    UnknownEntityError,
)
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.shapes import Circle, Rectangle
from nics_drl_bridge.sim.device import DeviceWorld
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import FASTEST, OutsideError
from nics_drl_bridge.sim.world_set import load_worlds

DISC = Circle(radius=0.2)
START = np.array([1.0, 1.0, 0.0])
HERE = ((DISC, (0.0, 0.0, 0.0)),)


@pytest.fixture(scope="module")
def model():
    return builtin_model("ackermann")


@pytest.fixture
def staged(model):
    """Make the entities of a named world, in its first episode."""

    def stage(name, robots=("car",)):
        world = load_worlds(name)

        def make(world, count):
            return FastSimulator(model, world, robots=count, renderer="baked")

        device = DeviceWorld(make(world, len(robots)), model, len(robots))
        entities = Entities(device, world, robots, make)
        device.begin(0, None)
        return entities

    return stage


def names(entities):
    return [entity.name for entity in entities]


def test_the_obstacles_of_a_world_and_its_robots_have_names(staged):
    entities = staged("arena")
    assert names(entities) == ["car", *(f"obstacle_{k}" for k in range(6))]
    with pytest.raises(UnknownEntityError, match="did you mean 'obstacle_1'"):
        entities.find("obstacle_11")


def test_the_episode_goes_on_when_something_is_spawned(staged):
    entities = staged("arena")
    other = staged("arena")
    for each in (entities, other):
        each.device.commands[0] = 0.4, 0.1
        for _ in range(5):
            each.device.advance()
    entities.spawn("disc", HERE, np.array([-2.9, -2.9, 0.0]))
    for each in (entities, other):
        for _ in range(5):
            each.device.advance()
    mine = entities.device.sensed(0)
    theirs = other.device.sensed(0)
    assert mine.pose == pytest.approx(theirs.pose, abs=1e-12)
    assert mine.odom == pytest.approx(theirs.odom, abs=1e-12)


def test_the_lidar_sees_what_was_spawned_moved_and_deleted(staged):
    entities = staged("empty")
    car = entities.find("car")
    entities.move(car, np.zeros(3), np.zeros(3))

    def ahead():
        entities.device.advance()
        ranges = entities.device.sensed(0).ranges
        return float(ranges[len(ranges) // 2 - 2 : len(ranges) // 2 + 2].min())

    free = ahead()
    disc = entities.spawn("disc", HERE, np.array([1.0, 0.0, 0.0]))
    near = ahead()
    entities.move(disc, np.array([1.5, 0.0, 0.0]), None)
    farther = ahead()
    entities.delete(disc)
    assert near < 1.0 < farther == pytest.approx(near + 0.5, abs=0.1)
    assert ahead() == pytest.approx(free, abs=0.1)


@pytest.mark.slow
def test_entities_keep_their_names_where_many_obstacles_are_sorted(staged):
    entities = staged("clutter")
    spawned = entities.spawn("disc", HERE, START)
    where = {entity.name: entities.pose(entity) for entity in entities}
    entities.move(spawned, np.array([0.5, 0.5, 0.0]), None)
    for name, pose in where.items():
        if name != "disc":
            assert entities.pose(entities.find(name)) == pytest.approx(pose)
    assert entities.pose(spawned) == pytest.approx([0.5, 0.5, 0.0])


def test_an_entity_of_several_shapes_moves_as_one(staged):
    entities = staged("empty")
    parts = ((DISC, (0.5, 0.0, 0.0)), (Rectangle(size=(0.2, 0.2)), (-0.5, 0.0, 0.0)))
    both = entities.spawn("both", parts, np.array([1.0, 1.0, np.pi / 2]))
    assert entities.pose(both) == pytest.approx([1.0, 1.0, np.pi / 2])
    found = entities.bodies()[list(both.slots), :2]
    assert found == pytest.approx(np.array([[1.0, 1.5], [1.0, 0.5]]))


def test_what_is_removed_stays_away_until_all_is_restored(staged):
    entities = staged("arena")
    entities.delete(entities.find("obstacle_2"))
    entities.spawn("disc", HERE, START)
    entities.device.begin(0, None)
    assert "obstacle_2" not in names(entities)
    assert entities.pose(entities.find("disc")) == pytest.approx(START)
    entities.restore()
    entities.device.begin(0, None)
    assert names(entities) == names(staged("arena"))


def test_a_robot_comes_and_goes_and_the_others_stay(staged):
    entities = staged("empty", ("left", "right"))
    right = entities.pose(entities.find("right"))
    entities.spawn_robot("third", START)
    assert entities.pose(entities.find("third")) == pytest.approx(START)
    entities.delete(entities.find("left"))
    assert entities.robot_names == ["right", "third"]
    assert entities.pose(entities.find("right")) == pytest.approx(right)
    entities.delete(entities.find("third"))
    with pytest.raises(ConfigError, match="the last robot"):
        entities.delete(entities.find("right"))


def test_starts_are_those_of_the_robots_that_are_still_there(staged):
    entities = staged("empty", ("left", "right"))
    entities.delete(entities.find("left"))
    entities.spawn_robot("third", START)
    entities.device.begin(0, np.array([-1.0, 0.0, 0.0, 1.0, -1.0, 0.5]))
    assert entities.pose(entities.find("right")) == pytest.approx([1.0, -1.0, 0.5])
    assert entities.pose(entities.find("third")) == pytest.approx(START)


@pytest.mark.slow
def test_room_for_what_was_spawned_is_given_back(staged):
    entities = staged("arena")
    room = entities.simulator.sampler.count
    for k in range(2):
        entities.spawn(
            "disc", ((Circle(radius=0.1 + 0.05 * k), (0.0, 0.0, 0.0)),), START
        )
        entities.restore()
        entities.device.begin(0, None)
        assert entities.simulator.sampler.count == room
        assert entities.bodies() == pytest.approx(staged("arena").bodies())


def test_only_what_moves_takes_a_twist(staged):
    entities = staged("arena")
    car = entities.find("car")
    still = entities.find("obstacle_0")
    entities.move(car, np.array([0.0, 0.0, np.pi / 2]), np.array([0.0, 0.3, 0.0]))
    assert entities.twist(car) == pytest.approx([0.0, 0.3, 0.0], abs=1e-9)
    with pytest.raises(ConfigError, match="stands still"):
        entities.move(still, None, np.array([0.1, 0.0, 0.0]))
    with pytest.raises(OutsideError, match="outside the world"):
        entities.move(still, np.array([99.0, 0.0, 0.0]), None)


@pytest.mark.parametrize("value", [1e308, 1e3])
def test_a_robot_gets_no_twist_that_it_could_not_be_commanded(staged, value):
    entities = staged("empty")
    car = entities.find("car")
    entities.move(car, START, np.array([value, value, value]))
    fastest = entities.simulator.model.robot.command_high[0]
    assert np.hypot(*entities.twist(car)[:2]) == pytest.approx(fastest)
    entities.device.advance()
    assert np.isfinite(entities.pose(car)).all()


def test_an_obstacle_moves_no_faster_than_obstacles_can(staged):
    entities = staged("crowd")
    walker = next(entity for entity in entities if entity.motion is not None)
    entities.move(walker, None, np.full(3, 1e308))
    assert np.abs(entities.twist(walker)).max() == FASTEST
    entities.device.advance()
    assert np.isfinite(entities.pose(walker)).all()
