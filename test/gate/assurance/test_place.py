from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.assurance.place import MOVING_STEPS, POLICY, Job, Place
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.further_lidar import FurtherLidar


def test_a_car_that_trembles_at_rest_was_walked_into():
    place = Place(builtin_model("ackermann"), "crowd")
    place.begin(Job("ram", 1, standing=True))
    for _ in range(80):
        place.step(np.zeros(3))
    simulator, (x, y, radius) = place._sim, place.truth.circles[0]
    # People keep out of its way, so it is put where one of them is about to tread.
    still = np.zeros(simulator.data.state.shape[-1])
    simulator.put_robot(0, np.array([x + radius, y, 0.0]), still)
    place.track += [np.array([x + radius, y, 0.0])] * (MOVING_STEPS + 1)
    place.step(np.zeros(3))
    assert place.outcome.walked_into
    assert not place.outcome.contact
    assert place.outcome.path > 0.01  # its noise


def test_a_robot_that_drives_into_something_is_in_contact():
    place = Place(builtin_model("mecanum"), "arena")
    place.begin(Job(POLICY, 0))  # which has the time to come to a wall
    while not (place.outcome.contact or place.outcome.walked_into):
        place.step(np.array([0.5, 0.0, 0.0]))
    assert place.outcome.contact
    assert place.outcome.speed == pytest.approx(0.5, abs=0.1)


def test_what_touches_a_robot_at_the_first_step_of_an_episode_walked_into_it():
    place = Place(builtin_model("mecanum"), "empty")
    place.begin(Job("ram", 0))
    wall = np.array([place.truth.walls[:, [0, 2]].max(), 0.0, 0.0])
    place._sim.put_robot(0, wall, np.zeros(place._sim.data.state.shape[-1]))
    place.track = [wall]
    place.step(np.zeros(3))
    assert (place.outcome.walked_into, place.outcome.contact) == (True, False)


def test_a_robot_that_turns_a_corner_into_a_wall_is_in_contact():
    place = Place(builtin_model("jackal"), "empty")
    place.begin(Job("ram", 0))
    simulator = place._sim
    still = np.zeros(simulator.data.state.shape[-1])
    wall = place.truth.walls[:, [0, 2]].max()
    beside = np.array([wall - 0.28, 0.0, 0.0])  # half its length is 0.254 m
    simulator.put_robot(0, beside, still)
    place.track = [beside]
    while not (place.outcome.contact or place.outcome.walked_into):
        place.step(np.array([0.0, 0.0, 2.5]))
    assert place.outcome.contact
    assert place.outcome.speed > 0.1  # of the corner


@pytest.mark.parametrize("robot", ["differential", "turtlebot3_burger"])
def test_the_steps_of_the_world_divide_the_control_period(robot):
    place = Place(builtin_model(robot), "arena")
    period = place.model.control_period
    assert place.step_s * place.period_steps == pytest.approx(period)
    assert place.step_s == pytest.approx(0.02)
    assert place.model.lidar.rate == pytest.approx(1.0 / period)


def test_a_robot_with_further_sensors_is_refused():
    model = builtin_model("differential")
    rear = model.lidar.model_copy(update={"frame": "rear"})
    sensors = (FurtherLidar(name="rear_scan", lidar=rear),)
    with pytest.raises(ConfigError, match=r"additional sensors \(rear_scan\)"):
        Place(replace(model, sensors=sensors), "arena")
