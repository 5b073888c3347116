"""A training with `stop` ends by episodes that it never learnt from."""

from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.evaluation import FIRST_SEED
from nics_drl_bridge.policy.train import stop as train_stop
from nics_drl_bridge.policy.train.run import SEEDS
from nics_drl_bridge.policy.train.settings import StopSettings
from nics_drl_bridge.policy.train.stop import HELD_OUT_SEED, Stop

GIVEN = StopSettings(success=0.9, every=100, episodes=10)


@pytest.fixture
def told(monkeypatch):
    """The stop of two worlds, the success that is told of each in turn, and the seeds driven."""
    rates = []
    seeds = []

    class Told:
        def __init__(self, success):
            self.success = np.arange(10) < 10 * success

    def drive(env, act, chosen):
        seeds.append(list(chosen))
        return Told(rates.pop(0))

    monkeypatch.setattr(train_stop, "drive_worlds", drive)
    return Stop(GIVEN, {"one": None, "other": None}), rates, seeds


def test_it_ends_after_two_evaluations_in_a_row_with_the_target_in_every_world(told):
    stop, rates, _ = told
    for steps, given, over in [
        (100, (1.0, 0.8), False),
        (200, (0.9, 0.9), False),
        (300, (0.8, 1.0), False),
        (400, (0.9, 1.0), False),
        (500, (1.0, 1.0), True),
    ]:
        rates.extend(given)
        assert stop.judge(steps, None)
        assert stop.least == min(given)
        assert stop.over == over


def test_it_evaluates_once_in_each_interval(told):
    stop, rates, seeds = told
    rates.extend([0.0] * 4)
    assert [stop.judge(steps, None) for steps in (99, 130, 199, 250)] == [
        False,
        True,
        False,
        True,
    ]
    assert len(seeds) == 4


def test_each_evaluation_has_episodes_of_its_own_beyond_those_of_training_and_protocol(
    told,
):
    stop, rates, seeds = told
    rates.extend([0.0] * 4)
    stop.judge(100, None)
    stop.judge(200, None)
    assert seeds[0] == seeds[1]  # the same ones in both worlds
    assert not set(seeds[0]) & set(seeds[2])
    assert min(seeds[0]) >= HELD_OUT_SEED > SEEDS + 1_000_000 > FIRST_SEED + 1_000_000


def test_episodes_are_driven_with_the_policy_that_is_given():
    world = field(6.0, starts={"at": [[0.0, 0.0, 0.0]]}, goals={"at": [[2.0, 0.0]]})
    env = BridgeVectorEnv(10, direct_model(), world, max_episode_steps=60)
    ahead, still = (np.tile(np.float32([x, 0.0, 0.0]), (10, 1)) for x in (1.0, 0.0))
    stop = Stop(GIVEN, {"one": env})
    stop.judge(100, lambda _: still)
    assert stop.least == 0.0
    stop.judge(200, lambda _: ahead)
    assert stop.least == 1.0
