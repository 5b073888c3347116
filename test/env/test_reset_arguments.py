from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError

ENVS = {
    "single": BridgeEnv,
    "vector": partial(BridgeVectorEnv, 3),
    "agents": BridgeParallelEnv,
}


@cache
def made(kind, number=0):
    return ENVS[kind](model=direct_model(), world=field())


@pytest.mark.parametrize("kind", sorted(ENVS))
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"seed": 2**63}, "^seed 9223372036854775808: must be a whole number"),
        ({"seed": 2**200}, "^seed 16069\\d*\\.\\.\\.\\d*: must be a whole number"),
        ({"seed": 10**6000}, "^seed of very many digits: must be a whole number"),
        ({"seed": -1}, "^seed -1: must be a whole number"),
        ({"seed": "three"}, "^seed 'three': must be a whole number"),
        ({"seed": 3.0}, "^seed 3.0: must be a whole number"),
        ({"options": [1]}, "^reset options of type list: must be a dict"),
        ({"options": "start"}, "^reset options of type str: must be a dict"),
        (
            {"options": {"gaol": (1.0, 1.0)}},
            "^unknown reset option 'gaol'; did you mean 'goal'?",
        ),
        ({"options": {3: 1}}, "^unknown reset option 3; "),
    ],
)
def test_what_a_reset_cant_use_is_one_sentence_and_the_next_reset_works(
    kind, arguments, sentence
):
    env = made(kind)
    with pytest.raises(ConfigError, match=sentence.replace("?", r"\?")):
        env.reset(**arguments)
    first = env.reset(seed=3)[0]
    again = made(kind, number=1).reset(seed=3)[0]
    np.testing.assert_equal(first, again)


def test_the_greatest_seed_works():
    assert made("single").reset(seed=2**63 - 1)[0].dtype == np.float32
    assert made("vector").reset(seed=2**63 - 3)[0].shape[0] == 3


def test_the_last_world_counts_on_from_the_seed_of_the_first():
    with pytest.raises(
        ConfigError, match=f"must be a whole number from 0 to {2**63 - 3}"
    ):
        made("vector").reset(seed=2**63 - 2)


def test_reset_mask_is_an_option_of_the_vector_env_alone():
    with pytest.raises(ConfigError, match="unknown reset option 'reset_mask'"):
        made("single").reset(options={"reset_mask": np.array([True])})


@pytest.mark.parametrize(
    "goal",
    [
        5.0,
        (1.0,),
        [[1.0], [1.0, 2.0]],
        None,
        object(),
        "12",
        (1j, 2.0),
        np.ones((1, 1, 1)),
    ],
)
def test_an_option_of_another_shape_is_refused_rather_than_spread(goal):
    with pytest.raises(
        ConfigError, match=r"reset option 'goal'.*must be numbers of shape"
    ):
        made("single").reset(options={"goal": goal})


@pytest.mark.parametrize(
    "command", [lambda c: c[..., :1], lambda c: c * np.nan, lambda c: c[0]]
)
def test_a_task_whose_command_no_robot_can_be_told_is_named(command):
    class Senseless(Navigation):
        def command(self, action):
            return command(super().command(action))

    env = BridgeEnv(model=direct_model(), world=field(), task=Senseless)
    env.reset(seed=0)
    with pytest.raises(
        ConfigError,
        match=r"its command must be finite, of shape \(1, 1, 3",
    ):
        env.step(np.ones(3, np.float32))
