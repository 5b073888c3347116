"""Yardsticks of a model: robots that keep their twist, and fitted textbooks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import drive, with_values
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import select_windows
from nics_drl_bridge.identify.textbook import (
    estimate_twists_at,
    fit_yardstick,
    predict_kept_twist,
)
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

LEARNT_S = 20.0
MOCAP = (0.0005, 0.001)


def share(ends, chosen):
    off = ends - chosen.end
    return float(np.hypot(off[:, 0], off[:, 1]).mean() / chosen.path.mean())


def held_out(driven):
    return select_windows(driven, Calibration(), LEARNT_S, driven.duration_s, 5.0, 0.1)


def without_a_textbook(spec):
    commands = [c.model_copy(update={"cmd_vel": None}) for c in spec.command]
    return RobotSpec(name="nameless", footprint_radius=0.2, command=tuple(commands))


@pytest.mark.parametrize("kind", ["differential", "mecanum", "tricycle"])
@pytest.mark.slow
def test_a_fitted_textbook_predicts_a_robot_of_its_kind(kind):
    spec = load_robot(kind)
    disturbed = drive(
        spec, duration=30.0, latency=0.05, rotation=0.4, lever=(0.1, 0.0), noise=MOCAP
    )
    driven = Drive(disturbed, spec)
    chosen = held_out(driven)
    predicted = share(fit_yardstick(driven, LEARNT_S).predict(driven, chosen), chosen)
    assert predicted < 0.03
    assert predicted < 0.2 * share(predict_kept_twist(driven, chosen), chosen)


def test_it_finds_the_latency_and_the_place_of_the_tracked_body():
    spec = load_robot("ackermann")
    disturbed = drive(spec, latency=0.05, rotation=0.4, lever=(0.1, -0.05), noise=MOCAP)
    found = fit_yardstick(Drive(disturbed, spec), LEARNT_S).response
    assert found.mounting == pytest.approx([0.1, -0.05, -0.4], abs=0.005)
    assert found.delay_s == pytest.approx(
        0.05, abs=0.03
    )  # the rest of the lag is a lag
    assert found.gain[0].tolist() == pytest.approx([1.0, 0.0], abs=0.02)


def test_commands_of_unknown_meaning_respond_linearly():
    spec = load_robot("mecanum")
    bare = without_a_textbook(spec)
    driven = Drive(replace(drive(spec, duration=30.0, noise=MOCAP), state=None), bare)
    chosen = held_out(driven)
    assert share(fit_yardstick(driven, LEARNT_S).predict(driven, chosen), chosen) < 0.03


def test_a_robot_that_keeps_its_twist_is_predicted_by_it():
    t = np.arange(0.0, 10.0, 0.02)
    pose = np.stack([np.sin(0.5 * t), 1.0 - np.cos(0.5 * t), 0.5 * t], axis=1)
    spec = load_robot("differential")
    driven = Drive(
        Recording(Stream(t[:1], np.array([[0.5, 0.5]])), Stream(t, pose)), spec
    )
    chosen = select_windows(driven, Calibration(), 1.0, 10.0, 5.0, 0.1)
    assert estimate_twists_at(driven, chosen.start_t) == pytest.approx(
        np.tile([0.5, 0.0, 0.5], (len(chosen.start_t), 1)), abs=1e-3
    )
    assert share(predict_kept_twist(driven, chosen), chosen) < 1e-3


def test_a_drive_too_short_to_learn_from_is_refused():
    spec = load_robot("differential")
    with pytest.raises(
        RecordingError, match="contain no window of 5 s; record a longer drive"
    ):
        fit_yardstick(Drive(drive(spec, duration=6.0), spec), 4.0)


@pytest.mark.parametrize("values", [0.0, 1e-3])
def test_a_robot_that_never_moved_has_one_too(values):
    spec = load_robot("ackermann")
    still = drive(spec, duration=20.0)
    pose = values * np.random.default_rng(0).normal(size=still.pose.values.shape)
    driven = Drive(with_values(still, pose=pose), spec)
    chosen = select_windows(driven, Calibration(), 5.0, 20.0, 5.0, 0.5)
    assert np.isfinite(fit_yardstick(driven, LEARNT_S).predict(driven, chosen)).all()
