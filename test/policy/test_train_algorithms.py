from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from robots import direct_model

from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.train.algorithms import Actor, Normaliser, make_act
from nics_drl_bridge.policy.train.export import export_policy

MODEL = direct_model()


@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_a_policy_file_made_of_an_actor_does_what_the_actor_does(actions, tmp_path):
    task = make_task("navigation", MODEL, {"actions": actions})
    size = task.observation_space.shape[0]
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    normaliser = rng.uniform(-1.0, 1.0, size), rng.uniform(0.1, 2.0, size)
    actor = Actor(task.observation_space, task.action_space, [16, 8], normaliser)
    torch.nn.init.normal_(
        actor.layers[-1].weight
    )  # at the start all actions are near zero
    export_policy(actor, task, MODEL, tmp_path / "policy.onnx")
    seen = rng.uniform(-1.0, 1.0, (50, size)).astype(np.float32)
    wanted = make_act(actor)(seen)
    if actions == "continuous":
        wanted = np.clip(wanted, -1.0, 1.0)
    else:
        assert len(set(wanted.tolist())) > 1
    deployed = load_policy(tmp_path / "policy.onnx").act(seen)
    np.testing.assert_allclose(deployed, wanted, atol=1e-5)


def test_a_normaliser_bends_what_lies_between_0_and_1_and_cuts_what_is_far_off():
    space = gymnasium.spaces.Box(
        np.zeros(2, np.float32), np.array([1.0, 9.0], np.float32)
    )
    see = Normaliser(space, np.array([0.5, 3.0]), np.array([0.25, 0.5]))
    seen = see(torch.tensor([[0.1, 4.0], [0.0, 9.0], [1.0, -9.0]]))
    torch.testing.assert_close(
        seen, torch.tensor([[0.2, 2.0], [-2.0, 5.0], [2.0, -5.0]])
    )
