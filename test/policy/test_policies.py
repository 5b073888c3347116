"""The planner, and the baselines beside it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from robots import field, lidar

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model, open_model
from nics_drl_bridge.interface import RobotView, Start
from nics_drl_bridge.policy import policies
from nics_drl_bridge.policy.evaluation import drive_all, drive_worlds, successes
from nics_drl_bridge.policy.file.stateful import Stateful, begin, resume
from nics_drl_bridge.policy.policies import (
    POLICIES,
    DynamicWindow,
    RandomActions,
    make_policy,
)
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


@cache
def policy_of(name, robot):
    task = Navigation(load_robot(robot), lidar(beams=90, mount=(0.05, 0.0, 0.1)))
    return make_policy(name, task)


def observe(task, bearing, distance=2.0, ranges=None):
    free = np.full(task.lidar.beams, np.inf, np.float32) if ranges is None else ranges
    view = RobotView(np.zeros(3), np.zeros(3), free, 0.0, 0.0, 0.0)
    goal = np.array([distance * np.cos(bearing), distance * np.sin(bearing)])
    return task.observation(view, {"goal": goal})


def twist_of(task, action):
    return task.robot.to_cmd_vel(task.command(action))


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", sorted(POLICIES))
def test_any_observation_gives_an_action_of_the_space_alone_as_among_many(robot, name):
    policy = policy_of(name, robot)
    if name == "random":
        policy = replace(policy)  # each begins with the same draws
    task = policy.task
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(8):
        ranges = rng.choice([np.inf, -np.inf, np.nan, 0.3, 1.0], 90).astype(np.float32)
        seen.append(observe(task, rng.uniform(-3, 3), rng.uniform(0, 5), ranges))
    actions = policy.act(np.array(seen))
    alone = replace(policy) if name == "random" else policy
    for observation, action in zip(seen, actions, strict=True):
        mine = alone.act(observation)
        assert task.action_space.contains(mine)
        assert np.array_equal(mine, action)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", ["dynamic_window", "mppi", "straight"])
def test_it_turns_or_moves_to_the_side_of_the_goal_and_drives_to_one_ahead(robot, name):
    policy = policy_of(name, robot)
    task = policy.task
    for side in (1.0, -1.0):
        _, left, turn = twist_of(task, policy.act(observe(task, side)))
        assert side * (left + turn) > 0.05
    forward, left, turn = twist_of(task, policy.act(observe(task, 0.0)))
    assert forward > 0.3
    # One on rollers is fastest askew.
    if name == "straight" or (robot != "mecanum" and name != "mppi"):
        assert (left, turn) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.slow
def test_the_planner_reaches_most_goals_where_straight_ones_collide():
    env = BridgeVectorEnv(20, "differential", "arena", max_episode_steps=200)
    share = {
        name: drive_worlds(
            env, make_policy(name, env.task).act, range(20)
        ).success.mean()
        for name in ("dynamic_window", "straight", "random")
    }
    assert share["dynamic_window"] >= 0.8
    assert share["dynamic_window"] > share["straight"] > share["random"]


@pytest.mark.slow
def test_the_planner_leaves_its_start_with_wheels_that_answer_slowly(tmp_path):
    robot = (share_folder() / "config" / "robots" / "differential.yaml").read_text()
    slow = tmp_path / "slow.yaml"
    slow.write_text(robot.replace("wheel_lag: 0.1", "wheel_lag: 0.8"))
    # At rest an estimator shows no noise.
    env = BridgeEnv(model=str(slow), world="empty", estimator=True)
    policy = make_policy("dynamic_window", env.task)
    assert successes(drive_all(TimeLimit(env, 300), policy, [0])) == 1


def car(**changes):
    return RobotSpec.model_validate(load_robot("ackermann").model_dump() | changes)


@pytest.mark.parametrize("changes", [{}, {"textbook": None}])
def test_a_car_turns_by_its_own_wheelbase(changes):
    long = car(
        parameters={"wheelbase": 2.5, "speed_lag": 0.1, "steering_lag": 0.1}, **changes
    )
    speed, angle = long.command_high
    assert not long.takes_turn_rate  # a copy of it that does is made of it
    twist = [speed, 0.0, speed * np.tan(angle) / 2.5]
    assert compute_steady_twist(long, long.command_high) == pytest.approx(twist)
    planner = DynamicWindow(Navigation(long, lidar()))
    assert np.abs(planner.twists).max(axis=0) == pytest.approx(np.abs(twist))


def test_the_planner_asks_a_model_whose_motors_bend_commands_where_they_lead():
    model = builtin_model("ackermann")
    curve = InputCurve(command="speed_command", dead=0.3)
    slow = np.array([[-0.5, 0.5], [-np.inf, np.inf]])
    bent = replace(
        model, kinematics=replace(model.kinematics, inputs=(curve,), limits=slow)
    )
    task = Navigation(model.robot, lidar())
    plain, asking = (make_policy("dynamic_window", task, m) for m in (model, bent))
    assert np.abs(asking.twists[:, 0]).max() == pytest.approx(0.7, abs=0.02)
    speeds = asking.commands[:, 0]
    crawling = speeds[speeds > 0.0].min()
    assert crawling < 0.3
    still = asking.twists[asking.commands[:, 0] == crawling]
    assert np.abs(still).max() < 1e-3
    # from 0.7 m/s by 0.5 m/s^2, not by 2
    slowness = asking.ahead.slowness - plain.ahead.slowness
    assert 0.7 * slowness == pytest.approx(1.4, abs=0.35)


def test_a_car_of_unknown_wheelbase_is_refused_and_none_assumed():
    unknown = car(parameters={}, textbook=None)
    with pytest.raises(
        ConfigError, match="'ackermann' steers, and its wheelbase is not known"
    ):
        make_policy("dynamic_window", Navigation(unknown, lidar()))


def counting(longest_gap=0.5):
    """A policy whose action is the number of its steps, for its states begin at 3."""
    return Stateful(
        lambda seen, state: (state[..., 0] - 2.0, state + 1.0), 2, 3.0, longest_gap
    )


def test_a_state_goes_on_from_step_to_step_and_begins_anew_where_it_is_reset():
    policy = counting()
    seen = np.zeros((2, 5), np.float32)
    assert [policy.act(seen).tolist() for _ in range(2)] == [[1, 1], [2, 2]]
    policy.reset(np.array([False, True]))
    assert policy.act(seen).tolist() == [3, 1]
    begin(policy.act)
    assert policy.act(seen[0]) == 1.0
    begin(RandomActions)  # has nothing to begin


def test_other_worlds_than_before_are_refused_unless_an_episode_begins():
    policy = counting()
    policy.act(np.zeros((2, 5), np.float32))
    with pytest.raises(
        ConfigError, match=r"has \(2,\) worlds, .* \(3,\); reset the policy"
    ):
        policy.act(np.zeros((3, 5), np.float32))


def test_after_a_gap_a_state_begins_anew_and_one_sentence_says_so():
    policy = counting()
    seen = np.zeros(5, np.float32)
    told = []
    acted = []
    for time_s in (10.0, 10.4, 10.9, 11.5, 12.0):
        told.append(resume(policy, time_s))
        acted.append(float(policy.act(seen)))
    assert acted == [1, 2, 3, 1, 2]
    assert [bool(one) for one in told] == [False, False, False, True, False]
    assert told[3].startswith("no observation for 0.6 s, longer than the 0.5 s")
    policy.reset()
    assert resume(policy, 99.0) == ""  # an episode begins, so there was no gap


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ackermann", "differential", "jackal", "mecanum"])
def test_a_shipped_policy_drives_where_it_was_learnt_to(name):
    """As one who installs the package calls it, with its robot's own lidar or a real one."""
    model = open_model(name, None if load_robot(name).lidar else "rplidar_a2")
    policy, task = policies.open_policy(name, model)
    env = BridgeVectorEnv(50, model, "circles", task, max_episode_steps=300)
    found = drive_worlds(env, policy.act, range(50))
    assert found.success.mean() >= 0.9
    assert found.collision.mean() <= 0.04


