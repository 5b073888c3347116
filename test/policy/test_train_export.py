from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from robots import field
from stable_baselines3 import PPO, SAC

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.policy.train.export import export_policy
from nics_drl_bridge.policy.train.networks import Actor, Network, count_weights
from nics_drl_bridge.policy.train.normaliser import Normaliser
from policy.policy_rig import (
    SECTORS,
    export,
    export_remembering,
    model_of,
    network,
    sequence,
)


@pytest.fixture
def env(request):
    options = {"scan": SECTORS, "actions": request.param}
    return BridgeEnv(model=model_of(), world=field(), task_options=options)


def observations(env, count=50):
    space = env.task.observation_space
    rng = np.random.default_rng(5)
    return rng.uniform(
        np.maximum(space.low, -4), np.minimum(space.high, 4), (count, *space.shape)
    )


def make_algorithm(name, env):
    """An untrained algorithm whose actions differ, some of them beyond the limits."""
    if name == "sac":
        return SAC("MlpPolicy", env, seed=0, buffer_size=10, device="cpu")
    if name == "ppo":
        made = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
        last = made.policy.action_net
    else:
        size = env.observation_space.shape[0]
        scale = np.linspace(-1.0, 1.0, size), np.linspace(0.1, 2.0, size)
        if name == "lean":
            return make_actor(env, scale)
        torch.manual_seed(0)
        return network(size, gymnasium.spaces.flatdim(env.action_space))
    with torch.no_grad():
        last.weight.mul_(500.0)
    return made


def make_actor(env, scale):
    widths = (len(scale[0]), 16, 8, gymnasium.spaces.flatdim(env.action_space))
    rng = np.random.default_rng(0)
    weights = rng.normal(0.0, 0.5, count_weights(widths)).astype(np.float32)
    normaliser = Normaliser.of(env.observation_space, *scale)
    return Actor(normaliser, Network(weights, widths), env.task.actions == "discrete")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "name"),
    [
        ("continuous", "ppo"),
        ("discrete", "ppo"),
        ("continuous", "sac"),
        ("continuous", "torch"),
        ("discrete", "torch"),
        ("continuous", "lean"),
        ("discrete", "lean"),
    ],
    indirect=["env"],
)
def test_the_file_of_an_algorithm_acts_as_it_predicts(env, tmp_path, name):
    algorithm = make_algorithm(name, env)
    policy = export_policy(algorithm, env.task, env.model, tmp_path / "policy.onnx")
    rows = observations(env).astype(np.float32)
    if name == "lean":
        wanted = algorithm.act(rows)
    elif name == "torch":
        raw = algorithm(torch.as_tensor(rows)).detach().numpy()
        wanted = raw.argmax(axis=1) if env.task.actions == "discrete" else raw
    else:
        wanted, _ = algorithm.predict(rows, deterministic=True)
    if env.task.actions == "continuous":
        wanted = np.clip(wanted, -1.0, 1.0)
    assert policy.act(rows) == pytest.approx(wanted, abs=1e-5)
    assert policy.command(rows) == pytest.approx(env.task.command(wanted), abs=1e-5)
    assert len(np.unique(np.round(policy.act(rows), 2))) > 1 + (
        name not in ("lean", "torch")
    )


def test_the_normaliser_is_inside_the_graph(tmp_path):
    rng = np.random.default_rng(6)
    mean = rng.normal(size=SECTORS + 6)
    std = rng.uniform(0.5, 2.0, SECTORS + 6)
    policy, _ = export(tmp_path / "one.onnx", normaliser=(mean, std, 1.5))
    seen = rng.normal(size=(7, SECTORS + 6)).astype(np.float32)
    cut = np.clip((seen - mean) / std, -1.5, 1.5).astype(np.float32)
    with torch.no_grad():
        raw = network(SECTORS + 6, 3)(torch.as_tensor(cut)).numpy()
    assert policy.act(seen) == pytest.approx(np.clip(raw, -1.0, 1.0), abs=1e-5)


def test_what_is_no_policy_cannot_be_exported(tmp_path):
    model = model_of()
    task = make_task("navigation", model)
    with pytest.raises(ConfigError, match="can't be exported"):
        export_policy("PPO", task, model, tmp_path / "one.onnx")
    with pytest.raises(ConfigError, match=r"ends with .\.onnx"):
        export_policy(network(78, 3), task, model, tmp_path / "one.zip")
    path = tmp_path / "one.onnx"
    with pytest.raises(ConfigError, match=r"'provenance'.*finite numbers"):
        export_policy(network(78, 3), task, model, path, None, {"success": np.nan})


def test_a_network_with_nan_weights_is_not_written(tmp_path):
    model = model_of()
    task = make_task("navigation", model, {"scan": SECTORS})
    broken = network(SECTORS + 6, 3)
    with torch.no_grad():
        broken[0].weight[0, 0] = np.nan
    with pytest.raises(PolicyError, match=r"golden|weights"):
        export_policy(broken, task, model, tmp_path / "one.onnx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_a_file_with_a_state_acts_as_the_module_step_by_step(tmp_path, actions):
    policy, task, module = export_remembering(tmp_path / "one.onnx", actions=actions)
    kept = policy.contract.state
    assert (kept.size, kept.start) == (module.state_size, module.state_start)
    ours = np.full((4, kept.size), kept.start, np.float32)
    theirs = torch.from_numpy(ours)
    for seen in sequence(task, 8, 4):
        before = ours
        action, command, ours = policy.run(seen, ours)
        with torch.no_grad():
            raw, theirs = module(torch.from_numpy(seen), theirs)
        wanted = raw.argmax(dim=1) if actions == "discrete" else raw.clamp(-1.0, 1.0)
        assert ours == pytest.approx(theirs.numpy(), abs=1e-5)
        assert command == pytest.approx(task.command(wanted.numpy()), abs=1e-5)
        assert command == pytest.approx(task.command(action), abs=1e-5)
    assert np.abs(ours - before).max() > 0.01
    alone, _, _ = policy.run(seen[1], before[1])
    assert alone == pytest.approx(action[1], abs=1e-6)
