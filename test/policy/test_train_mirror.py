"""To transitions come their mirror images, each as a whole, and as the policy would do it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from robots import direct_model, field

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.train_mirror import Reflection
from nics_drl_bridge.policy.train_ppo import LeanPpo, Transitions
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import TrainingSettings

STEPS = 12
WORLDS = 6
MODEL = direct_model()
STACK = {"kind": "stack", "scans": 3, "every": 2}


def engine(mirror=True, actions="continuous", memory=None):
    """The lean engine, begun; with layers that are far from nothing."""
    options = {"actions": actions}
    vector = BridgeVectorEnv(
        WORLDS, MODEL, field(count=2), "navigation", options, 5, "SameStep"
    )
    env = TrainVecEnv(vector)
    env.seed(3)
    ppo = {"rollout": STEPS, "batch": 24, "mirror": mirror}
    settings = TrainingSettings.model_validate(
        {"hidden": [16, 8], "ppo": ppo, "memory": memory}
    )
    size = env.observation_space.shape[0]
    rng = np.random.default_rng(0)
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
def test_each_transition_is_followed_by_its_mirror_image(actions, memory):
    lean, mirror = engine(True, actions, memory)
    plain, _ = engine(False, actions, memory)
    plain.collector.networks.load_state_dict(lean.networks.state_dict())
    both, driven = (
        one.learner.judge(one.collector.collect()[0]) for one in (lean, plain)
    )
    reflection = Reflection(mirror, lean.networks.actor.memory.extra, 72)
    count = STEPS * WORLDS
    for one, other in zip(both[:5], driven[:5], strict=True):
        assert len(one) == 2 * count
        assert torch.equal(one[:count], other)
    assert torch.equal(both.seen[count:], reflection.seen(driven.seen))
    assert not torch.equal(both.seen[count:], driven.seen)
    assert torch.equal(both.actions[count:], reflection.actions(driven.actions)[0])
    assert torch.equal(both.advantages[count:], driven.advantages)
    assert torch.equal(both.returns[count:], driven.returns)
    assert torch.equal(both.log_probs[count:], driven.log_probs)


def test_mirror_images_do_not_count_as_steps():
    lean, _ = engine()
    lean._advance(lean.collector.collect()[0], Watched())
    assert lean.steps == STEPS * WORLDS


class Watched:
    """As much of a watch as a rollout needs."""

    collisions: ClassVar[list[bool]] = []


def test_normalised_observations_mirror_as_the_observations_do():
    lean, mirror = engine()
    see = lean.networks.actor.normaliser
    seen = torch.rand(50, len(mirror.places)) * 2.0
    mirrored = seen[:, torch.from_numpy(mirror.places)] * torch.from_numpy(
        np.float32(mirror.signs)
    )
    reflection = Reflection(mirror, 0, 72)
    assert torch.allclose(see(mirrored), reflection.seen(see(seen)), atol=1e-6)


def test_a_balanced_normaliser_has_mean_and_deviation_of_both_kinds_of_observations():
    _, mirror = engine()
    rows = (
        np.random.default_rng(0).normal(size=(2000, len(mirror.places)))
        + mirror.places % 5
    )
    both = np.concatenate([rows, rows[:, mirror.places] * mirror.signs])
    mean, std = Reflection(mirror, 0, 72).balanced(rows.mean(axis=0), rows.std(axis=0))
    np.testing.assert_allclose(mean, both.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(std, both.std(axis=0), rtol=1e-12)


def test_what_the_mirror_image_can_not_do_is_not_learnt():
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
    rows = [torch.rand(4, 78), actions, *torch.rand(3, 4)]
    both = Reflection(mirror, 0, 72).doubled(Transitions(*rows))
    assert both.actions[4:, 2].tolist() == pytest.approx(
        [-0.1, -0.6]
    )  # 0.8 and -0.2 rad/s
    assert len(both.seen) == len(both.returns) == 6


def test_an_action_is_as_dense_as_limits_that_differ_stretch_it():
    _, mirror = engine()
    stretched = replace(mirror, scale=np.array([1.0, -2.0, -1.0]))
    rows = [torch.rand(3, 78), torch.zeros(3, 3), *torch.rand(3, 3)]
    both = Reflection(stretched, 0, 72).doubled(Transitions(*rows))
    assert torch.allclose(both.log_probs[3:], both.log_probs[:3] - math.log(2.0))
