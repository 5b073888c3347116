"""Behaviour cloning: a training with PPO begins with what a planner does (Pomerleau 1991).

The expert drives the training's worlds, disturbed by noise, so that it shows how to return
(Laskey and others 2017); the actor learns its actions, the critic what they brought.
"""

from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.policy.stateful import Policy
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import TrainingSettings

DISTURBANCE = 0.2  # standard deviation of the noise on driven actions
# of the gradient steps
RATE = 1e-3
BATCH = 512
LEAST_STD = 0.2  # of the actions with which PPO goes on


class Shown(NamedTuple):
    """R steps of an expert."""

    seen: torch.Tensor  # (R, O) observations
    actions: torch.Tensor  # (R, C) of the expert
    returns: (
        torch.Tensor
    )  # (R,) discounted; NaN if the episode did not end in time to know


def expert_of(settings: TrainingSettings, env: TrainVecEnv) -> Policy:
    """Opens the expert of the settings. Raises ConfigError if the task does not suit it."""
    name = getattr(settings.imitation, "expert", "")
    task = env.envs[0].task
    box = isinstance(env.action_space, gymnasium.spaces.Box)
    if not isinstance(task, Navigation) or not box:
        fix = "leave imitation out."
        raise ConfigError(
            f"imitation: experts drive continuous 'navigation' alone; {fix}"
        )
    return make_policy(name, task, env.envs[0].model)


def drive(
    env: TrainVecEnv,
    expert: Policy,
    last: NDArray[np.float32],
    steps: int,
    discount: float,
    rng: np.random.Generator,
) -> tuple[Shown, NDArray[np.float32]]:
    """Drives all worlds for steps of each, from observations (N, O); returns the last ones, too."""
    seen = []
    actions = []
    rewards = []
    ended = []
    for _ in range(steps):
        wanted = expert.act(last)
        noise = rng.normal(0.0, DISTURBANCE, wanted.shape).astype(np.float32)
        seen.append(last)
        actions.append(wanted)
        last, reward, done, _ = env.step(np.clip(wanted + noise, -1.0, 1.0))
        rewards.append(reward)
        ended.append(done)
    after = np.full(len(last), np.nan, np.float32)
    returns = []
    for reward, done in zip(reversed(rewards), reversed(ended), strict=True):
        after = reward + discount * np.where(done, np.float32(0.0), after)
        returns.append(after)
    rows = (np.concatenate(each) for each in (seen, actions, returns[::-1]))
    return Shown(*(torch.from_numpy(each) for each in rows)), last


def imitate(
    networks: Any, shown: Shown, epochs: int, generator: torch.Generator
) -> float:
    """Fits actor, spread and critic of `train_ppo.Networks`; returns the actions' squared error."""
    optimiser = torch.optim.Adam(networks.parameters(), lr=RATE)
    actor = networks.actor
    for _ in range(epochs):
        for rows in torch.randperm(len(shown.seen), generator=generator).split(BATCH):
            seen, actions, returns = (each[rows] for each in shown)
            features = actor.normaliser(seen)
            known = ~returns.isnan()
            error = (actor.layers(features) - actions).square().mean()
            apart = networks.critic(features[known]).squeeze(-1) - returns[known]
            optimiser.zero_grad(set_to_none=False)
            (error + 0.5 * apart.square().sum() / len(rows)).backward()
            optimiser.step()
    with torch.no_grad():
        apart = actor(shown.seen) - shown.actions
        networks.log_std.copy_(apart.square().mean(0).sqrt().clamp_min(LEAST_STD).log())
    return float(apart.square().mean())
