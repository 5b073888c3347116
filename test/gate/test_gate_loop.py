from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.gate.assurance.episodes import configure_gate
from nics_drl_bridge.gate.gate_loop import Gate
from nics_drl_bridge.gate.inputs import Press
from nics_drl_bridge.generator import builtin_model


def test_a_gate_that_can_not_be_armed_is_refused_in_one_sentence():
    model = builtin_model("differential")
    gate = Gate(configure_gate(model, "differential"), model.lidar)
    blind = np.full(model.lidar.beams, np.nan, np.float32)
    with pytest.raises(BackendError, match="the gate can't be armed: "):
        gate.arm(blind, np.zeros(3))


def test_a_latched_stop_is_reset_before_the_gate_is_armed():
    model = builtin_model("differential")
    gate = Gate(configure_gate(model, "differential"), model.lidar)
    free = np.full(model.lidar.beams, model.lidar.range_max, np.float32)
    gate.arm(free, np.zeros(3))
    gate.give(Press())
    gate.arm(free, np.zeros(3))
    assert gate.state.armed
