from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, replace

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import format_json
from nics_drl_bridge.policy.evaluation import (
    ELSEWHERE,
    Episode,
    Outcomes,
    drive,
    drive_all,
    drive_worlds,
    summarise,
    tallies,
)
from nics_drl_bridge.policy.file.stateful import Stateful
from nics_drl_bridge.policy.policies import make_policy

LIMIT = 40
MODEL = direct_model(odometry=(0.02, 0.02))
WORLD = field(count=6)


class Constant:
    """Drives on, whatever it sees."""

    def __init__(self, *action):
        self.action = np.array(action, np.float32)

    def act(self, observation):
        return self.action


@pytest.fixture
def env():
    return TimeLimit(BridgeEnv(model=direct_model(), world=field()), 12)


def episode(points, result="success", seed=0):
    path = np.zeros((len(points), 3))
    path[:, :2] = points
    return Episode(seed, result, path, path, np.zeros(2), np.zeros((0, 7)), 0.0)


class Quiet(Navigation):
    """Tells neither success nor collision, which are optional."""

    def info(self, view, memory):
        return {}


@pytest.mark.parametrize("task", [Navigation, Quiet])
def test_an_episode_that_nobody_ends_is_a_time_out(task):
    env = BridgeEnv(model=direct_model(), world=field(), task=task)
    result = drive(TimeLimit(env, 12), Constant(0.0, 0.0, 0.3), seed=1)
    assert result.result == "time-out"
    assert result.steps == 12
    assert result.length == pytest.approx(0.0, abs=1e-9)
    assert result.reward == pytest.approx(-0.12, abs=1e-6)


def test_an_action_that_is_no_number_is_told_with_its_step(env):
    with pytest.raises(
        ConfigError, match="the policy's action in step 1 contains NaN or inf"
    ):
        drive(env, Constant(np.nan, 0.0, 0.0), seed=1)
    many = BridgeVectorEnv(2, direct_model(), field())
    with pytest.raises(
        ConfigError, match="the policy's action in step 1 contains NaN or inf"
    ):
        drive_worlds(many, lambda seen: np.full((len(seen), 3), np.nan), [1, 2])


def test_the_path_is_the_true_one_from_the_start_on(env):
    result = drive(env, Constant(0.1, 0.0, 0.0), seed=3)
    _, info = env.reset(seed=3)
    assert np.array_equal(result.path[0], info["start"])
    assert np.array_equal(result.goal, info["goal"])
    assert len(result.path) == len(result.estimate) == result.steps + 1
    assert result.length == pytest.approx(0.02 * result.steps)


class Believing(gymnasium.Env):
    """Ends at once; the robot believes to be at its goal, the truth is what it is given."""

    def __init__(self, task, **truth):
        self.task = task
        self.truth = truth

    def reset(self, *, seed=None, options=None):
        return None, {
            "goal": GOAL,
            "bodies": np.zeros((0, 7)),
            "start": HOME,
            "pose": HOME,
        }

    def step(self, action):
        told = {"is_success": True, "collision": False, "pose": np.array([*GOAL, 0.0])}
        return None, 10.0, True, False, told | self.truth


HOME = np.zeros(3)
GOAL = np.array([3.0, 0.0])
TASK = Navigation(direct_model().robot, direct_model().lidar)


def judged(touched=None, task=TASK, **truth):
    return drive(Believing(task, **truth), Constant(0.0), 0, touched=touched)


def at(x):
    return {"true_pose": np.array([x, 0.0, 0.0])}


@pytest.mark.parametrize(
    ("x", "result"),
    [(2.75, "success"), (2.65, "success"), (2.55, ELSEWHERE), (np.nan, ELSEWHERE)],
)
def test_a_robot_is_at_its_goal_where_it_truly_is_not_where_it_believes_to_be(
    x, result
):
    found = judged(**at(x))
    assert (found.result, found.believed) == (result, "success")
    assert found.believed_success
    assert found.miss == pytest.approx(3.0 - x, nan_ok=True)


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


def drive_ever_faster(seen, state):
    """Drives the faster the longer the episode lasts."""
    turn = np.sin(state[..., 0])
    return np.stack([state[..., 0], 0.0 * turn, turn], -1).clip(-1.0, 1.0), state + 0.1


