from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import drive
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import (
    predict,
    predict_along_states,
    select_windows,
)

MOUNTING = Calibration(rotation_rad=0.4, lever_arm_m=(0.1, -0.05))


@pytest.fixture(scope="module", params=[1.0, 0.333])
def windows(request):
    """Model, drive and windows; of some a step ends within the last window."""
    spec = builtin_model("mecanum").robot
    model = builtin_model("mecanum").kinematics
    driven = Drive(drive(spec, duration=20.0), spec)
    chosen = select_windows(driven, MOUNTING, 0.0, 20.0, 1.0, 1.0)
    chosen = replace(chosen, end_t=chosen.start_t + request.param * 2.0)
    return model, driven, chosen


def test_predictions_along_exact_states_end_where_those_from_the_start_do(windows):
    model, driven, chosen = windows
    ends = predict(model, MOUNTING, driven, chosen)[:-1]  # no state follows the last
    along = predict_along_states(model, MOUNTING, driven, chosen)[:-1]
    assert along == pytest.approx(ends, abs=1e-6)


def test_predictions_along_states_are_not_bent_by_what_the_model_gets_wrong(windows):
    model, driven, chosen = windows
    coefficients = model.coefficients.copy()
    coefficients[3:] *= 0.5
    wrong = replace(model, coefficients=coefficients)
    along = predict_along_states(wrong, MOUNTING, driven, chosen)
    right = predict_along_states(model, MOUNTING, driven, chosen)
    assert along == pytest.approx(right, abs=1e-12)
    assert np.abs(predict(wrong, MOUNTING, driven, chosen) - right).max() > 0.01
