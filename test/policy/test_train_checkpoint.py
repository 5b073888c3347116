from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.train.checkpoint import restore, snapshot

MODEL = direct_model(odometry=(0.02, 0.02), latency=0.05)


def vector(count=5, **arguments):
    return BridgeVectorEnv(
        count, MODEL, field(count=4), max_episode_steps=12, **arguments
    )


def actions(count, steps):
    return (
        np.random.default_rng(1)
        .uniform(-1.0, 1.0, (steps, count, 3))
        .astype(np.float32)
    )


@pytest.mark.parametrize(
    "arguments", [{}, {"autoreset_mode": "SameStep"}, {"randomisation": "strong"}]
)
def test_an_env_that_is_given_the_state_of_another_goes_on_with_the_same_bits(
    arguments,
):
    one = vector(**arguments)
    other = vector(**arguments)
    one.reset(seed=3)
    for chosen in actions(5, 30):
        one.step(chosen)
    kept = snapshot(one)
    restore(other, kept)
    for chosen in actions(5, 40):
        mine = one.step(chosen)
        theirs = other.step(chosen)
        for a, b in zip(mine[:4], theirs[:4], strict=True):
            assert np.array_equal(a, b)


def test_the_state_of_another_env_is_refused():
    one = vector(5)
    other = vector(6)
    one.reset(seed=0)
    with pytest.raises(
        ConfigError, match=r"of shape .5,.*, but this env's is .* of shape .6,"
    ):
        restore(other, snapshot(one))
