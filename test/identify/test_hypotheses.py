"""Which textbook, with which effects and which more terms, predicts what its fit did not see."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from identify.drives import (
    drive,
    fit_trial,
    fit_whole,
    make_model,
    slipping_car,
    throttle_car,
)
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import resample_drive
from nics_drl_bridge.identify.forms import Evidence, Form
from nics_drl_bridge.identify.hypotheses import (
    Draft,
    Trial,
    choose_trial,
    describe_lag_sums,
    find_lags,
    fit_base,
    list_candidates,
    list_hypotheses,
)
from nics_drl_bridge.identify.identify import (
    STAGES,
    fit_terms,
    identify,
    make_library,
    run,
)
from nics_drl_bridge.identify.report import format_report
from nics_drl_bridge.identify.shooting import Parameters, Shooting
from nics_drl_bridge.identify.terms import Kind, Library

MOTION = Library(throttle_car(), Kind.MOTION, True, 1.0, 3)


@pytest.mark.slow
def test_a_car_without_drag_and_friction_is_given_none():
    spec, recording = slipping_car(3, 30.0, dead=0.0, friction=0.0, drag=0.0)
    found = run(STAGES[: STAGES.index(fit_terms)], Drive(recording, spec))
    samples = resample_drive(found.training, found)
    library = make_library(found.whole, found)
    evidence = Evidence(found.training, found.calibration, samples, library)
    base = fit_base(evidence, found.clear_curves)
    values = base.found.named
    assert values.get("throttle.dead", 0.0) < 0.01
    assert values.get("vx.friction", 0.0) < 0.05
    assert values.get("vx.drag", 0.0) < 0.02
    assert base.draft.form.limits == ()


@pytest.mark.slow
def test_a_car_that_slips_shows_its_effects_is_predicted_and_its_lever_is_not_bent():
    spec, recording = slipping_car(seed=5, duration=60.0)
    found = fit_trial(recording, spec, alpha=0.9)
    assert any(note.startswith("alpha = 0.9 was not used: ") for note in found.notes)
    assert found.held_out is not None
    assert found.held_out.mean_position_error_m < 0.03 * found.held_out.mean_path_m
    sigma = found.calibration.uncertainty
    assert abs(found.calibration.lever_arm_m[0] - 0.08) < 3.0 * sigma["lever_arm_x_m"]
    assert abs(found.calibration.rotation_rad + 0.1) < 3.0 * sigma["rotation_rad"]
    assert "command_latency_s" not in sigma
    form = found.findings.base.draft.form
    values = found.findings.base.found.named
    assert form.tyres
    assert form.drag == form.friction == ("vx",)
    assert values["throttle.dead"] == pytest.approx(0.1, abs=0.01)
    assert values["vx.friction"] == pytest.approx(0.3, abs=0.1)
    assert 0.0 < sigma["throttle.dead"] < 0.02
    assert any(
        "The model is the textbook with an input curve of throttle" in n
        for n in found.notes
    )
    assert any("can't be separated from the lags" in note for note in found.notes)
    candidates = list(list_candidates(found.findings.base, found.findings.trials))
    kept = [candidate.name for candidate in candidates if candidate.kept]
    assert kept[0].startswith("textbook")
    assert "tyres that slip" in kept
    errors = [candidate.error for candidate in candidates if candidate.kept]
    assert errors[-1] < 0.5 * errors[0]
    report = format_report("here", found)
    assert f"  tyres that slip{' ' * 21}" in report


def trial(order, error):
    return Trial(order, 0.0, error, {5.0: np.array([error])})


def test_a_higher_order_has_to_be_worth_its_terms():
    assert choose_trial([trial(0, 0.10), trial(1, 0.096), trial(2, 0.12)]).order == 0
    assert choose_trial([trial(0, 0.10), trial(1, 0.09), trial(2, 0.0857)]).order == 1


def test_hypotheses_go_from_the_textbook_to_the_freest():
    orders = [order for order, _ in list_hypotheses("auto", MOTION)]
    assert orders == sorted([0, *3 * [1, 2, 3]])
    assert {order for order, _ in list_hypotheses(2, MOTION)} == {0, 2}


def test_no_weaker_pull_is_tried_of_an_order_that_got_worse_by_the_last(monkeypatch):
    errors = {(0, 0.0): 0.1, (1, 0.1): 0.1, (1, 0.01): 0.103}
    errors |= {(2, 0.1): 0.1, (2, 0.01): 0.101, (2, 0.001): 0.08}

    def tried(draft, order, pull, folds):
        return replace(trial(order, errors[order, pull]), pull=pull)

    monkeypatch.setattr(Draft, "list_folds", lambda draft, orders: iter(()))
    monkeypatch.setattr(Draft, "try_hypothesis", tried)
    nothing = Parameters((), *np.zeros((4, 0)))
    draft = Draft(MOTION, Form(), Shooting(None, nothing, None, None, None))
    asked = (*errors, (1, 0.001))
    asked = tuple(sorted(asked, key=lambda each: (each[0], -each[1])))
    trials = draft.cross_validate(asked)
    assert [(each.order, each.pull) for each in trials] == list(errors)


def test_a_latency_is_told_as_its_sums_with_the_lags():
    sentence = describe_lag_sums(0.02, {"vx": 0.2, "wz": 0.1}, beside=0.05)
    assert sentence.startswith("Latency (0.020 s) can't be separated")
    assert "trust their sums, 0.250 s for vx, 0.150 s for wz" in sentence


def test_a_lag_is_what_the_state_itself_takes_from_its_rate():
    spec = throttle_car()
    states = {f"d_{name}": {name: -4.0} for name in ("vx", "vy", "wz")}
    model = make_model(spec, states)
    assert find_lags(model, spec) == {"vx": 0.25, "vy": 0.25, "wz": 0.25}
    rolling = replace(model, coefficients=0.01 * model.coefficients)
    assert find_lags(rolling, spec) == {}


@pytest.mark.slow
def test_a_drive_too_short_for_predictions_over_seconds_gets_the_textbook_in_silence():
    spec, recording = slipping_car(duration=8.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fit_trial(recording, spec, alpha="auto")
    assert choose_trial(found.findings.trials).order == 0


@pytest.mark.slow
def test_no_state_grows_by_itself_however_little_it_moved():
    spec, recording = slipping_car(duration=12.0)
    model = fit_whole(recording, spec, alpha="auto").model
    alone = model.powers.sum(axis=1) == 1
    for i, _ in enumerate(spec.state):
        assert (
            model.coefficients[3 + i, alone & (model.powers[:, i] == 1)] <= 0.0
        ).all()


def test_a_drive_whose_parts_are_too_short_to_be_left_out_is_still_fitted(mecanum):
    recording = drive(mecanum, duration=3.0, noise=(0.001, 0.002))
    found = identify(recording, mecanum)
    assert np.isnan([trial.error for trial in found.findings.trials]).all()
    assert found.held_out is None
