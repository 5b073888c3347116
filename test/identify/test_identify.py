from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import NOISE, drive, fit_trial, make_model, scale, with_values
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify.calibration import Settings
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import Findings
from nics_drl_bridge.identify.identify import (
    STAGES,
    complete_model,
    cut,
    identify,
    judge_model,
    run,
)
from nics_drl_bridge.identify.open_loop import predict, select_windows
from nics_drl_bridge.identify.textbook import assume_textbook
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.spec import RobotSpec, build_robot, load_robot
from nics_drl_bridge.robot.taylor import TaylorModel


def term(model, dof: str, name: str) -> float:
    return model.named.terms[dof].get(name, 0.0)


def learn(recording: Recording, order: int | str = 2) -> tuple[Drive, Findings]:
    """A drive of a car, and findings on its first 16 s before they are completed or judged."""
    settings = Settings(order=order, train_until_s=16.0)
    whole = replace(Drive(recording, load_robot("ackermann")), settings=settings)
    return whole, run(STAGES[: STAGES.index(complete_model)], whole)


def drive_noisily(spec: RobotSpec) -> Recording:
    """A noisy drive whose state was not measured."""
    return drive(spec, duration=24.0, noise=NOISE, measured_state=False)


@pytest.fixture(scope="module")
def noisy(car) -> Findings:
    return learn(drive_noisily(car))[1]


@pytest.fixture(scope="module")
def held(car) -> tuple[Drive, Findings]:
    """A noisy drive with the steering held at -0.4, and findings on it."""
    data = car.model_dump()
    data["command"][1].update(min=-0.4 - 1e-9, max=-0.4 + 1e-9)
    recording = drive_noisily(RobotSpec.model_validate(data))
    values = recording.command.values.copy()
    values[:, 1] = -0.4
    return learn(with_values(recording, command=values), "auto")


def test_an_exact_recording_is_fitted_to_nine_digits_and_not_refined(differential):
    found = identify(drive(differential, duration=45.0), differential)
    assert np.delete(found.fit.rmse, 1).max() < 1e-8
    assert (
        found.fit.rmse[1] < 1e-4
    )  # sideways the robot hardly moves, and gets no terms
    assert found.model is found.fit.model
    assert found.held_out is not None
    assert found.held_out.mean_position_error_m < 1e-4


@pytest.mark.slow
def test_the_held_out_part_is_not_used_for_the_model(car, noisy):
    plain = drive_noisily(car)
    late = plain.pose.t > 16.0
    factors = np.where(late[:, None], [1.5, 1.5, 1.0], 1.0)
    _, other = learn(scale(plain, pose=factors))
    assert np.array_equal(other.model.coefficients, noisy.model.coefficients)
    assert other.calibration == noisy.calibration


@pytest.mark.slow
def test_a_prediction_knows_no_pose_after_its_start(car, noisy):
    whole = noisy.whole
    chosen = select_windows(whole, noisy.calibration, 17.0, 23.0, 5.0, 0.1)
    values = whole.recording.pose.values.copy()
    values[whole.recording.pose.t > chosen.start_t[-1]] = 7.0
    blind = Drive(with_values(whole.recording, pose=values), car)
    seen, unseen = (
        predict(noisy.model, noisy.calibration, each, chosen) for each in (whole, blind)
    )
    assert np.array_equal(seen, unseen)


@pytest.mark.slow
def test_a_noisy_drive_in_bursts_without_state_still_gives_the_textbook_terms(car):
    recording = drive(
        car,
        duration=30.0,
        latency=0.06,
        pose_clock_ahead=0.4,
        rotation=-1.2,
        lever=(0.05, 0.02),
        noise=NOISE,
        burst=0.1,
        measured_state=False,
    )
    found = fit_trial(recording, car)
    assert term(found.model, "vx", "speed") == 1.0
    assert term(found.model, "wz", "speed*steering") == pytest.approx(5.2, abs=0.3)
    assert found.model.terms_kept <= 8
    assert found.held_out is not None
    assert found.held_out.mean_position_error_m < 0.05


def test_a_short_drive_says_that_it_was_not_tried(car):
    found = identify(drive(car, duration=9.0), car)
    assert found.held_out is None
    assert any("too short for a prediction over 5 s" in note for note in found.notes)


@pytest.mark.slow
def test_steering_that_never_moved_has_no_terms_and_a_sentence(held):
    whole, found = held
    found = run((judge_model,), whole, found)
    assert not found.model.powers[:, [1, 3]].any()
    assert found.pruned_fit.unmoved == ("steering", "steering_command")
    assert "drive with steering_command changing" in " ".join(found.notes)
    assert found.model.assumed == ()


