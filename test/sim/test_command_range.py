from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.sim.simulator import CommandRange, OutsideValidityWarning


@pytest.fixture
def model():
    spec = load_robot("ackermann")
    return TaylorModel(
        spec.variable_names,
        spec.dof_names,
        spec.dof_units,
        np.eye(4, dtype=np.int64),
        np.zeros((5, 4)),
        0.01,
        np.array([0.0, -0.4, 0.1, -0.4]),
        np.array([1.0, -0.4, 0.8, -0.4]),
    )


def range_of(model):
    return CommandRange(model, load_robot("ackermann"))


def test_commands_of_the_drive_do_not_warn(model):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        range_of(model).check(np.array([[[0.1, -0.4]], [[0.84, -0.36]]]))


def test_what_was_assumed_does_not_warn(model):
    assumed = replace(model, assumed=(("d_steering", "steering_command"),))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        range_of(assumed).check(np.array([[[0.5, 0.5]]]))
    with pytest.warns(
        OutsideValidityWarning, match=r"steering_command is 0.5, .* -0.4 to"
    ):
        range_of(model).check(np.array([[[0.5, 0.5]]]))
