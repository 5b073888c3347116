from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gate.rig import Rig, config
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.stopping import doubtful, lag, require_possible, shield_config, wheelbase
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


def shield_of(robot, file=None, **given):
    model = builtin_model(robot)
    return shield_config(model, load_limits(robot, model.robot), file or robot, given)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_shipped_robot_has_measured_values_and_room_of_its_own(robot):
    shield, said = shield_of(robot)
    assert (shield.latency_s, shield.deceleration, shield.obstacle_speed) == (0.2, 2.0, 1.0)
    assert shield.footprint_radius == load_robot(robot).footprint_radius
    assert (shield.wheelbase > 0.0) == (robot == "ackermann")
    assert shield.range_max == builtin_model(robot).lidar.range_max
    assert said.startswith("the shield is on: latency 0.2, deceleration 2, margin 0.05")
    assert f"limits/{robot}.yaml" in said


def test_the_outline_of_a_robot_that_has_one_is_swept():
    assert shield_of("jackal")[0].outline == load_robot("jackal").footprint
    assert shield_of("differential")[0].outline == ()


def test_what_is_given_goes_before_the_file():
    shield, said = shield_of("mecanum", latency=0.7)
    assert (shield.latency_s, shield.deceleration) == (0.7, 2.0)
    assert "but latency by parameter" in said


@pytest.mark.parametrize("robot", ROBOTS)
def test_what_no_file_tells_is_derived_with_care(robot):
    model = builtin_model(robot)
    shield, said = shield_config(model, load_limits(robot, model.robot))
    assert shield.latency_s == pytest.approx(model.control_period + 0.1, abs=0.01)
    assert shield.deceleration == 2.0  # what its limits say
    assert "derived from model and limits" in said
    slow = replace(model.calibration, command_latency_s=0.3)
    later = shield_config(replace(model, calibration=slow), None)[0]
    assert later.latency_s == pytest.approx(shield.latency_s + 0.3)
    assert later.deceleration < 1.0


def test_a_robot_brakes_no_harder_than_its_model_can():
    model = builtin_model("ackermann")
    limits = np.array([[-0.3, 0.4], [-0.1, 0.1]])  # of its speed, and of its steering
    slow = replace(model, kinematics=replace(model.kinematics, limits=limits))
    assert shield_config(slow, load_limits("ackermann", model.robot))[0].deceleration == 0.3
    assert shield_config(slow, None)[0].deceleration == 0.3


def test_the_lag_of_a_model_that_shows_none_is_guessed():
    model = builtin_model("ackermann").kinematics
    still = replace(model, coefficients=0.0 * model.coefficients)
    assert lag(model) == pytest.approx(0.1, abs=0.01)
    assert lag(still) == 0.5


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("deceleration", 0.0, "'shield_deceleration' is 0; it must be from 0.001 to 10000"),
        ("latency", -0.1, "'shield_latency' is -0.1; it must be from 0 to 10"),
        ("latency", 1e9, "'shield_latency' is 1e\\+09; it must be from 0 to 10"),
        ("obstacle_speed", 1e9, "'shield_obstacle_speed' is 1e\\+09; it must be from 0 to 100"),
        ("margin", float("inf"), "'shield_margin' is inf; it must be from 0 to 10"),
    ],
)
def test_a_value_that_makes_no_sense_is_one_sentence(name, value, sentence):
    with pytest.raises(ConfigError, match=sentence):
        shield_of("ackermann", **{name: value})


def test_a_limits_file_whose_shield_is_wrong_is_one_sentence(tmp_path):
    text = "robot: mecanum\ncommands: {}\nshield: {latency: 0.1, deceleration: -2.0}\n"
    (tmp_path / "my.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"my.yaml.*deceleration"):
        shield_of("mecanum", tmp_path / "my.yaml")


def test_a_car_that_does_not_tell_its_wheelbase_needs_it_or_no_shield():
    car = load_robot("ackermann").model_copy(update={"parameters": {}})
    with pytest.raises(ConfigError, match=r"'wheelbase' of a car; add it .* `shield: false`"):
        wheelbase(car)


def test_a_robot_that_is_told_volts_has_no_shield():
    robot = load_robot("differential")
    volts = robot.command[0].model_copy(update={"unit": "V"})
    with pytest.raises(ConfigError, match=r"'forward_command' is in 'V'; .* `shield: false`"):
        wheelbase(robot.model_copy(update={"command": (volts, robot.command[1])}))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"scan_age_s": 0.05}, "'scan_age': 0.05 s: scan comes every 0.1 s .* could never move"),
        ({"scan_age_s": 0.09}, "give more than 0.1"),
        ({"odom_age_s": 0.05}, "'odom_age': 0.05 s"),
        ({"scan_rate": 2.0}, "scan comes every 0.5 s"),
        ({"odom_rate": 1.5, "odom_age_s": 2.0}, "too seldom to be judged within 1 s"),
    ],
)
def test_a_setting_with_which_the_gate_is_never_armed_is_one_sentence(changes, sentence):
    given = config(**changes)
    with pytest.raises(ConfigError, match=sentence):
        require_possible(given)
    rig = Rig(given)
    rig.run(3.0)
    assert not rig.arm().granted


def test_the_settings_of_a_robot_that_drives_are_possible():
    require_possible(config())
    assert doubtful(config(), 0.1) == ""


def test_commands_that_are_too_old_before_the_next_one_comes_are_warned_of():
    assert "give more than 0.1" in doubtful(config(command_age_s=0.05), 0.1)
