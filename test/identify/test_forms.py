"""What motors and tyres do besides gains and lags: found in a motion, sought by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from identify.drives import make_model, slipping_car, throttle_car
from nics_drl_bridge.identify.calibration import Settings
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import Findings, resample_drive
from nics_drl_bridge.identify.forms import (
    Evidence,
    Form,
    add_dead_zones,
    add_reverse_gains,
    drop_unreached_ends,
    find_input_curve,
    find_two_way_curves,
    list_parameters,
    make_prediction_problem,
)
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


def test_values_are_sought_by_name_from_what_the_motion_shows(evidence):
    form = Form((CURVE,), friction=("vx",), limits=("vx",), drag=("vx",))
    sought = list_parameters(evidence, form)
    assert sought.names == (
        "latency",
        "throttle.dead",
        "throttle.least",
        "throttle.most",
        "vx.friction",
        "vx.drag",
        "vx.back_emf.throttle",
        "vx.fall",
        "vx.rise",
    )
    assert len(sought.sought) == len(sought.names)
    assert (sought.low <= sought.start).all()
    assert (sought.start <= sought.high).all()


def test_a_form_that_grows_starts_where_the_smaller_one_ended(evidence):
    small = list_parameters(evidence, Form((CURVE,)))
    ended = replace(small, start=small.start + np.array([0.02, 0.01, 0.0, 0.03]))
    larger = list_parameters(evidence, Form((CURVE,), drag=("vx",))).start_from(ended)
    assert larger.start[:4] == pytest.approx(ended.start)
    assert larger.start[4] > 0.0


def test_the_least_delay_of_the_commands_is_their_latency(evidence):
    form = Form((CURVE,), delays=(("throttle", 0.08), ("steering", 0.02)))
    sought = list_parameters(evidence, form)
    assert sought.names[:3] == ("latency", "throttle.delay", "steering.delay")
    assert 0 not in sought.sought
    at = sought.name(sought.start)
    assert form.find_latency(at) == 0.02
    (curve,) = form.make_curves(at)
    assert (curve.command, curve.delay) == ("throttle", pytest.approx(0.06))
    problem = make_prediction_problem(evidence, form, sought)
    delayed = problem.commands(at)
    alike = problem.commands(at | {"throttle.delay": 0.02})
    step = round(0.06 / evidence.samples.dt)
    assert delayed[step:, 0] == pytest.approx(alike[:-step, 0])
    assert np.array_equal(delayed[:, 1], alike[:, 1])


def test_values_become_curves_friction_limits_and_drag(evidence):
    form = Form((CURVE,), ("vx",), ("vx",), ("throttle",), ("vx",))
    sought = list_parameters(evidence, form)
    values = np.array([0.03, 0.12, -0.2, 0.4, 0.8, 0.25, 0.15, 1.2, 3.0, 2.0])
    at = sought.name(values)
    (curve,) = form.make_curves(at)
    assert curve == InputCurve(
        command="throttle", dead=0.12, least=-0.2, most=0.4, back=0.8
    )
    spec = evidence.drive.spec
    model = form.actuate(make_model(spec, {"vx": {"vx": 1.0}}), at)
    assert model.friction.tolist() == [0.25, 0.0, 0.0]
    assert model.drag.tolist() == [0.15, 0.0, 0.0]
    assert model.back_emf[0].tolist() == [1.2, 0.0]
    assert model.limits[0].tolist() == [-3.0, 2.0]


def test_a_dead_zone_is_tried_of_the_command_that_drives_alone(evidence):
    (curve,) = add_dead_zones(Form(), evidence).curves
    assert curve.command == "throttle"
    assert 0.0 < curve.dead < 0.05
    assert add_dead_zones(Form((CURVE,)), evidence).curves == (CURVE,)
    assert add_reverse_gains(add_dead_zones(Form(), evidence), (curve,)).back == (
        "throttle",
    )


def test_only_a_command_that_drives_both_ways_may_have_a_gain_of_its_own_backwards(
    evidence,
):
    (both,) = find_two_way_curves(evidence)
    assert both.command == "throttle"
    form = add_reverse_gains(Form(), (both,))
    assert form.back == ("throttle",)
    assert len(list_parameters(evidence, form).sought) == 4  # it has no dead zone
    forwards = replace(evidence.samples, x=np.abs(evidence.samples.x))
    assert find_two_way_curves(replace(evidence, samples=forwards)) == ()


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
