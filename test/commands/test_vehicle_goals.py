from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.commands import vehicle_goals
from nics_drl_bridge.commands.vehicle_goals import GoalOrder
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.world import load_world

SCENE = SimpleNamespace(
    starts=np.array([[1.0, -1.0, np.pi / 2]]), goals=np.array([[1.0, 2.0]])
)
ELSEWHERE = np.array([18.0, 5.0, np.pi])


@pytest.mark.parametrize(
    ("order", "goal", "distance", "said"),
    [
        (
            GoalOrder((2.0, 0.5), start="present"),
            (2.0, 0.5),
            np.hypot(2.0, 0.5),
            "2.00 m ahead and 0.50 m to the left of where it stands",
        ),
        (
            GoalOrder((2.0, -0.5), start="present", localised=True),
            (16.0, 5.5),
            np.hypot(2.0, 0.5),
            "2.00 m ahead and 0.50 m to the right",
        ),
        (
            GoalOrder((2.0, 0.5), "map", "present"),
            (2.0, 0.5),
            np.hypot(16.0, 4.5),
            "(2.00 m, 0.50 m) in map, 16.62 m from where it stands",
        ),
        (
            GoalOrder((2.0, 0.5)),
            (2.0, 0.5),
            np.hypot(1.0, 1.5),
            "place the vehicle at (1.00 m, -1.00 m, 1.57 rad)",
        ),
        (
            GoalOrder((2.0, 0.5), "robot"),
            geometry.compose(SCENE.starts[0], (2.0, 0.5, 0.0))[:2],
            np.hypot(2.0, 0.5),
            "it will drive to (0.50 m, 1.00 m) in map",
        ),
    ],
)
def test_a_goal_lies_where_its_frame_and_the_start_say(order, goal, distance, said):
    episode = order.episode(SCENE, ELSEWHERE if order.needs_pose else None)
    assert order.lays_map == (order.start == "present" and not order.needs_pose)
    assert episode.options["goal"] == pytest.approx(goal)
    assert ("start" in episode.options) == order.lays_map
    assert episode.distance == pytest.approx(distance)
    assert said in episode.sentence()


def test_without_a_goal_the_worlds_own_lies_as_in_its_episode_before_the_robot():
    order = GoalOrder(start="present")
    episode = order.episode(SCENE)
    assert order.lays_map
    assert episode.options == {}
    assert episode.seen == pytest.approx([3.0, 0.0])
    localised = GoalOrder(start="present", localised=True).episode(SCENE, ELSEWHERE)
    assert localised.options["goal"] == pytest.approx([15.0, 5.0])


def test_the_ground_around_a_vehicle_is_open_and_wide_enough_for_its_goal():
    world = load_world("circles")
    ground = GoalOrder((30.0, 0.0), start="present").ground(world)
    assert ground.bounds[2] > 30.0
    assert not ground.obstacles
    for other in (
        GoalOrder(start="present"),
        GoalOrder((1.0, 0.0)),
        GoalOrder((1.0, 0.0), "map"),
    ):
        assert other.ground(world) is world


def test_only_a_far_goal_is_confirmed():
    asked = []
    GoalOrder((4.0, 3.0), start="present").episode(SCENE).confirm(asked.append)
    assert not asked
    GoalOrder((4.0, 3.1), start="present").episode(SCENE).confirm(asked.append)
    assert "farther than 5 m" in asked[0]
    GoalOrder((4.0, 3.1), start="present", confirm_beyond_m=6.0).episode(SCENE).confirm(
        None
    )


def test_a_far_goal_that_nobody_can_confirm_is_refused_in_one_sentence(monkeypatch):
    far = GoalOrder((20.0, 0.0), start="present").episode(SCENE)
    for confirm in (None, vehicle_goals.confirm_at_terminal):
        with pytest.raises(
            ConfigError, match=r"20.00 m ahead.*farther than 5 m.*use --yes"
        ):
            far.confirm(confirm)


@pytest.mark.parametrize(
    ("answer", "driven"), [("y\n", True), ("n\n", False), ("\n", False)]
)
def test_at_a_terminal_the_answer_decides(monkeypatch, answer, driven):
    monkeypatch.setattr(vehicle_goals.sys, "stdin", Terminal(answer))
    if driven:
        vehicle_goals.confirm_at_terminal("it will drive far")
        return
    with pytest.raises(ConfigError, match="the goal was not confirmed"):
        vehicle_goals.confirm_at_terminal("it will drive far")


class Terminal:
    """Standard input with a person."""

    def __init__(self, answer):
        self.answer = answer

    def isatty(self):
        return True

    def readline(self, *_):
        return self.answer
