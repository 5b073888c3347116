from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from robots import direct_model, field
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from nics_drl_bridge.env.registry import ENVIRONMENTS
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv

LIMIT = 30


def vector(count=4, **arguments):
    return BridgeVectorEnv(
        count,
        direct_model(odometry=(0.02, 0.02)),
        field(count=3),
        max_episode_steps=LIMIT,
        **{"autoreset_mode": "SameStep"} | arguments,
    )


@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_stable_baselines3s_checker_finds_nothing_to_warn_of(name, actions):
    options = {"actions": actions}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(
            name, model=direct_model(), world=field(), task_options=options
        )
        check_env(env)
        check_env(env.unwrapped)


def test_it_feeds_what_a_vec_env_of_single_envs_feeds():
    def alone():
        return gymnasium.make(
            "NicsBridge/Navigation-v0",
            max_episode_steps=LIMIT,
            model=direct_model(odometry=(0.02, 0.02)),
            world=field(count=3),
        )

    ours = TrainVecEnv(vector(2))
    theirs = DummyVecEnv([alone, alone])
    ours.seed(3)
    theirs.seed(3)
    assert np.array_equal(ours.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(100):
        actions = rng.uniform(-1.0, 1.0, (2, 3)).astype(np.float32)
        one = ours.step(actions)
        another = theirs.step(actions)
        for a, b in zip(one[:3], another[:3], strict=True):
            assert a.dtype == b.dtype
            assert np.array_equal(a, b)
        for n in np.flatnonzero(one[2]):
            ended += 1
            mine = one[3][n]
            other = another[3][n]
            assert np.array_equal(
                mine["terminal_observation"], other["terminal_observation"]
            )
            for key in ("TimeLimit.truncated", "is_success", "collision"):
                assert mine[key] == other[key]
        assert all(one[3][n] == {} for n in np.flatnonzero(~one[2]))
    assert ended > 4


def test_an_env_that_it_can_not_feed_from_is_refused():
    for arguments in ({"autoreset_mode": "NextStep"}, {"copy": False}):
        with pytest.raises(ConfigError, match="autoreset_mode='SameStep', copy=True"):
            TrainVecEnv(vector(**arguments))


def test_pictures_of_all_worlds_are_tiled():
    picture = TrainVecEnv(vector(render_mode="rgb_array"))
    picture.reset()
    assert picture.render().shape == (1000, 1000, 3)
