from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.randomisation import Randomisation

OWN = Path(__file__).resolve().parents[2] / "examples" / "own_task.py"
TASKS = (
    ("cooperative_reaching", {"actions": "discrete", "robots": 2}),
    ("pursuit_evasion", {}),
    ("navigation", {"actions": "discrete"}),
    (f"{OWN}:Patrol", {}),
)


def env(task="cooperative_reaching", task_options=None, **arguments):
    return BridgeParallelEnv(
        direct_model(), field(8.0), task, task_options, **arguments
    )


def sampled(env, seed=0):
    for m, name in enumerate(env.possible_agents):
        env.action_space(name).seed(seed + m)
    while True:
        yield {name: env.action_space(name).sample() for name in env.agents}


@pytest.mark.slow
@pytest.mark.parametrize(("task", "options"), TASKS)
def test_pettingzoos_checkers_find_nothing_to_warn_of(task, options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(env(task, options), num_cycles=100)
        parallel_seed_test(lambda: env(task, options), num_cycles=50)


@pytest.mark.parametrize("task", ["cooperative_reaching", "pursuit_evasion"])
def test_its_rewards_sum_to_the_teams_and_its_rows_are_the_teams(task):
    each = env(task)
    team = BridgeEnv(model=direct_model(), world=field(8.0), task=task)
    (seen, _), (rows, _) = each.reset(seed=5), team.reset(seed=5)
    assert np.array_equal(np.concatenate(list(seen.values())), rows)
    moves = sampled(each)
    while each.agents:
        before = list(each.agents)
        actions = next(moves)
        rest = np.zeros(3, np.float32)
        joint = np.concatenate(
            [actions.get(name, rest) for name in each.possible_agents]
        )
        seen, rewards, *_ = each.step(actions)
        rows, reward, terminated, _, info = team.step(joint)
        assert sum(rewards.values()) == pytest.approx(reward)
        for name in before:
            m = each.possible_agents.index(name)
            assert np.array_equal(seen[name], rows.reshape(3, -1)[m])
        assert reward == pytest.approx(
            sum(term.sum() for term in info["reward_terms"].values())
        )
        assert not (terminated and each.agents)


def test_a_robot_that_touched_something_leaves_and_stands_still_as_an_obstacle():
    parallel = env(task_options={"robots": 2})
    starts = [(3.0, 0.0, 0.0), (-3.0, 0.0, 0.0)]
    goals = [(0.0, 3.0), (0.0, -3.0)]
    parallel.reset(seed=0, options={"start": starts, "goal": goals})
    ahead = np.array([1.0, 0.0, 0.0], np.float32)
    rest = np.zeros(3, np.float32)
    while "robot_0" in parallel.agents:
        _, rewards, ended, _, infos = parallel.step({"robot_0": ahead, "robot_1": rest})
    assert ended == {"robot_0": True, "robot_1": False}
    assert infos["robot_0"]["collision"]
    assert rewards["robot_0"] < -9.0 < rewards["robot_1"]
    poses = []
    for _ in range(5):
        _, rewards, *_ = parallel.step({"robot_1": rest})
        assert set(rewards) == {"robot_1"}
        poses.append(parallel.env._backend.facts()["true_pose"][0])
    assert np.abs(np.diff(poses, axis=0)).max() == 0.0


def test_the_limit_truncates_all_that_are_left():
    parallel = env(max_episode_steps=4)
    parallel.reset(seed=1)
    rest = dict.fromkeys(parallel.agents, np.zeros(3, np.float32))
    for step in range(1, 5):
        _, _, ended, cut, _ = parallel.step(rest)
        assert set(cut.values()) == {step == 4}
        assert not any(ended.values())
    assert parallel.agents == []


def test_an_agent_without_an_action_is_named():
    parallel = env()
    parallel.reset(seed=0)
    with pytest.raises(ConfigError, match="no action for robot_1, robot_2"):
        parallel.step({"robot_0": np.zeros(3, np.float32)})


@pytest.mark.parametrize("task", ["navigation", "cooperative_reaching"])
def test_each_agent_is_told_what_the_randomisation_drew_for_it(task):
    drawn = Randomisation.model_validate(
        {"name": "both", "action_latency": [0.0, 1.0], "obstacles": {"count": [1, 3]}}
    )
    parallel = BridgeParallelEnv(
        direct_model(), field(8.0, 2), task, randomisation=drawn
    )
    _, infos = parallel.reset(seed=3)
    _, info = parallel.env.reset(seed=3)
    latency = np.atleast_1d(info["randomisation"]["action_latency_s"])
    for m, name in enumerate(parallel.possible_agents):
        told = infos[name]["randomisation"]
        assert told["action_latency_s"] == latency[m]
        assert told["obstacles.count"] == info["randomisation"]["obstacles.count"]
