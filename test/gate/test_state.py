from __future__ import annotations

import dataclasses

import pytest

from gate.rig import driving
from nics_drl_bridge.gate.state import Cause, EStopState, replace


def test_a_changed_record_is_what_the_standard_library_makes_of_it():
    state = driving().state
    changes = {
        "now_s": 7.0,
        "latched": Cause("rule", "topic", "detail"),
        "armed": False,
    }
    mine = replace(state, **changes)
    theirs = dataclasses.replace(state, **changes)
    assert type(mine) is type(theirs)
    assert list(vars(mine)) == [field.name for field in dataclasses.fields(state)]
    assert all(vars(mine)[name] is vars(theirs)[name] for name in vars(theirs))
    assert state.armed


def test_it_stays_frozen_and_has_no_other_fields():
    changed = replace(EStopState(), latched=True)
    assert changed == EStopState(latched=True)
    with pytest.raises(dataclasses.FrozenInstanceError):
        changed.held = True
    with pytest.raises(TypeError, match="EStopState has no"):
        replace(changed, pressed=True)
