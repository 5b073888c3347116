from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nics_drl_bridge.config import list_shipped
from nics_drl_bridge.defaults import EPISODE_STEPS
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar
from nics_drl_bridge.policy.train.settings import (
    Opened,
    TrainingSettings,
    choose_fitting_settings,
    find_kin,
    find_pace,
    fit_settings,
    load_training,
    top_speed,
)
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.sim.world_set import load_worlds

LEARNT = (
    "ackermann",
    "differential",
    "mecanum",
)  # robots whose policies come with the package
BURGER = {"robot": "turtlebot3_burger"}


@pytest.fixture(scope="module")
def model():
    return open_model("differential")


def slow(model, speed=0.22):
    """The same robot, that drives at most so fast, ahead as backwards [m/s]."""
    data = model.robot.model_dump(mode="json")
    data["command"][0] |= {"min": -speed, "max": speed}
    return replace(model, robot=RobotSpec.model_validate(data))


def fitted(settings, model, inherited):
    worlds = {name: load_worlds(name) for name in settings.worlds}
    return fit_settings(settings, Opened(model, worlds), inherited)[:2]


@pytest.mark.parametrize("name", LEARNT)
def test_the_shipped_robots_keep_the_time_limit_that_their_policies_were_learnt_with(
    name,
):
    worlds = [load_worlds(world) for world in list_shipped("worlds")]
    known = SimpleNamespace(robot=load_robot(name), control_period=0.1)
    assert find_pace(known, worlds).steps == EPISODE_STEPS


def test_a_slow_robot_has_the_time_that_its_way_takes(model):
    pace = find_pace(slow(model), [load_worlds("doorway")])
    assert pace.steps == math.ceil(1.8 * 7.0 / 0.22 / 0.1)
    assert pace.shortfall(pace.steps) is None


def test_the_field_bounds_the_way_where_the_distance_of_goals_does_not(model):
    field = load_worlds("doorway").model_copy(update={"goal_distance": (2.0, 1e6)})
    assert find_pace(model, [field]).far == pytest.approx(math.hypot(8.0, 5.0))


def test_a_goal_that_cant_be_reached_in_time_is_told_and_none_at_all_is_refused(model):
    pace = find_pace(slow(model), [load_worlds("doorway")])
    told = pace.shortfall(300)
    assert "'doorway': a goal may be 7 m away, which takes 32 s at 0.22 m/s" in told
    assert "set max_episode_steps to 573" in told
    with pytest.raises(
        ConfigError, match=r"no goal can be reached in time: .* ends after 5 s"
    ):
        pace.shortfall(50)


def test_top_speed_is_that_of_the_kind_or_of_the_commands():
    assert top_speed(load_robot("turtlebot3_burger")) == pytest.approx(0.22)
    assert top_speed(load_robot("mecanum")) == pytest.approx(0.7)
    free = load_robot("differential").model_copy(update={"textbook": None})
    assert top_speed(free) == 1.0
    turning = free.model_copy(update={"command": free.command[1:]})
    assert top_speed(turning) == math.inf


@pytest.mark.parametrize(
    ("name", "like"),
    [
        ("turtlebot3_waffle", "differential"),
        ("jackal", "differential"),
        ("f1tenth", "ackermann"),
        ("tricycle", "ackermann"),
        ("mecanum", "mecanum"),
    ],
)
def test_a_robot_is_kin_to_the_shipped_one_that_moves_like_it(name, like):
    assert find_kin(load_robot(name)) == like


def test_settings_that_are_inherited_keep_their_meaning_over_a_longer_episode(model):
    base = load_training("own_differential").model_copy(
        update={"worlds": {"doorway": 4}}
    )
    settings, told = fitted(base, slow(model), inherited=True)
    factor = settings.max_episode_steps / EPISODE_STEPS
    assert settings.task_options["time_reward"] * factor == pytest.approx(
        -0.02, rel=1e-3
    )
    assert (1.0 - settings.ppo.discount) * factor == pytest.approx(0.01, rel=1e-3)
    assert len(told) == 3


def test_a_users_own_settings_get_a_time_limit_and_nothing_else(model):
    given = TrainingSettings(worlds={"doorway": 4}, task_options={"time_reward": -0.02})
    settings, _ = fitted(given, slow(model), inherited=False)
    assert settings == given.model_copy(update={"max_episode_steps": 573})
    limited = TrainingSettings(worlds={"doorway": 4}, max_episode_steps=320)
    assert fitted(limited, slow(model), inherited=False) == (limited, ())


def test_a_lidar_that_sees_no_full_circle_gets_the_layout_of_the_front(model):
    hokuyo = replace(model, lidar=load_lidar("hokuyo_ust_10lx"))
    settings, told = fitted(load_training("own_differential"), hokuyo, inherited=True)
    assert settings.task_options["scan"] == "front"
    assert told == (
        "the lidar 'hokuyo_ust_10lx' does not cover 3 m all around: scan: front",
    )


@pytest.mark.parametrize(
    ("changes", "scan"),
    [
        ({"angle_min": -np.pi / 2, "angle_max": np.pi / 2, "beams": 361}, 36),
        ({"angle_min": 0.0, "angle_max": 0.1, "beams": 11}, 4),
        ({"range_max": 2.0}, 72),  # which sees all around, but not far enough
    ],
)
def test_a_lidar_that_fills_no_layout_gets_sectors_over_its_own_view(
    model, changes, scan
):
    changed = LidarSpec.model_validate(model.lidar.model_dump() | changes)
    settings, told = fitted(
        load_training("own_differential"), replace(model, lidar=changed), inherited=True
    )
    assert settings.task_options["scan"] == scan
    assert told == (
        f"the lidar {changed.name!r} does not cover 3 m all around: scan: {scan}",
    )
    task = make_task("navigation", replace(model, lidar=changed), settings.task_options)
    assert task.scan.sectors == scan
    with pytest.raises(ConfigError, match=f"or train with `scan: {scan}`"):
        make_task("navigation", replace(model, lidar=changed), {"scan": "around"})


@pytest.mark.slow
def test_an_own_robot_trains_with_the_settings_of_its_kin_and_says_so():
    settings, told, _ = choose_fitting_settings(
        "navigation", None, BURGER | {"world": ["doorway"]}
    )
    own = load_training("own_differential")
    assert (settings.hidden, settings.teaching) == (own.hidden, own.teaching)
    assert (
        settings.max_episode_steps == 287
    )  # of 0.2 s, as its lidar turns five times a second
    assert "settings 'own_differential'" in told[0]


def test_a_shipped_robot_trains_with_its_own_settings_unchanged():
    settings, told, _ = choose_fitting_settings(
        "navigation", None, {"robot": "differential"}
    )
    assert settings == load_training("navigation_differential")
    assert told == ()
