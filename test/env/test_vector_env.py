from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils import env_checker as checking
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from robots import direct_model, field

from nics_drl_bridge.env import vector_env
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.registry import NAVIGATION
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.teaching import Teaching
from nics_drl_bridge.env.vector_env import BridgeVectorEnv

CHECKS = [
    getattr(checking, f"check_{name}")
    for name in (
        "seed_deprecation",
        "reset_return_info_deprecation",
        "reset_return_type",
        "reset_seed_determinism",
        "reset_options",
    )
    if hasattr(checking, f"check_{name}")  # Gymnasium 1.2 has not all of them
]
"""Those parts of Gymnasium's `check_env` that a vector env, which it refuses, can be given to."""
MODES = ("NextStep", "SameStep")
TASKS = (
    {"task": "navigation"},
    {"task": "navigation", "task_options": {"actions": "discrete"}},
    {"task": "cooperative_reaching"},
    {"task": "pursuit_evasion", "task_options": {"actions": "discrete"}},
    {"task": "navigation", "task_options": {"scan": 24}},
    {"task": "cooperative_reaching", "task_options": {"scan": "around"}},
)
LIMIT = 25


def model():
    return direct_model(odometry=(0.05, 0.05))


def vector(count, **arguments):
    return BridgeVectorEnv(
        count,
        **{"model": model(), "world": field(count=3), "max_episode_steps": LIMIT}
        | arguments,
    )


def single(**arguments):
    return TimeLimit(
        BridgeEnv(**{"model": model(), "world": field(count=3)} | arguments), LIMIT
    )


def actions_of(env, steps, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(steps)]


