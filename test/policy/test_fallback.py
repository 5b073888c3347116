"""A planner behind a policy: where it acts, and that it does nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from robots import lidar

from nics_drl_bridge.commands.episodes import Evaluated, line_of
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.lidar.sectors import LAYOUTS
from nics_drl_bridge.policy.evaluation import drive, drive_all, drive_worlds, tallies
from nics_drl_bridge.policy.fallback import KEPT, Fallback, acted
from nics_drl_bridge.policy.mppi import Mppi
from nics_drl_bridge.policy.policies import PLANNERS, make_policy, open_policy
from nics_drl_bridge.policy.stateful import Stateful, begin, resume
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


@dataclass(frozen=True)
class FullAhead:
    """Drives ahead at full speed, whatever it sees."""

    task: Navigation

    def act(self, observation):
        actions = np.zeros(
            (*observation.shape[:-1], len(self.task.robot.command)), np.float32
        )
        actions[..., 0] = 1.0
        return actions


def task_of(robot, **options):
    return Navigation(load_robot(robot), lidar(beams=360), **options)


def front_of(robot):
    """How far a robot reaches ahead of its origin [m]."""
    return max(x for x, _ in robot.footprint or [(robot.footprint_radius, 0.0)])


def before_a_wall(task, *distances, speed=0.0):
    """Observations (N, O) of a robot in front of walls at distances from its origin [m]."""
    cosine = np.cos(task.lidar.angles)
    ranges = np.full((len(distances), 360), np.inf, np.float32)
    for row, distance in zip(ranges, distances, strict=True):
        row[cosine > 0.1] = distance / cosine[cosine > 0.1]
    view = RobotView(
        np.zeros((len(distances), 3)),
        np.tile([speed, 0.0, 0.0], (len(distances), 1)),
        ranges,
        0.0,
        0.0,
        0.0,
    )
    return task.observation(view, {"goal": np.tile([2.5, 0.0], (len(distances), 1))})


def backed(robot, planner="mppi", policy=None, **options):
    task = task_of(robot, **options)
    model = builtin_model(robot)
    behind = make_policy(planner, task, model)
    return Fallback(policy or FullAhead(task), behind, task, model), behind, task


@pytest.mark.slow
@pytest.mark.parametrize("planner", PLANNERS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_who_drives_on_into_what_is_ahead_touches_nothing_with_a_fallback(
    robot, planner
):
    env = BridgeVectorEnv(
        20, robot, "circles", task_options={"scan": "around"}, max_episode_steps=60
    )
    model = builtin_model(robot)
    alone = FullAhead(env.task)
    policy = Fallback(alone, make_policy(planner, env.task, model), env.task, model)
    assert drive_worlds(env, alone.act, range(20)).collision.sum() > 8
    assert drive_worlds(env, policy.act, range(20)).collision.sum() == 0
    assert policy.acted > 0


def test_a_net_in_a_file_that_drives_into_a_wall_does_not_with_a_fallback(tmp_path):
    torch = pytest.importorskip("torch")
    from nics_drl_bridge.policy.train_export import export_policy
    from policy.policy_rig import network

    model = builtin_model("differential")
    task = Navigation(model.robot, model.lidar, scan=LAYOUTS["around"])
    net = network(task.observation_space.shape[0], 2)
    with torch.no_grad():
        net[-1].weight.zero_()
        net[-1].bias.copy_(torch.tensor([1.0, 0.0]))
    file = str(tmp_path / "ahead.onnx")
    export_policy(net, task, model, file)
    ends = {}
    for fallback in ("", "mppi"):
        policy, task = open_policy(file, model, fallback)
        env = TimeLimit(BridgeEnv(model=model, world="empty", task=task), 60)
        place = {"start": [0.0, 0.0, 0.0], "goal": [0.0, -1.5]}
        ends[fallback] = drive(env, policy, 3, place)
    assert ends[""].result == "collision"
    assert ends["mppi"].result != "collision"
    assert ends["mppi"].planned > 0
    assert ends[""].planned is None


@pytest.mark.parametrize("planner", PLANNERS)
def test_rows_that_are_admissible_keep_the_policys_bits_and_the_others_get_the_planners(
    planner,
):
    policy, behind, task = backed("differential", planner)
    seen = before_a_wall(task, *np.linspace(0.2, 0.6, 40), speed=0.5)
    own = (
        np.random.default_rng(0)
        .uniform([0.8, -0.1], [1.0, 0.1], (40, 2))
        .astype(np.float32)
    )
    policy._policy = type("Told", (), {"act": lambda _, rows: own[: len(rows)]})()
    actions = policy.act(seen)
    planned = behind.act(seen)
    kept = (actions == own).all(axis=1)
    assert 5 < kept.sum() < 35
    assert (np.diff(kept.astype(int)) >= 0).sum() >= 38  # far walls, not near ones
    assert np.array_equal(actions[~kept], planned[~kept])
    assert policy.acted == (~kept).sum()
    for k in range(40):
        policy._policy = type("Told", (), {"act": lambda _, row, k=k: own[k]})()
        assert np.array_equal(policy.act(seen[k]), actions[k])


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_action_is_admissible_as_long_as_its_stop_ends_before_the_margin(robot):
    task = task_of(robot)
    model = builtin_model(robot)
    judge = Mppi(task, model, samples=1, clearance=KEPT)
    command = task.command(FullAhead(task).act(np.zeros((1, 1), np.float32)))[0]
    kinematics = model.kinematics
    pose = np.zeros(3)
    state = np.zeros(kinematics.state_size)
    for _ in range(300):  # until its twist is that of the command
        before, (pose, state) = pose, kinematics.step(pose, state, command)
    speed = np.linalg.norm((pose - before)[:2]) / kinematics.dt
    latency = model.calibration.command_latency_s
    start = pose
    waited = speed * (latency + model.kinematics.delays.max(initial=0.0))
    for given, time_s in ((command, model.control_period), (0.0 * command, 3.0)):
        for _ in range(round(time_s / kinematics.dt)):
            pose, state = kinematics.step(pose, state, given)
    way = waited + np.linalg.norm((pose - start)[:2])
    front = front_of(task.robot)
    nearest = front + KEPT.margin + way
    walls = np.arange(
        max(nearest - 0.3, front), nearest + 0.3, 0.01
    )  # none inside the robot
    commands = np.tile(command, (len(walls), 1))
    told = judge.can_stop(before_a_wall(task, *walls, speed=speed), commands)
    assert walls[told].min() == pytest.approx(nearest, abs=0.06)  # a cell of the map
    assert not told[walls < nearest - 0.06].any()
    assert told[walls > nearest + 0.06].all()


def test_within_the_margin_a_policy_may_still_drive_away():
    task = task_of("mecanum")
    model = builtin_model("mecanum")
    judge = Mppi(task, model, samples=1, clearance=KEPT)
    seen = before_a_wall(task, front_of(task.robot) + 0.5 * KEPT.margin)
    ahead, back = (np.array([[speed, 0.0, 0.0]]) for speed in (0.3, -0.3))
    assert judge.can_stop(seen, back).all()
    assert not judge.can_stop(seen, ahead).any()


def test_a_command_that_is_no_number_is_not_admissible():
    class Broken:
        def act(self, observation):
            return np.full((*observation.shape[:-1], 2), np.nan, np.float32)

    policy, behind, task = backed("differential", policy=Broken())
    seen = before_a_wall(task, 2.5)
    assert np.array_equal(policy.act(seen), behind.act(seen))


def test_a_state_goes_on_while_the_planner_acts_and_begins_anew_with_the_episode():
    steps = []

    def step(seen, state):
        steps.append(int(state[0]))
        return np.array([1.0, 0.0], np.float32), state + 1.0

    policy, _, task = backed("differential", policy=Stateful(step, 1, 0.0, 0.5))
    near = before_a_wall(task, 0.22)[0]
    far = before_a_wall(task, 2.9)[0]
    for seen in (far, near, near, far):
        policy.act(seen)
    assert policy.acted == 2
    begin(policy.act)
    policy.reset(np.array([True]))
    policy.act(far)
    assert resume(policy, 10.0) == ""
    assert "longer than the 0.5 s" in resume(policy, 11.0)
    policy.act(far)
    assert steps == [0, 1, 2, 3, 0, 0]
    assert policy.acted == acted(policy) == acted(policy.act) == 2


def test_the_share_of_its_actions_is_told_by_an_evaluation():
    model = builtin_model("differential")
    runs = {}
    for fallback in ("", "dynamic_window"):
        policy, task = open_policy("straight", model, fallback)
        env = TimeLimit(BridgeEnv(model=model, world="circles", task=task), 60)
        episodes = drive_all(env, policy, range(6))
        runs[fallback] = Evaluated(
            "straight",
            {"fast": episodes},
            tallies({"fast": episodes}, model.control_period),
        )
    episodes = runs["dynamic_window"].runs["fast"]
    tally = runs["dynamic_window"].tallies["fast"]
    counts = [episode.planned for episode in episodes]
    assert sum(counts) > 0
    assert counts[0] == episodes[0].plain()["fallback_actions"]
    assert tally.fallback == sum(counts) / sum(episode.steps for episode in episodes)
    assert f"; fallback acted {100 * tally.fallback:.4g} % in process" in line_of(
        runs["dynamic_window"]
    )
    assert runs[""].tallies["fast"].figures()["fallback"] is None
    assert "fallback" not in line_of(runs[""])


class OwnObservation(Navigation):
    def observation(self, view, memory):
        return super().observation(view, memory)[..., ::-1]


class OwnReward(Navigation):
    def reward(self, before, after, memory):
        return {}


@pytest.mark.parametrize(
    ("policy", "fallback", "kind", "options", "said"),
    [
        (
            "straight",
            "mpi",
            Navigation,
            {},
            "fallback 'mpi': no such planner; did you mean 'mppi'",
        ),
        ("straight", "random", Navigation, {}, "valid are: 'dynamic_window', 'mppi'"),
        (
            "mppi",
            "mppi",
            Navigation,
            {},
            "is the policy itself; take 'dynamic_window', or none",
        ),
        (
            "straight",
            "mppi",
            OwnObservation,
            {},
            "and OwnObservation observes otherwise",
        ),
        (
            "straight",
            "mppi",
            Navigation,
            {"actions": "discrete"},
            "of the policy are discrete",
        ),
    ],
)
def test_a_fallback_that_cannot_serve_is_refused(policy, fallback, kind, options, said):
    task = kind(load_robot("differential"), lidar(), **options)
    with pytest.raises(ConfigError, match=said):
        make_policy(policy, task, builtin_model("differential"), fallback)


def test_a_task_of_ones_own_reward_can_have_a_fallback():
    task = OwnReward(load_robot("differential"), lidar())
    policy = make_policy(
        "straight", task, builtin_model("differential"), "dynamic_window"
    )
    assert acted(policy) == 0


def test_a_car_of_unknown_wheelbase_has_no_fallback():
    robot = load_robot("ackermann").model_copy(
        update={"textbook": None, "parameters": {}}
    )
    task = Navigation(robot, lidar())
    sentence = "^fallback 'dynamic_window': .*'ackermann' steers, and its wheelbase is not known"
    with pytest.raises(ConfigError, match=sentence):
        make_policy("random", task, None, "dynamic_window")
