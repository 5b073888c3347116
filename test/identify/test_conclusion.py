from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.identify.drive import Gap, Mistake
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.identify.judgement import Verdict
from nics_drl_bridge.identify.report import (
    UNTRIED,
    accuracy,
    conclude,
    format_opening,
    format_report,
)
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import build_robot, load_robot
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors

CAR = load_robot("ackermann")


@pytest.fixture(scope="module")
def found():
    return identify(record(CAR, np.random.default_rng(0), 30.0), CAR)


def judged(found, position, path=2.0):
    ends = EndErrors(position, 0.1), EndErrors(1.0, 0.1), EndErrors(0.5, 0.1)
    at = HorizonErrors(5.0, 9, path, ends[0], ends[1], ends[2])
    return replace(found, findings=replace(found.findings, judgement=(at,)))


@pytest.mark.parametrize(
    ("position", "path", "text"),
    [
        (
            0.0228,
            2.0,
            "end 0.0228 m off after 5 s (1.1 % of the path); a fitted textbook 25.0 %",
        ),
        (1e-5, 2.0, "(< 0.1 % of the path)"),
        (
            0.02,
            0.0,
            "end 0.02 m off after 5 s; a fitted textbook 0.5 m, constant twist 1 m.",
        ),
        (math.inf, 2.0, "the predictions diverge within 5 s."),
        (math.nan, 2.0, "the predictions diverge within 5 s."),
    ],
)
def test_the_accuracy_is_a_share_of_the_path_beside_those_of_the_yardsticks(
    found, position, path, text
):
    assert text in accuracy(judged(found, position, path))


def test_a_model_that_was_not_tried_says_so(found):
    untried = replace(found, findings=replace(found.findings, judgement=()))
    assert accuracy(untried) == UNTRIED
    assert "generate again" in conclude(untried).advice


def test_a_model_that_is_beaten_is_not_to_be_trained_with(found):
    assert conclude(found).doubts == ()
    beaten = conclude(judged(found, 2.0))
    assert any("does not beat" in doubt for doubt in beaten.doubts)
    assert beaten.verdict is Verdict.DO_NOT_TRAIN
    assert "longer than these 30 s" in beaten.advice


def test_the_report_opens_with_the_conclusion_and_the_model(found):
    report = format_report("here", found)
    first = format_opening("here", found)
    assert report.startswith(first)
    assert conclude(found).advice in " ".join(first.split())
    assert "Verdict: good. On unseen data" in first.split("\n\n")[0]
    assert "d_speed = " in first
    assert len(first.splitlines()) < 20 < len(report.splitlines())


def test_gaps_are_those_notes_that_tell_what_the_drive_could_not_teach(found):
    assert conclude(found).gaps == ()
    gap = "turn_command never moved."
    told = conclude(replace(found, notes=("Poses arrive in bursts.", Gap(gap))))
    assert told.gaps == (gap,)
    assert "first fix the points above" in told.advice
    assert type(told.gaps[0]) is str  # a file takes no other


def test_a_mistake_of_the_mapping_is_told_first_and_to_be_mended_before_a_training(
    found,
):
    assert conclude(found).ready
    mistake = "The commands ask for 57.3 times the turn_command that was driven."
    told = conclude(replace(judged(found, 2.0), notes=(Mistake(mistake),)))
    assert told.doubts[0] == mistake
    assert type(told.doubts[0]) is str  # a file takes no other
    assert told.advice.startswith(
        "Next: fix the mapping as described above, or the robot"
    )
    assert not told.ready


@pytest.mark.parametrize("kind", ["ackermann", "skid_steer"])
def test_a_robot_that_moves_ahead_alone_is_not_to_be_driven_aside(kind):
    spec = build_robot({"kind": kind, "footprint_radius": 0.25})
    found = identify(record(spec, np.random.default_rng(0), 30.0), spec)
    assert "vy" in found.fit.unmoved
    told = conclude(found)
    assert not any("vy" in gap for gap in told.gaps)
    assert told.ready
