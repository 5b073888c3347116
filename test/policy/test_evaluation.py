from __future__ import annotations

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.policy.evaluation import Episode, deviation, drive, drive_all, successes


class Constant:
    """Drives on, whatever it sees."""

    def __init__(self, *action):
        self.action = np.array(action, np.float32)

    def act(self, observation):
        return self.action


@pytest.fixture
def env():
    return TimeLimit(BridgeEnv(model=direct_model(), world=field()), 12)


def episode(points, result="success"):
    path = np.zeros((len(points), 3))
    path[:, :2] = points
    return Episode(0, result, path, path, np.zeros(2), np.zeros((0, 7)), 0.0)


def test_an_episode_that_nobody_ends_is_a_time_out(env):
    result = drive(env, Constant(0.0, 0.0, 0.3), seed=1)
    assert result.result == "time-out"
    assert result.steps == 12
    assert result.length == pytest.approx(0.0, abs=1e-9)
    assert result.reward == pytest.approx(-0.12, abs=1e-6)


def test_an_episode_that_drives_on_collides(env):
    result = drive(env, Constant(1.0, 0.0, 0.0), seed=4)
    while result.result == "time-out":
        result = drive(env, Constant(1.0, 0.0, 0.0), seed=result.seed + 1)
    assert result.result in ("collision", "success")
    assert result.steps < 12


def test_the_path_is_the_true_one_from_the_start_on(env):
    result = drive(env, Constant(0.1, 0.0, 0.0), seed=3)
    _, info = env.reset(seed=3)
    assert np.array_equal(result.path[0], info["start"])
    assert np.array_equal(result.goal, info["goal"])
    assert len(result.path) == len(result.estimate) == result.steps + 1
    assert result.length == pytest.approx(0.02 * result.steps)


def test_each_seed_is_driven_once_in_order_and_told_of(env):
    told = []
    episodes = drive_all(env, Constant(0.0, 0.0, 0.0), [5, 3, 4], told.append)
    assert [one.seed for one in episodes] == [5, 3, 4]
    assert told == episodes


def test_driving_a_seed_again_gives_the_same_path(env):
    one, other = (drive(env, Constant(0.2, 0.1, 0.3), seed=8) for _ in range(2))
    assert np.array_equal(one.path, other.path)
    assert one.reward == other.reward


def test_only_goals_count_as_successes():
    results = ("success", "collision", "time-out", "success")
    assert successes(episode([[0, 0]], result) for result in results) == 2


def test_deviation_is_the_greatest_distance_over_the_common_steps():
    one = episode([[0, 0], [1, 0], [2, 0]])
    other = episode([[0, 0], [1, 0.3], [2, 0.1], [9, 9]])
    assert deviation(one, other) == deviation(other, one) == pytest.approx(0.3)


def test_the_length_is_the_sum_of_the_steps():
    assert episode([[0, 0], [3, 4], [3, 5]]).length == pytest.approx(6.0)
