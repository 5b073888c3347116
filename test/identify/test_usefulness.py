from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from identify.drives import drive, fit_trial, with_values
from nics_drl_bridge.identify import judgement
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import describe_coarsest_state
from nics_drl_bridge.identify.identify import identify, prefer_textbook
from nics_drl_bridge.identify.open_loop import measure_open_loop_error
from nics_drl_bridge.identify.report import explain_uselessness, is_useless
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import RobotSpec

TOO_COARSE = "between rows that are 0.3 s apart, so record at a higher rate."


def coarse(spec: RobotSpec, every: int, duration: float = 60.0) -> Recording:
    """A drive of which one pose and state in so many, 10 ms apart, is recorded."""
    fine = record(spec, np.random.default_rng(0), duration, dt=0.01)
    pose, state = (
        replace(stream, t=stream.t[::every], values=stream.values[::every])
        for stream in (fine.pose, fine.state)
    )
    return replace(
        fine,
        command=replace(fine.command, t=fine.command.t + 0.003),
        pose=pose,
        state=state,
    )


def verdict_on(recording: Recording, spec: RobotSpec) -> str:
    return explain_uselessness(identify(recording, spec, alpha="auto"))


@pytest.mark.parametrize(
    ("error", "standing", "path", "radius", "useless"),
    [
        (0.99, 2.0, 2.5, 0.2, False),  # half of 2 m is left
        (1.01, 2.0, 2.5, 0.2, True),
        (0.9, 0.1, 4.0, 0.2, False),  # in circles: a quarter of the path is 1 m
        (1.1, 0.1, 4.0, 0.2, True),
        (0.19, 0.0, 0.0, 0.2, False),  # on the spot
        (0.21, 0.0, 0.0, 0.2, True),
        (float("nan"), 2.0, 2.5, 0.2, True),
    ],
)
def test_a_model_is_useless_if_standing_still_is_hardly_worse(
    error, standing, path, radius, useless
):
    assert is_useless(error, standing, path, radius) == useless


def test_standing_still_is_off_by_the_way_from_start_to_end(car):
    recording = drive(car, duration=20.0)
    along = 0.2 * recording.pose.t
    straight = np.stack([3.0 + 0.6 * along, 0.8 * along, 0.0 * along], axis=1)
    found = identify(recording, car)
    moved = Drive(with_values(recording, pose=straight), car)
    result = measure_open_loop_error(found.model, found.calibration, moved, 0.0, 20.0)
    assert result.median_displacement_m == pytest.approx(1.0)
    assert result.mean_path_m == pytest.approx(1.0)


@pytest.fixture(scope="module")
def useless(car):
    """A fit to a coarse drive, whose textbook, which is much better, did not take its place."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        patch.setattr(judgement, "is_beaten_by_textbook", lambda judgement: False)
        warnings.simplefilter("error")
        return fit_trial(coarse(car, every=30), car, alpha="auto")


@pytest.mark.slow
def test_a_model_that_predicts_nothing_is_told_of_in_one_sentence(useless):
    sentence = explain_uselessness(useless)
    assert "is useless: on unseen data its predictions end" in sentence
    assert useless.verdict is judgement.Verdict.DO_NOT_TRAIN
    ran_away = replace(useless.held_out, mean_position_error_m=np.inf)
    sentence = explain_uselessness(replace(useless, held_out=ran_away))
    assert "its predictions have diverged after 5 s" in sentence


@pytest.mark.slow
def test_the_textbook_takes_the_place_of_a_useless_model(useless):
    assert not useless.findings.replacement
    findings = prefer_textbook(useless.findings.whole, useless.findings)
    found = replace(useless, findings=findings, notes=findings.notes)
    found = replace(found, model=findings.model, held_out=findings.held_out)
    assert findings.replacement in found.notes
    assert explain_uselessness(found) == ""
    assert any(gap.endswith(TOO_COARSE) for gap in found.gaps)


def test_only_rows_that_are_too_far_apart_are_named(differential):
    assert (
        describe_coarsest_state(coarse(differential, every=5), differential, ()) == ""
    )
    far = coarse(differential, every=30)
    named = describe_coarsest_state(far, differential, ())
    assert named.split()[0] in {v.name for v in differential.state}
    assert f"{named}.".endswith(TOO_COARSE)
    assert (
        describe_coarsest_state(far, differential, [v.name for v in differential.state])
        == ""
    )
    assert describe_coarsest_state(replace(far, state=None), differential, ()) == ""


def test_a_drive_too_short_to_try_the_model_is_not_judged(car):
    assert verdict_on(drive(car, duration=9.0), car) == ""


class StraightFirst:
    """Draws commands of a car that never backs, and turns only in the last third of a drive."""

    def uniform(self, low, high, size):
        ahead = np.maximum(low, [0.0, -np.inf])
        held = np.random.default_rng(0).uniform(ahead, high, size)
        held[: 2 * len(held) // 3 + 1, 1] = 0.0
        return held


def test_what_the_textbook_fills_in_is_judged_with_it(car):
    recording = record(car, StraightFirst(), 90.0)
    filled = identify(recording, car, alpha="auto", assume=True)
    assert filled.fit.unmoved
    assert explain_uselessness(filled) == ""
    sentence = verdict_on(recording, car)
    assert "steering" in sentence
    assert "never moved in its first 60 s" in sentence


def test_a_model_of_too_few_terms_is_not_put_down_to_the_recording(car):
    found = identify(record(car, np.random.default_rng(0), 60.0), car, alpha=0.5)
    sentence = explain_uselessness(found)
    assert sentence.endswith("it may lack terms, so leave order and alpha at `auto`.")
