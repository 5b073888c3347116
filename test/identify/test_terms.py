"""The order of robots whose states follow the commands and were not measured."""

from __future__ import annotations

import numpy as np
import pytest

from identify.drives import MOTOR, servoed, tricycle
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive, Settings
from nics_drl_bridge.identify.identify import STAGES, Identified, complete, identify, run
from nics_drl_bridge.identify.terms import through_state
from nics_drl_bridge.robot import taylor

BASE = 0.9


def car_like(state):
    speed, angle = state.T
    return np.stack([speed, 0.0 * speed, speed * np.tan(angle) / BASE], axis=1)


def share(found: Identified) -> float:
    assert found.held_out is not None
    return found.held_out.mean_position_error_m / found.held_out.mean_path_m


def off(calibration: Calibration, mounting: tuple[float, float, float]) -> np.ndarray:
    """Errors of the mounting in its own standard errors."""
    x, y, heading = mounting
    names = ("lever_arm_x_m", "lever_arm_y_m", "rotation_rad")
    sigma = [max(calibration.uncertainty[name], 1e-4) for name in names]
    return (
        np.array([*calibration.lever_arm_m, calibration.rotation_rad]) - [x, y, -heading]
    ) / sigma


@pytest.mark.slow
def test_a_tricycle_that_steers_far_gets_its_order_and_mounting_by_itself():
    found = identify(servoed(), tricycle(), alpha="auto")
    trials = found.findings.trials
    assert [trial.order for trial in trials] == [2, 3, 4]
    assert trials[0].error > 3.0 * trials[2].error
    assert any("The model has terms up to order 4" in note for note in found.notes)
    assert found.model.powers.sum(axis=1).max() >= 3
    assert share(found) < 0.02
    assert np.abs(off(found.calibration, (0.25, 0.12, 0.5))).max() < 3.0
    assert found.calibration.command_latency_s == pytest.approx(0.1, abs=0.005)


@pytest.mark.slow
def test_a_car_that_steers_little_keeps_the_second_order():
    recording = servoed(car_like, seed=2, steering=0.15, steering_servo=MOTOR, duration=40.0)
    found = identify(recording, tricycle(), alpha="auto")
    assert found.model.powers.sum(axis=1).max() == 2
    assert share(found) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_a_dead_zone_is_not_taken_for_a_mounting(seed):
    mounting = (0.0, 0.0, 0.0)
    recording = servoed(seed=seed, dead=0.15, steering=0.5, mounting=mounting, duration=40.0)
    settings = Settings(order=2, alpha="auto", train_until_s=40.0)
    found = run(STAGES[: STAGES.index(complete)], Drive(recording, tricycle(), settings))
    assert np.abs(off(found.calibration, mounting)).max() < 3.0
    assert found.calibration.rotation_rad == pytest.approx(0.0, abs=0.003)


def test_a_mirror_leaves_even_terms_along_x_and_odd_ones_across():
    spec = tricycle()
    powers = taylor.exponents(4, 4)
    allowed = through_state(powers, spec, centred=True)
    names = [taylor.term_name(row, spec.variable_names) for row in powers]
    along, across = ([n for n, each in zip(names, allowed[d], strict=True) if each] for d in (0, 2))
    assert "speed*steering^2" in along
    assert "speed*steering" not in along
    assert {"speed", "speed*steering", "speed*steering^3"} <= set(across)
    assert "speed*steering^2" not in across
    assert not any("command" in name for name in along + across)
    sided = through_state(powers, spec, centred=False)
    assert sided[0][names.index("speed*steering")]
