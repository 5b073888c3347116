"""The campaign against an env over DDS in small."""

from __future__ import annotations

import pytest

from .runs import CAMPAIGNS

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]


@pytest.fixture
def abuse_env(monkeypatch):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    from parts import abuse_env

    return abuse_env


@pytest.mark.parametrize("seed", [1, 77])
def test_no_motion_stays_on_cmd_vel_whatever_is_thrown(abuse_env, seed):
    score = abuse_env.campaign(seed, 3)
    assert score.tries == 3
    assert score.told == []


def test_without_the_guard_motions_stay(abuse_env):
    score = abuse_env.campaign(3, 4, control="no_guard")
    assert score.tries == 4
    assert score.moved > 0
    assert set(abuse_env.CONTROLS) == {"no_guard"}


def test_a_robot_that_does_not_move_is_no_round(abuse_env, monkeypatch):
    monkeypatch.setattr(abuse_env, "AHEAD", 0.0 * abuse_env.AHEAD)
    monkeypatch.setattr(abuse_env, "MOVES_S", 0.3)
    monkeypatch.setattr(abuse_env, "MOVING", 1e6)
    with pytest.raises(
        RuntimeError, match="does not move, so that nothing can be measured"
    ):
        abuse_env.campaign(1, 1)
