"""What motors and tyres do besides gains and lags: found in a motion, sought by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from identify.drives import make_model, slipping_car, throttle_car
from nics_drl_bridge.identify.drive import Drive, Settings
from nics_drl_bridge.identify.effects import (
    Evidence,
    actuate,
    drop_unreached_ends,
    find_input_curve,
    find_latency,
    find_likely_delay,
    list_curve_rows,
    list_dead_zone_rows,
    list_delay_rows,
    list_drag_rows,
    list_friction_rows,
    list_limit_rows,
    list_plain_rows,
    list_reverse_rows,
    make_curves,
    make_parameters,
    make_prediction_problem,
)
from nics_drl_bridge.identify.findings import Findings, resample_drive
from nics_drl_bridge.identify.identify import (
    STAGES,
    find_input_curves,
    run,
)
from nics_drl_bridge.identify.terms import Kind, Library
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.taylor import TaylorModel

MOTION = Library(throttle_car(), Kind.MOTION, True, 1.0, 3)
CURVE = InputCurve(command="throttle", dead=0.05, least=-0.3, most=0.5)


@pytest.fixture(scope="module")
def found() -> Findings:
    """Findings on a car's motion before its input curves."""
    spec, recording = slipping_car()
    drive = Drive(recording, spec)
    drive = replace(drive, settings=Settings(train_until_s=drive.duration_s))
    return run(STAGES[: STAGES.index(find_input_curves)], drive)


@pytest.fixture(scope="module")
def samples(found) -> Samples:
    return resample_drive(found.training, found)


@pytest.fixture(scope="module")
def evidence(found, samples) -> Evidence:
    calibration = replace(found.calibration, command_latency_s=0.05)
    return Evidence(found.training, calibration, samples, MOTION)


def test_a_dead_zone_is_seen_in_the_speed_that_a_throttle_makes(found, samples):
    candidate = find_input_curve(samples, found.training.spec, 0)
    assert candidate is not None
    assert candidate.curve.command == "throttle"
    assert candidate.curve.dead == pytest.approx(0.1, abs=0.05)
    assert candidate.drives


def test_a_command_in_proportion_to_what_it_does_has_no_curve(found, samples):
    follows = replace(samples, x=samples.x.copy())
    share = 1.0 - np.exp(-samples.dt / 0.4)
    follows.x[:, 0] = lfilter([share], [1.0, share - 1.0], samples.x[:, 3])
    follows.x[:, 1:3] = 0.0
    assert find_input_curve(follows, found.training.spec, 0) is None


def test_a_command_that_does_not_drive_a_robot_has_no_curve_by_its_speed(
    found, samples
):
    slower = replace(samples, x=samples.x.copy())
    slower.x[:, 0] -= 2.0 * np.maximum(np.abs(samples.x[:, 4]) - 0.4, 0.0)
    slower.x[:, 1:3] = 0.0
    assert find_input_curve(slower, found.training.spec, 1) is None


def list_all_rows(evidence: Evidence) -> dict:
    """Returns the rows of a model with all effects of a throttle and a speed."""
    return (
        list_plain_rows(evidence, (CURVE,))
        | list_friction_rows(evidence, "vx")
        | list_drag_rows(evidence, "vx")
        | list_limit_rows(evidence, "vx")
    )


def test_values_are_sought_by_name_from_what_the_motion_shows(evidence):
    sought = make_parameters(list_all_rows(evidence))
    assert set(sought.names) == {
        "latency",
        "throttle.dead",
        "throttle.least",
        "throttle.most",
        "vx.friction",
        "vx.drag",
        "vx.back_emf.throttle",
        "vx.fall",
        "vx.rise",
    }
    assert len(sought.sought) == len(sought.names)
    assert (sought.low <= sought.start).all()
    assert (sought.start <= sought.high).all()


def test_a_model_that_grows_starts_where_the_smaller_one_ended(evidence):
    rows = list_plain_rows(evidence, (CURVE,))
    small = make_parameters(rows)
    ended = replace(small, start=small.start + np.array([0.02, 0.01, 0.0, 0.03]))
    grown = make_parameters(rows | list_drag_rows(evidence, "vx")).start_from(ended)
    assert grown.start[:4] == pytest.approx(ended.start)
    assert grown.start[4] > 0.0


