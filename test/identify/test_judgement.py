"""A model is tried on what it has not seen, beside yardsticks, and then learns that, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import NOISE, drive
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import identify, refit_model
from nics_drl_bridge.identify.judgement import HORIZONS_S
from nics_drl_bridge.identify.report import format_report
from nics_drl_bridge.robot.taylor import NamedTaylorModel

MENDED = "clock: 3 stamps ran backwards, and were left out."


@pytest.fixture(scope="module")
def found(differential):
    made = drive(differential, noise=NOISE, latency=0.05)
    return identify(replace(made, repairs=(MENDED,)), differential)


@pytest.mark.slow
def test_all_horizons_that_fit_are_judged_beside_both_yardsticks(found):
    assert tuple(at.horizon_s for at in found.judgement) == HORIZONS_S
    after_5_s = found.judgement[3]
    assert after_5_s.model.position_m == pytest.approx(
        found.held_out.mean_position_error_m
    )
    assert after_5_s.path_m == pytest.approx(found.held_out.mean_path_m)
    assert after_5_s.textbook.position_m < 0.02 * after_5_s.path_m
    assert after_5_s.kept_twist.position_m > 0.3 * after_5_s.path_m


@pytest.mark.slow
def test_the_band_holds_most_ends_and_not_by_being_wide(found):
    for at in found.judgement[:4]:
        assert at.coverage > 0.9
        assert at.band_m < 5.0 * at.model.position_m


@pytest.mark.slow
def test_the_judgement_is_kept_in_the_file_of_the_model(found):
    named = found.model.named.model_dump(exclude_none=True, exclude_defaults=True)
    read = NamedTaylorModel.model_validate(named).model()
    assert read.quality.judgement == found.judgement
    del named["quality"]["judgement"]  # a file of before
    assert NamedTaylorModel.model_validate(named).model().quality.judgement == ()


@pytest.mark.slow
def test_the_report_has_a_row_for_each_horizon_and_what_reading_mended(found):
    report = format_report("here", found)
    table = report.partition("By horizon")[2].split("\n\n")[0].splitlines()[2:]
    assert [row.split()[0] for row in table] == ["0.5", "1", "2", "5", "10"]
    assert MENDED in found.notes


@pytest.mark.slow
def test_the_model_is_of_all_data_and_the_judgement_of_its_trial(found):
    trial = found.trial
    assert len(found.samples.t) == pytest.approx(1.5 * len(trial.samples.t), rel=0.01)
    assert not np.array_equal(found.model.coefficients, trial.model.coefficients)
    assert trial.held_out is found.held_out
    assert found.model.quality is trial.model.quality
    assert any(
        "fitted to all 40.0 s once it had been judged" in note for note in found.notes
    )


@pytest.mark.slow
def test_a_refit_that_knows_the_first_part_worse_is_not_believed(found, monkeypatch):
    monkeypatch.setattr("nics_drl_bridge.identify.findings.WORSE", 0.0)
    findings = refit_model(found.drive, replace(found.findings, final=None))
    assert findings.final is None
    assert any("covers only the first 26.7 s" in note for note in findings.notes)


def test_an_exact_drive_needs_no_textbook_no_band_and_no_other_fit(differential):
    found = identify(drive(differential, duration=20.0), differential)
    assert found.judgement
    assert {(at.textbook, at.band_m) for at in found.judgement} == {(None, None)}
    assert found.trial.model is found.model


def test_a_drive_under_other_settings_stays_prepared(differential):
    one = Drive(drive(differential, duration=10.0), differential)
    twists = one.twists
    other = one.under(replace(one.settings, train_until_s=3.0))
    assert other.twists is twists
    assert (one.settings.train_until_s, other.settings.train_until_s) == (np.inf, 3.0)
