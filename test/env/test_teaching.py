from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model, field, lidar

from nics_drl_bridge.env.teaching import Teaching
from nics_drl_bridge.env.vector_env import BridgeVectorEnv

BLIND_BEHIND = lidar(beams=37, angle_min=-np.pi / 2.0, angle_max=np.pi / 2.0)
BACK = np.array([[-1.0, 0.0, 0.0]], np.float32)


def env_of(teaching, mode="NextStep", steps=100, **changes):
    """A robot that sees nothing behind, in the middle of a field."""
    places = {"starts": {"at": [[0.0, 0.0, 0.0]]}, "goals": {"at": [[2.0, 0.5]]}}
    world = field(6.0, **(places | changes))
    env = BridgeVectorEnv(
        1,
        direct_model(sensor=BLIND_BEHIND),
        world,
        max_episode_steps=steps,
        autoreset_mode=mode,
    )
    if teaching is not None:
        env.teach(teaching)
    return env


def drive(env, action, steps=80):
    """The outcome of each step until the episode ends."""
    env.reset(seed=0)
    for _ in range(steps):
        _, reward, terminated, _, info = env.step(action)
        yield float(reward[0]), bool(terminated[0]), info
        if terminated[0]:
            return


def test_a_contact_behind_ends_an_episode_with_its_reward_once():
    *before, last = drive(env_of(Teaching(contact=-7.0)), BACK)
    assert last[1]
    assert bool(last[2]["collision"][0])
    assert last[2]["reward_terms"]["contact"][0] == -7.0
    assert all(info["reward_terms"]["contact"][0] == 0.0 for *_, info in before)


def test_the_reward_of_the_path_adds_up_to_its_length():
    env = env_of(Teaching(path=2.0))
    terms = [
        info["reward_terms"]["path"][0]
        for *_, info in drive(env, np.array([[0.5, 0.0, 0.0]], np.float32), 10)
    ]
    moved = env.simulator.data.pose[0, 0, :2]
    straight = np.hypot(2.0, 0.5) - np.hypot(*(moved - [2.0, 0.5]))
    assert sum(terms) == pytest.approx(2.0 * straight, rel=0.1)


def test_rewards_of_the_task_stay_as_they_are():
    plain, more = (
        [
            reward
            - sum(info["reward_terms"].get(n, [0.0])[0] for n in ("path", "contact"))
            for reward, _, info in drive(env_of(given), BACK, 10)
        ]
        for given in (None, Teaching(path=1.0, contact=-1.0))
    )
    np.testing.assert_allclose(plain, more, atol=1e-12)


def episodes(env, action, steps):
    """The seeds of the episodes of so many steps."""
    _, info = env.reset(seed=3)
    seeds = [int(info["episode_seed"][0])]
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(action)
        if (terminated | truncated)[0]:
            seeds.append(int(info["episode_seed"][0]))
    return seeds


def test_an_episode_that_failed_is_driven_again_so_often():
    env = env_of(Teaching(retries=2), "SameStep", steps=5)
    one, *rest = episodes(env, np.zeros((1, 3), np.float32), 20)
    assert [seed == one for seed in rest] == [True, True, False, False]


def test_an_episode_that_succeeded_is_not_driven_again():
    env = env_of(Teaching(retries=2), "SameStep", goals={"at": [[2.0, 0.0]]})
    seeds = episodes(env, np.array([[1.0, 0.0, 0.0]], np.float32), 60)
    assert len(seeds) > 2
    assert len(set(seeds)) == len(seeds)
