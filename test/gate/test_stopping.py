from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import field

from gate.rig import config
from nics_drl_bridge.config import find_config
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import stopping
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.stopping import (
    get_wheelbase,
    require_possible,
    shield_config,
    warn_of_age_limit,
)
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.simulator import FastSimulator

ROBOTS = ("ackermann", "differential", "mecanum")  # as their shipped limits say


def shield_of(robot, file=None, **given):
    model = builtin_model(robot)
    return shield_config(model, load_limits(robot, model.robot), file or robot, given)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_shipped_robot_has_measured_values_and_room_of_its_own(robot):
    shield, said = shield_of(robot)
    assert (shield.latency_s, shield.deceleration, shield.obstacle_speed) == (
        0.2,
        2.0,
        1.0,
    )
    assert shield.footprint_radius == load_robot(robot).footprint_radius
    assert (shield.wheelbase > 0.0) == (robot == "ackermann")
    assert shield.range_max == builtin_model(robot).lidar.range_max
    assert said.startswith("the shield is on: latency 0.2, deceleration 2, margin 0.05")
    assert f"limits/{robot}.yaml" in said
    given, said = shield_of(robot, latency=0.7)
    assert given == replace(shield, latency_s=0.7)
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
    assert later.latency_s == pytest.approx(shield.latency_s + 0.3, abs=0.02)
    assert later.deceleration < 1.0


def limited(model, rate):
    """The model, whose states change by at most a rate per second."""
    limits = np.tile([-rate, rate], (model.kinematics.state_size, 1))
    return replace(model, kinematics=replace(model.kinematics, limits=limits))


def kept_free(shield, speed):
    """The distance that a shield keeps free straight ahead, without margin and hold [m]."""
    return speed * (shield.latency_s + speed / (2.0 * shield.deceleration))


def stopping_distance(model, limits, speed, command=0):
    """How far a robot still moves in the simulator: its base hears the stop a period late [m]."""
    sim = FastSimulator(model, field(60.0))
    commands = np.zeros((1, 1, len(model.robot.command)))
    sim.reset([0], starts=np.zeros((1, 1, 3)))
    commands[..., command] = speed
    for _ in range(round(12.0 / model.control_period)):
        sim.step(commands)
        before = sim.data.pose[0, 0].copy()
    sim.step(commands)
    path = float(np.hypot(*(sim.data.pose[0, 0] - before)[:2]))
    while abs(commands[0, 0, command]) > 0.0:
        slower = (
            abs(commands[0, 0, command]) - limits.rate[command] * model.control_period
        )
        commands[..., command] = np.sign(speed) * max(0.0, slower)
        path += moved_by(sim, commands)
    while (step := moved_by(sim, commands)) > 1e-4 * model.control_period:
        path += step
    return path


def moved_by(sim, commands):
    before = sim.data.pose[0, 0].copy()
    sim.step(commands)
    return float(np.hypot(*(sim.data.pose[0, 0] - before)[:2]))


@pytest.mark.parametrize(("at_the_rim", "least"), [(None, 0.45), (0.2, 2.4)])
@pytest.mark.slow
def test_the_way_that_is_kept_free_is_what_the_simulator_needs(at_the_rim, least):
    """Also for wheels, whose limits of rates are in rad/s^2: at 0.2 m/s^2 it is over 2.5 m."""
    model = replace(builtin_model("jackal"), noise=Noise())
    if at_the_rim is not None:
        model = limited(model, at_the_rim / model.robot.parameters["wheel_radius"])
    limits = load_limits("jackal", model.robot)
    shield, _ = shield_config(model, limits)
    for speed in (1.0, 0.2, -0.4):
        needed = stopping_distance(model, limits, speed)
        assert kept_free(shield, abs(speed)) >= needed - 0.01
        assert kept_free(shield, abs(speed)) <= 1.3 * needed + 0.05
    assert stopping_distance(model, limits, 1.0) > least


def test_wheels_that_brake_weakly_turn_the_robot_off_its_arc():
    model = builtin_model("jackal")
    weak = limited(model, 2.0)
    limits = load_limits("jackal", model.robot)
    assert shield_config(model, limits)[0].drift.is_none
    shield = shield_config(weak, limits)[0]
    assert shield.drift.greatest == pytest.approx(2.0, abs=0.1)
    assert shield.lever > 0.2


