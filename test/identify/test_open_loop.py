from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import drive
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import (
    convert_to_tracked,
    differentiate_ends,
    predict,
    predict_ends,
    select_windows,
    trace_states,
)

MOUNTING = Calibration(rotation_rad=0.4, lever_arm_m=(0.1, -0.05))
STEP = 1e-6


@pytest.fixture(scope="module", params=[1.0, 0.333])
def courses(request):
    """Model, drive, windows and their course; of some a step ends within the last window."""
    spec = builtin_model("mecanum").robot
    model = builtin_model("mecanum").kinematics
    driven = Drive(drive(spec, duration=20.0), spec)
    chosen = select_windows(driven, MOUNTING, 0.0, 20.0, 1.0, 1.0)
    chosen = replace(chosen, end_t=chosen.start_t + request.param * 2.0)
    return model, driven, chosen, trace_states(model, MOUNTING, driven, chosen)


def test_a_course_ends_where_the_prediction_does(courses):
    model, driven, chosen, course = courses
    ends = convert_to_tracked(course.chosen, MOUNTING, predict_ends(course, model)[0])
    expected = predict(model, MOUNTING, driven, chosen)
    assert ends == pytest.approx(expected, abs=1e-9)


def test_the_derivatives_are_those_of_finite_differences(courses):
    model, _, _, course = courses
    model = replace(model, coefficients=model.coefficients * 1.03)
    free = model.coefficients != 0.0
    free[3:] = False
    free[1, int(np.flatnonzero(~free[1])[0])] = True  # a term that is zero may move too
    ends, moved = predict_ends(course, model, free)
    slope = differentiate_ends(course, MOUNTING, ends, moved)
    for p, (d, k) in enumerate(np.argwhere(free)):
        sides = []
        for sign in (-1.0, 1.0):
            coefficients = model.coefficients.copy()
            coefficients[d, k] += sign * STEP
            changed = replace(model, coefficients=coefficients)
            sides.append(
                convert_to_tracked(
                    course.chosen, MOUNTING, predict_ends(course, changed, free)[0]
                )
            )
        difference = sides[1] - sides[0]
        difference[:, 2] = (difference[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        assert slope[:, :, p] == pytest.approx(
            difference / (2.0 * STEP), rel=1e-3, abs=2e-3
        )
