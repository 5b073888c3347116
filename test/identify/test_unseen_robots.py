"""Robots that the package does not ship: a recording and a YAML file are all it gets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identify.drives import (
    NOISE,
    draw_commands,
    fit_trial,
    fit_whole,
    follow_commands,
    with_values,
)
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

ROBOTS = Path(__file__).resolve().parent / "robots"
DT = 0.02
LAG = 0.15
WHEELBASE = 0.55
RADIUS = 0.1
TRACK = 0.4
SLIP = 1.6


def robot(name: str) -> RobotSpec:
    return load_robot(str(ROBOTS / f"{name}.yaml"))


def recorded(spec, target, twist, noise=(0.0, 0.0), latency=0.0, count=2000):
    """A robot whose state follows `target(command)` and that moves by a twist."""
    commands = draw_commands(spec, count)
    made = follow_commands(commands, target, twist, LAG, DT, noise)
    return replace(made, command=replace(made.command, t=made.command.t - latency))


def car_twist(state):
    angle, pace = state.T
    return np.stack([pace, 0.0 * pace, pace * np.tan(angle) / WHEELBASE], axis=1)


def skid_twist(state):
    right, left = state.T
    forward = RADIUS * (right + left) / 2
    turn = RADIUS * (right - left) / (TRACK * SLIP)
    return np.stack([forward, 0.0 * forward, turn], axis=1)


def skid_target(command):
    forward, turn = command.T
    return (
        np.stack([forward + turn * TRACK / 2, forward - turn * TRACK / 2], axis=1)
        / RADIUS
    )


def omni_twist(state):
    sideways, turn, forward = state.T
    return np.stack([forward, sideways, turn], axis=1)


def terms(found):
    return found.model.named.terms


@pytest.mark.slow
def test_a_car_of_another_wheelbase_with_its_steering_first():
    spec = robot("long_car")
    found = fit_trial(recorded(spec, lambda c: c, car_twist, NOISE), spec)
    turned = [
        v for k, v in terms(found)["wz"].items() if k.startswith("wheel_angle*pa")
    ]
    assert sum(turned) > 1.5
    rates = found.model.rates(np.array([0.3, 1.0, 0.3, 1.0]))
    ahead = [1.0, 0.0, np.tan(0.3) / WHEELBASE]
    assert rates[:3] == pytest.approx(ahead, abs=0.05)
    assert found.held_out.mean_position_error_m < 0.06
    assert found.model.quality.held_out_r2["wz"] > 0.99


def test_a_skid_steer_shows_its_slip_and_may_list_state_and_command_in_any_order():
    spec = robot("skid_steer")
    recording = recorded(spec, skid_target, skid_twist)
    found = identify(recording, spec)
    rates = found.model.rates(np.array([8.0, 4.0, 0.6, 1.0]))
    assert rates[:3] == pytest.approx(skid_twist(np.array([[8.0, 4.0]]))[0], abs=0.02)
    assert found.held_out.mean_position_error_m < 0.03
    data = spec.model_dump()
    data["state"], data["command"] = data["state"][::-1], data["command"][::-1]
    values = {
        name: recording.streams[name].values[:, ::-1] for name in ("state", "command")
    }
    turned = RobotSpec.model_validate(data)
    other = terms(identify(with_values(recording, **values), turned))
    for dof, row in terms(found).items():
        assert other[dof] == pytest.approx(row, rel=1e-6)


@pytest.mark.slow
def test_a_robot_without_any_state_but_three_commands():
    spec = robot("stateless")
    recording = recorded(spec, lambda c: c, omni_twist, NOISE, latency=0.1)
    found = fit_trial(replace(recording, state=None), spec)
    assert found.model.state_size == 0
    # a lag without a state acts as a delay
    assert found.calibration.command_latency_s == pytest.approx(0.1 + LAG, abs=0.05)
    for dof, name in (("vx", "forward"), ("vy", "sideways"), ("wz", "turn")):
        assert terms(found)[dof][name] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_the_uncertainty_of_the_latency_covers_the_step_of_the_model():
    spec = robot("long_car")
    recording = recorded(spec, lambda c: c, car_twist, NOISE, latency=0.15, count=1500)
    found = fit_whole(replace(recording, state=None), spec).calibration
    sigma = found.uncertainty["command_latency_s"]
    assert abs(found.command_latency_s - 0.15) < 3.0 * sigma
    assert sigma < DT
