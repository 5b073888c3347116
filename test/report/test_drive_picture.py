from __future__ import annotations

import pytest

from nics_drl_bridge.recording.excite import DrivePlan
from nics_drl_bridge.report.pictures import drive_picture
from nics_drl_bridge.robot.spec import load_robot


@pytest.mark.parametrize("name", ["ackermann", "mecanum"])
def test_a_drive_is_drawn(name):
    robot = load_robot(name)
    png = drive_picture(DrivePlan(robot, duration=20.0).preview(), robot)
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    assert len(png) > 10_000
