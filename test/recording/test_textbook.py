from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from steps import integrate

from nics_drl_bridge import geometry
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


def steady(spec, command):
    """The state that a command leads to in the end."""
    return textbook(spec).target(np.array(command))


@pytest.mark.parametrize("name", ["differential", "mecanum"])
@pytest.mark.parametrize("share", [(1.0, 0.0), (0.0, 1.0), (0.3, -0.8)])
def test_wheels_turn_so_that_the_body_moves_as_commanded(name, share):
    spec = load_robot(name)
    command = np.zeros(len(spec.command))
    command[[0, -1]] = share
    twist = textbook(spec).twist(steady(spec, command))
    assert twist == pytest.approx(spec.to_cmd_vel(command), abs=1e-12)


def test_mecanum_wheels_move_the_body_sideways():
    spec = load_robot("mecanum")
    front_left, front_right, rear_left, rear_right = steady(spec, [0.0, 0.5, 0.0])
    assert (
        -front_left
        == front_right
        == rear_left
        == -rear_right
        == pytest.approx(0.5 / 0.05)
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_the_motion_solves_the_differential_equation(name):
    spec = load_robot(name)
    book, rng = textbook(spec), np.random.default_rng(0)
    command = rng.uniform(spec.command_low, spec.command_high)
    state = rng.uniform([v.min for v in spec.state], [v.max for v in spec.state]) / 3.0

    def derivative(_, y):
        vx, vy, wz = book.twist(y[3:])
        c = np.cos(y[2])
        s = np.sin(y[2])
        rates = (book.target(command) - y[3:]) / book.lag
        return [c * vx - s * vy, s * vx + c * vy, wz, *rates]

    start = np.array([0.4, -0.2, 1.0, *state])
    solved = solve_ivp(derivative, (0.0, 0.8), start, rtol=1e-10, atol=1e-12).y[:, -1]
    pose, end = integrate(book, start[:3], state, command, 0.8)
    assert end == pytest.approx(solved[3:], rel=1e-8)
    assert pose[:2] == pytest.approx(solved[:2], abs=1e-5)
    assert geometry.wrap_angle(pose[2] - solved[2]) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("dt", [0.01, 0.025])
def test_a_recorded_drive_is_what_integration_gives_step_by_step(name, dt):
    spec = load_robot(name)
    book = textbook(spec)
    drive = record(spec, np.random.default_rng(1), duration=2.0, dt=dt)
    pose, state = integrate(
        book,
        drive.pose.values[:-1],
        drive.state.values[:-1],
        drive.command.values[:-1],
        dt,
    )
    assert np.allclose(state, drive.state.values[1:], atol=1e-9)
    assert np.abs(geometry.between(pose, drive.pose.values[1:])).max() < 1e-9


def test_a_recorded_drive_holds_commands_within_limits_and_starts_at_rest():
    spec = load_robot("mecanum")
    drive = record(spec, np.random.default_rng(2), duration=10.0, dt=0.01, hold=0.5)
    command = drive.command.values
    assert command.shape == (1000, 3)
    assert (command >= spec.command_low).all()
    assert (command <= spec.command_high).all()
    assert len(np.unique(command, axis=0)) == 20
    assert np.array_equal(
        np.flatnonzero(np.diff(command[:, 0])), np.arange(49, 999, 50)
    )
    assert not drive.state.values[0].any()
    assert not drive.pose.values[0].any()
    heading = drive.pose.values[:, 2]
    assert ((heading >= -np.pi) & (heading < np.pi)).all()


@pytest.mark.parametrize("name", ROBOTS)
def test_only_terms_of_the_structure_move_the_body(name):
    spec = load_robot(name)
    book = textbook(spec)
    states = np.random.default_rng(5).normal(size=(100, len(spec.state))) * 0.1
    twist = book.twist(states)
    for d, dof in enumerate(("vx", "vy", "wz")):
        assert (np.abs(twist[:, d]).max() > 1e-6) == bool(book.structure[dof])