def assert_alike(ours, theirs, path="info"):
    """Both infos hold the same entries, arrays and types."""
    assert ours.keys() == theirs.keys(), path
    for name, value in theirs.items():
        mine = ours[name]
        here = f"{path}[{name!r}]"
        if isinstance(value, dict):
            assert_alike(mine, value, here)
        elif value.dtype == object:
            assert mine.dtype == object
            for a, b in zip(mine, value, strict=True):
                assert (a is None) == (b is None), here
                assert a is None or np.array_equal(a, b), here
        else:
            assert mine.dtype == value.dtype, here
            assert mine.shape == value.shape, here
            assert np.array_equal(mine, value), here


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "mode"),
    [*((task, MODES[0]) for task in TASKS), (TASKS[0], MODES[1]), (TASKS[3], MODES[1])],
)
def test_it_steps_as_gymnasiums_own_vector_env_of_single_envs(task, mode):
    ours = vector(3, threads=2, autoreset_mode=mode, **task)
    theirs = SyncVectorEnv([lambda: single(**task)] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    (mine, facts), (other, known) = ours.reset(seed=4), theirs.reset(seed=4)
    assert np.array_equal(mine, other)
    assert_alike(facts, known)
    ended = 0
    for action in actions_of(ours, 80):
        one = ours.step(action)
        another = theirs.step(action)
        for a, b in zip(one[:4], another[:4], strict=True):
            assert a.dtype == b.dtype
            assert np.array_equal(a, b)
        assert_alike(one[4], another[4])
        ended += int((one[2] | one[3]).sum())
    assert ended >= 9


def test_threads_change_no_bit_of_what_is_taught():
    envs = [vector(5, threads=n, autoreset_mode="SameStep") for n in (1, 2)]
    for env in envs:
        env.teach(Teaching(path=1.0, contact=-1.0, retries=1))
    one, other = (env.reset(seed=6) for env in envs)
    assert np.array_equal(one[0], other[0])
    for action in actions_of(envs[0], 30):
        one, other = (env.step(action) for env in envs)
        for a, b in zip(one[:4], other[:4], strict=True):
            assert np.array_equal(a, b)
        assert_alike(one[4], other[4])


def test_returned_arrays_are_the_callers_own_unless_it_wants_none():
    for copy in (True, False):
        env = vector(2, copy=copy)
        observation, info = env.reset(seed=0)
        kept = observation.copy()
        poses = info["pose"].copy()
        for action in actions_of(env, 5):
            env.step(action)
        assert np.array_equal(observation, kept) == copy
        assert np.array_equal(info["pose"], poses)


def test_a_mask_resets_some_worlds_only():
    env = vector(3)
    other = vector(3)
    (observation, _), _ = env.reset(seed=0), other.reset(seed=0)
    moves = actions_of(env, 3)
    for action in moves:
        moved = env.step(action)[0]
    mask = np.array([False, True, False])
    again, info = env.reset(seed=0, options={"reset_mask": mask})
    assert np.array_equal(again[1], observation[1])
    assert np.array_equal(again[::2], moved[::2])
    assert np.array_equal(info["_episode_seed"], mask)


@pytest.mark.parametrize(
    ("name", "actions", "mode"),
    [
        (NAVIGATION, "continuous", MODES[0]),
        ("NicsBridge/PursuitEvasion-v0", "discrete", MODES[1]),
    ],
)
def test_gymnasiums_checks_of_an_env_find_nothing_to_warn_of_in_a_vector(
    name, actions, mode
):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make_vec(
            name,
            3,
            model=model(),
            world=field(),
            autoreset_mode=mode,
            task_options={"actions": actions},
        ).unwrapped
        assert isinstance(env, BridgeVectorEnv)
        assert env.metadata["autoreset_mode"] is AutoresetMode(mode)
        for check in CHECKS:
            check(env)
        for space in (env.observation_space, env.single_observation_space):
            checking.check_observation_space(space)
        for space in (env.action_space, env.single_action_space):
            checking.check_action_space(space)
            checking.check_space_limit(space, "action")
        env.close()
        env.close()


def test_gymnasiums_wrappers_take_it():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(vector(2))
    env.reset(seed=0)
    lengths = []
    for action in actions_of(env, LIMIT + 1):
        info = env.step(action)[4]
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert lengths
    assert min(lengths) >= 1


class Fragile(Navigation):
    """Raises in one world of the batch, after the simulator has moved all."""

    broken = False

    def step_into(self, *given):
        if Fragile.broken:
            raise KeyboardInterrupt
        return super().step_into(*given)


def test_an_exception_amid_a_step_wants_a_reset_of_all_worlds_which_sets_all_right():
    env = vector(3, task=Fragile)
    fresh = vector(3, task=Fragile)
    actions = np.full((3, 3), 0.5, np.float32)
    env.reset(seed=1)
    env.step(actions)
    Fragile.broken = True
    with pytest.raises(KeyboardInterrupt):
        env.step(actions)
    Fragile.broken = False
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(actions)
    with pytest.raises(gymnasium.error.ResetNeeded, match="all worlds"):
        env.reset(options={"reset_mask": np.array([True, False, True])})
    assert np.array_equal(env.reset(seed=7)[0], fresh.reset(seed=7)[0])
    for _ in range(3):
        assert np.array_equal(env.step(actions)[0], fresh.step(actions)[0])


def test_many_zeros_are_zeros_where_memory_can_not_be_mapped_privately_as_on_windows(
    monkeypatch,
):
    monkeypatch.delattr(vector_env.mmap, "MAP_PRIVATE")
    many = vector_env.zeros((vector_env.LARGE,), np.dtype(np.float32))
    assert many.shape == (vector_env.LARGE,)
    assert not many.any()


@pytest.mark.parametrize("kept", [(0,), (0, 1, 3)])
@pytest.mark.parametrize("kind", ["f8", "?", "U3", "O"])
def test_facts_of_some_worlds_are_copies_and_zeros_elsewhere_however_many_they_are(
    kind, kept
):
    values = np.array([[1, 2], [3, 4], [5, 6], [7, 8]]).astype(kind)
    mask = np.isin(np.arange(4), kept)
    found = vector_env.add_masks({"of": {"these": values}}, mask, True)["of"]
    expected = np.zeros_like(values)
    expected[mask] = values[mask]
    assert found["these"].dtype == values.dtype
    assert found["these"].tolist() == expected.tolist()
    assert found["_these"].tolist() == mask.tolist()
    assert not np.shares_memory(found["these"], values)
    with pytest.raises(IndexError):
        vector_env.add_masks({"wrong": np.concatenate([values, values])}, mask, True)
