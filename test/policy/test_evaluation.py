from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.policy.evaluation import (
    ELSEWHERE,
    Episode,
    deviation,
    drive,
    drive_all,
    successes,
)


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


class Believing(gymnasium.Env):
    """Ends at once; the robot believes to be at its goal, the truth is what it is given."""

    def __init__(self, task, **truth):
        self.task, self.truth = task, truth

    def reset(self, *, seed=None, options=None):
        return None, {"goal": GOAL, "bodies": np.zeros((0, 7)), "start": HOME, "pose": HOME}

    def step(self, action):
        told = {"is_success": True, "collision": False, "pose": np.array([*GOAL, 0.0])}
        return None, 10.0, True, False, told | self.truth


HOME, GOAL = np.zeros(3), np.array([3.0, 0.0])
TASK = Navigation(direct_model().robot, direct_model().lidar)


def judged(touched=None, task=TASK, **truth):
    return drive(Believing(task, **truth), Constant(0.0), 0, touched=touched)


def at(x):
    return {"true_pose": np.array([x, 0.0, 0.0])}


@pytest.mark.parametrize(("x", "result"), [(2.75, "success"), (2.65, "success"), (2.55, ELSEWHERE)])
def test_a_robot_is_at_its_goal_where_it_truly_is_not_where_it_believes_to_be(x, result):
    found = judged(**at(x))
    assert (found.result, found.believed) == (result, "success")
    assert found.believed_success
    assert found.miss == pytest.approx(3.0 - x)


def test_a_place_that_is_no_number_is_no_goal():
    assert judged(**at(np.nan)).result == ELSEWHERE


@pytest.mark.parametrize("how", ["info", "asked"])
def test_a_true_touch_is_a_collision_whatever_the_robot_believes(how):
    if how == "info":
        found = judged(**at(2.9), true_collision=True)
    else:
        found = judged(lambda: True, **at(2.9))
    assert (found.result, found.believed) == ("collision", "success")


def test_where_no_truth_is_known_what_the_robot_believes_counts_and_it_is_said():
    found = judged(lambda: pytest.fail("there is nobody to ask"))
    assert (found.result, found.believed) == ("success", None)


def test_a_task_without_a_goal_of_each_robot_is_not_judged_by_places():
    assert judged(task=object(), **at(9.0)).result == "success"


def test_only_goals_count_as_successes():
    results = ("success", "collision", "time-out", "success")
    assert successes(episode([[0, 0]], result) for result in results) == 2


def test_deviation_is_the_greatest_distance_over_the_common_steps():
    one = episode([[0, 0], [1, 0], [2, 0]])
    other = episode([[0, 0], [1, 0.3], [2, 0.1], [9, 9]])
    assert deviation(one, other) == deviation(other, one) == pytest.approx(0.3)


def test_the_length_is_the_sum_of_the_steps():
    assert episode([[0, 0], [3, 4], [3, 5]]).length == pytest.approx(6.0)
