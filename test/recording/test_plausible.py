from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.recording.recording import (
    find_clockwise_keys,
    find_implausible_pose,
    select_along_path,
)

T = np.arange(3000) * 0.02


def pose(speed=0.6, turn=0.5):
    """A drive that speeds up and slows down, and turns both ways."""
    v = speed * (1.0 + 0.5 * np.sin(T))
    w = turn * np.sin(0.3 * T) + 0.2 * turn
    heading = np.cumsum(w) * 0.02
    step = v[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1) * 0.02
    return np.column_stack([np.cumsum(step, axis=0), heading])


def wrapped(values):
    return (values + np.pi) % (2.0 * np.pi) - np.pi


def test_a_drive_in_si_is_plausible_and_so_is_a_heading_that_turns_on():
    assert find_implausible_pose(T, pose()) is None
    assert find_implausible_pose(T, pose(2.0, 3.0)) is None
    assert find_implausible_pose(T, pose(60.0, 0.2), radius=2.5) is None  # a race car


@pytest.mark.parametrize("unwrapped", [True, False])
def test_degrees_are_told(unwrapped):
    values = pose()
    values[:, 2] = np.degrees(values[:, 2] if unwrapped else wrapped(values[:, 2]))
    assert find_implausible_pose(T, values).line == "heading_unit: deg"


@pytest.mark.parametrize("turn", [0.05, 0.3])
def test_degrees_of_a_slow_turn_are_told_by_the_path(turn):
    values = pose(turn=turn)
    assert find_implausible_pose(T, values) is None
    values[:, 2] = np.degrees(values[:, 2])
    assert find_implausible_pose(T, values).line == "heading_unit: deg"


@pytest.mark.parametrize("unwrapped", [True, False])
def test_radians_that_are_taken_as_degrees_are_told(unwrapped):
    values = pose()
    values[:, 2] = np.radians(values[:, 2] if unwrapped else wrapped(values[:, 2]))
    assert find_implausible_pose(T, values).line == "heading_unit: rad"


def test_a_robot_that_spins_on_a_line_has_no_heading_in_degrees():
    values = np.column_stack([np.sin(T), 0.2 * np.sin(T), 0.7 * T])
    assert find_implausible_pose(T, values) is None


@pytest.mark.parametrize(
    ("factor", "line"), [(100.0, "unit: cm"), (1000.0, "unit: mm")]
)
def test_positions_that_are_no_metres_are_told(factor, line):
    assert find_implausible_pose(T, pose() * [factor, factor, 1.0]).line == line


def test_milliseconds_are_told():
    assert (
        "(microseconds look like this)" in find_implausible_pose(T * 1e6, pose()).cause
    )
    assert find_implausible_pose(T * 1e3, pose()).line == "time: {from: ..., unit: ms}"


def line_of(values, size=0.05):
    return find_clockwise_keys(values[select_along_path(values, size)])


@pytest.mark.parametrize(("speed", "turn"), [(0.6, 0.5), (20.0, 0.2)])
def test_the_heading_of_a_compass_is_told_with_what_turns_it_round(speed, turn):
    """A race car's course is steady to 0.7 even as seen from the wrong heading."""
    values = pose(speed, turn)
    assert line_of(values) == ""
    assert line_of(values * [1.0, 1.0, -1.0]) == "scale: -1"
    assert (
        line_of(values * [1.0, 1.0, -1.0] + [0.0, 0.0, np.pi / 2])
        == "scale: -1, offset: 1.5708"
    )


def test_a_straight_drive_or_a_robot_that_only_spins_does_not_show_a_compass():
    straight = pose(turn=0.02) * [1.0, 1.0, -1.0]
    assert line_of(straight) == ""
    assert line_of(np.column_stack([np.sin(T), 0.2 * np.sin(T), 0.7 * T])) == ""
