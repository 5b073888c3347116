"""Half of the transitions are mirrored, each as a whole, and as the policy would have done it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from robots import direct_model, field

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.train_mirror import Reflection
from nics_drl_bridge.policy.train_ppo import LeanPpo
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import TrainingSettings

STEPS, WORLDS = 12, 6
MODEL = direct_model()
STACK = {"kind": "stack", "scans": 3, "every": 2}


def engine(mirror=True, actions="continuous", memory=None):
    """The lean engine, begun; with layers that are far from nothing."""
    options = {"actions": actions}
    vector = BridgeVectorEnv(WORLDS, MODEL, field(count=2), "navigation", options, 5, "SameStep")
    env = TrainVecEnv(vector)
    env.seed(3)
    ppo = {"rollout": STEPS, "batch": 24, "mirror": mirror}
    settings = TrainingSettings.model_validate({"hidden": [16, 8], "ppo": ppo, "memory": memory})
    size, rng = env.observation_space.shape[0], np.random.default_rng(0)
    normaliser = rng.uniform(0.0, 0.5, size), rng.uniform(0.2, 1.0, size)
    lean = LeanPpo(settings, env, 0, normaliser)
    torch.manual_seed(5)
    for part in (lean.networks, lean.collector.networks):
        torch.nn.init.normal_(part.actor.layers[-1].weight, std=0.3)
    lean.collector.networks.load_state_dict(lean.networks.state_dict())
    lean.collector.last = env.reset()
    return lean, vector.task.mirror()


@pytest.mark.parametrize("actions", ["continuous", "discrete"])
@pytest.mark.parametrize("memory", [None, STACK])
def test_about_half_of_the_transitions_are_mirrored_and_the_others_are_as_they_were(
    actions, memory
):
    lean, mirror = engine(True, actions, memory)
    plain, _ = engine(False, actions, memory)
    plain.collector.networks.load_state_dict(lean.networks.state_dict())
    mirrored, driven = (one.collector.collect()[0] for one in (lean, plain))
    reflection = Reflection(mirror, lean.networks.actor.memory.extra, 72)
    other = reflection.seen(driven.seen)
    as_it_was = (mirrored.seen == driven.seen).all(1)
    assert torch.equal(mirrored.seen, torch.where(as_it_was[:, None], driven.seen, other))
    assert 20 < int(as_it_was.sum()) < 52
    acted, _ = reflection.actions(driven.actions)
    for k in range(STEPS * WORLDS):
        assert torch.equal(mirrored.actions[k], driven.actions[k] if as_it_was[k] else acted[k])
    assert torch.equal(mirrored.advantages, driven.advantages)
    assert torch.equal(mirrored.returns, driven.returns)
    networks = lean.collector.networks
    with torch.no_grad():
        raw = networks.actor.layers(mirrored.seen)
        expected = networks.log_probs(raw, mirrored.actions)
    assert torch.allclose(mirrored.log_probs, expected, atol=1e-5)


def test_normalised_observations_mirror_as_the_observations_do():
    lean, mirror = engine()
    see = lean.networks.actor.normaliser
    seen = torch.rand(50, len(mirror.places)) * 2.0
    mirrored = seen[:, torch.from_numpy(mirror.places)] * torch.from_numpy(np.float32(mirror.signs))
    reflection = Reflection(mirror, 0, 72)
    assert torch.allclose(see(mirrored), reflection.seen(see(seen)), atol=1e-6)


def test_a_balanced_normaliser_has_mean_and_deviation_of_both_kinds_of_observations():
    _, mirror = engine()
    rows = np.random.default_rng(0).normal(size=(2000, len(mirror.places))) + mirror.places % 5
    both = np.concatenate([rows, rows[:, mirror.places] * mirror.signs])
    mean, std = Reflection(mirror, 0, 72).balanced(rows.mean(axis=0), rows.std(axis=0))
    np.testing.assert_allclose(mean, both.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(std, both.std(axis=0), rtol=1e-12)


def test_what_the_mirror_image_can_not_do_is_not_mirrored():
    robot = MODEL.robot.model_dump(mode="json")
    robot["command"][2] |= {"min": -1.0, "max": 3.0}
    lopsided = type(MODEL.robot).model_validate(robot)
    _, mirror = engine()
    task = BridgeVectorEnv(1, MODEL, field()).task
    mirror = type(task)(lopsided, MODEL.lidar).mirror()
    turns = torch.tensor([-0.9, -0.4, 0.5, 1.4])  # -0.8, 0.2, 2.0 rad/s, and beyond 3
    actions = torch.stack([torch.tensor([0.0, 1.5, float(turn)]) for turn in turns])
    _, possible = Reflection(mirror, 0, 72).actions(actions)
    assert possible.tolist() == [True, True, False, False]
