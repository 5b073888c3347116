"""Terms that a model may have, and the order of robots whose states follow the commands."""

from __future__ import annotations

import numpy as np
import pytest

from identify.drives import make_model, slipping_car, throttle_car, tricycle
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import resample_drive
from nics_drl_bridge.identify.identify import STAGES, fit_terms, run
from nics_drl_bridge.identify.terms import (
    Kind,
    Library,
    fit_motion_terms,
    has_slipping_tyres,
    list_reversed_variables,
    select_motion_terms,
    select_terms_through_state,
    select_textbook_terms,
    share_effects,
)
from nics_drl_bridge.recording.recording import Samples, samples_on_one_clock
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec, build_robot


def test_a_textbook_of_a_front_driven_tricycle_is_expanded_with_its_trim():
    spec = tricycle()
    powers = taylor.list_exponents(4, 4)
    allowed = select_terms_through_state(powers, spec, centred=True, by_book=True)
    names = np.array([taylor.format_term(row, spec.variable_names) for row in powers])
    along, across, turn = ({*names[row]} for row in allowed[:3])
    assert along == {"speed", "speed*steering^2"}
    assert across == set()
    assert turn == {"speed", "speed*steering", "speed*steering^3"}


def test_a_variable_that_never_moved_is_a_factor_of_the_textbooks_terms():
    spec = tricycle()
    powers = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0], [0, 0, 1, 0]])
    allowed = select_terms_through_state(powers, spec, centred=True, by_book=True)
    assert allowed[:3].tolist() == [
        [False, True, False, False],
        [False, False, False, False],
        [False, True, False, False],
    ]


def test_lateral_motion_is_kept_where_a_state_measures_it():
    spec = tricycle()
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.5, 0.5, (400, 4))
    dq = np.stack([x[:, 0], 0.3 * x[:, 1], x[:, 0] * x[:, 1], *x[:, 2:].T], axis=1)
    t = 0.01 * np.arange(400)
    samples = Samples(t, np.zeros((400, 5)), x, dq, 0.01)
    plain = Library(spec, Kind.MEASURED, True, 1.0, 2).fit(samples, 2).model
    assert not plain.coefficients[1].any()
    speed, steering = spec.state
    slip = steering.model_copy(update={"twist": "vy", "follows": None, "unit": "m/s"})
    slides = spec.model_copy(update={"state": (speed, slip)})
    kept = Library(slides, Kind.MEASURED, True, 1.0, 2).fit(samples, 2).model
    assert kept.coefficients[1].any()


def test_a_mirror_leaves_even_terms_along_x_and_odd_ones_across():
    spec = tricycle()
    powers = taylor.list_exponents(4, 4)
    allowed = select_terms_through_state(powers, spec, centred=True)
    names = [taylor.format_term(row, spec.variable_names) for row in powers]
    along, across = (
        [n for n, each in zip(names, allowed[d], strict=True) if each] for d in (0, 2)
    )
    assert "speed*steering^2" in along
    assert "speed*steering" not in along
    assert {"speed", "speed*steering", "speed*steering^3"} <= set(across)
    assert "speed*steering^2" not in across
    assert not any("command" in name for name in along + across)
    sided = select_terms_through_state(powers, spec, centred=False)
    assert sided[0][names.index("speed*steering")]


def test_a_mirror_turns_the_steering_and_what_it_moves_aside():
    spec = throttle_car()
    assert list_reversed_variables(spec) == ("vy", "wz", "steering")


def test_the_twist_of_a_car_follows_its_commands_and_with_tyres_its_lateral_acceleration():
    spec = throttle_car()
    powers = taylor.list_exponents(len(spec.variable_names), 3)

    def terms(dof: str, **given: object) -> set[str]:
        allowed = select_textbook_terms(powers, spec, **given)[
            spec.dof_names.index(dof)
        ]
        return {taylor.format_term(row, spec.variable_names) for row in powers[allowed]}

    assert terms("d_vx") == {"vx", "throttle"}
    assert terms("d_vx", held=("throttle",)) == {"1", "vx", "throttle"}
    assert terms("d_wz") == {"vx", "wz", "vx*steering"}
    assert terms("d_wz", tyres=True) - terms("d_wz") == {"vx^2*wz"}
    assert terms("d_vy", tyres=True) == {"vy", "vx^2*wz"}


