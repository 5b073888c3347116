"""A robot behind the gate in process: what reaches it, and what is told of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import field

from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.gated_backend import GatedBackend
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import Start

START = Start(3, np.array([0.0, 0.0, 0.0]))
AHEAD = np.array([1.0, 0.0])


@pytest.fixture(scope="module")
def model():
    return builtin_model("differential")


def gated(model, size=6.0):
    backend = SimBackend(model, field(size), estimator=True)
    return GatedBackend(backend, model, "differential"), backend


def test_the_shield_stops_a_robot_before_the_wall_that_it_hits_without_a_gate(model):
    behind, bare = gated(model)
    alone = SimBackend(model, field(6.0), estimator=True)
    behind.reset(START)
    alone.reset(START)
    told = [behind.step(AHEAD)[1] for _ in range(60)]
    assert [alone.step(AHEAD) for _ in range(60)][-1][1]["true_collision"]
    assert not told[-1]["true_collision"]
    assert 2.5 < bare.simulator.data.pose[0, 0, 0] < 3.0 - model.robot.footprint_radius
    assert not told[0]["shielded"]
    assert told[-1]["shielded"]
    assert {each["stopped_by"] for each in told} == {""}


def test_an_episode_begins_armed_and_without_the_stop_of_the_one_before(model):
    behind, bare = gated(model)
    behind.reset(START)
    assert behind.step(np.array([1e6, 0.0]))[1]["stopped_by"] == "command_malformed"
    behind.reset(START)
    assert behind.step(AHEAD)[1]["stopped_by"] == ""
    assert np.array_equal(behind.facts()["true_pose"], bare.facts()["true_pose"])
    calls = []
    bare.halt = lambda: calls.append("halt")
    bare.close = lambda: calls.append("close")
    behind.halt()
    behind.close()
    assert calls == ["halt", "close"]


def test_a_robot_that_the_gate_does_not_fit_is_refused(model):
    with pytest.raises(ConfigError, match=r"commands come every 0\.3 s"):
        gated(replace(model, control_period=0.3))
