from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.excite import DrivePlan
from nics_drl_bridge.robot.spec import load_robot

CAR = load_robot("ackermann")


def test_the_drive_that_begins_is_the_one_that_was_previewed():
    plan = DrivePlan(CAR, bound=1.2, duration=20.0, seed=1)
    drive = plan.begin()
    commands = [drive.next() for _ in plan.preview().command]
    assert drive.done
    assert np.array_equal(commands, plan.preview().command)


@pytest.mark.parametrize("bound", [0.2, 0.6])
def test_a_circle_in_which_a_car_can_not_turn_is_refused(bound):
    with pytest.raises(ConfigError, match=f"bound {bound}.*too small.*more space"):
        DrivePlan(CAR, bound=bound).preview()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"bound": 0.1}, "bound 0.1: must be from 0.15 to 1000"),
        ({"bound": float("nan")}, "bound nan: must be from"),
        ({"duration": 5.0}, "duration 5: must be from 20 to 3600"),
        ({"speed": 0.0}, "speed 0: must be from 0.05 to 1"),
        ({"speed": 1.5}, "speed 1.5: must be from"),
        ({"seed": -1}, "seed -1: must be a whole number from 0"),
    ],
)
def test_a_value_out_of_range_is_named_with_its_range(changes, sentence):
    with pytest.raises(ConfigError, match=sentence):
        DrivePlan(CAR, **changes)
