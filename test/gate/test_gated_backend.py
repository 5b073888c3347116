"""A robot behind the gate in process: what reaches it, and what is told of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

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


WEAK = "robot: jackal\ncommands:\n" + "".join(
    f"  {name}: {{min: -0.5, max: {most}, rate: {rate}, jerk: {20 * rate}}}\n"
    for name, most, rate in (("forward_command", 1.0, 2.0), ("turn_command", 2.5, 8.0))
)
ASSUMED = (
    "shield: {latency: 0.305, deceleration: 2.0, margin: 0.05, obstacle_speed: 0.0}\n"
)


@pytest.mark.parametrize(("shield", "hits"), [("", False), (ASSUMED, True)])
@pytest.mark.slow
def test_wheels_that_brake_weakly_stop_before_the_wall_unless_more_is_assumed(
    tmp_path, shield, hits
):
    model = builtin_model("jackal")
    brakes = 0.2 / model.robot.parameters["wheel_radius"]
    limits = np.array([[-brakes, 4.0 * brakes], [-brakes, 4.0 * brakes]])
    weak = replace(model, kinematics=replace(model.kinematics, limits=limits))
    (tmp_path / "jackal.yaml").write_text(WEAK + shield)
    bare = SimBackend(weak, field(8.0), estimator=True)
    behind = GatedBackend(bare, weak, str(tmp_path / "jackal.yaml"))
    behind.reset(START)
    told = [behind.step(np.array([1.0, 0.0]))[1] for _ in range(250)]
    assert any(each["true_collision"] for each in told) == hits
    if not hits:  # and it does not stand far away from it
        assert 2.5 < bare.simulator.data.pose[0, 0, 0] < 4.0 - 0.25


def test_commands_rise_at_the_rate_of_the_limits(model):
    behind, bare = gated(model)
    behind.reset(START)
    sent = []
    for _ in range(4):
        behind.step(AHEAD)
        sent.append(float(bare.simulator.data.history[0, 0, 0, 0]))
    assert all(0.0 < after - before <= 0.2 + 1e-9 for before, after in pairwise(sent))


def test_what_the_gate_stops_for_is_told(model):
    behind, _ = gated(model)
    behind.reset(START)
    assert behind.step(np.array([1e6, 0.0]))[1]["stopped_by"] == "command_malformed"


def test_an_episode_begins_armed_and_without_the_stop_of_the_one_before(model):
    behind, bare = gated(model)
    behind.reset(START)
    behind.step(np.array([1e6, 0.0]))
    behind.reset(START)
    assert behind.step(AHEAD)[1]["stopped_by"] == ""
    assert np.array_equal(behind.facts()["true_pose"], bare.facts()["true_pose"])


def test_a_robot_that_is_commanded_too_seldom_is_refused(model):
    slow = replace(model, control_period=0.3)
    with pytest.raises(
        ConfigError, match=r"commands come every 0\.3 s, and it stops after 0\.2 s"
    ):
        gated(slow)
