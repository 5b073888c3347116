from __future__ import annotations

import re

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.gate.assurance.adversaries import HORIZONS_S, Adversary, Truth
from nics_drl_bridge.generator import builtin_model

MODEL = builtin_model("mecanum")  # it goes anywhere at once
AWAY = 2.0


def see(bearing, is_wall):
    """What is true of a robot at rest with one thing around it, a wall or a pillar."""
    x, y = AWAY * np.cos(bearing), AWAY * np.sin(bearing)
    wall = np.array([[x - y, y + x, x + y, y - x]])
    pillar = np.array([[x, y, 0.1]])
    return Truth(
        pose=np.zeros(3),
        twist=np.zeros(3),
        ranges=np.zeros(0, np.float32),
        circles=pillar[: 0 if is_wall else 1],
        velocities=np.zeros((0 if is_wall else 1, 2)),
        walls=wall[: 1 if is_wall else 0],
        goal=np.zeros(2),
    )


def approach(command, bearing):
    """How far a command leads towards a bearing, at most, by the horizons [m]."""
    places = geometry.exp(np.multiply.outer(HORIZONS_S, command))
    return float((places[:, :2] @ (np.cos(bearing), np.sin(bearing))).max())


def drive(kind, truth, steps=100):
    adversary = Adversary(kind, MODEL, np.random.default_rng(0))
    return [adversary.act(truth) for _ in range(steps)]


@pytest.mark.parametrize("bearing", [0.0, np.pi / 2, np.pi])
@pytest.mark.parametrize("is_wall", [True, False])
def test_one_that_rams_drives_at_the_nearest_thing(bearing, is_wall):
    commands = drive("ram", see(bearing, is_wall), 20)
    assert min(approach(command, bearing) for command in commands) > 0.2


def test_one_that_is_late_keeps_away_and_turns_in_for_three_steps_each_time():
    commands = drive("late", see(0.0, is_wall=True))
    steps = "".join("a" if approach(each, 0.0) < 0.0 else "t" for each in commands)
    assert re.fullmatch("(a{0,12}ttt)*a{0,12}t{0,2}", steps), steps
    assert "attta" in steps
