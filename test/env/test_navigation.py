from __future__ import annotations

import numpy as np
import pytest
from robots import DIRECT, FOOTPRINT, lidar

from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.robot.spec import load_robot

B = 72


@pytest.fixture
def task():
    return Navigation(DIRECT, lidar())


def view(pose=(0.0, 0.0, 0.0), twist=(0.0, 0.0, 0.0), ranges=None):
    scan = np.full(B, np.inf) if ranges is None else np.asarray(ranges)
    motion = np.array(pose, float), np.array(twist, float)
    return RobotView(*motion, scan.astype(np.float32), 0.0, 0.0, 0.0)


def observe(task, view, goal):
    return task.observation(view, {"goal": np.array(goal)})


def judge(task, view, goal):
    return task.judge(view, {"goal": np.array(goal)})


def test_the_observation_is_laid_out_as_documented(task):
    ranges = np.full(B, 1.5, np.float32)
    observation = observe(
        task, view([1.0, 1.0, np.pi / 2], [0.1, 0.2, 0.3], ranges), [1.0, 3.0]
    )
    assert observation.dtype == np.float32
    assert observation.shape == (B + 6,)
    assert observation[:B] == pytest.approx(0.5)
    assert observation[B:] == pytest.approx([2.0, 1.0, 0.0, 0.1, 0.2, 0.3], abs=1e-6)


def test_ranges_become_shares_with_free_one_and_unknown_zero(task):
    ranges = np.array([np.inf, -np.inf, np.nan, 0.0, 1.5, 3.0, 9.0], np.float32)
    shares = task.free_share(ranges)
    assert shares.tolist() == [1.0, 0.0, 0.0, 0.0, 0.5, 1.0, 1.0]
    assert shares.dtype == np.float32


@pytest.mark.parametrize("robot", ["ackermann", "differential", "mecanum"])
def test_actions_span_the_commands_between_their_limits(robot):
    spec = load_robot(robot)
    task = Navigation(spec, lidar())
    size = len(spec.command)
    assert task.action_space.shape == (size,)
    assert np.array_equal(task.command(-np.ones(size)), spec.command_low)
    assert np.array_equal(task.command(np.ones(size)), spec.command_high)
    assert task.command(np.zeros(size)) == pytest.approx(
        (spec.command_low + spec.command_high) / 2
    )
    assert np.array_equal(task.command(np.full(size, 7.0)), spec.command_high)


@pytest.mark.parametrize(("distance", "reached"), [(0.299, True), (0.301, False)])
def test_the_goal_is_reached_within_its_radius(task, distance, reached):
    verdict = judge(task, view([1.0, 2.0, 0.3]), [1.0 + distance, 2.0])
    assert verdict.reached == reached
    assert not verdict.touched


@pytest.mark.parametrize(
    "mount", [(0.0, 0.0, 0.0), (0.15, 0.05, 0.0), (-0.1, 0.1, 2.5)]
)
def test_a_touch_is_judged_from_the_footprint_wherever_the_lidar_sits(mount):
    sensor = lidar(mount=mount)
    task = Navigation(DIRECT, sensor)
    limit = FOOTPRINT + task.contact_margin
    for distance, touched in ((limit - 1e-3, True), (limit + 1e-3, False)):
        for angle in np.linspace(-np.pi, np.pi, 12, endpoint=False):
            # The return of one beam that ends at this distance from the robot's middle.
            away = np.exp(1j * (sensor.angles + mount[2])) - np.exp(1j * angle)
            beam = int(np.argmin(np.abs(away)))
            direction = sensor.angles[beam] + mount[2]
            along = mount[0] * np.cos(direction) + mount[1] * np.sin(direction)
            rest = mount[0] ** 2 + mount[1] ** 2 - distance**2
            ranges = np.full(B, np.inf)
            ranges[beam] = -along + np.sqrt(along**2 - rest)
            assert judge(task, view(ranges=ranges), [5.0, 5.0]).touched == touched


def test_too_close_to_measure_is_a_touch_and_unknown_is_not(task):
    ranges = np.full(B, np.nan)
    assert not judge(task, view(ranges=ranges), [5.0, 5.0]).touched
    ranges[7] = -np.inf
    assert judge(task, view(ranges=ranges), [5.0, 5.0]).touched


def test_one_beam_that_errs_is_no_touch_and_what_is_as_wide_as_a_finger_is_one():
    sensor = lidar(beams=720)
    task = Navigation(DIRECT, sensor)
    ranges = np.full(720, FOOTPRINT + 0.1)
    ranges[100] = FOOTPRINT - 0.05
    assert not judge(task, view(ranges=ranges), [5.0, 5.0]).touched
    ranges[97:104] = FOOTPRINT
    assert judge(task, view(ranges=ranges), [5.0, 5.0]).touched


def reward(task, before, after, goal, ranges=None):
    one = view(before)
    other = view(after, ranges=ranges)
    return task.reward(one, other, {"goal": np.array(goal)})


def test_a_step_is_paid_by_the_metre_of_approach_less_the_time(task):
    terms = reward(task, [0, 0, 0], [0.5, 0, 0], [2.0, 0.0])
    assert terms == pytest.approx(
        {"progress": 0.5, "time": -0.01, "success": 0.0, "collision": 0.0}
    )
    away = reward(task, [0.5, 0, 0], [0, 0, 0], [2.0, 0.0])
    assert away["progress"] == pytest.approx(-0.5)


def test_the_goal_and_a_touch_are_paid_once_and_a_touch_at_the_goal_is_no_success(task):
    near = np.full(B, 0.1)
    at_goal = reward(task, [0, 0, 0], [1.9, 0, 0], [2.0, 0.0])
    assert (at_goal["success"], at_goal["collision"]) == (10.0, 0.0)
    touched = reward(task, [0, 0, 0], [1.0, 0, 0], [2.0, 0.0], near)
    assert (touched["success"], touched["collision"]) == (0.0, -10.0)
    both = reward(task, [0, 0, 0], [1.9, 0, 0], [2.0, 0.0], near)
    assert (both["success"], both["collision"]) == (0.0, -10.0)
