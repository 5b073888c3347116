"""Loss, gradients and rollouts of the lean engine are those of Stable-Baselines3's PPO."""

from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.train import learner as train_learner
from nics_drl_bridge.policy.train.kernels import Transitions
from nics_drl_bridge.policy.train.networks import Network
from nics_drl_bridge.policy.train.ppo import LeanPpo
from nics_drl_bridge.policy.train.settings import TrainingSettings
from nics_drl_bridge.policy.train.worlds import TrainingWorlds

torch = pytest.importorskip("torch", reason="needs the extra sb3")
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.callbacks import ConvertCallback  # noqa: E402
from stable_baselines3.common.logger import Logger  # noqa: E402

from nics_drl_bridge.extras.sb3.layers import NormaliserLayer  # noqa: E402
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv  # noqa: E402

# fewer steps in an episode than in a rollout
STEPS = 12
WORLDS = 6
LIMIT = 5
MODEL = direct_model()
WORLD = field(count=2)


def pair(actions="continuous", log_std=-0.5, clip=0.2, entropy=0.01):
    """The lean engine and Stable-Baselines3's PPO with the same weights, in worlds alike."""
    envs = []
    for _ in range(2):
        vector = BridgeVectorEnv(
            WORLDS, MODEL, WORLD, "navigation", {"actions": actions}, LIMIT, "SameStep"
        )
        envs.append(TrainingWorlds(vector))
        envs[-1].seed(3)
    batch = STEPS * WORLDS
    ppo = {
        "rollout": STEPS,
        "batch": batch,
        "epochs": 1,
        "clip": clip,
        "entropy": entropy,
    }
    ppo["log_std"] = log_std
    settings = TrainingSettings.model_validate({"hidden": [16, 8], "ppo": ppo})
    size = envs[0].observation_space.shape[0]
    rng = np.random.default_rng(0)
    normaliser = rng.uniform(0.0, 0.5, size), rng.uniform(0.2, 1.0, size)
    lean = LeanPpo(settings, envs[0], 0, normaliser)
    network = {
        "net_arch": [16, 8],
        "activation_fn": torch.nn.ReLU,
        "log_std_init": log_std,
        "features_extractor_class": NormaliserLayer,
        "features_extractor_kwargs": {"mean": normaliser[0], "std": normaliser[1]},
    }
    theirs = PPO(
        "MlpPolicy",
        TrainVecEnv(worlds=envs[1]),
        n_steps=STEPS,
        batch_size=batch,
        n_epochs=1,
        gamma=0.98,
        gae_lambda=0.95,
        clip_range=clip,
        ent_coef=entropy,
        policy_kwargs=network,
        device="cpu",
    )
    theirs.set_logger(Logger(None, []))
    envs[1].seed(3)
    lean.networks.weights[:] = rng.normal(0.0, 0.3, lean.networks.weights.shape)
    lean.networks.log_std[:] = log_std
    for ours, other in zip(weights_of(lean), their_weights(theirs), strict=True):
        other.data.copy_(torch.as_tensor(ours))
    return lean, theirs


def weights_of(lean):
    networks = lean.networks
    layers = [*networks.actor.layers, *networks.critic.layers]
    return [part for layer in layers for part in layer]


def gradients_of(lean):
    """The gradients of `weights_of`, and that of the log deviation."""
    parts = lean.networks.split(lean.learner.optimiser.gradients)
    networks = lean.networks
    layers = []
    for vector, network in (
        (parts.actor, networks.actor),
        (parts.critic, networks.critic),
    ):
        layers += Network(vector, network.widths).layers
    return [part.copy() for layer in layers for part in layer], parts.log_std.copy()


def their_weights(ppo):
    policy = ppo.policy
    actor = [
        *policy.mlp_extractor.policy_net.parameters(),
        *policy.action_net.parameters(),
    ]
    critic = [
        *policy.mlp_extractor.value_net.parameters(),
        *policy.value_net.parameters(),
    ]
    return actor + critic


def filled(lean, theirs, seed=2):
    """One batch of both, in the same order; the actions were drawn with somewhat other weights."""
    rng = np.random.default_rng(seed)
    rows = STEPS * WORLDS
    seen = rng.uniform(-1.0, 1.0, (rows, *theirs.observation_space.shape)).astype(
        np.float32
    )
    normalised = lean.algorithm.normaliser(seen)
    raw = lean.networks.actor(normalised)
    actions = lean.networks.draw(raw, rng)
    noise = rng.standard_normal((3, rows), np.float32)
    log_probs = (
        lean.networks.compute_log_probs(raw, actions) + np.float32(0.3) * noise[0]
    )
    gains, returns = noise[1:]
    buffer = theirs.rollout_buffer
    buffer.reset()
    shapes = {
        "observations": seen,
        "actions": actions,
        "log_probs": log_probs,
        "advantages": gains,
        "returns": returns,
        "values": np.zeros(rows),
    }
    for name, values in shapes.items():
        target = getattr(buffer, name)
        target[...] = np.asarray(values, np.float32).reshape(target.shape)
    buffer.full = True
    columns = actions.reshape(rows, -1).astype(np.float32)
    return Transitions(normalised, columns, log_probs, gains, returns)


