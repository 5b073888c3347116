"""Recordings of others, from the drafts of their mappings to verdicts on their models."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.identify.judgement import (
    Outcome,
    Verdict,
    compare,
    select_usual_horizon,
)
from nics_drl_bridge.identify.report import conclude
from nics_drl_bridge.recording.mapping import DriveMapping
from nics_drl_bridge.recording.mapping_draft import propose_mapping
from nics_drl_bridge.recording.readers import open_drive, open_source
from nics_drl_bridge.recording.survey import inspect_tables


@cache
def identify_by_draft(path: Path) -> Identified:
    """Fits a model to a recording, mapped by its draft as it is."""
    with open_source(path) as source:
        text = propose_mapping(inspect_tables(source)).text
    mapping = DriveMapping.model_validate(parse_yaml(text, "draft"))
    spec, recording = open_drive(path, None, mapping)
    return identify(recording, spec, order="auto", alpha="auto")


def test_the_validation_drive_of_a_car_is_predicted_to_eight_per_cent(
    shared_recordings,
):
    path = shared_recordings / "jetracer_dart" / "long_prediction_69s.csv"
    (at,) = select_usual_horizon(identify_by_draft(path).judgement)
    assert at.horizon_s == 5.0
    assert at.model.position_m <= 0.08 * at.path_m


def test_the_gap_of_a_drive_on_slippery_floors_is_named_and_limits_the_verdict(
    shared_recordings,
):
    conclusion = conclude(
        identify_by_draft(shared_recordings / "f110_frictionmaps" / "DS2")
    )
    assert conclusion.verdict is not Verdict.GOOD
    assert "gap of 27.8 s" in " ".join(conclusion.lines)
    assert "across which it moves 9.58 m" in " ".join(conclusion.lines)
    assert any("The pose is missing for" in doubt for doubt in conclusion.doubts)


@pytest.mark.campaign
def test_a_plain_drive_is_predicted_no_worse_than_by_its_textbook(shared_recordings):
    found = identify_by_draft(shared_recordings / "f110_frictionmaps" / "DS5")
    (at,) = select_usual_horizon(found.judgement)
    outcome = compare(at.model, at.textbook, at.textbook_noise_m, at.path_m)
    assert outcome is not Outcome.WORSE
