"""Further sensors in the gate: as fresh as the scan, and what they show stops the robot."""

from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.gate.inputs import SensorReading

from .rig import Rig, config
from .test_shield import CAR, FAR


class Backed(Rig):
    """A car that drives back, with a sensor there."""

    def __init__(self, wish=(-0.3, 0.0, 0.0), behind=10.0):
        super().__init__(config(shield=CAR, frozen_distance=1e9, sensors=("rear",)))
        self.ranges = FAR.copy()
        self.frozen = True
        self.wish = np.array(wish)
        self.behind = behind

    def send(self, without: str = ""):
        super().send(without)
        if "rear" not in without:
            self.give(
                SensorReading(self.stamp, "rear", np.array([[-self.behind, 0.0]]))
            )


def test_it_has_to_be_fresh_before_the_gate_is_armed():
    rig = Backed()
    rig.run(1.5, without="rear")
    assert not rig.arm().granted
    assert "sensors_fresh: rear has not been fresh" in rig.decision.answer
    rig.settle()


def test_what_it_shows_behind_keeps_the_robot_from_backing_into_it():
    free = Backed(wish=(0.5, 0.0, 0.0))
    blocked = Backed(wish=(0.5, 0.0, 0.0), behind=-0.6)  # where the lidar sees nothing
    for rig in (free, blocked):
        rig.run(1.5)
        assert rig.arm().granted
        rig.run(0.5)
    assert free.decision.twist[0] > 0.2
    assert blocked.decision.twist[0] < free.decision.twist[0]
    assert blocked.decision.shielded


@pytest.mark.parametrize(
    ("name", "points", "reason"),
    [
        ("front", [[1.0, 0.0]], "no such sensor"),
        ("rear", [[np.nan, 0.0]], "NaN or inf"),
    ],
)
def test_what_is_malformed_is_refused(name, points, reason):
    rig = Backed()
    rig.run(0.2)
    assert (
        reason in rig.give(SensorReading(rig.stamp + 1, name, np.array(points))).refused
    )


def test_its_jump_in_time_latches():
    rig = Backed(wish=(0.5, 0.0, 0.0)).drive()
    rig.give(SensorReading(rig.stamp - 10**10, "rear", np.zeros((0, 2))))
    assert (rig.rule, rig.decision.cause.topic) == ("stamps_jumped", "rear")
    assert rig.state.latched is not None
