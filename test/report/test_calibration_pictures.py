from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identify.drives import drive, with_wheels

from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.identify.report import collect_estimates, format_report
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.report.fit_pictures import draw_inputs
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

Found = tuple[RobotSpec, Identified]
PNG = b"\x89PNG"
pytestmark = pytest.mark.slow
WHEEL_TICK_S = 0.01
"""Whether a wheel speed is of its stamp or of the tick before, a recording does not say."""


@pytest.fixture(scope="module")
def disturbed() -> Found:
    """A drive that shows everything there is to estimate."""
    car = load_robot("ackermann")
    spoilt = drive(
        car,
        duration=30.0,
        latency=0.12,
        pose_clock_ahead=3.0,
        rotation=0.3,
        lever=(0.1, 0.05),
        noise=(0.001, 0.002),
        burst=0.1,
        measured_state=False,
    )
    spoilt = with_wheels(spoilt, drive(car, duration=30.0, latency=0.12), swapped=True)
    return car, identify(spoilt, car)


@pytest.fixture(scope="module")
def exact() -> Found:
    spec = load_robot("differential")
    return spec, identify(record(spec, np.random.default_rng(0), 30.0), spec)


def test_the_estimates_are_right_within_their_uncertainty(disturbed):
    found = collect_estimates(disturbed[1])
    offset = replace(found["clock_offset_s"], value=-3.0012, sigma=0.0104)
    assert offset.text == "clock offset -3.001 +- 0.01 s"
    truth = {
        "clock_offset_s": -3.0,
        "command_latency_s": 0.12,
        "rotation_rad": 0.3,
        "lever_arm_x_m": 0.1,
        "wheel_scale": 1.0 / 70.0,
        "turn_scale": -1.0 / (70.0 * 0.16),
    }
    for name, value in truth.items():
        estimate = found[name]
        tolerance = 4.0 * estimate.sigma + (
            WHEEL_TICK_S if estimate.unit == "s" else 0.0
        )
        assert estimate.value == pytest.approx(value, abs=tolerance, rel=0.02), name
    assert found["wheels_swapped"].remark == "left and right are interchanged"


def test_the_report_says_why_an_estimate_was_not_possible(exact):
    _, identified = exact
    text = format_report("here", identified)
    for part in (
        "clock offset: not estimated, pose and commands are on one clock",
        "period of bursts: not estimated, the poses are stamped one by one",
        "wheel scale: not estimated, no wheel speeds were recorded",
    ):
        assert part in text


def test_motors_are_drawn_and_reported_with_what_is_known_of_them(exact):
    spec, found = exact
    assert draw_inputs(spec, found) is None
    assert "Effect of the motors" not in format_report("drive", found)
    name = spec.command[0].name
    state = spec.state[0].name
    size = len(spec.state)
    curve = InputCurve(command=name, dead=0.12, least=-0.5, most=0.8, back=0.6)
    friction = np.zeros(size)
    limits = np.tile([-np.inf, np.inf], (size, 1))
    friction[0] = 0.2
    limits[0] = (-3.0, 2.0)
    model = replace(found.model, inputs=(curve,), friction=friction, limits=limits)
    sigma = {f"{name}.dead": 0.004}
    calibration = replace(found.calibration, uncertainty=sigma)
    motors = replace(found, model=model, calibration=calibration)
    report = format_report("drive", motors)
    for part in (
        f"{name}' = 0 within +-0.12, else {name} -+ 0.12",
        ", at least -3, at most 2, less dry friction of 0.2  [rad/s/s]",
        f"{name:<24} dead zone on both sides of 0: 0.12 +- 0.004",
        f"{state:<24} dry friction: 0.2 rad/s/s",
    ):
        assert part in report
    assert draw_inputs(spec, motors).startswith(PNG)
