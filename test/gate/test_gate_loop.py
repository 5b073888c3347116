from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.gate.assurance.episodes import configure_gate
from nics_drl_bridge.gate.gate_loop import Gate
from nics_drl_bridge.generator import builtin_model


def test_a_gate_that_can_not_be_armed_is_refused_in_one_sentence():
    model = builtin_model("differential")
    gate = Gate(configure_gate(model, "differential"), model.lidar)
    blind = np.full(model.lidar.beams, np.nan, np.float32)
    with pytest.raises(BackendError, match="the gate can't be armed: "):
        gate.arm(blind, np.zeros(3))