def weak_jackal(rate):
    """A Jackal whose wheels brake weakly [m/s^2 at the rim], but speed up as ever."""
    model = builtin_model("jackal")
    brakes = rate / model.robot.parameters["wheel_radius"]
    limits = np.array([[-brakes, 10.0 * brakes], [-brakes, 10.0 * brakes]])
    return replace(model, kinematics=replace(model.kinematics, limits=limits))


@pytest.mark.parametrize("name", ["dynamic_window", "mppi"])
@pytest.mark.slow
def test_a_planner_stops_a_robot_before_a_wall_although_its_wheels_brake_weakly(name):
    """The goal is behind the wall, so that it drives up to it, at a speed that it can brake."""
    model = weak_jackal(0.2)
    task = Navigation(model.robot, model.lidar)
    backend = SimBackend(model, field(9.0))
    policy = make_policy(name, task, model)
    view = backend.reset(Start(0, np.array([-3.0, 0.0, 0.0])))
    fastest = farthest = -math.inf
    for _ in range(120):
        action = policy.act(task.observation(view, {"goal": np.array([6.0, 0.0])}))
        view, told = backend.step(task.command(action))
        fastest = max(fastest, float(view.twist[0]))
        farthest = max(farthest, float(view.pose[0]))
        assert not told["true_collision"]
    assert fastest > 0.4
    assert farthest > 0.5


def test_a_planner_refuses_a_model_that_does_not_stop():
    model = weak_jackal(1e-5)
    with pytest.raises(ConfigError, match=r"'jackal': its model does not stop"):
        make_policy("dynamic_window", Navigation(model.robot, model.lidar), model)