def test_a_model_that_shows_no_lag_has_an_assumed_one():
    model = builtin_model("ackermann")
    still = replace(model.kinematics, coefficients=0.0 * model.kinematics.coefficients)
    limits = load_limits("ackermann", model.robot)
    shield = shield_config(replace(model, kinematics=still), limits)[0]
    assert shield.latency_s == pytest.approx(0.5 + model.control_period)


def test_a_robot_that_does_not_stop_by_its_model_needs_to_be_told_how_it_stops(
    tmp_path, monkeypatch
):
    def roll_on(*_):
        raise ConfigError("the robot does not stop.")

    monkeypatch.setattr(stopping, "find_braking", roll_on)
    model = builtin_model("jackal")
    limits = load_limits("jackal", model.robot)
    with pytest.raises(
        ConfigError, match=r"does not stop.* file of limits may give it: `shield: {lat"
    ):
        shield_config(model, limits)
    told = {"latency": 0.5, "deceleration": 0.05}
    assert shield_config(model, limits, overrides=told)[0].deceleration == 0.05
    text = find_config("jackal", "limits").read_text()
    (tmp_path / "my.yaml").write_text(
        f"{text}shield: {{latency: 0.5, deceleration: 0.05}}\n"
    )
    assert shield_config(model, limits, tmp_path / "my.yaml")[0].latency_s == 0.5


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("deceleration", 9e-4),
        ("latency", -0.1),
        ("latency", 10.1),
        ("obstacle_speed", 101.0),
        ("margin", np.inf),
    ],
)
def test_a_value_that_makes_no_sense_is_named(name, value):
    with pytest.raises(ConfigError, match=rf"shield's parameters.*'{name}'.*{value:g}"):
        shield_of("ackermann", **{name: value})


def test_a_limits_file_whose_shield_is_wrong_is_named_with_its_key(tmp_path):
    text = "robot: mecanum\ncommands: {}\nshield: {latency: 0.1, deceleration: -2.0}\n"
    (tmp_path / "my.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"my.yaml.*deceleration"):
        shield_of("mecanum", tmp_path / "my.yaml")


def test_a_robot_that_no_shield_fits_may_drive_without_one():
    model = builtin_model("ackermann")
    volts = model.robot.command[0].model_copy(update={"unit": "V"})
    single = model.lidar.model_copy(update={"beams": 1})
    robots = (
        ("wheelbase", model.robot.model_copy(update={"parameters": {}})),
        ("'V'", model.robot.model_copy(update={"command": (volts,)})),
    )
    for words, robot in robots:
        with pytest.raises(ConfigError, match=rf"{words}.*`shield: false`"):
            get_wheelbase(robot)
    with pytest.raises(ConfigError, match=r"has 1;.*`shield: false`"):
        shield_config(replace(model, lidar=single), None)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"scan_age_s": 0.09}, "'scan_age'.*give more than 0.1"),
        ({"odom_age_s": 0.09}, "'odom_age': 0.09 s"),
        ({"scan_age_s": 0.1}, "'scan_age'"),  # any message is a little late
        ({"odom_age_s": 0.1}, "'odom_age'"),
        ({"scan_rate": 2.0}, "scan comes every 0.5 s"),
        ({"odom_rate": 2.0, "odom_age_s": 2.0}, ""),
        ({"odom_rate": 1.5, "odom_age_s": 2.0}, "too rarely to be judged within 1 s"),
    ],
)
def test_a_setting_with_which_the_gate_is_never_armed_is_refused(changes, words):
    given = config(**changes)
    if not words:
        require_possible(given)
        return
    with pytest.raises(ConfigError, match=words):
        require_possible(given)


@pytest.mark.parametrize(("period_s", "warns"), [(0.1, False), (0.25, True)])
def test_an_age_limit_that_suits_only_a_faster_policy_is_warned_of(period_s, warns):
    assert bool(warn_of_age_limit(config(command_age_s=0.25), period_s)) == warns