@pytest.mark.parametrize(
    ("worlds", "name"), [(3, "straight"), (3, "stateful"), (8, "stateful")]
)
def test_many_at_once_end_as_one_after_the_other(worlds, name):
    env = BridgeVectorEnv(worlds, MODEL, WORLD, max_episode_steps=LIMIT)
    policy = Stateful(drive_ever_faster, 1, 0.0)
    if name == "straight":
        policy = make_policy(name, env.task)
    seeds = [7, 3, 11, 5, 100, 42, 43]
    found = drive_worlds(env, policy.act, seeds)
    alone = TimeLimit(BridgeEnv(model=MODEL, world=WORLD), LIMIT)
    told = []
    episodes = drive_all(alone, policy, seeds, told.append)
    assert told == episodes
    assert found.seeds.tolist() == seeds
    assert found.steps.tolist() == [one.steps for one in episodes]
    assert np.allclose(found.length, [one.length for one in episodes], atol=1e-12)
    assert np.allclose(found.reward, [one.reward for one in episodes], atol=1e-9)
    assert found.success.tolist() == [one.result == "success" for one in episodes]
    assert found.collision.tolist() == [one.result == "collision" for one in episodes]
    assert len({one.result for one in episodes}) > 1


class Aside(BridgeVectorEnv):
    """Tells that robots are half a metre from where they are."""

    def step(self, actions):
        *rest, infos = super().step(actions)
        for told in (infos, infos.get("final_info", {})):
            if "true_pose" in told:
                told["true_pose"] = told["true_pose"] + [0.5, 0.0, 0.0]
        return *rest, infos


def test_arrived_is_who_truly_is_there():
    honest, lied = (
        drive_worlds(env, make_policy("straight", env.task).act, range(8))
        for env in (
            kind(8, MODEL, WORLD, max_episode_steps=LIMIT)
            for kind in (BridgeVectorEnv, Aside)
        )
    )
    assert honest.success.any()
    assert lied.success.sum() < honest.success.sum() == honest.believed.sum()
    assert lied.believed.tolist() == honest.believed.tolist()
    assert lied.collision.tolist() == honest.collision.tolist()


def test_time_and_length_are_those_of_the_successful():
    flags = np.array([True, False, True, False])
    outcomes = Outcomes(
        np.arange(4),
        flags,
        np.array([False, True, False, False]),
        np.array([10, 99, 30, 300]),
        np.array([1.0, 50.0, 2.0, 60.0]),
        np.zeros(4),
        np.array([True, False, True, True]),
    )
    summary = summarise(outcomes, 0.1)
    assert summary.episodes == 4
    shares = {name: share.value for name, share in summary.shares.items()}
    assert list(shares.values()) == [0.5, 0.75, 0.25, 0.25]
    assert summary.length.value == pytest.approx(1.5)
    assert summary.time.value == pytest.approx(2.0)


def line(length, aside=0.0):
    return [(0.1 * k * length, aside * k / 10.0) for k in range(11)]


RUNS = {
    "fast": [episode(line(2.0)), episode(line(1.0), seed=1)],
    "dds": [episode(line(2.0, 0.3)), episode(line(1.0)[:6], "collision", 1)],
}


def test_worlds_are_compared_with_the_first():
    told = tallies(RUNS, 0.1)
    assert told["fast"].success.value == 1.0
    assert told["fast"].same == 1.0
    assert told["fast"].greatest_deviation == 0.0
    dds = told["dds"]
    assert dds.success.value == dds.collision.value == dds.same == 0.5
    assert told["dds"].greatest_deviation == pytest.approx(0.3)
    assert told["dds"].deviation.value == pytest.approx(0.15)
    assert told["fast"].time.value == pytest.approx(1.0)
    assert told["fast"].length.value == pytest.approx(1.5)


def test_without_any_success_its_length_is_unknown_and_the_json_is_still_json():
    told = tallies({"fast": [episode(line(0.0), "time-out")]}, 0.1)["fast"]
    assert math.isnan(told.length.value)
    text = json.dumps(told.figures(), allow_nan=False)
    assert json.loads(text)["length"] == [None, None, None]


def test_what_the_robot_took_for_a_success_is_told_beside_what_was_one():
    lied = replace(episode(line(2.0), "elsewhere"), believed="success")
    told = tallies({"fast": [lied, episode(line(1.0), seed=1)]}, 0.1)["fast"]
    shares = told.success, told.believed, told.time_out
    assert [share.value for share in shares] == [0.5, 1.0, 0.5]
    assert lied.plain()["believed"] == "success"
    assert lied.plain()["goal_distance_m"] == pytest.approx(2.0)


@pytest.mark.parametrize("arrived", [0, 2])
def test_a_summary_shows_neither_nan_nor_inf_and_is_json_that_others_read(arrived):
    train = pytest.importorskip("nics_drl_bridge.policy.train.run")
    success = np.arange(3) < arrived
    steps = np.full(3, 7)
    figures = steps, steps * 0.1, steps * 1.0
    told = summarise(
        Outcomes(np.arange(3), success, np.zeros(3, bool), *figures, success), 0.1
    )
    line = f"{train.line_of(told)} {told.length.text('m')}"
    assert not re.search(r"\b(nan|inf)\b", line)
    assert ("path" in line) == (arrived > 0)
    assert (
        json.loads(format_json(asdict(told)), parse_constant=pytest.fail)["length"]
        is not None
    )
