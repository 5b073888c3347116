from __future__ import annotations

import numpy as np
from robots import direct_model, field

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.train.worlds import TrainingWorlds

LIMIT = 30


def vector(count):
    return BridgeVectorEnv(
        count,
        direct_model(),
        field(count=3),
        max_episode_steps=LIMIT,
        autoreset_mode="SameStep",
    )


def test_who_watches_is_called_after_each_step_of_all_worlds():
    env = TrainingWorlds(vector(2), vector(3))
    seen = []
    env.on_step = lambda: seen.append(
        [one.simulator.data.steps.max() for one in env.envs]
    )
    env.seed(0)
    env.reset()
    for _ in range(2):
        env.step(np.zeros((5, 3), np.float32))
    assert seen == [[1, 1], [2, 2]]


def test_endings_of_all_envs_are_told_with_the_worlds_numbers():
    env = TrainingWorlds(vector(2), vector(3))
    env.seed(0)
    env.reset()
    for _ in range(LIMIT - 1):
        assert not env.step(np.zeros((5, 3), np.float32)).endings.truncated.any()
    step = env.step(np.zeros((5, 3), np.float32))
    assert step.endings.worlds.tolist() == np.flatnonzero(step.ended).tolist()
    assert step.endings.truncated.any()
    assert step.endings.observations.shape == (
        step.ended.sum(),
        step.observations.shape[1],
    )
    assert not step.endings.get_flag("is_success").any()
