"""The row of stages: each adds what it says, and says what is missing where it is taken out."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

from identify.drives import drive, slipping_car
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify import clocks
from nics_drl_bridge.identify import drive as prepared
from nics_drl_bridge.identify import identify as stages
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.clocks import nominal_timing
from nics_drl_bridge.identify.drive import Drive, Settings
from nics_drl_bridge.identify.findings import Findings, StageOrderError
from nics_drl_bridge.identify.identify import (
    STAGES,
    identify,
    run,
    start_findings,
)
from nics_drl_bridge.identify.verdict import describe_responses
from nics_drl_bridge.robot.spec import RobotSpec, StateVariable

NAMES = tuple(stage.__name__ for stage in STAGES)
ADDED = {
    "repair_drive": {"training", "whole", "repairs"},
    "estimate_timing": {"timing", "calibration"},
    "find_mounting": {"expected_speed", "mounting", "calibration"},
    "find_responses": {"calibration"},
    "measure_noise": {"calibration", "noise"},
    "derive_motion": set(),
    "find_input_curves": set(),
    "fit_terms": {"samples", "regression"},
    "prune_terms": {"pruned_fit", "model"},
    "refine_model": {"model", "calibration", "refinement"},
    "complete_model": {"model", "assumptions"},
    "judge_model": {
        "calibration",
        "noise",
        "model",
        "unseen",
        "held_out",
        "judgement",
        "notes",
        "yardstick",
    },
    "prefer_textbook": set(),  # the model is better than the textbook
    "refit_model": {"final"},
}
SETTINGS = Settings(train_until_s=14.0, assume=True)


@dataclass(frozen=True)
class HasQuality:
    """What a refit takes from a model."""

    quality: None = None


def rest(drive: Drive, found: Findings, name: str) -> Findings:
    """The findings when the row goes on after a stage, up to what may replace a poor model."""
    for stage in STAGES[NAMES.index(name) + 1 : NAMES.index("prefer_textbook")]:
        found = stage(drive, found)
    return found


@pytest.fixture(scope="module")
def disturbed(car) -> Drive:
    """A drive in which each stage finds something: disturbed, and always at one steering angle."""
    data = car.model_dump()
    speed, steering = data["command"]
    held = {**steering, "min": -0.4 - 1e-9, "max": -0.4 + 1e-9}
    locked = RobotSpec.model_validate({**data, "command": [speed, held]})
    recording = drive(
        locked, duration=21.0, latency=0.05, rotation=0.4, noise=(5e-4, 1e-3)
    )
    command = recording.command.values.copy()
    pose = recording.pose
    command[:, 1] = -0.4
    twice = np.sort(np.append(np.arange(len(pose.t)), 700))
    repeated = replace(pose, t=pose.t[twice], values=pose.values[twice])
    still = replace(recording.command, values=command)
    return Drive(replace(recording, pose=repeated, command=still), car, SETTINGS)


def test_the_row_is_the_road_from_a_recording_to_a_model():
    assert tuple(ADDED) == NAMES


@pytest.fixture(scope="module")
def road(disturbed) -> list[Findings]:
    """The findings before each stage, and after the last."""
    found = [start_findings(disturbed)]
    for stage in STAGES:
        found.append(stage(disturbed, found[-1]))
    return found


@pytest.mark.slow
def test_a_stage_adds_what_it_says_and_leaves_the_rest(road):
    for name, before, after in zip(NAMES, road, road[1:], strict=False):
        names = {f.name for f in fields(Findings)}
        changed = {n for n in names if getattr(after, n) is not getattr(before, n)}
        assert changed == ADDED[name]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "missing"),
    [
        (
            "repair_drive",
            lambda found: found.repairs == () and 0.0 in np.diff(found.whole.sample_t),
        ),
        ("estimate_timing", lambda found: found.calibration.command_latency_s == 0.0),
        ("find_mounting", lambda found: found.calibration.rotation_rad == 0.0),
        ("measure_noise", lambda found: found.calibration.position_noise_m == 0.0),
        (
            "refine_model",
            lambda found: not any("were refined" in note for note in found.notes),
        ),
        ("complete_model", lambda found: found.model.assumed == ()),
        (
            "judge_model",
            lambda found: found.notes == () and found.model.quality is None,
        ),
    ],
)
def test_without_a_stage_its_finding_is_missing_and_the_rest_is_there(
    disturbed, road, name, missing
):
    assert not missing(road[-1])
    found = rest(disturbed, road[NAMES.index(name)], name)
    assert missing(found)
    assert found.model.terms_kept > 0


@pytest.fixture(scope="module")
def inferred(car) -> tuple[Drive, Findings]:
    """A drive whose state was not measured, and its findings up to the mounting."""
    driven = Drive(drive(car, duration=21.0, measured_state=False), car, SETTINGS)
    return driven, run(STAGES[: NAMES.index("find_responses")], driven)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "find_responses",
            "the response of each state is missing; put the stage 'find_responses' before",
        ),
        (
            "fit_terms",
            "the fit of all terms is missing; put the stage 'fit_terms' before",
        ),
        (
            "prune_terms",
            "the pruned fit is missing; put the stage 'prune_terms' before",
        ),
    ],
)
def test_without_a_stage_that_others_need_the_row_says_which(inferred, name, sentence):
    driven, found = inferred
    with pytest.raises(StageOrderError, match=sentence):
        rest(driven, found, name)


def test_a_state_that_nothing_determines_is_one_sentence_beside_a_motion_too():
    spec, recording = slipping_car(duration=4.0)
    arm = StateVariable(name="arm", unit="rad", min=-1.0, max=1.0)
    armed = spec.model_copy(update={"state": (*spec.state, arm), "textbook": None})
    with pytest.raises(RecordingError, match=r"'arm' of robot .* follows no command"):
        identify(recording, armed)


def test_a_follower_beside_a_motion_has_the_lag_and_the_error_of_its_own_command(
    monkeypatch,
):
    spec, recording = slipping_car(duration=4.0)
    data = spec.model_dump()
    angle = {"name": "angle", "unit": "rad", "min": -1.0, "max": 1.0}
    data["state"] = [data["state"][0], angle | {"follows": "steering"}]
    data["textbook"] = None
    followed = RobotSpec.model_validate(data)
    timing = replace(
        nominal_timing(Drive(recording, spec)),
        lags=np.array([0.3, 0.1]),  # of throttle and steering
        lag_sigma=np.array([0.03, 0.01]),
    )
    monkeypatch.setattr(clocks, "timing_of", lambda drive: timing)
    driven = Drive(recording, followed)
    found = run(STAGES[: NAMES.index("find_mounting")], driven)
    assert found.calibration.responses == (Response("angle", "steering", 0.1),)
    (sentence,) = describe_responses(driven, found.calibration, found.timing)
    assert "follow steering with a lag of 0.1000 s (+- 0.0100 s)" in sentence


@pytest.fixture(scope="module")
def judged(car) -> tuple[Drive, Findings]:
    """A noisy drive as it stands before the last stage, without its model."""
    driven = Drive(drive(car, duration=6.0), car, Settings(train_until_s=4.0))
    noisy = Calibration(position_noise_m=0.01)
    return driven, replace(start_findings(driven), calibration=noisy)


@pytest.mark.parametrize(
    ("error", "kept"), [(1.2, True), (1.3, False), (np.nan, False)]
)
def test_a_refit_is_kept_unless_it_predicts_worse_or_not_at_all(
    judged, monkeypatch, error, kept
):
    errors = [SimpleNamespace(mean_position_error_m=each) for each in (error, 1.0)]
    monkeypatch.setattr(stages, "run", lambda row, driven, found: found)
    monkeypatch.setattr(stages, "require_model", lambda found: HasQuality())
    monkeypatch.setattr(stages.verdict, "collect_notes", lambda driven, found: ())
    monkeypatch.setattr(
        stages.verdict, "list_plain_calibration_notes", lambda found: ()
    )
    monkeypatch.setattr(
        stages.open_loop, "open_loop_error", lambda *given: errors.pop(0)
    )
    assert (stages.refit_model(*judged).final is not None) == kept


def test_a_stage_in_the_wrong_place_is_not_taken_for_a_drive_that_can_not_be_fitted(
    judged, monkeypatch
):
    monkeypatch.setattr(stages, "fit_terms", lambda driven, found: found)
    with pytest.raises(StageOrderError, match="put the stage 'fit_terms' before"):
        stages._cross_validate(*judged, order=2)


def test_the_bursts_of_a_drive_are_found_once(differential, monkeypatch):
    asked = []
    find = prepared.find_bursts
    monkeypatch.setattr(
        prepared, "find_bursts", lambda t: asked.append(len(t)) or find(t)
    )
    recording = drive(differential, duration=21.0, burst=0.1, noise=(5e-4, 1e-3))
    found = identify(recording, differential)
    assert found.drive.bursts is not None
    assert asked.count(len(recording.pose.t)) == 1
    assert asked.count(len(found.findings.training.recording.pose.t)) == 1
