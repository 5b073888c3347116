from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags
from command_line import nics

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.policy.shadow import Shadow, shadow
from nics_drl_bridge.robot.spec import load_robot
from policy.policy_rig import export_remembering

pytestmark = pytest.mark.slow
LIDAR = load_lidar("paper")
ROBOT = load_robot("ackermann")
SEED = 4
PERIOD = 0.1
LATE = {"/odom": 0.005, "/scan": 0.01, "/cmd_vel": 0.02}


def driven_by(name):
    """Goal and messages of an episode that a policy drives with the estimator."""
    env = BridgeEnv(model="ackermann", world="circles", estimator=True)
    policy = make_policy(name, env.task)
    observation, info = env.reset(seed=SEED)
    topics = {topic: [] for topic in LATE}
    ended = False
    k = 1
    while not ended and k < 60:
        t = PERIOD * k
        data = env._backend.simulator.data
        action = policy.act(observation)
        twist = ROBOT.to_cmd_vel(env.task.command(action))
        told = {
            "/scan": bags.scan_of(LIDAR, t, data.ranges[0, 0]),
            "/odom": bags.moving_odometry(t, data.odom[0, 0], data.twist[0, 0]),
            "/cmd_vel": bags.twist_stamped(t, *twist),
        }
        for topic, message in told.items():
            topics[topic].append((t + LATE[topic], message))
        observation, _, ended, _, _ = env.step(action)
        k += 1
    env.close()
    return info["goal"], topics


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The goal of a drive of dynamic_window, and its bag."""
    goal, topics = driven_by("dynamic_window")
    return (
        goal,
        bags.write(tmp_path_factory.mktemp("drive") / "bag", topics),
        len(topics["/scan"]),
    )


def test_a_policy_in_the_shadow_of_its_own_drive_commands_what_was_driven(recorded):
    goal, bag, count = recorded
    made, again = (
        shadow(bag, builtin_model("ackermann"), "dynamic_window", {}, goal)
        for _ in range(2)
    )
    assert made.policy.tobytes() == again.policy.tobytes()
    assert len(made.time) == count
    assert np.abs(made.policy - made.driven).max() < 1e-4
    assert np.abs(made.driven).max() > 0.1
    assert all(figures["opposite"] == 0.0 for figures in made.differences().values())


@pytest.fixture
def remembering(tmp_path):
    """A policy with a state, the goal and the messages of its drive."""
    path = tmp_path / "car.onnx"
    export_remembering(path, builtin_model("ackermann"), scan=None)
    return str(path), *driven_by(str(path))


def test_a_policy_with_a_state_commands_what_it_drove_even_where_no_command_is_left(
    remembering, tmp_path
):
    policy, goal, topics = remembering
    count = len(topics["/scan"])
    assert count > 15
    bag = bags.write(tmp_path / "whole", topics)
    made = shadow(bag, builtin_model("ackermann"), policy, {}, goal)
    assert np.abs(made.policy - made.driven).max() < 1e-4
    assert np.ptp(made.driven, axis=0).min() > 0.001
    topics["/cmd_vel"] = topics["/cmd_vel"][12:]
    bag = bags.write(tmp_path / "fewer", topics)
    made = shadow(bag, builtin_model("ackermann"), policy, {}, goal)
    assert (
        np.abs(made.policy - made.driven).max() < 5e-3
    )  # the estimator hears commands, too
    assert made.skipped["no command was driven"] >= 10
    assert made.resets == 0


def test_after_a_gap_in_a_drive_the_state_begins_anew_and_it_is_counted(
    remembering, tmp_path
):
    policy, goal, topics = remembering
    bag = bags.write(
        tmp_path / "gap", {name: rows[:4] + rows[12:] for name, rows in topics.items()}
    )
    made = shadow(bag, builtin_model("ackermann"), policy, {}, goal)
    assert made.resets == 1


def test_without_a_goal_it_is_where_the_robot_was_later(recorded):
    _, bag, _ = recorded
    made = shadow(bag, builtin_model("ackermann"), "dynamic_window", {}, ahead_s=1.0)
    ahead = round(1.0 / PERIOD)
    assert made.goal[0] == pytest.approx(made.pose[ahead, :2], abs=1e-6)


def test_figures_are_those_of_the_definition():
    wanted = np.array([[1.0], [-1.0], [0.02], [0.5]])
    driven = np.array([[0.5], [1.0], [-1.0], [0.5]])
    where = np.zeros((4, 3))
    one = Shadow(
        ("speed",),
        ("m/s",),
        np.arange(4.0),
        where,
        where[:, :2],
        wanted,
        driven,
        np.ones(1),
        {},
    )
    told = one.differences()["speed"]
    assert told["mean"] == pytest.approx((0.5 - 2.0 + 1.02 + 0.0) / 4.0)
    assert told["mean_size"] == pytest.approx((0.5 + 2.0 + 1.02 + 0.0) / 4.0)
    assert told["greatest"] == pytest.approx(2.0)
    assert told["opposite"] == pytest.approx(
        1.0 / 3.0
    )  # 0.02 is too small to have a sign


@pytest.mark.parametrize(
    ("topics", "goal", "ahead", "words"),
    [
        ({"scan": "/scna"}, None, 4.0, "/scna"),
        ({}, None, 0.0, "--ahead 0"),
        ({}, (0.0, 0.0), 4.0, "nothing to compare"),  # at the goal all the time
    ],
)
def test_what_can_not_be_compared_is_told(standing, topics, goal, ahead, words):
    model = builtin_model("ackermann")
    with pytest.raises((RecordingError, ConfigError), match=words):
        shadow(standing, model, "dynamic_window", topics, goal, ahead)


def test_a_bag_without_commands_is_refused(tmp_path):
    topics = driven_standing()
    del topics["/cmd_vel"]
    bag = bags.write(tmp_path / "bag", topics)
    with pytest.raises(RecordingError, match="has no cmd_vel"):
        shadow(bag, builtin_model("ackermann"), "dynamic_window", {})


@pytest.fixture
def standing(tmp_path):
    return bags.write(tmp_path / "standing", driven_standing())


def driven_standing():
    free = np.full(LIDAR.beams, 2.0)
    moments = [PERIOD * k for k in range(1, 8)]
    return {
        "/scan": [(t + LATE["/scan"], bags.scan_of(LIDAR, t, free)) for t in moments],
        "/odom": [(t, bags.odometry(t, *np.zeros(3))) for t in moments],
        "/cmd_vel": [(t, bags.twist(0.0, 0.0, 0.0)) for t in moments],
    }


def test_the_command_writes_a_table_a_picture_and_json(recorded, tmp_path):
    goal, bag, count = recorded
    words = ["evaluate", "dynamic_window", "--shadow", str(bag), "--model", "ackermann"]
    words += [f"--goal={goal[0]},{goal[1]}", "--out", str(tmp_path / "out")]
    done = nics(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"compared at {count} times" in done.stdout
    told = json.loads(
        (tmp_path / "out" / "shadow_dynamic_window.json").read_text(encoding="utf-8")
    )
    assert told["resets"] == 0
    assert told["commands"]["speed_command"]["greatest"] < 1e-4
    assert (
        (tmp_path / "out" / "shadow_dynamic_window.png")
        .read_bytes()
        .startswith(b"\x89PNG")
    )
