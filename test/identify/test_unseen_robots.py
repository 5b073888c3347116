"""Robots that the package does not ship: a recording and a YAML file are all it gets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

ROBOTS = Path(__file__).resolve().parent / "robots"
DT = 0.02
FINE = 20
HOLD = 25
LAG = 0.15
WHEELBASE = 0.55
RADIUS = 0.1
TRACK = 0.4
SLIP = 1.6


def robot(name: str) -> RobotSpec:
    return load_robot(str(ROBOTS / f"{name}.yaml"))


def recorded(spec, target, twist, noise=(0.0, 0.0), latency=0.0, seconds=60.0, seed=0):
    """A drive of a robot whose state follows `target(command)` and that moves by `twist(state)`."""
    rng = np.random.default_rng(seed)
    count = int(seconds / DT)
    held = rng.uniform(
        spec.command_low, spec.command_high, (count // HOLD, len(spec.command))
    )
    commands = np.repeat(held, HOLD, axis=0)
    decay = np.exp(-np.arange(FINE)[:, None] * DT / FINE / LAG)
    state = np.zeros(target(commands[:1]).shape[1])
    states = []
    for goal in target(commands):
        states.append(goal + (state - goal) * decay)
        state = goal + (state - goal) * np.exp(-DT / LAG)
    moved = geometry.exp(twist(np.concatenate(states)) * DT / FINE)
    heading = np.cumsum(moved[:, 2]) - moved[:, 2]
    path = np.cumsum(geometry.rotate(moved[:, :2], heading), axis=0)
    poses = np.concatenate(
        [path - geometry.rotate(moved[:, :2], heading), heading[:, None]], 1
    )
    poses = poses[::FINE] + rng.normal(size=(count, 3)) * [noise[0], *noise]
    t = np.arange(count) * DT
    return Recording(
        Stream(t - latency, commands),
        Stream(t, poses),
        Stream(t, np.array(states)[:, 0]),
    )


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


@pytest.mark.parametrize("noise", [(0.0, 0.0), (5e-4, 1e-3)])
def test_a_car_of_another_wheelbase_with_its_steering_first(noise):
    spec = robot("long_car")
    found = identify(recorded(spec, lambda c: c, car_twist, noise), spec)
    assert (
        sum(v for k, v in terms(found)["wz"].items() if k.startswith("wheel_angle*pa"))
        > 1.5
    )
    x = np.array([0.3, 1.0, 0.3, 1.0])
    assert found.model.rates(x)[:3] == pytest.approx(
        [1.0, 0.0, np.tan(0.3) / WHEELBASE], abs=0.05
    )
    assert found.held_out.mean_position_error_m < 0.06
    assert found.model.quality.held_out_r2["wz"] > 0.99


@pytest.mark.slow
def test_the_same_car_without_its_state_measured():
    spec = robot("long_car")
    recording = recorded(spec, lambda c: c, car_twist, (5e-4, 1e-3), latency=0.06)
    found = identify(replace(recording, state=None), spec)
    assert found.calibration.command_latency_s == pytest.approx(0.06, abs=0.01)
    assert [r.lag_s for r in found.calibration.responses] == pytest.approx(
        [LAG, LAG], abs=0.02
    )
    assert terms(found)["wz"]["wheel_angle*pace"] == pytest.approx(
        1.0 / WHEELBASE, rel=0.08
    )
    assert found.held_out.mean_position_error_m < 0.06


@pytest.mark.parametrize("noise", [(0.0, 0.0), (5e-4, 1e-3)])
def test_a_skid_steer_shows_its_slip(noise):
    spec = robot("skid_steer")
    found = identify(recorded(spec, skid_target, skid_twist, noise), spec)
    x = np.array([8.0, 4.0, *np.array([[0.6, 1.0]])[0]])
    assert found.model.rates(x)[:3] == pytest.approx(
        skid_twist(x[None, :2])[0], abs=0.02
    )
    assert found.held_out.mean_position_error_m < 0.03


@pytest.mark.slow
def test_a_robot_without_any_state_but_three_commands():
    spec = robot("stateless")
    recording = recorded(spec, lambda c: c, omni_twist, (5e-4, 1e-3))
    found = identify(replace(recording, state=None), spec)
    assert found.model.state_size == 0
    for dof, name in (("vx", "forward"), ("vy", "sideways"), ("wz", "turn")):
        assert terms(found)[dof][name] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("latency", [0.0, 0.15])
def test_the_latency_of_a_robot_without_state_is_exact(latency):
    spec = robot("stateless")
    rng = np.random.default_rng(3)
    t = np.arange(3000) * DT
    command = rng.uniform(
        spec.command_low, spec.command_high, (3000 // HOLD, len(spec.command))
    )
    command = np.repeat(command, HOLD, axis=0)
    steps = geometry.exp(omni_twist(command) * DT)
    pose = np.zeros((len(t), 3))
    for k, step in enumerate(steps[:-1]):
        pose[k + 1] = geometry.compose(pose[k], step)
    found = identify(Recording(Stream(t - latency, command), Stream(t, pose)), spec)
    assert found.calibration.command_latency_s == pytest.approx(latency, abs=1e-6)
    assert found.held_out.mean_position_error_m < 1e-6


@pytest.mark.slow
def test_the_uncertainty_of_the_latency_covers_the_step_of_the_model():
    spec = robot("long_car")
    recording = recorded(spec, lambda c: c, car_twist, (5e-4, 1e-3), latency=0.15)
    for wheels in (None, Stream(recording.state.t, recording.state.values[:, [1, 1]])):
        pose = (
            recording.pose if wheels is None else replace(recording.pose, clock="mocap")
        )
        drive = replace(recording, state=None, wheels=wheels, pose=pose)
        found = identify(drive, spec).calibration
        sigma = found.uncertainty["command_latency_s"]
        assert abs(found.command_latency_s - 0.15) < 3.0 * sigma
        assert sigma < DT


def test_the_order_of_state_and_command_is_that_of_the_file():
    spec = robot("skid_steer")
    data = spec.model_dump()
    data["state"], data["command"] = data["state"][::-1], data["command"][::-1]
    turned = RobotSpec.model_validate(data)
    recording = recorded(spec, skid_target, skid_twist)
    other = replace(
        recording,
        state=replace(recording.state, values=recording.state.values[:, ::-1]),
        command=replace(recording.command, values=recording.command.values[:, ::-1]),
    )
    a = terms(identify(recording, spec))
    b = terms(identify(other, turned))
    for dof in a:
        assert b[dof] == pytest.approx(a[dof], rel=1e-6)
