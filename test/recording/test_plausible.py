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


def turned(factor, wraps=False, turn=0.5):
    """A drive whose headings are in another unit."""
    values = pose(turn=turn)
    if wraps:
        values[:, 2] = (values[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return values * [1.0, 1.0, factor]


DEG = 180.0 / np.pi
SPINNING = np.column_stack([np.sin(T), 0.2 * np.sin(T), 0.7 * T])


@pytest.mark.parametrize(
    "values", [pose(), pose(2.0, 3.0), pose(turn=0.05), pose(turn=0.3), SPINNING]
)
def test_a_drive_in_si_is_plausible_and_so_is_a_heading_that_turns_on(values):
    assert find_implausible_pose(T, values) is None


def test_a_race_car_is_plausible():
    assert find_implausible_pose(T, pose(60.0, 0.2), radius=2.5) is None


@pytest.mark.parametrize(
    ("values", "line"),
    [
        *((turned(DEG, wraps), "heading_unit: deg") for wraps in (False, True)),
        *((turned(DEG, turn=turn), "heading_unit: deg") for turn in (0.05, 0.3)),
        *((turned(1.0 / DEG, wraps), "heading_unit: rad") for wraps in (False, True)),
        (pose() * [100.0, 100.0, 1.0], "unit: cm"),
        (pose() * [1000.0, 1000.0, 1.0], "unit: mm"),
    ],
)
def test_another_unit_is_told(values, line):
    assert find_implausible_pose(T, values).line == line


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
    assert line_of(SPINNING) == ""
