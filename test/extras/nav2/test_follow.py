from __future__ import annotations

import math

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.nav2.follow import (
    GoalCheck,
    GoalChecker,
    PlannedPath,
    ProgressCheck,
    ProgressChecker,
)

GOAL = GoalCheck(0.25, 0.25, stateful=True, path_length_tolerance=1.0)
PROGRESS = ProgressCheck(0.5, 10.0, required_movement_angle=math.inf)
CORNER = np.array([(0.0, 0.0, 0.0), (2.0, 0.0, math.pi / 2), (2.0, 2.0, math.pi)])


def test_the_sub_goal_lies_ahead_on_the_path():
    place = PlannedPath(CORNER).locate(np.array([0.5, 0.1, 0.0]), 1.0)
    assert place.ahead == pytest.approx([1.5, 0.0], abs=0.05)
    assert place.remaining == pytest.approx(3.5, abs=0.05)
    assert place.distance == pytest.approx(math.hypot(1.5, 1.9))
    assert place.nearest == 1  # the nearest of the given poses ahead


def test_errors_have_the_signs_of_the_standard():
    left = PlannedPath(CORNER).locate(np.array([0.5, 0.2, 0.3]), 1.0)
    assert left.left == pytest.approx(0.2)  # to the left of the path
    assert left.turned == pytest.approx(-0.3)  # turned to the left of its direction
    assert PlannedPath(CORNER).locate(
        np.array([0.5, -0.2, -0.3]), 1.0
    ).left == pytest.approx(-0.2)


def test_a_path_that_comes_back_is_followed_to_its_turn_first():
    there_and_back = np.array([(0.0, 0.0), (5.0, 0.0), (0.0, 0.0)])
    path = PlannedPath(there_and_back)
    assert path.locate(np.zeros(3), 1.0).remaining == pytest.approx(10.0)
    assert path.locate(np.array([0.5, 0.0, 0.0]), 1.0).remaining == pytest.approx(
        9.5, abs=0.05
    )


@pytest.mark.parametrize(
    ("poses", "why"),
    [
        (np.zeros((0, 3)), "empty"),
        (np.full((2, 3), math.nan), "not a number"),
        (np.full((2, 3), 1e9), "not a number, or too large"),
        (
            np.array([(0.0, 0.0), (2e5, 0.0)]),
            r"is 2e\+05 m long; the maximum is 100000 m",
        ),
    ],
)
def test_what_is_no_path_is_refused(poses, why):
    with pytest.raises(ConfigError, match=why):
        PlannedPath(poses)


def test_a_path_of_one_pose_is_its_own_end():
    place = PlannedPath(CORNER[2:]).locate(np.array([2.0, 1.0, 0.0]), 1.0)
    assert (place.remaining, place.distance) == (0.0, 1.0)
    assert place.ahead == pytest.approx([2.0, 2.0])


def arrive(checker, *poses):
    path = PlannedPath(CORNER)
    turn = None
    for pose in ((1.0, 0.0, 0.0), (2.0, 0.5, 0.0), *poses):
        turn = checker.turn_left(
            path.locate(np.array(pose), 1.0), np.array(pose), path.end
        )
    return turn


def test_at_the_goal_a_robot_turns_and_then_is_there():
    check = GOAL
    assert arrive(GoalChecker(check, turns=True), (2.0, 1.5, 1.0)) is None
    left = arrive(GoalChecker(check, turns=True), (2.0, 1.9, 1.0))
    assert left == pytest.approx(
        math.pi - 1.0 - 2.0 * math.pi * (math.pi - 1.0 >= math.pi)
    )
    assert arrive(GoalChecker(check, turns=True), (2.0, 1.9, math.pi - 0.2)) == 0.0
    assert arrive(GoalChecker(check, turns=False), (2.0, 1.9, 1.0)) == 0.0


def test_a_place_that_was_reached_stays_so_if_the_check_is_stateful():
    drifted = (2.0, 1.9, 1.0), (2.0, 1.6, 1.0)
    assert arrive(GoalChecker(GOAL, turns=True), *drifted) is not None
    assert (
        arrive(GoalChecker(GOAL._replace(stateful=False), turns=True), *drifted) is None
    )


def test_a_loop_does_not_end_where_it_begins():
    loop = np.array(
        [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 2.0, 0.0), (0.0, 0.1, 0.0)]
    )
    path = PlannedPath(loop)
    checker = GoalChecker(GOAL, turns=False)
    assert (
        checker.turn_left(path.locate(np.zeros(3), 1.0), np.zeros(3), path.end) is None
    )


def test_a_turn_is_progress_where_it_is_to_count():
    turned = np.array([0.0, 0.0, 0.6])
    for angle, stuck in ((math.inf, True), (0.5, False)):
        checker = ProgressChecker(PROGRESS._replace(required_movement_angle=angle))
        assert not checker.stuck(0.0, np.zeros(3))
        assert checker.stuck(10.5, turned) is stuck


def test_a_robot_that_does_not_get_on_is_stuck():
    checker = ProgressChecker(PROGRESS)
    assert not checker.stuck(0.0, np.zeros(3))
    assert not checker.stuck(9.0, np.array([0.4, 0.0, 0.0]))
    assert checker.stuck(10.5, np.array([0.4, 0.0, 0.0]))
    assert not checker.stuck(10.6, np.array([0.6, 0.0, 0.0]))
    assert not checker.stuck(20.0, np.array([0.6, 0.0, 0.0]))
    assert not checker.stuck(1.0, np.array([0.6, 0.0, 0.0]))  # the clock was set back
    assert checker.stuck(11.5, np.array([0.6, 0.0, 0.0]))