def test_only_cars_that_steer_in_front_slip_by_their_tyres(differential):
    spec = throttle_car()
    assert has_slipping_tyres(spec)
    assert not has_slipping_tyres(differential)
    assert not has_slipping_tyres(tricycle())


@pytest.fixture(scope="module")
def held_throttle() -> tuple[RobotSpec, Samples]:
    """A robot, and samples of its motion under one throttle."""
    spec, recording = slipping_car(throttle=0.25, friction=0.0, duration=20.0)
    found = run(STAGES[: STAGES.index(fit_terms)], Drive(recording, spec))
    return spec, resample_drive(found.training, found)


@pytest.mark.slow
def test_a_command_held_at_one_value_pushes_as_a_constant(held_throttle):
    spec, samples = held_throttle
    model = fit_motion_terms(samples, spec, 3, select_textbook_terms).model
    assert model.rates(np.zeros(5))[3] == pytest.approx(9.0 * 0.15, rel=0.2)
    steered = model.rates([0.0, 0, 0, 0, 0.5])[5]
    assert steered == pytest.approx(0.0, abs=0.1)  # it steers only


@pytest.mark.slow
def test_a_speed_that_never_changed_is_a_constant_of_the_twist(held_throttle):
    spec, samples = held_throttle
    steady = samples.rows(samples.t > samples.t[0] + 10.0)
    steady.x[:, :2] = 2.0, 0.0
    model = fit_motion_terms(steady, spec, 3, select_textbook_terms).model
    assert model.rates(np.zeros(5))[:3] == pytest.approx([2.0, 0.0, 0.0])
    turning = model.rates([0.0, 0.0, 0.0, 0.25, 0.5])
    assert turning[3] == 0.0
    assert turning[5] > 1.0


def test_a_wheel_that_was_held_drives_and_turns_as_a_constant():
    two = {"kind": "differential_wheels", "footprint_radius": 0.3, "state": []}
    limits = dict.fromkeys(("left_wheel", "right_wheel"), (-9.0, 9.0))
    spec = build_robot(two, limits)
    assert list_reversed_variables(spec) is None  # a mirror exchanges the wheels
    powers = taylor.list_exponents(2, 1)
    constant = (powers == 0).all(axis=1)
    assert not select_motion_terms(powers, spec)[:, constant].any()
    assert select_motion_terms(powers, spec, held=("left_wheel",))[:, constant].all()


def test_wheels_that_always_move_together_share_what_they_do():
    four = {"kind": "mecanum", "footprint_radius": 0.4, "state": []}
    names = ("front_left", "front_right", "rear_left", "rear_right")
    spec = build_robot(
        four, dict.fromkeys((f"{name}_wheel" for name in names), (-9.0, 9.0))
    )
    rng = np.random.default_rng(2)
    three = rng.uniform(-8.0, 8.0, (400, 3))
    wheels = np.column_stack([three, three[:, 0] + three[:, 1] - three[:, 2]])[
        :, [0, 2, 3, 1]
    ]
    # the last wheel does nothing
    acting = spec.variable_names[:3]
    terms = {
        dof: dict(zip(acting, rng.normal(size=3), strict=True))
        for dof in spec.dof_names
    }
    alone = make_model(spec, terms, dt=0.05)
    still = np.zeros((400, 3))
    samples = samples_on_one_clock(0.05 * np.arange(400), still, still[:, :0], wheels)
    model = share_effects(alone, spec, samples)
    assert model.rates(wheels) == pytest.approx(alone.rates(wheels))
    assert (
        model.coefficients @ model.powers @ [1.0, -1.0, -1.0, 1.0]
    ) == pytest.approx(0.0)
    assert np.abs(model.coefficients).min() > 0.0
