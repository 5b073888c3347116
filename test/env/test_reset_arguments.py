from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError


def single():
    return BridgeEnv(model=direct_model(), world=field())


def vector(count=3):
    return BridgeVectorEnv(count, model=direct_model(), world=field())


def agents():
    return BridgeParallelEnv(model=direct_model(), world=field())


ENVS = {"single": single, "vector": vector, "agents": agents}


@pytest.mark.parametrize("kind", sorted(ENVS))
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"seed": 2**63}, "^seed 9223372036854775808: must be at most"),
        ({"seed": 2**200}, "^seed of 201 bits: must be at most"),
        ({"seed": 10**6000}, "^seed of 19932 bits: must be at most"),
        ({"seed": "three"}, "^seed of type str: must be an integer, or None"),
        ({"seed": 3.0}, "^seed of type float: must be an integer, or None"),
        ({"options": [1]}, "^reset options of type list: must be a dict"),
        ({"options": "start"}, "^reset options of type str: must be a dict"),
        ({"options": {"gaol": (1.0, 1.0)}}, "^unknown reset option 'gaol'; did you mean 'goal'?"),
        ({"options": {3: 1}}, "^unknown reset option 3; "),
    ],
)
def test_what_a_reset_cant_use_is_one_sentence_and_the_next_reset_works(kind, arguments, sentence):
    env = ENVS[kind]()
    with pytest.raises(ConfigError, match=sentence.replace("?", r"\?")):
        env.reset(**arguments)
    first = env.reset(seed=3)[0]
    again = ENVS[kind]().reset(seed=3)[0]
    np.testing.assert_equal(first, again)


@pytest.mark.parametrize("kind", sorted(ENVS))
def test_a_negative_seed_is_one_sentence(kind):
    with pytest.raises(gymnasium.error.Error, match="must be greater or equal to zero"):
        ENVS[kind]().reset(seed=-1)


def test_the_greatest_seed_works():
    assert single().reset(seed=2**63 - 1)[0].dtype == np.float32
    assert vector(3).reset(seed=2**63 - 3)[0].shape[0] == 3


def test_the_last_world_counts_on_from_the_seed_of_the_first():
    with pytest.raises(ConfigError, match=r"must be at most 2\*\*63 - 3\.$"):
        vector(3).reset(seed=2**63 - 2)


@pytest.mark.parametrize("bad", [2**63, "x", 1.5])
def test_a_list_of_seeds_is_checked_one_by_one(bad):
    with pytest.raises(ConfigError, match=r"^seed "):
        vector(3).reset(seed=[1, bad, None])


def test_reset_mask_is_an_option_of_the_vector_env_alone():
    with pytest.raises(ConfigError, match="unknown reset option 'reset_mask'"):
        single().reset(options={"reset_mask": np.array([True])})
