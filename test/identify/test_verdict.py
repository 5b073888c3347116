"""What is told of a drive is what its driver can act on."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.excitation import Excitation
from nics_drl_bridge.identify.verdict import refuse_unexcited, unlearnt
from nics_drl_bridge.robot.spec import robot_from


@pytest.fixture(scope="module")
def throttled():
    """A car by throttle, whose state is its twist."""
    return robot_from({"kind": "ackermann_throttle", "footprint_radius": 0.2}, {})


def told(spec, *unmoved: str) -> str:
    regression = SimpleNamespace(excitation=Excitation(unmoved, (), {}), dependent=())
    return " ".join(unlearnt(SimpleNamespace(regression=regression), Calibration(), spec))


def test_a_driver_is_asked_to_move_commands_and_no_states(throttled):
    sentences = told(throttled, "vy", "wz", "steering")
    assert "no terms of vy, wz, steering, which never moved" in sentences
    assert "Drive with steering changing over the whole range" in sentences
    assert "Drive with" not in told(throttled, "vy")


def test_a_car_that_never_moves_sideways_is_not_refused(throttled, car):
    refuse_unexcited(Excitation(("vy",), (), {}), throttled)
    with pytest.raises(FitError, match="steering never moved; drive with steering changing"):
        refuse_unexcited(Excitation(("vy", "wz", "steering"), (), {}), throttled)
    with pytest.raises(FitError, match="steering never moved"):  # a sensor that is stuck
        refuse_unexcited(Excitation(("steering",), (), {}), car)
