from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.config import validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.kinds import require_textbook
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


def data(**changes):
    speed = {"name": "speed", "unit": "m/s", "min": -1.0, "max": 1.0}
    return {
        "name": "cart",
        "footprint_radius": 0.2,
        "state": [{**speed, "follows": "push"}],
        "command": [
            {**speed, "name": "push", "cmd_vel": "linear.x"},
            {**speed, "name": "turn", "unit": "rad/s", "cmd_vel": "angular.z"},
        ],
    } | changes


@pytest.mark.parametrize("name", ROBOTS)
def test_a_shipped_robot_loads_by_its_name(name):
    robot = load_robot(name)
    assert robot.name == robot.textbook == name
    assert (robot.command_low < robot.command_high).all()


def test_names_and_units_stand_in_the_order_of_x_and_of_dq():
    robot = RobotSpec.model_validate(data())
    assert robot.variable_names == ("speed", "push", "turn")
    assert robot.variable_units == ("m/s", "m/s", "rad/s")
    assert robot.dof_names == ("vx", "vy", "wz", "d_speed")
    assert robot.dof_units == ("m/s", "m/s", "rad/s", "m/s/s")


def test_each_command_travels_in_the_field_of_cmd_vel_that_it_names():
    assert np.array_equal(load_robot("ackermann").to_cmd_vel([0.5, -0.2]), [0.5, 0.0, -0.2])
    assert np.array_equal(load_robot("mecanum").to_cmd_vel([1.0, 2.0, 3.0]), [1.0, 2.0, 3.0])
    backwards = RobotSpec.model_validate(data(command=data()["command"][::-1]))
    assert np.array_equal(backwards.to_cmd_vel([0.1, 0.7]), [0.7, 0.0, 0.1])


@pytest.mark.parametrize("name", ROBOTS)
def test_commands_come_back_from_cmd_vel_in_any_batch(name):
    robot = load_robot(name)
    command = np.random.default_rng(0).normal(size=(4, 5, len(robot.command)))
    assert np.array_equal(robot.from_cmd_vel(robot.to_cmd_vel(command)), command)


def test_fields_that_a_robot_has_no_use_for_are_dropped():
    assert np.array_equal(load_robot("ackermann").from_cmd_vel([1.0, 9.0, 0.3]), [1.0, 0.3])


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"footprint_radius": 0.0}, "greater than or equal to 0.001"),
        ({"command": []}, "at least 1 item"),
        ({"state": data()["command"][:1]}, "unknown key 'state.0.cmd_vel'"),
        ({"state": [{"name": "push", "unit": "m", "min": 0, "max": 1}]}, "a name of its own"),
        (
            {"state": [{"name": "a", "unit": "m", "min": 1, "max": 1}]},
            "min must be less than max of variable 'a'",
        ),
        (
            {"state": [{"name": "a", "unit": "m", "min": 0, "max": 1, "follows": "b"}]},
            "state 'a' follows 'b', which is no command",
        ),
        (
            {"command": [{**c, "cmd_vel": "linear.x"} for c in data()["command"]]},
            "two commands share one field",
        ),
        ({"state": [{"name": "A b", "unit": "m", "min": 0, "max": 1}]}, "state.0.name"),
        ({"textbook": "tank"}, "key 'textbook'"),
        ({"footprint": [[0.1, 0.0], [0.0, 0.1]]}, "at least 3 items"),
        ({"footprint": [[0.1, 0.0], [0.0, "a"], [0.0, 0.0]]}, "footprint.1.1"),
        ({"footprint": [[0.1, 0.1], [-0.1, -0.1], [0.1, -0.1], [-0.1, 0.1]]}, "cross or touch"),
        ({"footprint": [[0.1, 0.0], [0.2, 0.0], [0.1, 0.0]]}, "cross or touch"),
        ({"footprint": [[0.1, 0.0], [0.1, 0.0], [0.0, 0.1]]}, "cross or touch"),
        ({"footprint": [[0.1, 0.1], [-0.1, 0.1], [0.0, -0.1]]}, "leave footprint_radius out"),
    ],
)
def test_a_robot_that_cant_be_is_refused_in_one_sentence(changes, sentence):
    with pytest.raises(ConfigError) as caught:
        validate(data(**changes), RobotSpec, "cart.yaml")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_robot_without_textbook_is_told_so():
    with pytest.raises(ConfigError, match="robot 'cart' names no textbook kinematics"):
        require_textbook(RobotSpec.model_validate(data()))


def test_a_footprint_gives_the_radius_of_the_circle_that_holds_it():
    given = data(footprint=[[0.3, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.3, -0.1]])
    del given["footprint_radius"]
    robot = RobotSpec.model_validate(given)
    assert robot.footprint_radius == pytest.approx(np.hypot(0.3, 0.1))
    assert RobotSpec.model_validate(robot.model_dump(mode="json")) == robot


def test_a_footprint_may_be_concave():
    given = data(footprint=[[0.3, 0.2], [-0.2, 0.2], [-0.2, -0.2], [0.3, -0.2], [0.0, 0.0]])
    del given["footprint_radius"]
    assert len(RobotSpec.model_validate(given).footprint) == 5


def test_a_robot_without_any_footprint_is_refused():
    given = data()
    del given["footprint_radius"]
    with pytest.raises(ConfigError, match="footprint_radius"):
        validate(given, RobotSpec, "cart.yaml")
