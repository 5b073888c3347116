"""Sampled roll-outs in the robot's model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.policy.planners.mppi import Mppi
from nics_drl_bridge.policy.planners.mppi_kernels import fit_command
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = ("ackermann", "differential", "mecanum", "tricycle")


def planner(robot="differential", **changes):
    model = builtin_model(robot)
    return Mppi(Navigation(model.robot, lidar(beams=90)), model, **changes)


def observe(policy, count=20):
    rng = np.random.default_rng(0)
    task = policy.task
    ranges = rng.uniform(0.5, 3.0, (count, 90)).astype(np.float32)
    twist = np.zeros((count, 3))
    pose = rng.uniform(-1.0, 1.0, (count, 3))
    view = RobotView(pose, twist, ranges, 0.0, 0.0, 0.0)
    return task.observation(view, {"goal": rng.uniform(-3.0, 3.0, (count, 2))})


def test_an_action_follows_from_seed_and_observation_whatever_was_asked_before_and_beside():
    policy = planner(samples=32)
    seen = observe(policy)
    actions = policy.act(seen)
    assert np.array_equal(policy.act(seen[::-1])[::-1], actions)
    assert np.array_equal(planner(samples=32).act(seen[7]), actions[7])
    assert not np.array_equal(planner(samples=32, seed=1).act(seen), actions)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_command_behind_a_twist_is_that_which_led_to_it(robot):
    policy = planner(robot)
    spec = policy.task.robot
    model = policy.model.kinematics
    command = 0.6 * spec.command_high
    pose = np.zeros(3)
    state = np.zeros(model.state_size)
    for _ in range(300):
        before, (pose, state) = pose, model.step(pose, state, command)
    moved = np.linalg.norm((pose - before)[:2]) / model.dt
    turned = (pose - before)[2] / model.dt
    direction = np.array([0.0]) if robot != "mecanum" else np.arctan2(*command[1::-1])
    twist = np.array(
        [moved * np.cos(direction).item(), moved * np.sin(direction).item(), turned]
    )
    _, lanes = policy._make_memory()
    fit_command(twist, policy._plant, lanes)
    assert lanes.held == pytest.approx(command, abs=0.08)


def test_it_waits_out_the_latency_of_its_model():
    model = builtin_model("differential")
    late = replace(model, calibration=replace(model.calibration, command_latency_s=0.3))
    assert Mppi(planner().task, late)._plant.latency == pytest.approx(
        planner()._plant.latency + 0.3, abs=0.05
    )


def test_it_plans_with_the_speeds_that_its_task_allows():
    slow = planner()
    slow = replace(slow, task=replace(slow.task, top_speed=0.2))
    fastest, _ = slow.task.command(np.ones(2))
    assert slow._plant.high[0] == fastest == 0.2
    ahead = RobotView(
        np.zeros(3), np.zeros(3), np.full(90, np.inf, np.float32), 0.0, 0.0, 0.0
    )
    action = slow.act(slow.task.observation(ahead, {"goal": np.array([2.0, 0.0])}))
    assert slow.task.command(action)[0] > 0.15


def test_a_robot_of_which_neither_model_nor_textbook_is_known_is_refused():
    robot = load_robot("ackermann").model_copy(
        update={"textbook": None, "parameters": {}}
    )
    with pytest.raises(BridgeError, match="ackermann"):
        Mppi(Navigation(robot, lidar(beams=90)))
