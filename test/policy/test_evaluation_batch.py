from __future__ import annotations

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.evaluation import drive
from nics_drl_bridge.policy.evaluation_batch import Outcomes, drive_worlds, summarise
from nics_drl_bridge.policy.policies import make_policy

LIMIT = 40
MODEL, WORLD = direct_model(odometry=(0.02, 0.02)), field(count=6)


@pytest.mark.parametrize("worlds", [3, 8])
def test_many_at_once_end_as_one_after_the_other(worlds):
    env = BridgeVectorEnv(worlds, MODEL, WORLD, max_episode_steps=LIMIT)
    policy = make_policy("straight", env.task)
    seeds = [7, 3, 11, 5, 100, 42, 43]
    found = drive_worlds(env, policy.act, seeds)
    alone = TimeLimit(BridgeEnv(model=MODEL, world=WORLD), LIMIT)
    episodes = [drive(alone, policy, seed) for seed in seeds]
    assert found.seeds.tolist() == seeds
    assert found.steps.tolist() == [one.steps for one in episodes]
    assert np.allclose(found.length, [one.length for one in episodes], atol=1e-12)
    assert np.allclose(found.reward, [one.reward for one in episodes], atol=1e-9)
    assert found.success.tolist() == [one.result == "success" for one in episodes]
    assert found.collision.tolist() == [one.result == "collision" for one in episodes]
    assert len({one.result for one in episodes}) > 1


def test_arrived_is_who_truly_is_there(monkeypatch):
    env = BridgeVectorEnv(8, MODEL, WORLD, max_episode_steps=LIMIT)
    policy = make_policy("straight", env.task)
    honest = drive_worlds(env, policy.act, range(8))
    assert honest.success.any()
    of_step = BridgeVectorEnv._facts_of_step

    def aside(self, outcome):
        facts = of_step(self, outcome)
        return facts | {"true_pose": facts["true_pose"] + [0.5, 0.0, 0.0]}

    monkeypatch.setattr(BridgeVectorEnv, "_facts_of_step", aside)
    lied = drive_worlds(env, policy.act, range(8))
    assert lied.success.sum() < honest.success.sum()
    assert lied.collision.tolist() == honest.collision.tolist()


def test_a_robot_that_stands_still_runs_out_of_time():
    env = BridgeVectorEnv(4, MODEL, WORLD, max_episode_steps=5)
    found = drive_worlds(env, lambda seen: np.zeros((len(seen), 3)), range(4))
    assert found.time_out.all()
    assert found.steps.tolist() == [5] * 4
    assert found.length == pytest.approx(np.zeros(4), abs=1e-9)


def test_time_and_length_are_those_of_the_successful():
    flags = np.array([True, False, True, False])
    outcomes = Outcomes(
        np.arange(4), flags, np.array([False, True, False, False]), np.array([10, 99, 30, 300]),
        np.array([1.0, 50.0, 2.0, 60.0]), np.zeros(4),
    )  # fmt: skip
    summary = summarise(outcomes, 0.1)
    assert summary.episodes == 4
    assert (summary.success.value, summary.collision.value, summary.time_out.value) == (
        0.5, 0.25, 0.25,
    )  # fmt: skip
    assert summary.length.value == pytest.approx(1.5)
    assert summary.time.value == pytest.approx(2.0)
