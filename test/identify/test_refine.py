"""Refinement: what is fixed by definition, what is free, and the sentence on the result."""

from __future__ import annotations

import pytest

from identify.drives import drive, make_model
from nics_drl_bridge.identify.calibration import Calibration, Response, align
from nics_drl_bridge.identify.drive import Drive, Settings
from nics_drl_bridge.identify.fit import fit
from nics_drl_bridge.identify.refine import (
    TOO_SHORT,
    apply_definitions,
    refine_by_predictions,
    select_free_coefficients,
)

FOLLOWS = Calibration(
    responses=(
        Response("speed", "speed_command", 0.2),
        Response("steering", "steering_command", 0.1),
    )
)


def test_a_state_without_a_term_of_its_command_alone_keeps_its_other_terms_free(car):
    model = make_model(
        car,
        {
            "vx": {"speed": 0.9},
            "d_speed": {"speed": -5.0, "speed*speed_command": 2.0},
            "d_steering": {"steering": -8.0, "steering_command": 8.0},
        },
    )
    free = select_free_coefficients(model, FOLLOWS)
    assert free[3].tolist() == (model.coefficients[3] != 0.0).tolist()
    assert free[4, model.term_names.index("steering")]
    assert not free[4, model.term_names.index("steering_command")]


def test_the_range_of_a_speed_is_scaled_with_the_speed(car):
    terms = {
        "vx": {"speed": 0.5},
        "wz": {"speed*steering": 2.0},
        "d_speed": {"speed": -5.0, "speed_command": 5.0},
        "d_steering": {"steering": -8.0, "steering_command": 8.0},
    }
    model = make_model(car, terms)
    scaled, calibration = apply_definitions(model, FOLLOWS, car)
    assert calibration.responses[0].gain == 0.5
    assert scaled.low.tolist() == [-0.5, -1.0, -1.0, -1.0]
    assert scaled.high.tolist() == [0.5, 1.0, 1.0, 1.0]
    assert scaled.rates(scaled.high)[:3] == pytest.approx(model.rates(model.high)[:3])


def test_lateral_motion_is_kept_where_a_state_measures_it(car):
    terms = {"vx": {"speed": 1.0}, "vy": {"steering": 0.3}}
    kept, _ = apply_definitions(make_model(car, terms), Calibration(), car)
    assert not kept.coefficients[1].any()
    speed, steering = car.state
    slip = steering.model_copy(update={"twist": "vy", "follows": None, "unit": "m/s"})
    slides = car.model_copy(update={"state": (speed, slip)})
    kept, _ = apply_definitions(make_model(car, terms), Calibration(), slides)
    assert kept.coefficients[1].any()


@pytest.mark.parametrize("length_s", [0.8, 4.0])
def test_a_sentence_names_the_horizon_that_fits_and_what_was_refined(car, length_s):
    settings = Settings(order=1, train_until_s=length_s)
    recording = drive(car, duration=length_s + 0.2, noise=(1e-3, 1e-3))
    driven = Drive(recording, car, settings)
    calibration = Calibration(position_noise_m=1e-3)
    linear = fit(align(driven, calibration), car, order=1).model
    _, after, sentence = refine_by_predictions(linear, calibration, driven)
    assert after == calibration
    if length_s < 1.0:
        assert sentence == TOO_SHORT
    else:
        assert sentence.startswith("Coefficients were refined by the open-loop errors")
        assert "over up to 1 s: the root mean square of x, y and heading" in sentence
