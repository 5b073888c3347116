"""What is told of a drive is what its driver can act on."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from identify.drives import drive
from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.clocks import measure_timing
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import (
    describe_clocks,
    describe_mounting,
    describe_unlearnt,
    refuse_unexcited,
)
from nics_drl_bridge.identify.fit import Excitation
from nics_drl_bridge.identify.mounting import Mounting
from nics_drl_bridge.robot.spec import build_robot


@pytest.fixture(scope="module")
def throttled():
    """A car by throttle, whose state is its twist."""
    return build_robot({"kind": "ackermann_throttle", "footprint_radius": 0.2}, {})


def told(spec, *unmoved: str) -> str:
    regression = SimpleNamespace(excitation=Excitation(unmoved, ()), dependent=())
    return " ".join(
        describe_unlearnt(
            SimpleNamespace(regression=regression), Calibration(), spec, {}
        )
    )


def test_a_driver_is_asked_to_move_commands_and_no_states(throttled):
    sentences = told(throttled, "vy", "wz", "steering")
    assert "no terms of wz, steering, which never moved" in sentences
    assert "Drive with steering changing over the whole range" in sentences
    assert "Drive with" not in told(throttled, "wz")


def test_only_a_robot_that_moves_sideways_is_told_that_it_never_did(throttled):
    assert told(throttled, "vy") == ""
    aside = build_robot({"kind": "omnidirectional", "footprint_radius": 0.2})
    assert "no terms of body_vy, which" in told(aside, "body_vy")


def test_a_car_that_never_moves_sideways_is_not_refused(throttled, car):
    refuse_unexcited(Excitation(("vy",), ()), throttled)
    with pytest.raises(
        FitError, match="steering never moved; drive with steering changing"
    ):
        refuse_unexcited(Excitation(("vy", "wz", "steering"), ()), throttled)
    with pytest.raises(
        FitError, match="steering never moved"
    ):  # a sensor that is stuck
        refuse_unexcited(Excitation(("steering",), ()), car)


def of_mounting(spec, sigma: tuple[float, float], **learnt: float) -> str:
    mounting = Mounting(0.0, np.array([0.1, 0.0]), 0.001, np.array(sigma), 2)
    calibration = Calibration(lever_arm_m=(0.1, 0.0), uncertainty=learnt)
    return " ".join(
        describe_mounting(SimpleNamespace(spec=spec), calibration, mounting)
    )


def test_a_lever_arm_that_was_not_learnt_has_one_reason(throttled):
    unknown = Mounting(0.0, np.zeros(2), 0.001, np.array([0.001, np.nan]), 2)
    assert unknown.hidden == ("", "no speed was known apart from the tracked one")
    sentence = of_mounting(throttled, (0.001, np.nan), lever_arm_x_m=0.001)
    assert "along y could not be learnt, since no speed was known apart" in sentence
    sentence = of_mounting(throttled, (np.nan, np.nan))
    assert "since noise hides it" in sentence
    assert "along y" not in sentence


def test_a_lever_arm_that_predictions_told_is_learnt(throttled):
    learnt = {"lever_arm_x_m": 0.001, "lever_arm_y_m": 0.002}
    assert "could not be learnt" not in of_mounting(
        throttled, (0.001, np.nan), **learnt
    )


@pytest.mark.parametrize(
    ("sigma", "told"), [(0.0343, False), (0.0001, False), (0.00005, True)]
)
def test_a_latency_below_three_standard_errors_is_not_told(car, sigma, told):
    tried = Drive(drive(car, duration=10.0), car)
    calibration = Calibration(
        command_latency_s=0.0003, uncertainty={"command_latency_s": sigma}
    )
    sentences = " ".join(describe_clocks(tried, calibration, measure_timing(tried)))
    assert ("Commands take effect 0.0003 s" in sentences) == told