@pytest.mark.slow
def test_on_request_the_textbook_completes_what_was_measured_at_a_constant(held):
    whole, plain = held
    whole = replace(whole, settings=replace(whole.settings, assume=True))
    found = run((complete_model, judge_model), whole, plain)
    learnt = term(plain.model, "wz", "speed")
    assert term(found.model, "wz", "speed*steering") == pytest.approx(learnt / -0.4)
    assert ("wz", "speed*steering") in found.model.assumed
    assert term(found.model, "d_steering", "steering_command") > 0.0
    assert any(note.startswith("Assumed, not learnt: wz") for note in found.notes)


def test_at_zero_steering_the_parameters_of_the_spec_are_assumed(car):
    still = np.zeros(4)
    straight = make_model(car, {"vx": {"speed": 1.0}}, low=still, high=still)
    found, notes = assume_textbook(straight, car, ("steering", "steering_command"))
    turned = term(found, "wz", "speed*steering")
    assert turned == pytest.approx(1.0 / 0.2, rel=1e-3)
    assert "from the parameters" in " ".join(notes)


@pytest.mark.parametrize("until", [0.0, -3.0])
def test_a_training_part_must_have_a_length(car, until):
    with pytest.raises(RecordingError, match="use more than 0"):
        cut(drive(car, duration=5.0), until)


def test_the_training_part_ends_at_one_time_in_all_streams_of_a_clock(car):
    plain = drive(car, duration=20.0)
    late = plain.state.rows(plain.state.t > plain.pose.t[0] + 4.0)
    part = cut(replace(plain, state=late), 10.0)
    assert part.state.t[0] == late.t[0]
    assert part.state.t[-1] == part.pose.t[-1] <= plain.pose.t[0] + 10.0
    other = cut(replace(plain, state=replace(late, clock="board")), 10.0)
    assert other.state.t[-1] > part.state.t[-1]  # its offset is not known yet


def test_a_stream_that_starts_after_the_training_part_is_refused_if_it_is_needed(car):
    plain = drive(car, duration=20.0)
    late = plain.state.rows(plain.state.t > plain.pose.t[0] + 12.0)
    assert cut(replace(plain, wheels=late), 10.0).wheels is None
    with pytest.raises(RecordingError, match="state: starts after the first 10 s"):
        cut(replace(plain, state=late), 10.0)


@pytest.mark.parametrize("name", ["mecanum", "differential"])
def test_a_wheel_that_always_follows_from_the_others_is_named(name, request):
    spec = request.getfixturevalue(name)
    notes = " ".join(identify(drive(spec, duration=20.0), spec).notes)
    # Four wheels that roll without slip have three speeds to choose.
    told = "rear_right_wheel always depended on the other variables" in notes
    assert told == (name == "mecanum")
    assert "left_wheel always depended" not in notes


def by_throttle(steering: float, **given) -> tuple[RobotSpec, TaylorModel]:
    """A car by throttle, and its model of a drive that held one steering."""
    spec = build_robot(
        {"kind": "ackermann_throttle", "footprint_radius": 0.2, **given}, {}
    )
    terms = {"vx": {"vx": 1.0}, "d_vx": {"vx": -2.0, "throttle": 6.0}}
    if steering:
        terms["wz"] = {"wz": 1.0}
        terms["d_wz"] = {"vx": 10.0 * 1.5 * steering, "wz": -10.0}
    low = np.array([-1.0, -0.01, -0.01, -0.5, steering])
    high = np.array([2.0, 0.01, 0.01, 0.5, steering])
    model = make_model(spec, terms, dt=0.02, low=low, high=high, bounded=True)
    return spec, model


@pytest.mark.parametrize("steering", [0.0, 0.2])
def test_what_is_assumed_of_a_car_by_its_motion_turns_it_by_its_speed(steering):
    spec, model = by_throttle(steering)
    still = ("vy", "steering") if steering else ("vy", "wz", "steering")
    completed, notes = assume_textbook(model, spec, still)
    turned = term(completed, "d_wz", "vx*steering") / -term(completed, "d_wz", "wz")
    curvature = spec.parameters["greatest_steering"] / spec.parameters["wheelbase"]
    assert turned == pytest.approx(1.5 if steering else curvature, rel=1e-6)
    assert term(completed, "d_wz", "steering") == 0.0
    assert all(
        dof == "d_wz" for dof, _ in completed.assumed
    )  # no twist, which is by definition
    pose = np.zeros(3)
    state = np.array([1.0, 0.0, 0.0])
    for _ in range(100):
        state[0] = 1.0
        pose, state = completed.step(pose, state, np.array([1.0 / 3.0, 0.3]))
    assert state[2] == pytest.approx(0.3 * turned, rel=0.01)
    assert completed.rates(np.array([0.0, 0.0, 0.0, 0.0, 0.3]))[5] == 0.0
    assert len(notes) == 1