@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_loss_and_gradients_are_those_of_stable_baselines3(actions):
    lean, theirs = pair(actions)
    batch = filled(lean, theirs)
    theirs.policy.optimizer.step = lambda: None
    theirs.train()
    logged = theirs.logger.name_to_value["train/loss"]
    assert lean.learner.compute_gradients(batch) == pytest.approx(logged, rel=1e-5)
    gradients, of_deviation = gradients_of(lean)
    norm = np.linalg.norm(lean.learner.optimiser.gradients)
    factor = min(1.0, theirs.max_grad_norm / norm)  # as they have clipped theirs
    for ours, other in zip(gradients, their_weights(theirs), strict=True):
        assert factor * ours == pytest.approx(other.grad.numpy(), abs=1e-6, rel=1e-4)
    if actions == "continuous":
        theirs_of_deviation = theirs.policy.log_std.grad.numpy()
        assert factor * of_deviation == pytest.approx(theirs_of_deviation, abs=1e-6)


def test_actor_and_critic_learn_at_once_while_a_core_is_free_to_the_same_bits(
    monkeypatch,
):
    lean, theirs = pair()
    batch = filled(lean, theirs)
    loss = lean.learner.compute_gradients(batch)
    gradients = lean.learner.optimiser.gradients
    wanted = gradients.copy()
    gradients[:] = 0.0
    jobs = []
    together = train_learner.run_parts
    monkeypatch.setattr(
        train_learner,
        "run_parts",
        lambda job, parts: jobs.append(len(parts)) or together(job, parts),
    )
    lean.learner.core_is_free.set()
    assert lean.learner.compute_gradients(batch) == loss
    assert jobs == [2]
    assert np.array_equal(gradients, wanted)


def test_a_batch_of_fewer_rows_than_the_one_before_has_gradients_of_its_own():
    lean, theirs = pair()
    batch = filled(lean, theirs)
    few = Transitions(*(each[:7] for each in batch))
    lean.learner.compute_gradients(few)
    gradients = lean.learner.optimiser.gradients
    wanted = gradients.copy()
    lean.learner.compute_gradients(batch)
    assert not np.array_equal(gradients, wanted)
    lean.learner.compute_gradients(few)
    assert np.array_equal(gradients, wanted)


def test_a_batch_of_one_transition_learns_from_its_own_advantage():
    lean, theirs = pair()
    one = Transitions(*(each[:1] for each in filled(lean, theirs)))
    assert np.isfinite(lean.learner.compute_gradients(one))
    gradients, _ = gradients_of(lean)
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    assert any(gradient.any() for gradient in gradients)


@pytest.mark.parametrize(
    ("kind", "change", "sentence"),
    [
        ("discrete", lambda actions: actions * 0 - 1, "index of an action is not from"),
        ("discrete", lambda actions: actions + 99, "index of an action is not from"),
        ("continuous", lambda actions: actions[..., :1], "the actions are of shape"),
    ],
)
def test_saved_actions_that_are_none_of_the_space_are_refused(kind, change, sentence):
    lean, _ = pair(kind)
    lean.collector.last_observations = lean.collector.worlds.reset()
    rollout, _ = lean.collector.collect()
    state = lean.state()
    state["rollout"] = rollout._asdict()
    lean.restore(state)
    changed = rollout._replace(actions=change(rollout.actions))
    state["rollout"] = changed._asdict()
    with pytest.raises(ValueError, match=sentence):
        lean.restore(state)


def test_a_rollout_is_that_of_stable_baselines3_over_ends_of_episodes_and_time_limits():
    lean, theirs = pair(
        log_std=-30.0
    )  # no noise to speak of, as both draw it differently
    _, callback = theirs._setup_learn(1, ConvertCallback(lambda *_: True))
    theirs.collect_rollouts(theirs.env, callback, theirs.rollout_buffer, STEPS)
    lean.collector.networks.weights[:] = lean.networks.weights
    lean.collector.last_observations = lean.collector.worlds.reset()
    driven, ended = lean.collector.collect()
    rollout = lean.learner.compute_transitions(driven)
    buffer = theirs.rollout_buffer
    assert len(ended) >= WORLDS
    for ours, other in [
        (rollout.actions, buffer.actions),
        (rollout.advantages, buffer.advantages),
        (rollout.returns, buffer.returns),
    ]:
        assert ours == pytest.approx(other.reshape(ours.shape), abs=1e-4)
