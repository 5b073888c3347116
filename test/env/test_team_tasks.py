from __future__ import annotations

import numpy as np
import pytest
from robots import DIRECT, FOOTPRINT, direct_model, field, lidar

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.task import Episodes
from nics_drl_bridge.env.tasks.teams import CooperativeReaching, PursuitEvasion
from nics_drl_bridge.interface import RobotView

B = 72
REST = np.zeros((3, 3), np.float32)


def views(poses, near=()):
    """One world of robots at these poses; those in `near` have something at their footprint."""
    poses = np.array([poses], float)
    ranges = np.full((*poses.shape[:2], B), np.inf, np.float32)
    ranges[:, list(near), 5] = FOOTPRINT
    return RobotView(poses, np.zeros_like(poses), ranges, 0.0, 0.0, 0.0)


def begun(task, poses, goals):
    poses = np.array([poses], float)
    return task.reset(Episodes(np.zeros(1, np.int64), poses, np.array([goals], float)))


def step(task, before, after, memory):
    out = np.empty((*after.pose.shape[:2], task.observation_space.shape[0]), np.float32)
    return task.step_into(out, before, after, memory), out


@pytest.fixture
def team():
    return CooperativeReaching(DIRECT, lidar(), robots=2)


GOALS = [(0.0, 0.0), (3.0, 0.0)]


def test_the_team_is_paid_for_the_approach_of_whoever_is_nearest_to_a_goal(team):
    memory = begun(team, [(1.0, 0, 0), (5.0, 0, 0)], GOALS)
    before = views([(1.0, 0, 0), (5.0, 0, 0)])
    after = views([(0.8, 0, 0), (4.5, 0, 0)])
    outcome, _ = step(team, before, after, memory)
    # Goal 0 came 0.2 m nearer to robot 0; goal 1 0.5 m to robot 1, from 2 m to 1.5 m.
    assert outcome.terms["progress"] == pytest.approx(
        np.full((1, 2), (0.2 + 0.5) / 2.0)
    )
    assert outcome.terms["reached"].tolist() == [[0.0, 0.0]]
    assert not outcome.ended.any()


def test_a_goal_is_reached_once_for_all_and_the_last_one_ends_it(team):
    far = [(1.0, 0, 0), (5.0, 0, 0)]
    near = [(0.2, 0, 0), (5.0, 0, 0)]
    memory = begun(team, far, GOALS)
    first, _ = step(team, views(far), views(near), memory)
    assert first.terms["reached"].tolist() == [[5.0, 5.0]]
    assert first.info["reached"].tolist() == [[True, False]]
    again, _ = step(team, views(near), views(near), memory)
    assert again.terms["reached"].tolist() == [[0.0, 0.0]]
    assert not again.ended.any()
    last, _ = step(team, views(near), views([(3.1, 0, 0), (5.0, 0, 0)]), memory)
    assert last.terms["reached"].tolist() == [[5.0, 5.0]]
    # Only the goal that was open pays: from 2 m to 0.1 m.
    assert last.terms["progress"] == pytest.approx(np.full((1, 2), 1.9 / 2.0))
    assert last.ended.all()
    assert last.info["is_success"].all()


def test_only_the_robot_that_touches_something_is_out_and_pays(team):
    poses = [(1.0, 0, 0), (5.0, 0, 0)]
    memory = begun(team, poses, GOALS)
    outcome, _ = step(team, views(poses), views(poses, near=[1]), memory)
    assert outcome.ended.tolist() == [[False, True]]
    assert outcome.terms["collision"].tolist() == [[0.0, -10.0]]