def test_the_least_delay_of_the_commands_is_their_latency(evidence):
    rows = list_plain_rows(evidence, (CURVE,)) | list_delay_rows(evidence)
    sought = make_parameters(rows)
    assert sought.names[0] == "latency"
    assert sought.names[-2:] == ("throttle.delay", "steering.delay")
    assert 0 not in sought.sought
    at = sought.name(sought.start) | {"throttle.delay": 0.08, "steering.delay": 0.02}
    assert find_latency(at) == 0.02
    (curve,) = make_curves(evidence.drive.spec, at)
    assert (curve.command, curve.delay) == ("throttle", pytest.approx(0.06))
    problem = make_prediction_problem(evidence, sought)
    delayed = problem.commands(at)
    alike = problem.commands(at | {"throttle.delay": 0.02})
    step = round(0.06 / evidence.samples.dt)
    assert delayed[step:, 0] == pytest.approx(alike[:-step, 0])
    assert np.array_equal(delayed[:, 1], alike[:, 1])


def test_a_latency_is_seen_in_a_motion_that_comes_later(evidence):
    drive = evidence.drive
    command = replace(drive.recording.command, t=drive.recording.command.t - 0.2)
    later = drive.part(replace(drive.recording, command=command))
    at_once, late = (
        find_likely_delay(each, evidence.calibration, evidence.samples)
        for each in (drive, later)
    )
    assert late - at_once == pytest.approx(0.2, abs=0.021)


def test_values_become_curves_friction_limits_and_drag(evidence):
    spec = evidence.drive.spec
    curve = {"dead": 0.12, "least": -0.2, "most": 0.4, "back": 0.8}
    at = {"latency": 0.03} | {f"throttle.{part}": curve[part] for part in curve}
    assert make_curves(spec, at) == (InputCurve(command="throttle", **curve),)
    at |= {"vx.friction": 0.25, "vx.drag": 0.15, "vx.back_emf.throttle": 1.2}
    at |= {"vx.fall": 3.0, "vx.rise": 2.0}
    model = actuate(spec, make_model(spec, {"vx": {"vx": 1.0}}), at)
    assert model.friction.tolist() == [0.25, 0.0, 0.0]
    assert model.drag.tolist() == [0.15, 0.0, 0.0]
    assert model.back_emf[0].tolist() == [1.2, 0.0]
    assert model.limits[0].tolist() == [-3.0, 2.0]


def test_a_dead_zone_starts_small_and_may_be_none(evidence):
    start, _, low, high = list_dead_zone_rows(evidence, "throttle")["throttle.dead"]
    assert 0.0 == low < start < 0.05 < high


def test_only_a_command_that_drives_both_ways_may_have_a_gain_of_its_own_backwards(
    evidence,
):
    neutral = list_curve_rows(InputCurve(command="throttle", least=-0.3, most=0.6))
    assert set(list_reverse_rows(evidence)) == {*neutral, "throttle.back"}
    forwards = replace(evidence.samples, x=np.abs(evidence.samples.x))
    assert list_reverse_rows(replace(evidence, samples=forwards)) == {}


def test_ends_and_limits_that_the_drive_never_reached_are_left_out(found, samples):
    spec = found.training.spec
    sent = found.training.recording.command.values[:, 0]
    asked = 5.0 * samples.x[:, 3]

    def written(most: float, rise: float) -> TaylorModel:
        curve = InputCurve(
            command="throttle", dead=0.1, least=1.2 * sent.min(), most=most
        )
        limits = np.tile([-np.inf, np.inf], (3, 1))
        limits[0] = 2.0 * asked.min(), rise
        pushed = {"d_vx": {"throttle": 5.0}}
        model = make_model(spec, pushed, inputs=(curve,), limits=limits)
        return drop_unreached_ends(model, found.training, samples, {})

    beyond = written(1.1 * sent.max(), 2.0 * asked.max())
    assert beyond.inputs == (InputCurve(command="throttle", dead=0.1),)
    assert not np.isfinite(beyond.limits).any()
    assert beyond.high[3] == pytest.approx(sent.max() - 0.1)
    within = written(0.8 * sent.max(), 0.5 * asked.max())
    assert within.inputs[0].most == pytest.approx(0.8 * sent.max())
    assert within.inputs[0].least == -np.inf
    assert within.limits[0].tolist() == [-np.inf, 0.5 * asked.max()]
