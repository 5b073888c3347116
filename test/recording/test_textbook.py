import numpy as np
import pytest
from scipy.integrate import solve_ivp

from nics_drl_bridge import geometry
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


def test_mecanum_wheels_move_the_body_sideways():
    spec = load_robot("mecanum")
    wheels = textbook(spec).target(np.array([0.0, 0.5, 0.0]))
    front_left, front_right, rear_left, rear_right = wheels
    assert (
        -front_left
        == front_right
        == rear_left
        == -rear_right
        == pytest.approx(0.5 / 0.05)
    )


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("dt", [0.01, 0.025])
def test_a_recorded_drive_solves_the_differential_equation(name, dt):
    spec = load_robot(name)
    book = textbook(spec)
    drive = record(spec, np.random.default_rng(1), duration=1.0, dt=dt)
    rows = np.concatenate([drive.pose.values, drive.state.values], axis=1)
    row = round(0.5 / dt)  # at which the command changes
    command = drive.command.values[row]

    def derivative(_, y):
        vx, vy, wz = book.twist(y[3:])
        c = np.cos(y[2])
        s = np.sin(y[2])
        rates = (book.target(command) - y[3:]) / book.lag
        return [c * vx - s * vy, s * vx + c * vy, wz, *rates]

    span = (0.0, 0.5 - dt)
    solved = solve_ivp(derivative, span, rows[row], rtol=1e-10, atol=1e-12).y[:, -1]
    off = rows[-1] - solved
    off[2] = geometry.wrap_angle(off[2])
    assert np.abs(off).max() < 1e-8


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