def test_what_a_robot_of_a_team_sees_is_laid_out_as_documented(team):
    poses = [(1.0, 0.0, np.pi / 2), (1.0, 2.0, 0.0)]
    memory = begun(team, poses, GOALS)
    memory["reached"][0, 1] = True
    seen = team.observation(views(poses), memory)[0]
    assert seen.shape == (2, B + 4 * 2 + 3 + 3)
    goal_0 = seen[0, B : B + 4]
    goal_1 = seen[0, B + 4 : B + 8]
    mate = seen[0, B + 8 : B + 11]
    assert goal_0 == pytest.approx([1.0, 0.0, 1.0, 0.0], abs=1e-6)
    assert goal_1 == pytest.approx([2.0, 0.0, -1.0, 1.0], abs=1e-6)
    assert mate == pytest.approx([2.0, 1.0, 0.0], abs=1e-6)
    assert seen[1, B + 8 : B + 11] == pytest.approx([2.0, 0.0, -1.0], abs=1e-6)


@pytest.fixture
def chase():
    return PursuitEvasion(DIRECT, lidar())


PURSUERS = [(0.0, 0, 0), (0.0, 3.0, 0)]
EVADER = (2.0, 0, 0)


def test_a_pursuer_is_paid_for_coming_nearer_and_the_evader_for_getting_away(chase):
    before = views([*PURSUERS, EVADER])
    memory = begun(chase, before.pose[0], np.zeros((3, 2)))
    outcome, _ = step(chase, before, views([(0.5, 0, 0), PURSUERS[1], EVADER]), memory)
    assert outcome.terms["pursuit"] == pytest.approx(np.array([[0.5, 0.0, -0.5]]))
    assert outcome.terms["time"].tolist() == [[-0.01, -0.01, 0.01]]
    assert not outcome.ended.any()


def test_a_capture_pays_every_pursuer_costs_the_evader_and_ends_it(chase):
    before = views([*PURSUERS, EVADER])
    memory = begun(chase, before.pose[0], np.zeros((3, 2)))
    reach = 2.0 * FOOTPRINT + chase.capture_gap
    for gap, caught in ((reach + 1e-6, False), (reach - 1e-6, True)):
        after = views(
            [(2.0 - gap, 0, 0), PURSUERS[1], EVADER], near=[2] if caught else []
        )
        outcome, _ = step(chase, before, after, memory)
        assert outcome.terms["capture"].tolist() == [
            [10.0, 10.0, -10.0] if caught else [0.0] * 3
        ]
        # Being caught is no collision, whatever the scan says.
        assert outcome.terms["collision"].tolist() == [[0.0, 0.0, 0.0]]
        assert outcome.ended.all() == caught
    assert outcome.info["is_success"].tolist() == [[True, True, False]]


def test_the_chase_ends_when_all_pursuers_are_out_and_nobody_is_caught(chase):
    poses = [*PURSUERS, EVADER]
    memory = begun(chase, poses, np.zeros((3, 2)))
    first, seen = step(chase, views(poses), views(poses, near=[0]), memory)
    assert first.ended.tolist() == [[True, False, False]]
    # The others see that robot 0 is out: the fifth part of its entry.
    assert seen[0, 1, B + 4] == seen[0, 2, B + 4] == 1.0
    last, _ = step(chase, views(poses), views(poses, near=[0, 1]), memory)
    assert last.ended.all()
    assert last.info["is_success"].tolist() == [[False, False, True]]


def test_what_a_robot_of_a_chase_sees_is_laid_out_as_documented(chase):
    poses = [*PURSUERS, EVADER]
    memory = begun(chase, poses, np.zeros((3, 2)))
    seen = chase.observation(views(poses), memory)[0]
    assert seen.shape == (3, B + 5 * 2 + 1 + 3)
    assert seen[0, B : B + 11] == pytest.approx(
        [3.0, 0.0, 1.0, 1.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0], abs=1e-6
    )
    assert seen[2, B + 10] == 0.0


def test_each_robot_of_an_estimating_team_has_an_estimate_of_its_own():
    env = BridgeEnv(
        model=direct_model(),
        world=field(8.0),
        task="cooperative_reaching",
        estimator=True,
    )
    env.reset(seed=0)
    for _ in range(5):
        info = env.step(np.array([0.5, 0.0, 0.0, 0.0, 0.5, 0.2, -0.5, 0.0, 0.0]))[4]
    assert info["pose"].shape == (3, 3)
    assert info["pose"] == pytest.approx(info["true_pose"], abs=0.05)
