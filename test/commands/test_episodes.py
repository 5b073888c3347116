"""Where an evaluation drives a robot."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("gymnasium")

from nics_drl_bridge.commands.episodes import FAST, PLACES, EvaluationOrder, _places
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.spec import robot_from

KART = SimpleNamespace(robot=robot_from({"kind": "ackermann_throttle", "footprint_radius": 0.2}))


def order(*places):
    return EvaluationOrder(["straight"], Path("out"), places=places)


def test_a_robot_without_cmd_vel_is_driven_in_process_alone_and_that_is_said():
    said = []
    assert _places(order(*PLACES), KART, said.append) == (FAST,)
    assert said[0].startswith("in process alone: robot 'ackermann_throttle': the command 'throttl")
    assert _places(order(FAST), KART, said.append) == (FAST,)
    assert len(said) == 1


def test_to_ask_for_topics_with_such_a_robot_is_refused():
    with pytest.raises(ConfigError, match="names no field of cmd_vel"):
        _places(order(FAST, "dds"), KART, print)
