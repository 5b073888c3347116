from __future__ import annotations

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from robots import lidar

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.policy.evaluation import drive_all, successes
from nics_drl_bridge.policy.go_to_goal import GoToGoal
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


def observe(task, bearing, distance=2.0, ranges=None):
    free = np.full(task.lidar.beams, np.inf, np.float32) if ranges is None else ranges
    view = RobotView(np.zeros(3), np.zeros(3), free, 0.0, 0.0, 0.0)
    goal = np.array([distance * np.cos(bearing), distance * np.sin(bearing)])
    return task.observation(view, {"goal": goal})


def turn_of(task, action):
    return task.robot.to_cmd_vel(task.command(action))[2]


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_turns_to_the_side_of_the_goal_and_goes_straight_to_one_ahead(robot):
    task = Navigation(load_robot(robot), lidar(beams=180))
    policy = GoToGoal(task)
    assert turn_of(task, policy.act(observe(task, 1.0))) > 0.05
    assert turn_of(task, policy.act(observe(task, -1.0))) < -0.05
    assert turn_of(task, policy.act(observe(task, 0.0))) == pytest.approx(0.0, abs=1e-6)


def test_it_turns_away_from_what_stands_before_the_goal():
    task = Navigation(load_robot("ackermann"), lidar(beams=180))
    policy = GoToGoal(task)
    ranges = np.full(180, np.inf, np.float32)
    ahead = np.abs(task.lidar.angles - 0.15) < 0.35
    ranges[ahead] = 0.6
    assert turn_of(task, policy.act(observe(task, 0.0, ranges=ranges))) < -0.05
    ranges = ranges[::-1].copy()
    assert turn_of(task, policy.act(observe(task, 0.0, ranges=ranges))) > 0.05


@pytest.mark.parametrize("robot", ROBOTS)
def test_any_observation_gives_an_action_of_the_space_that_depends_on_it_alone(robot):
    task = Navigation(load_robot(robot), lidar(beams=90, mount=(0.05, 0.0, 0.1)))
    one, other = GoToGoal(task), GoToGoal(task)
    rng = np.random.default_rng(0)
    for _ in range(50):
        ranges = rng.choice([np.inf, -np.inf, np.nan, 0.3, 1.0], 90).astype(np.float32)
        observation = observe(task, rng.uniform(-3, 3), rng.uniform(0, 5), ranges)
        action = one.act(observation)
        assert task.action_space.contains(action)
        assert np.array_equal(action, other.act(observation))


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_reaches_every_goal_of_the_empty_world(robot):
    env = BridgeEnv(model=robot, world="empty")
    policy = make_policy("go_to_goal", env.task)
    assert successes(drive_all(TimeLimit(env, 300), policy, range(3))) == 3


def test_it_reaches_most_goals_of_the_arena():
    env = BridgeEnv(world="arena")
    policy = make_policy("go_to_goal", env.task)
    assert successes(drive_all(TimeLimit(env, 300), policy, range(20))) >= 18


def test_an_unknown_policy_gives_the_nearest():
    task = Navigation(load_robot("ackermann"), lidar())
    with pytest.raises(ConfigError, match="unknown policy 'go_to_gaol'; did you mean 'go_to_goal'"):
        make_policy("go_to_gaol", task)
