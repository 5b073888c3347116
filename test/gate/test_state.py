from __future__ import annotations

import dataclasses

import pytest

from nics_drl_bridge.gate.state import EStopState, replace


def test_it_stays_frozen_and_has_no_other_fields():
    changed = replace(EStopState(), latched=True)
    assert changed == EStopState(latched=True)
    with pytest.raises(dataclasses.FrozenInstanceError):
        changed.held = True
    with pytest.raises(TypeError, match="EStopState has no"):
        replace(changed, pressed=True)
