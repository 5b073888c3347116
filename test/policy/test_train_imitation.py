"""A training that begins with what a planner does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from robots import direct_model, field

from nics_drl_bridge.config import validate
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy import train_imitation
from nics_drl_bridge.policy.train_imitation import Shown, drive, expert_of, imitate
from nics_drl_bridge.policy.train_ppo import LeanPpo
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import TrainingSettings

WORLDS = 6
LIMIT = 5
IMITATION = {"expert": "straight", "steps": 120, "epochs": 300}


def settings(**changes):
    ppo = {"rollout": 12, "batch": 72, "epochs": 1}
    given = {
        "hidden": [32],
        "ppo": ppo,
        "worlds": {"empty": WORLDS},
        "imitation": IMITATION,
    }
    return validate(given | changes, TrainingSettings, "settings")


def worlds(actions="continuous"):
    options = {"actions": actions}
    env = BridgeVectorEnv(
        WORLDS, direct_model(), field(count=2), "navigation", options, LIMIT, "SameStep"
    )
    fed = TrainVecEnv(env)
    fed.seed(3)
    return fed


def training(env, seed=0, **changes):
    size = env.observation_space.shape[0]
    return LeanPpo(settings(**changes), env, seed, (np.full(size, 0.5), np.ones(size)))


def begun(seed=0):
    made = training(worlds(), seed)
    made.collector.last = made.collector.env.reset()
    made._imitate()
    return made


def test_the_actor_comes_to_do_what_the_expert_does_and_its_steps_count():
    env = worlds()
    made = begun()
    seen = env.reset()
    expert = expert_of(settings(), env)
    with torch.no_grad():
        mine = made.policy.best(torch.from_numpy(seen)).numpy()
        fresh = training(worlds()).policy.best(torch.from_numpy(seen)).numpy()
    wanted = expert.act(seen)
    assert np.abs(mine - wanted).mean() < 0.5 * np.abs(fresh - wanted).mean()
    assert made.steps == 120


def test_what_drives_next_has_the_weights_that_were_fitted_and_the_same_seed_gives_the_same():
    made = begun()
    again = begun()
    other = begun(1)
    ours = made.networks.state_dict()
    driving = made.collector.networks.state_dict()
    assert all(torch.equal(driving[name], each) for name, each in ours.items())
    assert all(
        torch.equal(again.networks.state_dict()[name], each)
        for name, each in ours.items()
    )
    first = "actor.layers.0.weight"
    assert not torch.equal(other.networks.state_dict()[first], ours[first])


def test_returns_are_discounted_to_the_end_of_an_episode_and_unknown_without_one():
    env = worlds()
    rng = np.random.default_rng(0)
    first = env.reset()
    shown, last = drive(env, expert_of(settings(), env), first, 2 * LIMIT - 1, 0.5, rng)
    returns = shown.returns.reshape(-1, WORLDS)
    assert last.shape == first.shape
    assert torch.equal(shown.seen[:WORLDS], torch.from_numpy(first))
    assert not returns[0].isnan().any()  # no episode is longer
    assert returns.isnan().any()
    again = worlds()
    seen = again.reset()
    noise = np.random.default_rng(0)
    total = np.zeros(WORLDS)
    going = np.ones(WORLDS)
    for t in range(LIMIT):
        action = expert_of(settings(), again).act(seen)
        moved = action + noise.normal(
            0.0, train_imitation.DISTURBANCE, action.shape
        ).astype(np.float32)
        seen, reward, done, _ = again.step(np.clip(moved, -1.0, 1.0))
        total += going * 0.5**t * reward
        going *= ~done
    assert returns[0].numpy() == pytest.approx(total, abs=1e-5)


def test_the_spread_of_actions_is_that_of_the_fit_but_not_too_little():
    made = training(worlds())
    seen = torch.rand(200, made.policy.normaliser.features_dim)
    noise = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    shown = Shown(seen, noise * torch.tensor([0.0, 1.0, 1.0]), torch.zeros(200))
    imitate(made.networks, shown, 1, torch.Generator().manual_seed(0))
    small, large, _ = made.networks.log_std.exp().tolist()
    assert small == pytest.approx(train_imitation.LEAST_STD)
    assert large == pytest.approx(1.0, abs=0.2)


def test_an_expert_is_refused_for_discrete_actions_and_by_an_unknown_name():
    with pytest.raises(
        ConfigError, match="experts drive continuous 'navigation' alone"
    ):
        expert_of(settings(), worlds("discrete"))
    with pytest.raises(ConfigError, match="did you mean 'mppi'"):
        expert_of(settings(imitation=IMITATION | {"expert": "mpi"}), worlds())


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"ppo": {"engine": "sb3"}}, "imitation needs the lean engine of ppo"),
        ({"algorithm": "sac"}, "imitation needs the lean engine of ppo"),
        ({"steps": 100}, "imitation.steps must be from 6, one in each world"),
        ({"imitation": IMITATION | {"steps": 5}}, "imitation.steps must be from 6"),
    ],
)
def test_settings_that_can_not_imitate_are_refused(changes, sentence):
    with pytest.raises(ConfigError, match=sentence):
        settings(**changes)
