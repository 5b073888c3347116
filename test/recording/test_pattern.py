from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.recording.excite import Pattern


@pytest.fixture
def quarter_circle():
    """A turn to the left of radius 2 m at 1 m/s, within pi seconds."""
    turn = np.tile([1.0, 0.0, 0.5], (100, 1))
    poses = [np.zeros(3)]
    for twist in turn:
        poses.append(geometry.compose(poses[-1], geometry.exp(twist * np.pi / 100)))
    return Pattern(np.pi / 100, turn[:, [0, 2]], np.array(poses), bound=3.5, footprint=0.5)


def test_it_tells_duration_path_speeds_and_space(quarter_circle):
    assert quarter_circle.duration == pytest.approx(np.pi)
    assert quarter_circle.speed == pytest.approx(np.ones(100))
    assert quarter_circle.twist[:, 2] == pytest.approx(np.full(100, 0.5))
    assert quarter_circle.box == pytest.approx(np.array([[-0.5, -0.5], [2.5, 2.5]]))
    assert quarter_circle.reach == pytest.approx(2.0 * np.sqrt(2.0) + 0.5)


def test_its_lines_hold_what_somebody_has_to_know(quarter_circle):
    drive, space, bound = quarter_circle.lines()
    assert "3 s: a path of 3.1 m, up to 1.00 m/s and 0.50 rad/s" in drive
    assert "x -0.50 to +2.50 m and y -0.50 to +2.50 m" in space
    assert "circle of 3.5 m" in bound
